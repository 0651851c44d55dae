"""Convert bodies of other libraries. They are recognised by their attributes, so that no library is imported."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from igps.mesh.formats._format import RawBody, corners_of_rows
from igps.mesh.formats._polygons import flat_triangles
from igps.mesh.formats.volumes import label_bodies, volume_in_memory
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions


def object_bodies(thing: Any, name: str, options: LoadOptions = LoadOptions()) -> list[RawBody]:
    """Return the bodies of a surface (see `raw_body`), or of labels: an array, a pair (array, spacing), or an image."""
    labels, spacing = thing if isinstance(thing, tuple) and len(thing) == 2 else (thing, None)
    if not _is_volume(labels):
        return [raw_body(thing)[1]]
    bodies = label_bodies(volume_in_memory(labels, spacing, name, options), options)
    is_mask = [body.part for body in bodies] == ["1"]
    return [replace(bodies[0], part=None)] if is_mask else bodies


def raw_body(thing: Any, spacing: Sequence[float] | None = None) -> tuple[str, RawBody]:
    """Return the name and the unchecked surface of a body; a TypeError unless it has a type listed in `Mesh.of`."""
    if _is_volume(thing):
        bodies = object_bodies((thing, spacing), "volume")
        if len(bodies) > 1:
            several = f"volume: expected one label, got {', '.join(str(body.part) for body in bodies)[:80]}."
            raise MeshError(
                f"{several} Select one, such as labels == 1, or make a SignatureDataset of all."
            )
        raw = bodies[0].made()
        if raw.fault is not None:
            raise raw.fault
        return "volume", raw
    metadata, source = getattr(thing, "metadata", None), getattr(thing, "source", None)
    file_name = metadata.get("file_name") if isinstance(metadata, dict) else None
    path = getattr(source, "file_path", None)  # trimesh keeps the path of the file here
    name = str(file_name or (Path(path).name if path else "mesh"))
    if hasattr(thing, "get_arrays_from_intent"):
        points, faces = (
            thing.get_arrays_from_intent(f"NIFTI_INTENT_{kind}")
            for kind in ("POINTSET", "TRIANGLE")
        )
        if not points or not faces:
            raise TypeError(
                "mesh: expected a GIFTI image of a surface, got one without points or triangles."
            )
        return name, RawBody(
            np.asarray(points[0].data, np.float64), np.asarray(faces[0].data, np.int64), unit="mm"
        )
    if hasattr(thing, "points") and hasattr(thing, "faces"):
        vertices = np.asarray(thing.points, np.float64)
        corners, n_corners = corners_of_rows(np.asarray(thing.faces, dtype=np.int64))
        return name, RawBody(vertices, flat_triangles(corners, n_corners, vertices))
    if hasattr(thing, "vertices") and hasattr(thing, "faces"):
        unit = getattr(thing, "units", None) or getattr(thing, "unit", None)
        vertices, triangles = (
            np.asarray(thing.vertices, np.float64),
            np.asarray(thing.faces, np.int64),
        )
        return name, RawBody(vertices, triangles, unit=unit, notes=getattr(thing, "notes", ()))
    expected = "a Mesh, a trimesh.Trimesh, a pyvista.PolyData, a nibabel.GiftiImage or labels"
    got = f"{type(thing).__module__}.{type(thing).__qualname__}"
    raise TypeError(
        f"mesh: expected {expected}, got {got}. Read a file with igps.load_mesh, or pass Mesh(...)."
    )


def _is_volume(thing: Any) -> bool:
    """Return whether an object is an array of voxels or a nibabel image."""
    is_image = hasattr(thing, "dataobj") and hasattr(thing, "affine")
    return is_image or (isinstance(thing, np.ndarray) and thing.ndim == 3)
