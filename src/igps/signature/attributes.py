"""Scalars and directions of samples that a histogram may be split by, beside the potential."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from igps._arrays import Floats, Integers, Singles
from igps.mesh.mesh import Mesh
from igps.mesh.surface import area_vectors, unit
from igps.signature.surface_potential import surface_potential

AttributeName = Literal["depth", "electrostatic_potential", "surface_direction"]


def interior_attributes(mesh: Mesh, points: Floats, names: Sequence[AttributeName]) -> Mapping[str, Singles]:
    """The named attributes of points inside, (P,) or (P, 3), free of scale and motion."""
    functions = {
        "depth": depth,
        "electrostatic_potential": electrostatic_potential,
        "surface_direction": surface_direction,
    }
    return {name: functions[name](mesh, points).astype(np.float32) for name in names}


def surface_attributes(mesh: Mesh, faces: Integers, names: Sequence[AttributeName]) -> Mapping[str, Singles]:
    """Those of the named attributes that points on these faces (P,) have: "surface_direction", the outward normal."""
    if "surface_direction" not in names:
        return {}
    normals = area_vectors(mesh.vertices, mesh.faces)[faces]
    return {"surface_direction": unit(normals).astype(np.float32)}


def depth(mesh: Mesh, points: Floats) -> Floats:
    """(P,) distances of points (P, 3) to the surface over √area: 0 on it, 0.28 in the centre of a ball, its maximum."""
    return np.linalg.norm(_to_surface(mesh, points), axis=1) / np.sqrt(mesh.area)


def surface_direction(mesh: Mesh, points: Floats) -> Floats:
    """(P, 3) unit vectors from points (P, 3) inside to the nearest of the surface, the outward normal near it; 0 on it.

    Where several points of the surface are nearest, as on the axis of a tube, it is one of their directions.
    """
    return unit(_to_surface(mesh, points))


def _to_surface(mesh: Mesh, points: Floats) -> Floats:
    import igl

    *_, nearest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces)
    )
    return np.asarray(nearest) - points


def electrostatic_potential(mesh: Mesh, points: Floats) -> Floats:
    """(P,) potentials of a uniform unit charge on the surface, (1/√area) ∫ dS/|x − s| at points x: √4π in a ball.

    It is high where much surface is near: deep in thick parts and among folded ones, low in thin limbs and at their
    tips. Rustamov 2010, section 4, names electrostatic potentials as a further dimension; where a body has charges of
    its own (a protein), pass that potential as an attribute instead. It does not depend on how the surface is cut into
    triangles; on the surface it is finite. See `surface_potential` for the method and its error.
    """
    return surface_potential(mesh.vertices, mesh.faces, points) / np.sqrt(mesh.area)
