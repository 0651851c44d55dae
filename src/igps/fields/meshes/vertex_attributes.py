"""Attributes from values at the vertices of surfaces, or in tetrahedra."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import igl
import numpy as np
from scipy.spatial import cKDTree

from igps._arrays import Floats
from igps.data.attribute_sources import FileAttribute, attribute_source, fill_missing
from igps.fields.meshes import vertex_values
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef, load_mesh, read_surface
from igps.mesh.options import LoadOptions
from igps.signature.mean_value import extend

_TOLERANCE = 0.05  # share of its height by which a point may lie outside a tetrahedron: rounding, curved surfaces


@dataclass(frozen=True)
class VertexAttribute(FileAttribute):
    """Values at the vertices of the body's file, extended to the interior by mean value coordinates.

    Formats are PLY, VTK (.vtk, .vtp), GIFTI (.shape.gii, .func.gii) and FreeSurfer (lh.thickness, lh.curv). The file
    has one value for each vertex of the body before mending, or of the whole file if bodies are its pieces or objects.
    A vertex that mending created gets the value at the nearest point of the original surface.
    """

    reading: LoadOptions = LoadOptions()

    def reading_by(self, options: LoadOptions) -> Self:
        return replace(self, reading=options)

    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        # If the pattern ends in {file}, the suffix is known only here, and may be that of an image.
        source = attribute_source(file.name)
        if isinstance(source, FileAttribute) and not isinstance(
            source, VertexAttribute | TetAttribute
        ):
            return source.values(body, file, name, points)
        raw = read_surface(body.path, self.reading, part=body.part)
        values = vertex_values.chosen(vertex_values.read(file), name, file)
        if len(values) != (n_own := len(raw.vertices)) and self.reading.bodies in (
            "pieces",
            "objects",
        ):
            raw = read_surface(body.path, replace(self.reading, bodies="whole"))
        if len(values) != len(raw.vertices):
            whole = f" ({len(raw.vertices)} in the whole file)" * (len(raw.vertices) != n_own)
            raise MeshError(
                f"{body}: {file} has {len(values)} values for {n_own} vertices{whole}. Give one for each."
            )
        columns = fill_missing(values.reshape(len(values), -1), raw.vertices, str(file))
        mesh = load_mesh(body.path, self.reading, part=body.part)
        if not np.array_equal(mesh.vertices, raw.vertices):
            faces = np.ascontiguousarray(raw.faces)
            _, face, nearest = igl.point_mesh_squared_distance(
                mesh.vertices, np.ascontiguousarray(raw.vertices), faces
            )
            corners = [np.ascontiguousarray(raw.vertices[faces[face, i]]) for i in range(3)]
            weights = np.nan_to_num(
                igl.barycentric_coordinates(np.ascontiguousarray(nearest), *corners), nan=1 / 3
            )
            columns = np.einsum("vi,vid->vd", weights, columns[faces[face]])
        return extend(mesh.vertices, mesh.faces, columns, points).reshape(
            len(points), *values.shape[1:]
        )


@dataclass(frozen=True)
class TetAttribute(FileAttribute):
    """Values at the vertices of a tetrahedral mesh (.vtu), interpolated linearly in each tetrahedron."""

    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        vertices, tetrahedra, arrays = vertex_values.read_tetrahedra(file)
        at_vertices = vertex_values.chosen(arrays, name, file)
        corners = vertices[tetrahedra]
        edges = corners[:, 1:] - corners[:, :1]
        is_solid = np.abs(np.linalg.det(edges)) > 0
        corners = corners[is_solid]
        tetrahedra = tetrahedra[is_solid]
        edges = edges[is_solid]
        inverse = np.linalg.inv(edges)
        # Tetrahedron of each point, barycentric coordinates in it, and the smallest of them, which is negative outside
        n = len(points)
        owner = np.zeros(n, int)
        weights = np.zeros((n, 4))
        smallest = np.full(n, -np.inf)
        # No point of a tetrahedron is farther from its centre than a corner
        centres = corners.mean(axis=1)
        radius = np.linalg.norm(corners - centres[:, None], axis=2).max()
        for i, near in enumerate(
            cKDTree(centres).query_ball_point(points, radius * (1 + _TOLERANCE))
        ):
            if near:
                last_three = np.einsum("td,tde->te", points[i] - corners[near, 0], inverse[near])
                barycentric = np.column_stack([1 - last_three.sum(axis=1), last_three])
                best = int(np.argmax(barycentric.min(axis=1)))
                smallest[i] = barycentric[best].min()
                weights[i] = barycentric[best]
                owner[i] = near[best]
        values = np.einsum(
            "pi,pi...->p...", weights, at_vertices[tetrahedra[owner]].astype(np.float64)
        )
        values[smallest < -_TOLERANCE] = np.nan
        return values
