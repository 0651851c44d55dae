"""The number of triangles is told before a file is read, and too many are refused."""

import subprocess
import sys
from pathlib import Path

import pytest
from trimesh.creation import icosphere

from igps.mesh import limits
from igps.mesh.errors import MeshError
from igps.mesh.limits import available_memory, expected_faces
from igps.mesh.mesh import Mesh
from igps.signature.voxels import interior_samples


@pytest.mark.parametrize("kind", ["off", "ply", "stl"])
def test_announced_numbers(tmp_path, kind):
    surface = icosphere(subdivisions=4)
    surface.export(tmp_path / f"ball.{kind}")
    assert expected_faces(tmp_path / f"ball.{kind}") == len(surface.faces)


@pytest.mark.parametrize("name", ["ball.obj", "ball_ascii.stl"])
def test_numbers_from_the_size(tmp_path, name):
    surface = icosphere(subdivisions=5)
    kind = "stl_ascii" if "ascii" in name else None
    surface.export(tmp_path / name, file_type=kind)
    assert 0.5 < expected_faces(tmp_path / name) / len(surface.faces) < 3


def test_headers_with_comments_and_lies(tmp_path):
    file = tmp_path / "a.off"
    file.write_text("OFF\n# made by hand\n8 12 0\n" + "0 0 0\n" * 8)
    assert expected_faces(file) == 12
    file.write_text("OFF 8 12 0\n" + "0 0 0\n" * 8)
    assert expected_faces(file) == 12
    file.write_text("OFF\n8 99999999999 0\n")
    assert expected_faces(file) < 20
    file.write_text("nonsense\n")
    assert expected_faces(file) == 0


def under_limits(program, most, *words):
    """What a program says under a limit of the address space, and then of data alone, in a process of its own."""
    pytest.importorskip("resource")
    lines = [
        "import resource, sys; from pathlib import Path; from igps.mesh.limits import available_memory, check_memory",
        "for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA):",
        "    before, (soft, hard) = available_memory(), resource.getrlimit(kind)",
        f"    resource.setrlimit(kind, ({most}, hard))",
        *(f"    {line}" for line in program.splitlines()),
        "    resource.setrlimit(kind, (soft, hard))",
    ]
    command = [sys.executable, "-c", "\n".join(lines), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout.splitlines()


def test_ten_million_triangles_in_two_gibibytes(tmp_path):
    file = tmp_path / "huge.stl"
    with file.open("wb") as stream:  # a sparse file: only its head is on the disk
        stream.write(bytes(80) + (10_000_000).to_bytes(4, "little"))
        stream.truncate(84 + 50 * 10_000_000)
    program = (
        "try:\n    check_memory(Path(sys.argv[1]))\nexcept ValueError as error:\n    print(error)"
    )
    messages = under_limits(program, 2 << 30, str(file))
    assert len(messages) == 2
    for message in messages:
        assert "huge.stl: about 10,000,000 triangles need 10.0 GB" in message
        assert "Simplify" in message


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="the system does not tell")
def test_some_memory_is_available():
    free = available_memory()
    assert free is not None
    assert 0 < free < 1 << 50


def group(folder, most, used, cached):
    """Files of a control group."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "memory.max").write_text(f"{most}\n")
    (folder / "memory.current").write_text(f"{used}\n")
    (folder / "memory.stat").write_text(
        f"active_file 7\nsome_inactive_file 3\ninactive_file {cached}\n"
    )


def test_the_groups_around_a_process_bound_its_memory(tmp_path):
    own = tmp_path / "own"
    root = tmp_path / "groups"
    own.write_text("0::/job/step\n")
    assert limits._memory_in_groups(root, own) is None
    group(root / "job" / "step", "max", 300, 0)
    assert limits._memory_in_groups(root, own) is None
    group(root / "job", 1000, 400, 150)  # of all steps together; files that were read can go
    assert limits._memory_in_groups(root, own) == 1000 - 400 + 150
    group(root / "job" / "step", 500, 300, 0)
    assert limits._memory_in_groups(root, own) == 200


def test_a_container_has_its_group_as_the_root(tmp_path):
    own = tmp_path / "own"
    root = tmp_path / "groups"
    own.write_text("0::/docker/0815\n")
    group(root, 2000, 1500, 100)
    assert limits._memory_in_groups(root, own) == 600
    group(root / "docker" / "0815", 1000, 900, 0)
    assert limits._memory_in_groups(root, own) == 100
    assert limits._memory_in_groups(tmp_path / "nowhere", tmp_path / "nothing") is None


def test_the_limits_of_the_process_bound_its_memory():
    program = (
        "assert before is None or 0 < available_memory() <= min(before, 1 << 33) + (1 << 26)\n"
        "block = bytearray(1 << 29)\n"
        "assert available_memory() < (1 << 33) - (1 << 29)\n"
        "del block; print('bounded')"
    )
    assert under_limits(program, 1 << 33) == ["bounded", "bounded"]


def test_a_grid_that_does_not_fit_is_refused(monkeypatch):
    ball = icosphere(subdivisions=2)
    mesh = Mesh(ball.vertices, ball.faces, name="ball")
    free = 100 * 2**20
    monkeypatch.setattr(limits, "available_memory", lambda: free)
    assert len(interior_samples(mesh, 100)) > 100_000  # 40 MB
    with pytest.raises(
        MeshError,
        match=r"ball: a grid of 8,000,000 cells needs 0\.3 GB of memory, and 0\.1 GB are free",
    ):
        interior_samples(mesh, 200)
    # Nor is a grid refined into what does not fit.
    with pytest.raises(MeshError, match="use fewer workers"):
        interior_samples(mesh, 60, min_samples=3_000_000)
    free = 10**10
    assert len(interior_samples(mesh, 150)) > 10**6
