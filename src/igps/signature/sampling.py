"""Random points of a surface."""

from dataclasses import dataclass

import numpy as np

from igps._arrays import Floats, Integers
from igps.mesh.mesh import Mesh
from igps.mesh.surface import face_areas
from igps.signature.ordering import systematic_sample


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on the faces of a mesh."""

    mesh: Mesh
    face: Integers  # (P,) index of each point's face
    weights: Floats  # (P, 3) barycentric coordinates in the face

    @property
    def positions(self) -> Floats:
        """Positions (P, 3), length."""
        return self.interpolate(self.mesh.vertices)

    def interpolate(self, values: Floats) -> Floats:
        """Return the linear interpolation (P, D) of values (V, D) at the vertices."""
        corners = self.mesh.faces[self.face]
        return np.einsum("pi,pid->pd", self.weights, values[corners])


def surface_points(
    mesh: Mesh, n_points: int, seed: int, keys: Floats | None = None
) -> SurfacePoints:
    """Draw random points, uniformly distributed over the surface.

    Keys (V,) of the vertices, see `igps.signature.ordering`, give faces and corners an order independent of their
    numbering. One point is then drawn in each of `n_points` equal parts of the area, and the points are in that order.
    """
    generator = np.random.default_rng(seed)
    areas = face_areas(mesh.vertices, mesh.faces)
    if keys is None:
        shares = areas / areas.sum()
        face = generator.choice(len(areas), size=n_points, p=shares)
        return SurfacePoints(mesh, face, _in_triangles(n_points, generator))
    corner_keys = keys[mesh.faces]
    order = np.argsort(corner_keys.sum(axis=1), kind="stable")
    drawn = systematic_sample(areas[order], n_points, generator)
    face = order[drawn]
    corner_order = np.argsort(corner_keys, axis=1)[face]
    in_triangles = _in_triangles(n_points, generator)
    weights = np.empty((n_points, 3))
    np.put_along_axis(weights, corner_order, in_triangles, axis=1)
    return SurfacePoints(mesh, face, weights)


def _in_triangles(n_points: int, generator: np.random.Generator) -> Floats:
    """Draw uniform barycentric coordinates (P, 3) in a triangle (Osada et al. 2002, equation 1)."""
    r = np.sqrt(generator.random(n_points))
    s = generator.random(n_points)
    return np.column_stack([1 - r, r * (1 - s), r * s])
