"""The imports run one way: each room uses only the floors below its own; the lowest know nothing of igps."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import igps

PACKAGE = Path(igps.__file__).parent
# From the ground up. A room imports only from the floors below its own, and itself; a new room is one more name here.
FLOORS = (
    ("_arrays", "_failures", "_files", "_parameters", "_threads", "_compiled"),
    ("_workers",),
    ("_parallel", "spectra", "retrieval"),
    ("mesh",),
    ("fields",),
    ("signature",),
    ("shapes",),
    ("data",),
    ("nn",),
    ("descriptors",),
    ("learning",),
    ("gallery",),
    ("duplicates",),
    ("analysis",),
    ("report",),
    ("cli", "sklearn"),
)
# Rooms that are one file.
FILES = (
    "_arrays",
    "_compiled",
    "_failures",
    "_files",
    "_parallel",
    "_parameters",
    "_threads",
    "_workers",
    "sklearn",
)


def imported_rooms(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        rooms |= {name.split(".")[1] for name in names if name.startswith("igps.")}
    return rooms


@pytest.mark.parametrize(
    ("floor", "room"), [(floor, room) for floor, rooms in enumerate(FLOORS) for room in rooms]
)
def test_imports_run_one_way(floor: int, room: str) -> None:
    below = {name for rooms in FLOORS[:floor] for name in rooms}
    files = [PACKAGE / f"{room}.py"] if room in FILES else sorted((PACKAGE / room).rglob("*.py"))
    assert files
    for file in files:
        assert imported_rooms(file) <= {room} | below, file


def test_every_room_has_its_floor() -> None:
    rooms = {file.parent.name for file in PACKAGE.glob("*/__init__.py")}
    files = {file.stem for file in PACKAGE.glob("*.py")} - {"__init__"}
    assert files == set(FILES)
    assert rooms | files == {room for rooms in FLOORS for room in rooms}


def test_nobody_enters_by_the_front_door() -> None:
    """`import igps` inside the package would be a ring: rooms name the rooms they use."""
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                assert "igps" not in [alias.name for alias in node.names], file
            if isinstance(node, ast.ImportFrom):
                assert not node.level, file
                if node.module == "igps":
                    assert all((PACKAGE / alias.name).is_dir() for alias in node.names), file


def test_a_wrong_arrow_would_be_seen(tmp_path: Path) -> None:
    source = "from igps.cli.demo import demo\nimport igps.nn.axes as axes\nfrom igps import data\nimport numpy\n"
    (tmp_path / "room.py").write_text(source)
    assert imported_rooms(tmp_path / "room.py") == {"cli", "nn", "data"}
