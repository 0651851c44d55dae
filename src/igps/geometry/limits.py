"""Whether a file fits into memory, told from its first lines before it is read."""

from __future__ import annotations

import re
from pathlib import Path

from igps.geometry.mesh import MeshError

# What reading and mending took of each triangle at most (OFF, OBJ, STL and PLY of 330,000 triangles).
_BYTES_PER_FACE = 1000
# What a triangle takes in a file whose first lines do not tell the number: OBJ, and text STL.
_OBJ_BYTES, _TEXT_STL_BYTES = 35, 200
# A file so small is not looked at.
_SMALL = 1 << 20


def check_memory(path: Path) -> None:
    """Refuse a file whose triangles need more memory than the process may still have.

    Raises:
        MeshError: names the file, its number of triangles, both amounts, and the remedy.
    """
    if path.stat().st_size < _SMALL:
        return
    n_faces = expected_faces(path)
    needed, free = n_faces * _BYTES_PER_FACE, available_memory()
    if free is not None and needed > free:
        raise MeshError(
            f"{path}: about {n_faces:,} triangles need {needed / 1e9:.1f} GB of memory, and "
            f"{max(free, 0) / 1e9:.1f} GB are free. "
            "Simplify the mesh in a program that streams it, or give the process more memory."
        )


def expected_faces(path: Path) -> int:
    """The number of triangles that a mesh file announces, or, where it announces none, that its size allows for."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(4096)
    kind = path.suffix.lower()
    announced: int | None = None
    if kind == ".off":
        counts = re.match(rb"\s*(?:[A-Z4n]*OFF)?\s*(?:#[^\n]*\n\s*)*(\d+)\s+(\d+)", head)
        announced = int(counts[2]) if counts else None
    elif kind == ".ply":
        element = re.search(rb"element\s+face\s+(\d+)", head)
        announced = int(element[1]) if element else None
    elif kind == ".stl":
        count = int.from_bytes(head[80:84], "little")
        announced = count if size == 84 + 50 * count else size // _TEXT_STL_BYTES
    # A damaged header may announce anything; no format holds a triangle in less than two bytes.
    return size // _OBJ_BYTES if announced is None else min(announced, size // 2)


def available_memory() -> int | None:
    """Bytes that the process may still take: of its own limits, its control group's and the machine's, the least.

    None where the system does not tell.
    """
    found = [value for value in (_of_limits(), _of_group(), _of_machine()) if value is not None]
    return min(found, default=None)


def _of_limits() -> int | None:
    try:
        import resource
    except ImportError:  # there are none on Windows
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    used = _first_number(Path("/proc/self/statm"))
    if limit == resource.RLIM_INFINITY or used is None:
        return None
    return limit - used * resource.getpagesize()


def _of_group() -> int | None:
    for limit, used in (
        ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
        ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ):
        most, current = _first_number(Path(limit)), _first_number(Path(used))
        if most is not None and current is not None:
            return most - current
    return None


def _of_machine() -> int | None:
    try:
        line = re.search(r"MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text())
    except OSError:
        return None
    return int(line[1]) * 1024 if line else None


def _first_number(path: Path) -> int | None:
    try:
        return int(path.read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return None
