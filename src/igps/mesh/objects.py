"""Surfaces of other libraries, in memory, recognised by their attributes: none of the libraries is imported."""

from pathlib import Path
from typing import Any

import numpy as np

from igps.mesh.formats._format import RawBody, corners_of_rows
from igps.mesh.formats._polygons import flat_triangles


def raw_of(thing: Any) -> tuple[str, RawBody]:
    """Name and surface of a trimesh.Trimesh, a pyvista.PolyData or a nibabel.GiftiImage, unchecked; or a TypeError."""
    metadata, source = getattr(thing, "metadata", None), getattr(thing, "source", None)
    known = metadata.get("file_name") if isinstance(metadata, dict) else None
    path = getattr(source, "file_path", None)  # where trimesh keeps that of a file that it read
    name = str(known or (Path(path).name if path else "mesh"))
    if hasattr(thing, "get_arrays_from_intent"):
        points, faces = (thing.get_arrays_from_intent(f"NIFTI_INTENT_{kind}") for kind in ("POINTSET", "TRIANGLE"))
        if not points or not faces:
            raise TypeError("the GIFTI image holds no surface: it lacks points or triangles. Give one of a surface.")
        return name, RawBody(np.asarray(points[0].data, np.float64), np.asarray(faces[0].data, np.int64), unit="mm")
    if hasattr(thing, "points") and hasattr(thing, "faces"):
        vertices = np.asarray(thing.points, np.float64)
        return name, RawBody(
            vertices, flat_triangles(*corners_of_rows(np.asarray(thing.faces, dtype=np.int64)), vertices)
        )
    if hasattr(thing, "vertices") and hasattr(thing, "faces"):
        unit = getattr(thing, "units", None)
        return name, RawBody(np.asarray(thing.vertices, np.float64), np.asarray(thing.faces, np.int64), unit=unit)
    given = f"{type(thing).__module__}.{type(thing).__qualname__}"
    raise TypeError(
        f"mesh: expected a Mesh, a trimesh.Trimesh, a pyvista.PolyData or a nibabel.GiftiImage, got {given}. "
        "Read a file with igps.load_mesh, or pass Mesh(vertices, faces)."
    )
