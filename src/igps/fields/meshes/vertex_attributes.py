"""Attributes from values at the vertices of surfaces."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import igl
import numpy as np

from igps._arrays import Floats
from igps.data.attribute_sources import FileAttribute, attribute_source, fill_missing
from igps.fields.meshes import vertex_values
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef, load_mesh, read_surface
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody
from igps.signature.mean_value import extend


@dataclass(frozen=True)
class VertexAttribute(FileAttribute):
    """Values at the vertices of the body's file, extended to the interior by mean value coordinates.

    Formats are PLY, VTK, GIFTI (.shape.gii, .func.gii) and FreeSurfer (lh.thickness, lh.curv). The file has one value
    for each vertex of the body before mending, or of the whole file if bodies are its pieces or objects. A vertex that
    mending created gets the value at the nearest point of the original surface.
    """

    reading: LoadOptions = LoadOptions()

    def reading_by(self, options: LoadOptions) -> Self:
        return replace(self, reading=options)

    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        # If the pattern ends in {file}, the suffix is known only here, and may be that of an image.
        source = attribute_source(file.name)
        if isinstance(source, FileAttribute) and not isinstance(source, VertexAttribute):
            return source.values(body, file, name, points)
        raw = read_surface(body.path, self.reading, part=body.part)
        values = vertex_values.chosen(vertex_values.read(file), name, file)
        n_own = len(raw.vertices)
        if len(values) != n_own and self.reading.bodies in ("pieces", "objects"):
            raw = read_surface(body.path, replace(self.reading, bodies="whole"))
        if len(values) != len(raw.vertices):
            whole = f" ({len(raw.vertices)} in the whole file)" * (len(raw.vertices) != n_own)
            raise MeshError(
                f"{body}: {file} has {len(values)} values for {n_own} vertices{whole}. Give one for each."
            )
        columns = fill_missing(values.reshape(len(values), -1), raw.vertices, str(file))
        mesh = load_mesh(body.path, self.reading, part=body.part)
        if not np.array_equal(mesh.vertices, raw.vertices):
            columns = _at_nearest(mesh.vertices, raw, columns)
        extended = extend(mesh.vertices, mesh.faces, columns, points)
        return extended.reshape(len(points), *values.shape[1:])


def _at_nearest(points: Floats, raw: RawBody, columns: Floats) -> Floats:
    """Return values (P, C) where a surface is nearest to points (P, 3), from those (V, C) at its vertices."""
    vertices = np.ascontiguousarray(raw.vertices)
    faces = np.ascontiguousarray(raw.faces)
    _, face, nearest = igl.point_mesh_squared_distance(points, vertices, faces)
    ends = faces[face]
    corners = [np.ascontiguousarray(vertices[ends[:, i]]) for i in range(3)]
    weights = igl.barycentric_coordinates(np.ascontiguousarray(nearest), *corners)
    weights = np.nan_to_num(weights, nan=1 / 3)
    return np.einsum("vi,vid->vd", weights, columns[ends])
