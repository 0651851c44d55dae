"""Whether a file, or a grid in a body, fits into memory, checked before any is taken."""

import re
from pathlib import Path

from igps.mesh.mesh import MeshError

# Memory for reading and mending, at most, for each triangle (OFF, OBJ, STL and PLY of 330,000 triangles).
_BYTES_PER_FACE = 1000
# Size of a triangle in files that do not begin with their number: OBJ, and text STL.
_OBJ_BYTES, _TEXT_STL_BYTES = 35, 200
# Memory for each cell of a grid while the cells inside are found.
_BYTES_PER_CELL = 40
# Smaller files and grids are not checked.
_SMALL, _SMALL_GRID = 1 << 20, 1 << 26


def check_memory(path: Path) -> None:
    """Raise a MeshError for a file whose triangles need more memory than the process may still have."""
    if path.stat().st_size >= _SMALL:
        n_faces = expected_faces(path)
        remedy = "Simplify the mesh in a program that streams it, or give the process more memory."
        check_fits(n_faces * _BYTES_PER_FACE, f"{path}: about {n_faces:,} triangles need", remedy)


def check_grid(n_cells: int, name: str) -> None:
    """Raise a MeshError for a grid whose cells need more memory than the process may still have."""
    if n_cells * _BYTES_PER_CELL >= _SMALL_GRID:
        remedy = "Lower the resolution or min_samples, use fewer workers, or give the process more memory."
        check_fits(n_cells * _BYTES_PER_CELL, f"{name}: a grid of {n_cells:,} cells needs", remedy)


def check_fits(n_bytes: int, subject: str, remedy: str) -> None:
    """Raise a MeshError, "SUBJECT so many GB of memory, and ... REMEDY", if the process may not take so many bytes."""
    free = available_memory()
    if free is not None and n_bytes > free:
        needed = f"{n_bytes / 1e9:,.1f} GB of memory"
        raise MeshError(f"{subject} {needed}, and {max(free, 0) / 1e9:.1f} GB are free. {remedy}")


def expected_faces(path: Path) -> int:
    """The number of triangles that a mesh file announces, or, where it announces none, that its size allows for."""
    size, kind = path.stat().st_size, path.suffix.lower()
    with path.open("rb") as file:
        head = file.read(4096)
    found = None
    if kind == ".off":
        found = re.match(rb"\s*(?:[A-Z4n]*OFF)?\s*(?:#[^\n]*\n\s*)*\d+\s+(\d+)", head)
    elif kind == ".ply":
        found = re.search(rb"element\s+face\s+(\d+)", head)
    announced = int(found[1]) if found else size // _OBJ_BYTES
    if kind == ".stl":
        count = int.from_bytes(head[80:84], "little")
        announced = count if size == 84 + 50 * count else size // _TEXT_STL_BYTES
    return min(announced, size // 2)  # of a damaged header; no format holds a triangle in less than two bytes


def available_memory() -> int | None:
    """Bytes that the process may still take: of its own limits, its control group's and the machine's, the least.

    None where the system does not tell it.
    """
    kilobytes = _number(Path("/proc/meminfo"), r"^MemAvailable:\s+")
    found = (_of_limits(), _of_group(), None if kilobytes is None else 1024 * kilobytes)
    return min((n_bytes for n_bytes in found if n_bytes is not None), default=None)


def _of_limits() -> int | None:
    try:
        import resource
    except ImportError:  # there are none on Windows
        return None
    left = []
    # Of the address space, and of data alone, which is what `igps._parallel` bounds.
    for kind, column in ((resource.RLIMIT_AS, 0), (resource.RLIMIT_DATA, 5)):
        limit, _ = resource.getrlimit(kind)
        pages = _number(Path("/proc/self/statm"), rf"^(?:\d+ ){{{column}}}")
        if limit != resource.RLIM_INFINITY and pages is not None:
            left.append(limit - pages * resource.getpagesize())
    return min(left, default=None)


def _of_group(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> int | None:
    """The least of the process's control group and those around it, of either version of the kernel's interface."""
    lines = [line.split(":", 2) for line in _text(own).splitlines()]
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
                # Files that were read stay in memory only until it is needed.
                found.append(most - current + (_number(folder / "memory.stat", rf"^{cache}\s+") or 0))
    return min(found, default=None)


def _number(path: Path, before: str = "^") -> int | None:
    """The first number in a file that stands behind what an expression matches; None if there is none."""
    found = re.search(rf"{before}(\d+)", _text(path), re.MULTILINE)
    return int(found[1]) if found else None


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
