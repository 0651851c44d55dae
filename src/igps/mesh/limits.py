"""Check whether a file, or a grid in a body, fits into memory, before any memory is allocated."""

import re
from pathlib import Path

from igps.mesh.errors import MeshError

# Peak memory of reading and mending a triangle, measured on OFF, OBJ, STL and PLY files of 330,000 triangles.
_BYTES_PER_FACE = 1000
# File size of a triangle in formats whose header has no number of triangles: OBJ, and text STL.
_OBJ_BYTES, _TEXT_STL_BYTES = 35, 200
_BYTES_PER_CELL = 40  # memory per grid cell while the cells inside a body are found
# bytes; smaller files and grids are not checked
_MIN_CHECKED_FILE = 1 << 20
_MIN_CHECKED_GRID = 1 << 26


def check_memory(path: Path) -> None:
    """Raise a MeshError if the triangles of a file need more memory than is available."""
    if path.stat().st_size >= _MIN_CHECKED_FILE:
        n_faces = expected_faces(path)
        remedy = "Simplify the mesh in a program that streams it, or give the process more memory."
        check_fits(n_faces * _BYTES_PER_FACE, f"{path}: about {n_faces:,} triangles need", remedy)


def check_grid(n_cells: int, name: str) -> None:
    """Raise a MeshError if the cells of a grid need more memory than is available."""
    if n_cells * _BYTES_PER_CELL >= _MIN_CHECKED_GRID:
        remedy = "Lower the resolution or min_samples, use fewer workers, or give the process more memory."
        check_fits(n_cells * _BYTES_PER_CELL, f"{name}: a grid of {n_cells:,} cells needs", remedy)


def check_unpacked(n_bytes: int, path: Path, limit: int) -> None:
    """Raise a MeshError if the content of a file unpacks to more than `limit` bytes."""
    if n_bytes > limit:
        fault = f"{path}: unpacks to {n_bytes / 1e9:.2g} GB or more, expected at most {limit / 1e9:.2g} GB."
        remedy = "If you trust the file, raise LoadOptions(max_unpacked=...), on the command line --max_unpacked."
        raise MeshError(f"{fault} {remedy}")


def check_fits(n_bytes: int, subject: str, remedy: str) -> None:
    """Raise a MeshError, "SUBJECT 3.0 GB of memory, and 2.0 GB are free. REMEDY", if `n_bytes` are not available."""
    free = available_memory()
    if free is not None and n_bytes > free:
        sizes = f"{n_bytes / 1e9:,.1f} GB of memory, and {max(free, 0) / 1e9:.1f} GB are free"
        raise MeshError(f"{subject} {sizes}. {remedy}")


def expected_faces(path: Path) -> int:
    """Return the number of triangles in a mesh file: from its header, or estimated from its size."""
    size = path.stat().st_size
    suffix = path.suffix.lower()
    with path.open("rb") as file:
        head = file.read(4096)
    match = None
    if suffix == ".off":
        match = re.match(rb"\s*(?:[A-Z4n]*OFF)?\s*(?:#[^\n]*\n\s*)*\d+\s+(\d+)", head)
    elif suffix == ".ply":
        match = re.search(rb"element\s+face\s+(\d+)", head)
    n_faces = int(match[1]) if match else size // _OBJ_BYTES
    if suffix == ".stl":
        count = int.from_bytes(head[80:84], "little")
        n_faces = count if size == 84 + 50 * count else size // _TEXT_STL_BYTES
    # A header may be damaged; a triangle takes at least two bytes in any format
    return min(n_faces, size // 2)


def available_memory() -> int | None:
    """Return the bytes that the process may still allocate, or None if the system does not provide them.

    This is the minimum over the limits of the process, of its control groups and of the machine.
    """
    kilobytes = _number(Path("/proc/meminfo"), r"^MemAvailable:\s+")
    bounds = (
        _memory_in_limits(),
        _memory_in_groups(),
        None if kilobytes is None else 1024 * kilobytes,
    )
    return min((n_bytes for n_bytes in bounds if n_bytes is not None), default=None)


def _memory_in_limits() -> int | None:
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return None
    available = []
    # Limits of the address space, and of data alone (set by `igps._parallel`), and the columns of their use in statm.
    for kind, column in ((resource.RLIMIT_AS, 0), (resource.RLIMIT_DATA, 5)):
        limit, _ = resource.getrlimit(kind)
        pages = _number(Path("/proc/self/statm"), rf"^(?:\d+ ){{{column}}}")
        if limit != resource.RLIM_INFINITY and pages is not None:
            available.append(limit - pages * resource.getpagesize())
    return min(available, default=None)


def _memory_in_groups(
    root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")
) -> int | None:
    """Return the minimum over the control group of the process and its parents, for cgroup version 2."""
    group = re.search(r"^0::/(.*)$", _text(own), re.MULTILINE)
    path = root / (group[1] if group else "")
    available = []
    # A container may see its own group as the root, whatever the path says.
    for folder in (path, *path.parents, root):
        max_bytes = _number(folder / "memory.max")
        current = _number(folder / "memory.current")
        if max_bytes is not None and current is not None:
            # The kernel frees cached files when memory is needed.
            cached = _number(folder / "memory.stat", r"^inactive_file\s+") or 0
            available.append(max_bytes - current + cached)
    return min(available, default=None)


def _number(path: Path, prefix: str = "^") -> int | None:
    """Return the first number in a file that follows a match of the expression `prefix`, or None."""
    match = re.search(rf"{prefix}(\d+)", _text(path), re.MULTILINE)
    return int(match[1]) if match else None


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
