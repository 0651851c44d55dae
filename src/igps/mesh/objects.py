"""Convert bodies of other libraries. They are recognised by their attributes, so that no library is imported."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igps.mesh.errors import MeshError
from igps.mesh.formats import all_formats
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.mesh.polygons import corners_of_rows, flat_triangles
from igps.mesh.raw_body import RawBody


def as_mesh(body: Any, spacing: Sequence[float] | None = None) -> Mesh:
    """Convert a body of another library to a Mesh; a Mesh is returned unchanged.

    Example:
        >>> import trimesh
        >>> as_mesh(trimesh.creation.box((1, 2, 3)))
        Mesh('mesh', 8 vertices, 12 faces)
        >>> ball = ((np.indices((20, 20, 20)) - 9.5) ** 2).sum(axis=0) < 8**2
        >>> round(float(as_mesh(ball, spacing=(1, 1, 2)).volume / ball.sum()), 3)
        2.0

    Args:
        body: a Mesh; a closed surface as a trimesh.Trimesh, a pyvista.PolyData or a nibabel.GiftiImage, whose
            polygons are cut into triangles; or voxels of one label, as an array (X, Y, Z) or a nibabel image.
        spacing: sides of a voxel of an array in millimetres. None for voxels of side 1 without a unit.

    Raises:
        TypeError: the body has none of these types.
        MeshError: its surface is not usable, or there are several labels.
    """
    if isinstance(body, Mesh):
        return body
    surface = _surface(body)
    if surface is not None:
        name, raw = surface
    else:
        name = "volume"
        thing = body if spacing is None else (body, spacing)
        raw = _single(object_bodies(thing, name)).made()
    if raw.fault is not None:
        raise raw.fault
    mesh = Mesh(raw.vertices, raw.faces, name=name, unit=raw.unit, notes=raw.notes)
    return mesh.annotated(frame=raw.frame, given=raw.given)


def object_bodies(thing: Any, name: str, options: LoadOptions = LoadOptions()) -> Sequence[RawBody]:
    """Return the bodies of a surface (see `as_mesh`), or those that a format makes of an object in memory."""
    surface = _surface(thing)
    if surface is not None:
        return [surface[1]]
    for kind in all_formats():
        bodies = None if kind.in_memory is None else kind.in_memory(thing, name, options)
        if bodies is not None:
            return bodies
    expected = "a Mesh, a trimesh.Trimesh, a pyvista.PolyData, a nibabel.GiftiImage or labels"
    got = f"{type(thing).__module__}.{type(thing).__qualname__}"
    raise TypeError(
        f"mesh: expected {expected}, got {got}. Read a file with igps.load_mesh, or pass Mesh(...)."
    )


def _single(bodies: Sequence[RawBody]) -> RawBody:
    if len(bodies) == 1:
        return bodies[0]
    names = ", ".join(str(body.part) for body in bodies)[:80]
    remedy = "Select one, such as labels == 1, or make a SignatureDataset of all."
    raise MeshError(f"volume: expected one label, got {names}. {remedy}")


def _surface(thing: Any) -> tuple[str, RawBody] | None:
    """Return the name and the unchecked surface of an object that has vertices and faces; None if it has none."""
    name = _file_name(thing)
    if hasattr(thing, "get_arrays_from_intent"):
        points = thing.get_arrays_from_intent("NIFTI_INTENT_POINTSET")
        faces = thing.get_arrays_from_intent("NIFTI_INTENT_TRIANGLE")
        if not points or not faces:
            raise TypeError(
                "mesh: expected a GIFTI image of a surface, got one without points or triangles."
            )
        vertices = np.asarray(points[0].data, np.float64)
        triangles = np.asarray(faces[0].data, np.int64)
        return name, RawBody(vertices, triangles, unit="mm", frame="RAS")
    if hasattr(thing, "points") and hasattr(thing, "faces"):
        vertices = np.asarray(thing.points, np.float64)
        rows = np.asarray(thing.faces, dtype=np.int64)
        triangles = flat_triangles(*corners_of_rows(rows), vertices)
        return name, RawBody(vertices, triangles)
    if hasattr(thing, "vertices") and hasattr(thing, "faces"):
        vertices = np.asarray(thing.vertices, np.float64)
        triangles = np.asarray(thing.faces, np.int64)
        unit = getattr(thing, "units", None) or getattr(thing, "unit", None)
        notes = getattr(thing, "notes", ())
        return name, RawBody(vertices, triangles, unit=unit, notes=notes)
    return None


def _file_name(thing: Any) -> str:
    metadata = getattr(thing, "metadata", None)
    if isinstance(metadata, dict) and metadata.get("file_name"):
        return str(metadata["file_name"])
    source = getattr(thing, "source", None)
    path = getattr(source, "file_path", None)  # trimesh keeps the path of the file here
    return Path(path).name if path else "mesh"
