"""Whether a file, or a grid in a body, fits into memory, told before it takes any."""

from __future__ import annotations

import re
from pathlib import Path

from igps.mesh.mesh import MeshError

# What reading and mending took of each triangle at most (OFF, OBJ, STL and PLY of 330,000 triangles).
_BYTES_PER_FACE = 1000
# What a triangle takes in a file whose first lines do not tell the number: OBJ, and text STL.
_OBJ_BYTES, _TEXT_STL_BYTES = 35, 200
# What a cell of a grid takes while it is told whether it is inside.
_BYTES_PER_CELL = 40
# A file so small is not looked at, nor a grid that takes so little.
_SMALL, _SMALL_GRID = 1 << 20, 1 << 26


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


def check_grid(n_cells: int, name: str) -> None:
    """Refuse a grid whose cells need more memory than the process may still have.

    Raises:
        MeshError: names the mesh, the number of cells, both amounts, and the remedy.
    """
    needed = n_cells * _BYTES_PER_CELL
    if needed < _SMALL_GRID:
        return
    free = available_memory()
    if free is not None and needed > free:
        raise MeshError(
            f"{name}: a grid of {n_cells:,} cells needs {needed / 1e9:.1f} GB of memory, and {max(free, 0) / 1e9:.1f} "
            "GB are free. Lower the resolution or min_samples, use fewer workers, or give the process more memory."
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
    # Of the address space, and of data alone, which is what `igps._parallel` bounds.
    for kind, column in ((resource.RLIMIT_AS, 0), (resource.RLIMIT_DATA, 5)):
        limit, _ = resource.getrlimit(kind)
        pages = _number(Path("/proc/self/statm"), column)
        if limit != resource.RLIM_INFINITY and pages is not None:
            left.append(limit - pages * resource.getpagesize())
    return min(left, default=None)


def _of_group(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> int | None:
    """The least of the process's control group and those around it, of either version of the kernel's interface."""
    try:
        lines = [line.split(":", 2) for line in own.read_text().splitlines()]
    except OSError:
        lines = []
    found = []
    for mount, limit, usage, cache, controller in (
        (root, "memory.max", "memory.current", "inactive_file", ""),
        (root / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file", "memory"),
    ):
        paths = [line[2].strip("/") for line in lines if len(line) == 3 and controller in line[1].split(",")]
        # A container may see its own group as the root, whatever the path says.
        for folder in {place for path in ["", *paths] for place in (mount / path, *(mount / path).parents)}:
            most, current = _number(folder / limit), _number(folder / usage)
            if most is not None and current is not None:
                # Files that were read stay in memory as long as nobody else wants it.
                found.append(most - current + (_named_number(folder / "memory.stat", cache) or 0))
    return min(found, default=None)


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
