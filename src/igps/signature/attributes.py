"""Attributes of samples: scalars and directions that a histogram may use as axes, beside the potential."""

from collections.abc import Mapping, Sequence

import numpy as np

from igps._arrays import Floats, Integers, Singles
from igps.mesh.mesh import Mesh
from igps.mesh.surface import area_vectors, lengths, unit
from igps.signature.config import AttributeName
from igps.signature.surface_potential import surface_potential


def interior_attributes(
    mesh: Mesh, points: Floats, names: Sequence[AttributeName]
) -> Mapping[str, Singles]:
    """Return the named attributes (P,), or (P, 3) for a direction, of interior points (P, 3); none depends on scale."""
    attributes = {}
    for function in (depth, electrostatic_potential, surface_direction):
        if function.__name__ in names:
            values = function(mesh, points)
            attributes[function.__name__] = values.astype(np.float32)
    return attributes


def surface_attributes(
    mesh: Mesh, faces: Integers, names: Sequence[AttributeName]
) -> Mapping[str, Singles]:
    """Return the named attributes of points on faces (P,): only "surface_direction", here the outward normal (P, 3)."""
    if "surface_direction" not in names:
        return {}
    normals = area_vectors(mesh.vertices, mesh.faces)[faces]
    return {"surface_direction": unit(normals).astype(np.float32)}


def depth(mesh: Mesh, points: Floats) -> Floats:
    """Return the distances (P,) of points (P, 3) from the surface over √area: at most 0.28, in the centre of a ball."""
    distances = lengths(_vectors_to_surface(mesh, points))
    return distances / np.sqrt(mesh.area)


def surface_direction(mesh: Mesh, points: Floats) -> Floats:
    """Return unit vectors (P, 3) from interior points (P, 3) to the nearest surface points.

    Near the surface this is the outward normal, on it 0. If several surface points are nearest, as on the axis of a
    tube, one of their directions is returned.
    """
    return unit(_vectors_to_surface(mesh, points))


def _vectors_to_surface(mesh: Mesh, points: Floats) -> Floats:
    import igl

    arrays = map(np.ascontiguousarray, (points, mesh.vertices, mesh.faces))
    _, _, nearest = igl.point_mesh_squared_distance(*arrays)
    return np.asarray(nearest) - points


def electrostatic_potential(mesh: Mesh, points: Floats) -> Floats:
    """Return the potentials (P,) of a uniform unit charge on the surface, (1/√area) ∫ dS/|x − s|, at points x (P, 3).

    It is √4π in a ball. It is high where much surface is near, as deep in thick parts and among folds, and low in thin
    limbs and at their tips. It does not depend on the triangulation, and is finite on the surface. Rustamov 2010,
    section 4, names electrostatic potentials as a further dimension; if a body has charges of its own (a protein), pass
    their potential as an attribute instead. See `surface_potential` for the method and its error.
    """
    potentials = surface_potential(mesh.vertices, mesh.faces, points)
    return potentials / np.sqrt(mesh.area)
