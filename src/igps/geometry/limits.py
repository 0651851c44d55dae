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
# Of a control group: the folder, its limit, what it uses, and in memory.stat what of that is files that were read and
# may be forgotten at any time.
_GROUPS = (
    (Path("/sys/fs/cgroup"), "memory.max", "memory.current", "inactive_file"),
    (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)


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
    left = []
    # Address space, and of that what can be written, which a memory limit of `igps.parallel` bounds.
    for kind, column in ((resource.RLIMIT_AS, 0), (resource.RLIMIT_DATA, 5)):
        limit, _ = resource.getrlimit(kind)
        pages = _number(Path("/proc/self/statm"), column)
        if limit != resource.RLIM_INFINITY and pages is not None:
            left.append(limit - pages * resource.getpagesize())
    return min(left, default=None)


def _of_group() -> int | None:
    for folder, limit, used, cached in _GROUPS:
        most, current = _number(folder / limit), _number(folder / used)
        if most is not None and current is not None:
            return most - current + (_named_number(folder / "memory.stat", cached) or 0)
    return None


def _of_machine() -> int | None:
    kilobytes = _named_number(Path("/proc/meminfo"), "MemAvailable:")
    return None if kilobytes is None else kilobytes * 1024


def _number(path: Path, column: int = 0) -> int | None:
    """A number of the first line of a file; None if there is none."""
    try:
        return int(path.read_text().split()[column])
    except (OSError, ValueError, IndexError):
        return None


def _named_number(path: Path, name: str) -> int | None:
    """The number after a name at the start of a line; None if there is none."""
    try:
        line = re.search(rf"^{re.escape(name)}\s+(\d+)", path.read_text(), re.MULTILINE)
    except OSError:
        return None
    return int(line[1]) if line else None
