"""Volumetric Shape-DNA: the spectrum of the Laplacian in the body (Reuter, Wolter and Peinecke 2005, 2006).

The body is divided into cubic cells. The volume of a cell is a fixed share of the body's volume, so that the grid
adapts to scale and a thin body has as many cells as a stout one. The filled share of a cell is sampled at 3³ points.

Neumann: finite volumes of the cut cells (Ng, Min and Gibou 2009 for the fractions). The mass of a cell is its filled
volume, and the flux between two cells goes through the open share of their common face. So a limb thinner than a cell
keeps its cross-section and its connection. A body of several components has several zero eigenvalues, as in the limit
of ever thinner necks. Only the first zero is left out.

Dirichlet: finite differences at the cell centres inside, with the wall at its distance along the grid line, in the
symmetric second-order form of Gibou, Fedkiw, Cheng and Kang 2002. Parts thinner than a cell are left out; they would
only add eigenvalues far above the first ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, eigsh, splu
from torch import Tensor

from igps._arrays import Booleans, Floats, Integers, Singles
from igps._parameters import check_at_least, check_one_of
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import longest_side
from igps.nn.descriptor import BodyDescriptor
from igps.retrieval.distances import euclidean
from igps.signature.voxels import grid_axes, inside_grid

Boundary = Literal["dirichlet", "neumann"]

# Components with a smaller share of the volume are artefacts of the sampling, at tips and seams. Each adds a zero.
_MIN_COMPONENT_SHARE = 0.01
_MAX_RESOLUTION = 128  # cells along the longest side; 3³ points for each cell must fit into memory
# Shift of the inverse iteration, in units of volume^(-2/3): below the zero mode, and far from singular.
_SHIFT = -1.0
# Relative accuracy of the eigenvalues' distances from the shift, far below the error of the grid.
_TOLERANCE = 1e-8
_N_RECHECKED = 3  # eigenvalues in each search for missed copies of multiple eigenvalues


@dataclass(eq=False, repr=False)
class VolumeShapeDNA(BodyDescriptor):
    """The first non-zero eigenvalues of the Laplacian in the body, times volume^(2/3).

    Source: Reuter, Wolter and Peinecke 2005, 2006 (normalisation, Euclidean distance); 12 eigenvalues as in `ShapeDNA`.
    """

    name = "volume_shape_dna"
    source = "Reuter, Wolter and Peinecke 2005"
    invariant_to = ("motion", "scale")
    requirements = Requirements(mesh=True)

    # Zero on the surface; or "neumann": no flux through the surface
    boundary: Boundary = "dirichlet"
    n_eigenvalues: int = 12  # without the first zero under Neumann conditions
    n_voxels: int = 4000  # a cell has 1/`n_voxels` of the volume, but its side is at least 1/128 of the longest side

    def __post_init__(self) -> None:
        super().__init__()
        check_one_of(get_args(Boundary), boundary=self.boundary)
        check_at_least(1, n_eigenvalues=self.n_eigenvalues, n_voxels=self.n_voxels)

    def describe_body(self, body: Body) -> Singles:
        """(n_eigenvalues,) normalised eigenvalues, ascending, without unit; raises the errors of `volume_spectrum`."""
        values = volume_spectrum(body.mesh, self.n_eigenvalues, self.boundary, self.n_voxels)
        return values.astype(np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) Euclidean distances."""
        return euclidean(queries, gallery)


def volume_spectrum(mesh: Mesh, n_eigenvalues: int, boundary: Boundary, n_voxels: int) -> Floats:
    """Smallest eigenvalues of −Δ in the body, times volume^(2/3), ascending, without the first zero under "neumann".

    Raises:
        MeshError: the body is too thin for the grid, or has too few cells for the eigenvalues.
    """
    inside, cell = _sampled_cells(mesh, n_voxels)
    if boundary == "dirichlet":
        stiffness, mass = _dirichlet(inside)
        n_skipped = 0
    else:
        stiffness, mass = _neumann(inside)
        n_skipped = 1
    # ARPACK needs space for its basis, and the search for missed eigenvalues needs a complement of that size.
    min_cells = 2 * (n_eigenvalues + n_skipped + _N_RECHECKED) + 1
    if len(mass) < min_cells:
        raise MeshError(
            f"{mesh.name}: {len(mass)} cells are too few for {n_eigenvalues} eigenvalues; at least {min_cells} are "
            "needed. Raise n_voxels, or lower n_eigenvalues."
        )
    scale = (abs(mesh.volume) / cell**3) ** (2 / 3)
    values = _smallest_eigenvalues(stiffness, mass, n_eigenvalues + n_skipped, _SHIFT / scale)
    return np.maximum(values[n_skipped:], 0) * scale


def _sampled_cells(mesh: Mesh, n_voxels: int) -> tuple[Booleans, float]:
    """Whether 3³ points per cell are inside, (X, 3, Y, 3, Z, 3), with a margin of empty cells; and the cell side."""
    longest = longest_side(mesh.vertices)
    cells_per_length = (n_voxels / abs(mesh.volume)) ** (1 / 3)
    n_longest = np.ceil(longest * cells_per_length)
    resolution = int(np.clip(n_longest, 1, _MAX_RESOLUTION))
    cell = longest / resolution
    thirds = np.array([-1, 0, 1]) * cell / 3
    axes = []
    for axis in grid_axes(mesh, resolution):
        before = axis[0] - cell
        after = axis[-1] + cell
        centres = np.concatenate([[before], axis, [after]])
        points = centres[:, None] + thirds
        axes.append(points.ravel())
    x, y, z = axes
    inside = inside_grid(mesh, (x, y, z))
    shape = (len(x) // 3, 3, len(y) // 3, 3, len(z) // 3, 3)
    return inside.reshape(shape), cell


def _neumann(inside: Booleans) -> tuple[sparse.csr_array, Floats]:
    """Stiffness and diagonal mass of the non-empty cells, lengths in cells."""
    filled = inside.mean(axis=(1, 3, 5))
    is_cell = filled > 0
    mass = filled[is_cell]
    index = np.full(filled.shape, -1)
    index[is_cell] = np.arange(len(mass))
    rows = []
    columns = []
    weights = []
    for i in range(3):
        # With axis i first, (X, 3, Y, 3, Z, 3) becomes (X, 3, others). The facing layers of two neighbours are sampled
        # at the same 3 × 3 positions.
        layers = np.moveaxis(inside, (2 * i, 2 * i + 1), (0, 1))
        is_open_at = layers[:-1, 2] & layers[1:, 0]
        aperture = is_open_at.mean(axis=(2, 4))
        is_open = np.nonzero(aperture)
        cell = np.moveaxis(index, i, 0)
        rows.append(cell[:-1][is_open])
        columns.append(cell[1:][is_open])
        weights.append(aperture[is_open])
    graph = _symmetric(rows, columns, weights, len(mass))
    n_components, component = connected_components(graph, directed=False)
    volumes = np.bincount(component, weights=mass, minlength=n_components)
    is_large = volumes / mass.sum() >= _MIN_COMPONENT_SHARE
    cells = np.flatnonzero(is_large[component])
    graph = graph[cells][:, cells]
    degrees = sparse.diags_array(graph.sum(axis=1))
    return degrees - graph, mass[cells]


def _dirichlet(inside: Booleans) -> tuple[sparse.csr_array, Floats]:
    """Stiffness and unit mass of the cells whose centre is inside, lengths in cells."""
    is_cell = inside[:, 1, :, 1, :, 1]
    n_cells = int(is_cell.sum())
    index = np.full(is_cell.shape, -1)
    index[is_cell] = np.arange(n_cells)
    rows = []
    columns = []
    weights = []
    diagonal = np.zeros(is_cell.shape)
    for i in range(3):
        # The points on the grid lines through the cell centres along axis i
        layers = np.moveaxis(inside, (2 * i, 2 * i + 1), (0, 1))
        line = layers[:, :, :, 1, :, 1]
        centre = line[:, 1]
        cell = np.moveaxis(index, i, 0)
        for step in (-1, 1):
            # `np.roll` wraps around only into the margin of empty cells.
            neighbour = np.roll(line, -step, axis=0)
            first = line[:, 1 + step]
            second = neighbour[:, 1 - step]
            both = first & second
            linked = centre & both & neighbour[:, 1]
            # The wall lies between the last point inside and the next point, on average half way.
            wall = (first.astype(int) + both + 0.5) / 3
            coefficient = np.where(linked, 1.0, 1.0 / wall)
            diagonal += np.moveaxis(coefficient, 0, i)
            if step == 1:
                next_cell = np.roll(cell, -1, axis=0)
                rows.append(cell[linked])
                columns.append(next_cell[linked])
                weights.append(np.ones(int(linked.sum())))
    graph = _symmetric(rows, columns, weights, n_cells)
    stiffness = sparse.diags_array(diagonal[is_cell]) - graph
    return stiffness, np.ones(n_cells)


def _symmetric(
    rows: Sequence[Integers], columns: Sequence[Integers], weights: Sequence[Floats], size: int
) -> sparse.csr_array:
    """Return a symmetric matrix (size, size) of weights that are given on one side of the diagonal."""
    both_rows = np.concatenate([*rows, *columns])
    both_columns = np.concatenate([*columns, *rows])
    both_weights = np.concatenate([*weights, *weights])
    matrix = sparse.coo_array((both_weights, (both_rows, both_columns)), shape=(size, size))
    return matrix.tocsr()


def _smallest_eigenvalues(
    stiffness: sparse.csr_array, mass: Floats, n_values: int, shift: float
) -> Floats:
    """Smallest eigenvalues of K u = λ M u, ascending, by Lanczos iteration on (K − shift M)⁻¹."""
    scaling = sparse.diags_array(1 / np.sqrt(mass))
    matrix = (scaling @ stiffness @ scaling).tocsc()
    shifted = (matrix - shift * sparse.eye_array(len(mass))).tocsc()
    # The matrix is positive definite: factorize without pivoting, in an elimination order for symmetric matrices.
    factor = splu(
        shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    inverse = LinearOperator(matrix.shape, factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(len(mass))
    values, vectors = eigsh(matrix, n_values, sigma=shift, OPinv=inverse, v0=start, tol=_TOLERANCE)
    while True:
        # An iteration from a single vector may find only one copy of a multiple eigenvalue. The missed copies lie in
        # the orthogonal complement of the eigenvectors found so far.
        def in_complement(vector: Floats, known: Floats = vectors) -> Floats:
            return _project(factor.solve(_project(vector, known)), known)

        complement = LinearOperator(matrix.shape, in_complement, dtype=np.float64)
        start_beside = _project(start, vectors)
        inverses, candidates = eigsh(
            complement, _N_RECHECKED, which="LA", v0=start_beside, tol=_TOLERANCE
        )
        found = shift + 1 / inverses
        largest = values.max()
        is_missed = found < largest - _TOLERANCE * (largest - shift)
        if not is_missed.any():
            return np.sort(values)
        values = np.concatenate([values, found[is_missed]])
        vectors = np.hstack([vectors, candidates[:, is_missed]])
        smallest = np.argsort(values)[:n_values]
        values = values[smallest]
        vectors = vectors[:, smallest]


def _project(vector: Floats, basis: Floats) -> Floats:
    """The part of a vector orthogonal to an orthonormal basis."""
    return vector - basis @ (basis.T @ vector)
