"""The imports run one way, without circles; and the core runs with the rooms around it taken away."""

import ast
import shutil
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import igps

PACKAGE = Path(igps.__file__).parent
# From the ground up. A room imports only from the floors below its own, and itself; a new room is one more name here.
FLOORS = (
    (
        "_arrays",
        "failures",
        "_files",
        "_parameters",
        "_tensors",
        "_progress",
        "_text",
        "_threads",
        "_compiled",
    ),
    ("_workers",),
    ("_parallel", "spectra", "retrieval"),
    ("mesh",),
    ("signature",),
    ("shapes",),
    ("data",),
    ("nn",),
    ("descriptors",),
    ("learning",),
    ("fields",),
    ("gallery",),
    ("duplicates",),
    ("analysis",),
    ("report",),
    ("cli", "monai", "sklearn"),
)
# The rooms around the core, each of which can be taken away.
AROUND = ("fields", "analysis", "gallery", "duplicates", "report", "cli")
# Rooms that are one file.
FILES = {room for room in sum(FLOORS, ()) if (PACKAGE / f"{room}.py").exists()}


def imported_names(path):
    """Return what a file imports anywhere, also within functions, as modules or as names in them."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


def imported_rooms(path):
    return {name.split(".")[1] for name in imported_names(path) if name.startswith("igps.")}


def import_graph(root):
    """Return the modules of a package by name, and the modules that each imports."""
    files = {}
    for file in sorted(root.rglob("*.py")):
        parts = file.relative_to(root.parent).with_suffix("").parts
        files[".".join(parts).removesuffix(".__init__")] = file
    graph = {}
    for name, file in files.items():
        imported = imported_names(file)
        modules = imported & set(files)
        # In `from package import module`, the package only leads to the module.
        packages = {module.rpartition(".")[0] for module in modules}
        has_names = {one.rpartition(".")[0] for one in imported - modules}
        graph[name] = {one for one in modules if one not in packages or one in has_names} - {name}
    return graph


def circle(root):
    try:
        TopologicalSorter(import_graph(root)).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


@pytest.mark.parametrize(
    ("floor", "room"), [(floor, room) for floor, rooms in enumerate(FLOORS) for room in rooms]
)
def test_imports_run_one_way(floor, room):
    below = {name for rooms in FLOORS[:floor] for name in rooms}
    files = [PACKAGE / f"{room}.py"] if room in FILES else sorted((PACKAGE / room).rglob("*.py"))
    assert files
    for file in files:
        assert imported_rooms(file) <= {room} | below, file


def test_every_room_has_its_floor():
    rooms = {file.parent.name for file in PACKAGE.glob("*/__init__.py")}
    files = {file.stem for file in PACKAGE.glob("*.py")} - {"__init__", "__main__"}
    assert files == FILES
    assert rooms | files == {room for rooms in FLOORS for room in rooms}


def test_nobody_enters_by_the_front_door():
    """`import igps` inside the package would be a ring: rooms name the rooms they use."""
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                assert "igps" not in [alias.name for alias in node.names], file
            if isinstance(node, ast.ImportFrom):
                assert not node.level, file
                if node.module == "igps":
                    assert all((PACKAGE / alias.name).is_dir() for alias in node.names), file


def test_a_wrong_arrow_would_be_seen(tmp_path):
    source = "from igps.cli import main\nimport igps.nn.axes as axes\nfrom igps import data\nimport numpy\n"
    (tmp_path / "room.py").write_text(source)
    assert imported_rooms(tmp_path / "room.py") == {"cli", "nn", "data"}


def test_no_module_imports_itself_by_way_of_others():
    assert circle(PACKAGE) == []


def test_a_circle_would_be_seen_even_if_an_import_is_deferred(tmp_path):
    package = tmp_path / "house"
    package.mkdir()
    (package / "__init__.py").write_text("from house import first\n")
    (package / "first.py").write_text("from house import second\n")
    (package / "second.py").write_text("def later():\n    from house.first import x\n")
    assert set(circle(package)) == {"house.first", "house.second"}
    (package / "second.py").write_text("import house.third\n")
    assert circle(package) == []


CORE = """
import sys
import numpy as np
import torch
import trimesh
from igps.descriptors import descriptor
from igps.data.collation import collate
from igps.mesh.mesh import Mesh
from igps.nn.heads import WhitenedHead
from igps.retrieval import chi_square
from igps.signature.signature import SignatureConfig, compute_signature

interior = descriptor("interior")
few = SignatureConfig(resolution=12, n_surface_samples=100, min_samples=0)
config = interior.requirements.apply_to(few)
signatures = []
for sides in ((1, 1, 1), (1, 1, 1.1), (1, 2, 4), (1, 2, 4.4)):
    box = trimesh.creation.box(sides).subdivide().subdivide().subdivide()
    mesh = Mesh(np.array(box.vertices), np.array(box.faces))
    signatures.append(compute_signature(mesh, config))
batch = collate(signatures)
with torch.no_grad():
    histograms = interior(batch)
distances = chi_square(histograms, histograms)
head = WhitenedHead().fit(histograms, torch.tensor([0, 0, 1, 1]))
fitted = head.distances(head(histograms), head(histograms))
assert distances[0, 1] < distances[0, 2], distances
assert fitted[0, 1] < fitted[0, 2], fitted
print(*sorted(name for name in sys.modules if name.startswith("igps.")))
"""


def test_the_core_runs_without_the_rooms_around_it(tmp_path):
    """From the arrays of a mesh to a signature, a histogram, a distance and a fitted head.

    Loops that are compiled come along.
    """
    ignored = shutil.ignore_patterns("*.pyc", *AROUND)
    shutil.copytree(PACKAGE, tmp_path / "igps", ignore=ignored)
    for room in AROUND:
        assert not (tmp_path / "igps" / room).exists()
    command = [sys.executable, "-c", CORE]
    environment = {"PYTHONPATH": str(tmp_path), "PATH": "", "OMP_NUM_THREADS": "1"}
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert str(tmp_path) not in run.stderr
    assert "igps.signature.signature" in run.stdout.split()
