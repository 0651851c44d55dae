"""What a format is, and what a file gives."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from igps._arrays import Floats, Integers
from igps.mesh._label_measures import LabelVoxels
from igps.mesh._tidying import are_specks, places
from igps.mesh.mesh import Mesh, MeshError, check_arrays
from igps.mesh.options import BodyKind, LoadOptions
from igps.mesh.surface import compact, face_parts, stacked

# What ITK says before a fault: where in its sources and memory it was found.
_PLACES_IN_ITK = re.compile(r"^Exception thrown in SimpleITK .*ERROR: (\w+\(0x\w+\): )?")


@dataclass(frozen=True, eq=False)
class RawBody:
    """A surface as a file has it, unchecked; a cloud of points has no faces."""

    vertices: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (V, 3) length
    faces: Integers = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))  # (F, 3) vertex indices
    part: str | None = None  # its name among the bodies of the file; None where the file is one body
    unit: str | None = None  # of length, such as "mm"; None where the file does not tell
    normals: Floats | None = None  # (V, 3) of a cloud of points that has them
    notes: tuple[str, ...] = ()  # what was noticed on reading, in words
    fault: MeshError | None = None  # why there is no surface of this body, where there are others
    make: Callable[[], RawBody] | None = None  # makes the surface, where that takes time; see `made`
    voxels: Callable[[], LabelVoxels] | None = None  # that the surface was made of, of a label
    denoise: bool = True  # whether it may be rough with noise; not a surface that was made here

    def made(self) -> RawBody:
        """The same with its surface, or with the fault for which there is none."""
        return self if self.make is None else self.make()


@dataclass(frozen=True)
class Format:
    """A file format.

    `read` gives the bodies of a file, with distinct names, or the one named, and raises anything where the file is
    faulty. Surfaces that take time are made later, see `RawBody.make`; "whole" and "pieces" are made of what it gives.
    """

    name: str  # for messages
    suffixes: tuple[str, ...]  # lower case, with the dot; the longest that ends a file's name decides
    read: Callable[[Path, LoadOptions, str | None], Sequence[RawBody]]
    bodies: tuple[BodyKind, ...] = ("whole",)  # what a body of the file may be, the usual first
    is_searched: bool = True  # whether files below a folder are taken for bodies by their suffix
    ignored: tuple[str, ...] = ()  # suffixes of files of the same format that hold no surface
    extra: str | None = None  # the extra of this package with the modules that it needs
    beside: Callable[[Path, LoadOptions], Sequence[Path]] | None = None  # other files on which the bodies depend


def made_later(
    make: Callable[[], Mesh], part: str | None, unit: str | None, voxels: Callable[[], LabelVoxels] | None = None
) -> RawBody:
    """A body whose surface is made when it is asked for; if that fails, the others of the file are still read."""

    def made() -> RawBody:
        try:
            mesh = make()
        except MeshError as fault:
            return RawBody(part=part, fault=fault, voxels=voxels)
        return RawBody(mesh.vertices, mesh.faces, part, unit, notes=mesh.notes, voxels=voxels, denoise=False)

    return RawBody(part=part, make=made)


def joined(bodies: Sequence[RawBody]) -> RawBody:
    """All of them as one."""
    bodies = [body.made() for body in bodies]
    if len(bodies) == 1:
        return replace(bodies[0], part=None)
    meshes = [body for body in bodies if len(body.faces)]
    kept = meshes or [body for body in bodies if len(body.vertices)]
    if not kept:
        return RawBody(fault=next((body.fault for body in bodies if body.fault), None))
    for body in meshes:
        if body.faces.min() < 0 or body.faces.max() >= len(body.vertices):  # it would take those of another body
            raise ValueError(f"{body.part} refers to vertices that are not there")
    units = {body.unit for body in kept}
    normals = [body.normals for body in kept if body.normals is not None]
    return RawBody(
        *stacked([(body.vertices, body.faces) for body in kept]),
        unit=units.pop() if len(units) == 1 else None,
        normals=np.concatenate(normals) if len(normals) == len(kept) else None,
        notes=tuple(dict.fromkeys(note for body in kept for note in body.notes)),
        denoise=any(body.denoise for body in kept),
    )


def pieces(whole: RawBody) -> list[RawBody]:
    """The connected components in the order of the file, as "piece 1" and so on; specks are left out."""
    vertices, faces = whole.vertices, whole.faces
    if not len(faces):
        return [whole]
    check_arrays(vertices, faces, "the whole")
    vertices, faces = compact(vertices, faces)  # where others lie is no matter
    owner, areas = face_parts(vertices, places(vertices)[faces])  # loose triangles are connected where they meet
    small = are_specks(areas)
    notes = (*whole.notes, f"left out {int(small.sum())} specks") if small.any() else whole.notes
    order = [k for k in np.argsort(np.unique(owner, return_index=True)[1]) if not small[k]]
    surfaces = [compact(vertices, faces[owner == k]) for k in order]
    return [replace(whole, vertices=v, faces=f, part=f"piece {i}", notes=notes) for i, (v, f) in enumerate(surfaces, 1)]


def distinct(names: Iterable[str]) -> list[str]:
    """The names, those that repeat with a number behind them."""
    found: list[str] = []
    taken: Counter[str] = Counter()
    for name in names:
        new = name
        while new in taken:
            taken[name] += 1
            new = f"{name} ({taken[name]})"
        taken[new] += 1
        found.append(new)
    return found


def stamp_of(*paths: Path) -> tuple[int, int, int]:
    """Bytes of files, and when their content and their names or rights were last changed, in nanoseconds."""
    found = [os.stat(path) for path in paths]
    sizes, contents, names = zip(*((one.st_size, one.st_mtime_ns, one.st_ctime_ns) for one in found), strict=True)
    return sum(sizes), max(contents), max(names)


def text_of(path: Path) -> str:
    """The text of a file, in UTF-8, or else in Latin-1, which has a letter for any byte; no carriage returns."""
    content = path.read_bytes().replace(b"\r", b"\n")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def corners_of_rows(rows: Integers) -> tuple[Integers, Integers]:
    """The corners of polygons laid end to end, and how many each has, of rows that begin with these numbers."""
    starts, at = [], 0
    while at < len(rows):
        starts.append(at)
        at += max(int(rows[at]), 0) + 1
    if at != len(rows):
        raise ValueError("the numbers of corners do not add up")
    is_corner = np.ones(len(rows), dtype=bool)
    is_corner[starts] = False
    return rows[is_corner], rows[starts]


@contextmanager
def faults(path: object, kind: Format) -> Iterator[None]:
    """Turn what a reader raises into a MeshError about the file, or a body in it; memory that ran out is no fault."""
    try:
        yield
    except (MeshError, MemoryError):
        raise
    except ImportError as error:
        missing = f"{path}: {kind.name} needs a module that is not installed ({error})."
        install = f'Install it: pip install "interior-gps[{kind.extra}]"; or convert the file to OFF, OBJ, PLY or STL.'
        raise MeshError(f"{missing} {install}") from error
    except Exception as error:  # the loaders of some thirty formats raise whatever they like
        words = _PLACES_IN_ITK.sub("", " ".join(str(error).split()))[:300]
        fault = f"{path}: not readable as {kind.name} ({type(error).__name__}: {words})."
        remedy = "Check that the file is complete and in the format that its name tells; or export it again."
        raise MeshError(f"{fault} {remedy}") from error


def check_unpacked(n_bytes: int, path: Path, limit: int) -> None:
    """Raise a MeshError for what would take more bytes than allowed."""
    if n_bytes > limit:
        raise MeshError(
            f"{path}: unpacks to {n_bytes / 1e9:.2g} GB or more, and at most {limit / 1e9:.2g} GB are allowed. If you "
            "trust the file, read it with LoadOptions(max_unpacked=...), on the command line --max_unpacked."
        )
