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

    boundary: Boundary = (
        "dirichlet"  # zero on the surface; or "neumann": no flux through the surface
    )
    n_eigenvalues: int = 12  # without the first zero under Neumann conditions
    n_voxels: int = 4000  # a cell has 1/`n_voxels` of the volume, but its side is at least 1/128 of the longest side

    def __post_init__(self) -> None:
        super().__init__()
        check_one_of(get_args(Boundary), boundary=self.boundary)
        check_at_least(1, n_eigenvalues=self.n_eigenvalues, n_voxels=self.n_voxels)

    def describe_body(self, body: Body) -> Singles:
        """(n_eigenvalues,) normalised eigenvalues, ascending, without unit; raises the errors of `volume_spectrum`."""
        return volume_spectrum(body.mesh, self.n_eigenvalues, self.boundary, self.n_voxels).astype(
            np.float32
        )

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) Euclidean distances."""
        return euclidean(queries, gallery)


def volume_spectrum(mesh: Mesh, n_eigenvalues: int, boundary: Boundary, n_voxels: int) -> Floats:
    """Smallest eigenvalues of −Δ in the body, times volume^(2/3), ascending, without the first zero under "neumann".

    Raises:
        MeshError: the body is too thin for the grid, or has too few cells for the eigenvalues.
    """
    inside, cell = _sampled_cells(mesh, n_voxels)
    stiffness, mass = _dirichlet(inside) if boundary == "dirichlet" else _neumann(inside)
    n_skipped = int(boundary == "neumann")
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
    resolution = int(
        np.clip(np.ceil(longest * (n_voxels / abs(mesh.volume)) ** (1 / 3)), 1, _MAX_RESOLUTION)
    )
    cell = longest / resolution
    axes = []
    for axis in grid_axes(mesh, resolution):
        centres = np.concatenate([[axis[0] - cell], axis, [axis[-1] + cell]])
        axes.append((centres[:, None] + np.array([-1, 0, 1]) * cell / 3).ravel())
    inside = inside_grid(mesh, (axes[0], axes[1], axes[2]))
    x, y, z = (len(axis) // 3 for axis in axes)
    return inside.reshape(x, 3, y, 3, z, 3), cell


def _neumann(inside: Booleans) -> tuple[sparse.csr_array, Floats]:
    """Stiffness and diagonal mass of the non-empty cells, lengths in cells."""
    filled = inside.mean(axis=(1, 3, 5))
    mass = filled[filled > 0]
    index = np.full(filled.shape, -1)
    index[filled > 0] = np.arange(len(mass))
    rows, columns, weights = [], [], []
    for i in range(3):
        # With axis i first, (X, 3, Y, 3, Z, 3) becomes (X, 3, others). The facing layers of two neighbours are sampled
        # at the same 3 × 3 positions.
        layers = np.moveaxis(inside, (2 * i, 2 * i + 1), (0, 1))
        aperture = (layers[:-1, 2] & layers[1:, 0]).mean(axis=(2, 4))
        is_open = np.nonzero(aperture)
        cell = np.moveaxis(index, i, 0)
        rows.append(cell[:-1][is_open])
        columns.append(cell[1:][is_open])
        weights.append(aperture[is_open])
    graph = _symmetric(
        np.concatenate(rows), np.concatenate(columns), np.concatenate(weights), len(mass)
    )
    n_components, component = connected_components(graph, directed=False)
    share = np.bincount(component, weights=mass, minlength=n_components) / mass.sum()
    cells = np.nonzero((share >= _MIN_COMPONENT_SHARE)[component])[0]
    graph, mass = graph[cells][:, cells], mass[cells]
    return sparse.diags_array(graph.sum(axis=1)) - graph, mass


def _dirichlet(inside: Booleans) -> tuple[sparse.csr_array, Floats]:
    """Stiffness and unit mass of the cells whose centre is inside, lengths in cells."""
    is_cell = inside[:, 1, :, 1, :, 1]
    n_cells = int(is_cell.sum())
    index = np.full(is_cell.shape, -1)
    index[is_cell] = np.arange(n_cells)
    rows, columns = [], []
    diagonal = np.zeros(is_cell.shape)
    for i in range(3):
        # The points on the grid lines through the cell centres along axis i
        line = np.moveaxis(inside, (2 * i, 2 * i + 1), (0, 1))[:, :, :, 1, :, 1]
        cell = np.moveaxis(index, i, 0)
        for step in (-1, 1):
            # `np.roll` wraps around only into the margin of empty cells.
            first, second = line[:, 1 + step], np.roll(line, -step, axis=0)[:, 1 - step]
            beyond = np.roll(line, -step, axis=0)[:, 1]
            linked = line[:, 1] & first & second & beyond
            # The wall lies between the last point inside and the next point, on average half way.
            wall = (first.astype(int) + (first & second) + 0.5) / 3
            diagonal += np.moveaxis(np.where(linked, 1.0, 1.0 / wall), 0, i)
            if step == 1:
                rows.append(cell[linked])
                columns.append(np.roll(cell, -1, axis=0)[linked])
    row = np.concatenate(rows)
    graph = _symmetric(row, np.concatenate(columns), np.ones(len(row)), n_cells)
    return sparse.diags_array(diagonal[is_cell]) - graph, np.ones(n_cells)


def _symmetric(rows: Integers, columns: Integers, weights: Floats, size: int) -> sparse.csr_array:
    entries = (
        np.concatenate([weights, weights]),
        (np.concatenate([rows, columns]), np.concatenate([columns, rows])),
    )
    return sparse.coo_array(entries, shape=(size, size)).tocsr()


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
        complement = LinearOperator(
            matrix.shape,
            lambda u, q=vectors: _project(factor.solve(_project(u, q)), q),
            dtype=np.float64,
        )
        inverses, candidates = eigsh(
            complement, _N_RECHECKED, which="LA", v0=_project(start, vectors), tol=_TOLERANCE
        )
        missed = shift + 1 / inverses < values.max() - _TOLERANCE * (values.max() - shift)
        if not missed.any():
            return np.sort(values)
        values = np.concatenate([values, shift + 1 / inverses[missed]])
        smallest = np.argsort(values)[:n_values]
        values, vectors = values[smallest], np.hstack([vectors, candidates[:, missed]])[:, smallest]


def _project(vector: Floats, basis: Floats) -> Floats:
    """The part of a vector orthogonal to an orthonormal basis."""
    return vector - basis @ (basis.T @ vector)
