"""A file becomes bodies: which it holds, and each as a closed surface."""

import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from igps._arrays import Floats
from igps._threads import one_thread
from igps.mesh._tidying import joined_at_free_edges
from igps.mesh.formats import FORMATS, Format, RawBody, format_of
from igps.mesh.formats._format import faults, joined, pieces
from igps.mesh.limits import check_memory
from igps.mesh.mending import mend
from igps.mesh.mesh import Mesh, MeshError, check_arrays
from igps.mesh.options import BodyKind, LoadOptions
from igps.mesh.surface import compact, diagonal, face_parts

logger = logging.getLogger(__name__)

# Steps of coordinates, over the size, that make eigenvalues wrong by about a hundredth.
_COARSE = 0.004


@dataclass(frozen=True)
class BodyRef:
    """A body that a file holds: the file, and its name there, None where the file is one body."""

    path: Path
    part: str | None = None

    def __str__(self) -> str:
        return str(self.path) if self.part is None else f"{self.path}#{self.part}"


def list_bodies(path: str | Path, options: LoadOptions = LoadOptions()) -> list[BodyRef]:
    """The bodies of a file, without making surfaces of them where the format can tell."""
    path = Path(path)
    if _bodies(_format(path), options) == "whole":
        return [BodyRef(path)]
    return [BodyRef(path, body.part) for body in _read(path, options)]


@one_thread()
def load_mesh(
    path: str | Path, options: LoadOptions = LoadOptions(), *, part: str | None = None, least_vertices: int = 0
) -> Mesh:
    """Read a mesh, a cloud of points, a label volume or a molecule, and make a body of it.

    Polygons are cut into triangles. Vertices keep their order and are not merged; only in an STL file, which has none,
    corners in one place are a vertex.

    Example:
        >>> import tempfile, trimesh
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = trimesh.creation.box((1, 2, 3)).export(f"{folder}/box.obj")
        ...     mesh = load_mesh(f"{folder}/box.obj")
        >>> len(mesh.vertices), round(mesh.volume, 6)
        (8, 6.0)

    Args:
        options: what of the file is a body, and what may be done to it; what was done is kept in `Mesh.notes`.
        part: which of its bodies, see `list_bodies`; needed where there are several.
        least_vertices: a body with fewer is subdivided, unless `options` mends never.

    Raises:
        MeshError: the file is missing or unreadable, has no such part, or the surface is not usable.
    """
    raw = read_surface(path, options, part=part)
    return surface_body(raw, BodyRef(Path(path), raw.part), options, least_vertices=least_vertices)


def load_bodies(path: str | Path, options: LoadOptions = LoadOptions()) -> list[Mesh]:
    """All usable bodies of a file; the others are logged. A MeshError if none is usable."""
    found, faults = [], []
    for _, body in each_body(path, options):
        if isinstance(body, MeshError):
            logger.warning("%s", body)
            faults.append(body)
        else:
            found.append(body)
    if not found:
        raise faults[0] if faults else MeshError(f"{path}: no body in it. Check the file.")
    return found


def each_body(
    path: str | Path, options: LoadOptions = LoadOptions(), *, parts: Sequence[str | None] | None = None,
    least_vertices: int = 0,
) -> Iterator[tuple[BodyRef, Mesh | MeshError]]:  # fmt: skip
    """The bodies of a file, read once, or those of the given parts; what is wrong with one stands in its place."""
    for ref, raw in each_surface(path, options, parts=parts):
        with one_thread():
            try:
                body: Mesh | MeshError = surface_body(raw, ref, options, least_vertices=least_vertices)
            except MeshError as error:
                body = error
        yield ref, body


def each_surface(
    path: str | Path, options: LoadOptions = LoadOptions(), *, parts: Sequence[str | None] | None = None
) -> Iterator[tuple[BodyRef, RawBody]]:
    """The surfaces of the bodies of a file, or of the given parts, unchecked, one after the other; see `each_body`."""
    path = Path(path)
    for raw in _read(path, options, parts[0] if parts and len(parts) == 1 else None):
        if parts is None or raw.part in parts:
            ref = BodyRef(path, raw.part)
            with one_thread():
                try:
                    with faults(ref, _format(path)):
                        body = raw.made()
                except MeshError as fault:  # leaves the others
                    body = replace(raw, fault=fault, make=None)
            yield ref, body


def read_surface(path: str | Path, options: LoadOptions = LoadOptions(), *, part: str | None = None) -> RawBody:
    """The surface of a body as the file has it, unchecked; its only one, if none is named."""
    path = Path(path)
    bodies = _read(path, options, part)
    found = [body for body in bodies if body.part == part] if part is not None else bodies
    if len(found) == 1:
        with faults(path, _format(path)):
            return found[0].made()
    names = [body.part for body in (bodies if part is None else list_bodies(path, options))]
    shown = ", ".join(repr(name) for name in names[:8]) + (", ..." if len(names) > 8 else "")
    if part is None:
        raise MeshError(f"{path}: holds {len(names)} bodies: {shown}. Name one as part=, or read all by load_bodies.")
    if names == [None]:
        raise MeshError(f"{path}: is one body, and has none called {part!r}. Leave that name out.")
    raise MeshError(f"{path}: has no body {part!r}; there are: {shown}. Choose one of them.")


def surface_body(raw: RawBody, ref: BodyRef, options: LoadOptions = LoadOptions(), *, least_vertices: int = 0) -> Mesh:
    """The body that the options make of a surface, see `load_mesh`; a MeshError if it is not usable."""
    if raw.fault is not None:
        raise raw.fault
    name = str(ref)
    vertices, faces, notes = raw.vertices, raw.faces, raw.notes
    if options.component == "largest" and len(faces):
        check_arrays(vertices, faces, name)
        connected = faces if options.mend == "never" else joined_at_free_edges(vertices, faces)
        owner, areas = face_parts(vertices, connected)
        if len(areas) > 1:
            n_before = len(vertices)
            vertices, faces = compact(vertices, faces[owner == int(np.argmax(areas))])
            kept = f"{len(vertices)} of {n_before} vertices"
            notes = (*notes, f"kept the largest of {len(areas)} components ({kept})")
    notes = (*notes, *_rounding(vertices, name))
    if options.allow_open and options.mend != "always":
        try:
            return Mesh(vertices, faces, name=name, allow_open=True, notes=notes, unit=raw.unit)
        except MeshError:
            if options.mend == "never":
                raise
    mesh = mend(
        vertices, faces, how=options.mend, least_vertices=least_vertices, normals=raw.normals,
        cavities=options.cavities, denoise=raw.denoise, name=name, notes=notes,
    )  # fmt: skip
    return mesh.annotated(unit=raw.unit)


def _rounding(vertices: Floats, name: str) -> list[str]:
    """A note of numbers in single precision so far from the origin that their last digits are seen in the shape."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused later
        single = vertices.astype(np.float32)
        step = float(np.spacing(np.abs(single).max(initial=0)))
        size = diagonal(vertices) if len(vertices) else 0.0
    if not _COARSE * size < step < size or (single != vertices).any():
        return []
    note = f"coordinates are rounded to {step:.2g}, {step / size:.1%} of the size, so far from the origin"
    logger.warning("%s: %s. Move the body to the origin before it is written.", name, note)
    return [note]


def _read(path: Path, options: LoadOptions, part: str | None = None) -> list[RawBody]:
    kind = _format(path)
    how = _bodies(kind, options)
    if kind.bodies[0] == "whole":
        check_memory(path)
    with faults(path, kind):  # of the bodies at least the one that is named
        bodies = list(kind.read(path, replace(options, bodies=how), part if how not in ("whole", "pieces") else None))
        if how == "whole":
            return [joined(bodies)]
        return pieces(joined(bodies)) if how == "pieces" and how not in kind.bodies else bodies


def _bodies(kind: Format, options: LoadOptions) -> BodyKind:
    return options.bodies if options.bodies in (*kind.bodies, "whole", "pieces") else kind.bodies[0]


def _format(path: Path) -> Format:
    if not os.path.isfile(path):  # False, too, of a name that no file can have
        if os.path.isdir(path):
            raise MeshError(f"{path}: a folder; a file expected. Name each file of it.")
        raise MeshError(f"{path}: no such file. Check the path.")
    if path.stat().st_size == 0:
        raise MeshError(f"{path}: the file is empty (0 bytes). Export it again.")
    kind = format_of(path)
    if kind is None:
        known = ", ".join(suffix for one in FORMATS for suffix in one.suffixes)
        raise MeshError(f"{path}: not a format that is read. Convert it to one of {known}.")
    return kind
