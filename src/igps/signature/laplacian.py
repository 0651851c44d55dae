"""The Laplace–Beltrami operator of a triangle mesh: positive semi-definite stiffness and lumped mass."""

from typing import get_args

import numpy as np
from scipy import sparse

from igps._arrays import Floats
from igps._parameters import check_one_of
from igps.mesh.mesh import Mesh
from igps.mesh.surface import lengths, longest_side
from igps.signature.config import Backend

# Smallest thickness, twice the area over the squared longest edge, of a face without mollified edge lengths.
_MIN_THICKNESS = 1e-8
# Length added to each edge of a thinner face, in units of its longest edge: limits its cotangents to about a thousand.
_MOLLIFIER = 1e-6


def laplacian(mesh: Mesh, backend: Backend = "cotangent") -> tuple[sparse.csr_matrix, Floats]:
    """Return stiffness and mass of the generalised eigenproblem `stiffness φ = λ mass φ`.

    Args:
        mesh: V vertices.
        backend: "cotangent" is the paper's operator: cotangent stiffness (Pinkall and Polthier 1993) with mixed Voronoi
            mass (Meyer et al. 2002). "robust" is the tufted intrinsic-Delaunay Laplacian (Sharp and Crane 2020), for
            surfaces with many sliver triangles.

    Returns:
        stiffness (V, V), symmetric positive semi-definite with rows that sum to zero, dimensionless; mass (V,) > 0,
        length², which sums to the surface area.

    Raises:
        ImportError: backend "robust" without `robust-laplacian` installed.
    """
    check_one_of(get_args(Backend), backend=backend)
    if backend == "cotangent":
        return _cotangent(mesh)
    try:
        import robust_laplacian
    except ImportError as error:
        remedy = 'pip install "interior-gps[robust]"'
        raise ImportError(f'backend="robust" needs robust-laplacian: {remedy}.') from error
    # Scale the mesh to unit size, because robust-laplacian mollifies by an absolute length.
    scale = longest_side(mesh.vertices)
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    faces = np.asarray(mesh.faces)
    stiffness, mass = robust_laplacian.mesh_laplacian(centred / scale, faces)
    return stiffness.tocsr(), mass.diagonal() * scale**2


def _cotangent(mesh: Mesh) -> tuple[sparse.csr_matrix, Floats]:
    corners = mesh.vertices[mesh.faces]
    # Column i is the edge opposite corner i.
    following = np.roll(corners, -1, axis=1)
    edges = np.roll(corners, -2, axis=1) - following
    squared = np.einsum("fij,fij->fi", edges, edges)
    normals = np.cross(edges[:, 0], edges[:, 1])
    double_area = lengths(normals)
    is_thin = double_area <= _MIN_THICKNESS * squared.max(axis=1)
    if is_thin.any():
        # Intrinsic mollification (Sharp and Crane 2020) of the degenerate faces alone: the cotangent matrix stays
        # positive semi-definite, and a vertex whose faces all have zero area keeps a positive mass.
        longer = np.sqrt(squared[is_thin])
        longer += _MOLLIFIER * longer.max(axis=1, keepdims=True)
        squared[is_thin] = longer**2
        double_area[is_thin] = 2 * _areas_by_lengths(longer)
    # cot at corner i = (b·b + c·c − a·a) / (4 area), where a is the edge opposite corner i.
    differences = squared.sum(axis=1, keepdims=True) - 2 * squared
    cotangents = differences / (2 * double_area[:, None])
    stiffness = _stiffness(mesh, cotangents)
    mass = _mixed_voronoi_mass(mesh, cotangents, squared, double_area[:, None] / 2)
    return stiffness, mass


def _areas_by_lengths(sides: Floats) -> Floats:
    """Return areas by Heron's formula in Kahan's arrangement, which is stable for needles."""
    shortest, middle, longest = np.sort(sides, axis=1).T
    difference = longest - middle
    product = longest + (middle + shortest)
    product = product * (shortest - difference)
    product = product * (shortest + difference)
    product = product * (longest + (middle - shortest))
    return np.sqrt(product) / 4


def _stiffness(mesh: Mesh, cotangents: Floats) -> sparse.csr_matrix:
    # Half of each corner's cotangent belongs to the edge opposite it. Enter it at one of the edge's two entries.
    starts = np.roll(mesh.faces, -1, axis=1)
    ends = np.roll(mesh.faces, -2, axis=1)
    edges = (starts.ravel(), ends.ravel())
    halves = cotangents.ravel() / 2
    n_vertices = len(mesh.vertices)
    directed = sparse.csr_matrix((halves, edges), shape=(n_vertices, n_vertices))
    weights = directed + directed.T
    row_sums = np.asarray(weights.sum(axis=1))
    return sparse.diags(row_sums.ravel(), format="csr") - weights


def _mixed_voronoi_mass(mesh: Mesh, cotangents: Floats, squared: Floats, area: Floats) -> Floats:
    # Meyer et al. 2002, section 3.3. The Voronoi area of corner i is the sum of edge² · cot / 8 over the two edges
    # at i, with the angle opposite the edge. In an obtuse face the corners get fixed shares of the area instead.
    share = squared * cotangents / 8
    voronoi = share.sum(axis=1, keepdims=True) - share
    is_obtuse = cotangents < 0
    fixed = np.where(is_obtuse, area / 2, area / 4)
    has_obtuse = is_obtuse.any(axis=1, keepdims=True)
    corner_areas = np.where(has_obtuse, fixed, voronoi)
    mass = np.zeros(len(mesh.vertices))
    np.add.at(mass, mesh.faces, corner_areas)
    return mass
