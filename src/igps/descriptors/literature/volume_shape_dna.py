"""Volumetric Shape-DNA: the spectrum of the Laplacian in the body (Reuter, Wolter and Peinecke 2005, 2006).

The body is divided into cubic cells. The volume of a cell is a fixed share of the body's volume, so that the grid
adapts to scale and a thin body has as many cells as a stout one.

The functions are zero on the surface (Dirichlet). They are approximated by finite differences at the cell centres
inside, with the wall at its distance along the grid line, in the symmetric second-order form of Gibou, Fedkiw, Cheng
and Kang 2002. For that distance, a cell is sampled at 3³ points. Parts thinner than a cell are left out; they would
only add eigenvalues far above the first ones.
"""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, lobpcg, splu
from torch import Tensor

from igps._arrays import Booleans, Floats, Singles
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import longest_side
from igps.nn.descriptor import BodyDescriptor
from igps.retrieval.distances import euclidean
from igps.signature.voxels import grid_axes, inside_grid

_MAX_RESOLUTION = 128  # cells along the longest side; 3³ points for each cell must fit into memory
# Largest residual of a unit vector; the error of an eigenvalue is about its square
_TOLERANCE = 1e-6
_MAX_STEPS = 200
_N_GUARDS = 5  # further vectors of the block, which converge last


class VolumeShapeDNA(BodyDescriptor):
    """The first non-zero eigenvalues of the Laplacian in the body, times volume^(2/3).

    Source: Reuter, Wolter and Peinecke 2005, 2006 (normalisation, Euclidean distance); 12 eigenvalues as in `ShapeDNA`.
    """

    name = "volume_shape_dna"
    source = "Reuter, Wolter and Peinecke 2005"
    invariant_to = ("motion", "scale")
    requirements = Requirements(mesh=True)

    n_eigenvalues = 12
    n_voxels = 4000  # a cell has 1/`n_voxels` of the volume, but its side is at least 1/128 of the longest side

    def describe_body(self, body: Body) -> Singles:
        """(n_eigenvalues,) normalised eigenvalues, ascending, without unit; raises the errors of `volume_spectrum`."""
        values = volume_spectrum(body.mesh, self.n_eigenvalues, self.n_voxels)
        return values.astype(np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) Euclidean distances."""
        return euclidean(queries, gallery)


def volume_spectrum(mesh: Mesh, n_eigenvalues: int, n_voxels: int) -> Floats:
    """Smallest eigenvalues of −Δ in the body, times volume^(2/3), ascending.

    Raises:
        MeshError: the body is too thin for the grid, or has too few cells for the eigenvalues.
    """
    inside, cell = _sampled_cells(mesh, n_voxels)
    stiffness = _stiffness(inside)
    # The search for a block of eigenvectors needs a space that is several times as large
    min_cells = 5 * (n_eigenvalues + _N_GUARDS) + 1
    n_cells = stiffness.shape[0]
    if n_cells < min_cells:
        raise MeshError(
            f"{mesh.name}: {n_cells} cells are too few for {n_eigenvalues} eigenvalues; at least {min_cells} are "
            "needed. Raise n_voxels, or lower n_eigenvalues."
        )
    scale = (abs(mesh.volume) / cell**3) ** (2 / 3)
    return _smallest_eigenvalues(stiffness, n_eigenvalues) * scale


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


def _stiffness(inside: Booleans) -> sparse.csr_array:
    """Stiffness of the cells whose centre is inside, lengths in cells; each cell has the mass 1."""
    is_cell = inside[:, 1, :, 1, :, 1]
    n_cells = int(is_cell.sum())
    index = np.full(is_cell.shape, -1)
    index[is_cell] = np.arange(n_cells)
    rows = []
    columns = []
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
    row = np.concatenate(rows)
    column = np.concatenate(columns)
    ones = np.ones(len(row))
    links = sparse.coo_array((ones, (row, column)), shape=(n_cells, n_cells)).tocsr()
    return sparse.diags_array(diagonal[is_cell]) - links - links.T


def _smallest_eigenvalues(stiffness: sparse.csr_array, n_values: int) -> Floats:
    """Smallest eigenvalues of K u = λ u, ascending (LOBPCG, Knyazev 2001, with K⁻¹ as preconditioner).

    A block of vectors finds all copies of multiple eigenvalues.
    """
    matrix = stiffness.tocsc()
    # The matrix is positive definite: factorize without pivoting, in an elimination order for symmetric matrices.
    factor = splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    inverse = LinearOperator(matrix.shape, factor.solve, matmat=factor.solve, dtype=np.float64)
    random = np.random.default_rng(0)
    start = random.standard_normal((matrix.shape[0], n_values + _N_GUARDS))
    values, _ = lobpcg(matrix, start, M=inverse, tol=_TOLERANCE, maxiter=_MAX_STEPS, largest=False)
    return np.sort(values)[:n_values]
