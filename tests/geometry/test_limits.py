"""The number of triangles is told before a file is read, and too many are refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import trimesh

from igps.geometry import limits
from igps.geometry.limits import available_memory, check_memory, expected_faces
from igps.geometry.mesh import MeshError


@pytest.mark.parametrize("kind", ["off", "ply", "stl"])
def test_announced_numbers(tmp_path: Path, kind: str) -> None:
    surface = trimesh.creation.icosphere(subdivisions=4)
    surface.export(tmp_path / f"ball.{kind}")
    assert expected_faces(tmp_path / f"ball.{kind}") == len(surface.faces)


@pytest.mark.parametrize("name", ["ball.obj", "ball_ascii.stl"])
def test_numbers_from_the_size(tmp_path: Path, name: str) -> None:
    surface = trimesh.creation.icosphere(subdivisions=5)
    kind = "stl_ascii" if "ascii" in name else None
    surface.export(tmp_path / name, file_type=kind)
    assert 0.5 < expected_faces(tmp_path / name) / len(surface.faces) < 3


def test_headers_with_comments_and_lies(tmp_path: Path) -> None:
    file = tmp_path / "a.off"
    file.write_text("OFF\n# made by hand\n8 12 0\n" + "0 0 0\n" * 8)
    assert expected_faces(file) == 12
    file.write_text("OFF 8 12 0\n" + "0 0 0\n" * 8)
    assert expected_faces(file) == 12
    file.write_text("OFF\n8 99999999999 0\n")
    assert expected_faces(file) < 20
    file.write_text("nonsense\n")
    assert expected_faces(file) == 0


@pytest.mark.parametrize("limit", ["RLIMIT_AS", "RLIMIT_DATA"])
def test_ten_million_triangles_in_two_gibibytes(tmp_path: Path, limit: str) -> None:
    file = tmp_path / "huge.stl"
    with file.open("wb") as stream:  # a sparse file: only its head is on the disk
        stream.write(bytes(80) + (10_000_000).to_bytes(4, "little"))
        stream.truncate(84 + 50 * 10_000_000)
    program = (
        "import resource, sys; from pathlib import Path; from igps.geometry.limits import check_memory\n"
        "resource.setrlimit(getattr(resource, sys.argv[2]), (2 << 30, 2 << 30))\n"
        "check_memory(Path(sys.argv[1]))"
    )
    pytest.importorskip("resource")
    words = [sys.executable, "-c", program, str(file), limit]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    message = done.stderr.strip().splitlines()[-1]
    assert "huge.stl: about 10,000,000 triangles need 10.0 GB" in message
    assert "Simplify" in message


@pytest.mark.parametrize(
    ("limit", "used", "cached"),
    [("memory.max", "memory.current", "inactive_file"),
     ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")],
)  # fmt: skip
def test_files_that_a_group_has_read_are_free_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, used: str, cached: str
) -> None:
    monkeypatch.setattr(limits, "_GROUPS", ((tmp_path, limit, used, cached),))
    monkeypatch.setattr(limits, "_of_limits", lambda: None)
    monkeypatch.setattr(limits, "_of_machine", lambda: None)
    (tmp_path / used).write_text("900\n")
    assert available_memory() is None
    (tmp_path / limit).write_text("max\n")
    assert available_memory() is None
    (tmp_path / limit).write_text("1000\n")
    assert available_memory() == 100
    (tmp_path / "memory.stat").write_text(f"anon 50\nfile 800\nsome_{cached} 3\n{cached} 700\nslab 9\n")
    assert available_memory() == 800


def test_what_fits_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "ball.off"
    trimesh.creation.icosphere(subdivisions=6).export(file)
    check_memory(file)
    monkeypatch.setattr(limits, "available_memory", lambda: 1000)
    with pytest.raises(MeshError, match=r"ball\.off: about 81,920 triangles"):
        check_memory(file)
    monkeypatch.setattr(limits, "available_memory", lambda: None)
    check_memory(file)


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="the system does not tell")
def test_some_memory_is_available() -> None:
    free = available_memory()
    assert free is not None
    assert 0 < free < 1 << 50
