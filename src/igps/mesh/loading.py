"""Read a file: list its bodies, and make a closed surface of each."""

import logging
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np

from igps._arrays import Booleans, Floats, Integers
from igps._text import counted
from igps._threads import one_thread
from igps.mesh.errors import MeshError
from igps.mesh.formats import Format, all_formats, faults, format_of
from igps.mesh.limits import check_memory
from igps.mesh.mending import mend
from igps.mesh.mesh import Mesh
from igps.mesh.options import BodyKind, LoadOptions
from igps.mesh.raw_body import RawBody, joined, pieces
from igps.mesh.simplification import subdivide
from igps.mesh.surface import compact, diagonal, face_areas

logger = logging.getLogger(__name__)

_COARSE = 0.004  # rounding step of coordinates, over the size of the body, that changes eigenvalues by about 1 %

# A mesh with too few vertices is subdivided to this multiple of the minimum: with just enough vertices the last
# eigenfunctions would depend on the triangles.
_SUBDIVISION_FACTOR = 4

_MAX_LOST = 0.01  # largest share of faces that may be dropped because a vertex has no coordinates


@dataclass(frozen=True)
class BodyRef:
    """Reference to a body in a file."""

    path: Path
    part: str | None = None  # name of the body in the file; None if the file is one body
    number: str | None = field(default=None, compare=False)  # another name: the number of a label

    def __str__(self) -> str:
        return str(self.path) if self.part is None else f"{self.path}#{self.part}"


def list_bodies(path: str | Path, options: LoadOptions = LoadOptions()) -> list[BodyRef]:
    """List the bodies of a file. Their surfaces are not computed, unless the format has no other way to list them."""
    path = Path(path)
    if is_one_body(path, options):
        return [BodyRef(path)]
    return [BodyRef(path, body.part, body.number) for body in _read(path, options)]


def is_one_body(path: Path, options: LoadOptions) -> bool:
    """Return whether a file is one body whatever it holds; a MeshError if it has no known format."""
    return _body_kind(_format(path), options) == "whole"


@one_thread()
def load_mesh(
    path: str | Path,
    options: LoadOptions = LoadOptions(),
    *,
    part: str | None = None,
    least_vertices: int = 0,
) -> Mesh:
    """Read a mesh, a point cloud, a label volume or a molecule, and make a body of it.

    Polygons are cut into triangles. Vertices keep their order and are not merged. In an STL file, which has no shared
    vertices, coincident corners become one vertex.

    Example:
        >>> import tempfile, trimesh
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = trimesh.creation.box((1, 2, 3)).export(f"{folder}/box.obj")
        ...     mesh = load_mesh(f"{folder}/box.obj")
        >>> len(mesh.vertices), round(mesh.volume, 6)
        (8, 6.0)

    Args:
        options: what counts as a body of the file, and how it may be repaired. The repairs are listed in `Mesh.notes`.
        part: name of the body, see `list_bodies`; required if the file has several.
        least_vertices: minimal number of vertices. A smaller mesh is subdivided, unless `options.mend` is "never".

    Raises:
        MeshError: the file is missing or unreadable or has no such part, or the surface is not usable.
    """
    raw = read_surface(path, options, part=part)
    ref = BodyRef(Path(path), raw.part)
    mesh = surface_body(raw, ref, options)
    return refined(mesh, options, least_vertices)


def load_bodies(path: str | Path, options: LoadOptions = LoadOptions()) -> list[Mesh]:
    """Return all usable bodies of a file, and log the errors of the others; a MeshError if no body is usable."""
    bodies = []
    errors = []
    for _, body in each_body(path, options):
        if isinstance(body, MeshError):
            logger.warning("%s", body)
            errors.append(body)
        else:
            bodies.append(body)
    if not bodies:
        raise errors[0] if errors else MeshError(f"{path}: the file holds no body. Check the file.")
    return bodies


def each_body(
    path: str | Path,
    options: LoadOptions = LoadOptions(),
    *,
    parts: Sequence[str | None] | None = None,
) -> Iterator[tuple[BodyRef, Mesh | MeshError]]:
    """Iterate over the bodies of a file, or over the given parts; the MeshError of an unusable body takes its place."""
    for ref, raw in each_surface(path, options, parts=parts):
        with one_thread():
            try:
                body: Mesh | MeshError = surface_body(raw, ref, options)
            except MeshError as error:
                body = error
        yield ref, body


def each_surface(
    path: str | Path,
    options: LoadOptions = LoadOptions(),
    *,
    parts: Sequence[str | None] | None = None,
) -> Iterator[tuple[BodyRef, RawBody]]:
    """Iterate over the unchecked surfaces of the bodies of a file, or of the given parts; see `each_body`."""
    for ref, raw in each_raw_body(path, options, parts=parts):
        with one_thread():
            try:
                with faults(ref, _format(ref.path)):
                    body = raw.made()
            except MeshError as fault:  # the other bodies may be sound
                body = replace(raw, fault=fault, make=None)
        yield ref, body


def each_raw_body(
    path: str | Path,
    options: LoadOptions = LoadOptions(),
    *,
    parts: Sequence[str | None] | None = None,
) -> Iterator[tuple[BodyRef, RawBody]]:
    """Iterate over the bodies of a file as they were read, slow surfaces not yet computed; see `RawBody.made`."""
    path = Path(path)
    only = parts[0] if parts and len(parts) == 1 else None
    for raw in _read(path, options, only):
        if parts is None or raw.part in parts:
            yield BodyRef(path, raw.part), raw


def read_surface(
    path: str | Path, options: LoadOptions = LoadOptions(), *, part: str | None = None
) -> RawBody:
    """Return the unchecked surface of a body as it is in the file; for `part` and the errors see `load_mesh`."""
    path = Path(path)
    bodies = _read(path, options, part)
    matching = bodies if part is None else [body for body in bodies if body.part == part]
    if len(matching) == 1:
        with faults(path, _format(path)):
            return matching[0].made()
    known: Sequence[RawBody | BodyRef] = bodies if part is None else list_bodies(path, options)
    names = [body.part for body in known]
    shown = ", ".join(map(repr, names[:8]))
    if len(names) > 8:
        shown += ", ..."
    if part is None:
        raise MeshError(
            f"{path}: holds {len(names)} bodies: {shown}. Name one as part=, or read all by load_bodies."
        )
    if names == [None]:
        raise MeshError(f"{path}: is a single body, and has no body {part!r}. Leave out the name.")
    raise MeshError(f"{path}: has no body {part!r}; there are: {shown}. Choose one of them.")


def surface_body(raw: RawBody, ref: BodyRef, options: LoadOptions = LoadOptions()) -> Mesh:
    """Make a body of a surface, see `load_mesh`; a MeshError if the surface is not usable."""
    if raw.fault is not None:
        raise raw.fault
    name = str(ref)
    vertices = raw.vertices
    faces = raw.faces
    notes = raw.notes
    if options.mend != "never":
        vertices, faces, dropped = _with_coordinates(vertices, faces)
        notes = (*notes, *dropped)
    notes = (*notes, *_rounding_notes(vertices, name))
    if options.allow_open and options.mend != "always":
        try:
            mesh = Mesh(vertices, faces, name=name, allow_open=True)
            return mesh.annotated(notes=notes, unit=raw.unit, frame=raw.frame, given=raw.given)
        except MeshError:
            if options.mend == "never":
                raise
    mesh = mend(
        vertices,
        faces,
        how=options.mend,
        normals=raw.normals,
        cavities=options.cavities,
        denoise=raw.denoise,
        name=name,
    )
    # Of another surface, such as one of the pieces, the area is not known
    area = face_areas(raw.vertices, raw.faces).sum()
    is_same = math.isclose(mesh.area, area, rel_tol=1e-6)
    fine_area = raw.fine_area if is_same else None
    return mesh.annotated(
        notes=notes, unit=raw.unit, frame=raw.frame, fine_area=fine_area, given=raw.given
    )


def refined(mesh: Mesh, options: LoadOptions, least_vertices: int) -> Mesh:
    """Subdivide a body of too few vertices for its eigenpairs, longest edges first; see `load_mesh`."""
    if options.mend == "never" or mesh.allow_open:
        return mesh
    _, is_outer = mesh.outer()
    n_outer = int(is_outer.sum())
    if n_outer >= least_vertices:
        return mesh
    n_inner = len(mesh.vertices) - n_outer
    return subdivide(mesh, _SUBDIVISION_FACTOR * least_vertices + n_inner)


def _with_coordinates(vertices: Floats, faces: Integers) -> tuple[Floats, Integers, list[str]]:
    """Drop a few vertices that are not finite, with their faces; or return all if they are more than a sliver."""
    is_found: Booleans = np.asarray(np.isfinite(vertices).all(axis=1))
    is_valid = faces.min(initial=0) >= 0 and faces.max(initial=-1) < len(vertices)
    if is_found.all() or not is_valid:
        return vertices, faces, []
    is_whole = is_found[faces].all(axis=1)
    kept = is_whole if len(faces) else is_found
    if (~kept).mean() > _MAX_LOST:
        return vertices, faces, []
    n_lost = counted(int((~is_found).sum()), "vertex")
    n_faces = counted(int((~is_whole).sum()), "face")
    note = f"dropped {n_lost} without coordinates and {n_faces}"
    if not len(faces):
        return vertices[is_found], faces, [note]
    return *compact(vertices, faces[is_whole]), [note]


def _rounding_notes(vertices: Floats, name: str) -> list[str]:
    """Return a note if coordinates in single precision are so far from the origin that rounding changes the shape."""
    # Values that are not finite are rejected later
    with np.errstate(over="ignore", invalid="ignore"):
        single = vertices.astype(np.float32)
        largest = np.abs(single).max(initial=0)
        step = float(np.spacing(largest))
        size = diagonal(vertices) if len(vertices) else 0.0
    if not _COARSE * size < step < size or (single != vertices).any():
        return []
    note = f"coordinates are rounded to {step:.2g}, {step / size:.1%} of the size, so far from the origin"
    logger.warning("%s: %s. Move the body to the origin before writing the file.", name, note)
    return [note]


def _read(path: Path, options: LoadOptions, part: str | None = None) -> list[RawBody]:
    """Read all bodies of a file, or at least the one named `part`."""
    file_format = _format(path)
    kind = _body_kind(file_format, options)
    if file_format.bodies[0] == "whole" and file_format.has_triangles:
        check_memory(path)
    if kind in ("whole", "pieces"):
        part = None
    with faults(path, file_format):
        reading = replace(options, bodies=kind)
        bodies = list(file_format.read(path, reading, part))
        if kind == "whole":
            return [joined(bodies)]
        if kind == "pieces" and kind not in file_format.bodies:
            return pieces(joined(bodies))
        return bodies


def _body_kind(file_format: Format, options: LoadOptions) -> BodyKind:
    if options.bodies in (*file_format.bodies, "whole", "pieces"):
        return options.bodies
    return file_format.bodies[0]


def _format(path: Path) -> Format:
    # Unlike Path.is_file, this raises nothing for names that no file can have
    if not os.path.isfile(path):
        if os.path.isdir(path):
            raise MeshError(f"{path}: expected a file, got a folder. Name each file in it.")
        raise MeshError(f"{path}: no such file. Check the path.")
    if path.stat().st_size == 0:
        raise MeshError(f"{path}: the file is empty (0 bytes). Export it again.")
    file_format = format_of(path)
    if file_format is None:
        suffixes = chain.from_iterable(known.suffixes for known in all_formats())
        remedy = f"Convert the file to one of {', '.join(suffixes)}."
        raise MeshError(f"{path}: unknown file format. {remedy}")
    return file_format
