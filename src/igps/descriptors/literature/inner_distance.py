"""Inner distance: the length of the shortest path between two points that stays in the body (Ling and Jacobs 2007).

The interior samples are centres of cells of a cubic grid. They are the nodes of a graph whose links run in 98
directions, from each cell to the visible ones of the 5³ cells around it. A link within the 3³ nearest cells may pass
between two cells; a longer link must run through cells of the body. A path along the links is never shorter than the
inner distance in the union of the cells. Where all cells between two samples are inside, as in a box, it is at most
`METRICATION` times as long as their Euclidean distance.
"""

from itertools import product

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from igps._arrays import Floats, Integers, Singles
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.descriptors.literature._linear_histogram import linear_histogram
from igps.nn.descriptor import BodyDescriptor

METRICATION = 1.0495
"""Largest ratio of the shortest path along the links to the Euclidean distance of its ends, in free space."""

_GRID_TOLERANCE = 1e-3  # largest distance of a sample from a grid point, in cells


class InnerDistance(BodyDescriptor):
    """Histogram of the inner distances between interior samples, in units of √area.

    The pairs of samples are those of a random subset, the sources, with all samples.

    Source: Ling and Jacobs 2007 for the distance; Liu, Fang and Ramani 2009 for its histogram as a signature of solids,
    there over surface samples.
    """

    name = "inner_distance"
    source = "Liu, Fang and Ramani 2009"
    invariant_to = ("motion", "scale", "pose")
    requirements = Requirements()

    n_bins = 64  # distance bins, with a linear kernel
    # Upper end of the last bin, in units of √area; larger distances go into this bin
    max_distance = 3.0
    n_sources = 200  # samples from which paths start; all samples if there are fewer

    def describe_body(self, body: Body) -> Singles:
        """(n_bins,) histogram of sum 1; raises the errors of `inner_distances`."""
        points = body.interior.points
        n_sources = min(self.n_sources, len(points))
        sources = np.random.default_rng(0).permutation(len(points))[:n_sources]
        lengths = inner_distances(points, sources)
        lengths[np.arange(n_sources), sources] = np.nan  # a sample and itself are no pair
        ratio = lengths[~np.isnan(lengths)] / np.sqrt(body.area)
        return linear_histogram([ratio / self.max_distance], [self.n_bins]).astype(np.float32)


def inner_distances(points: Floats, sources: Integers) -> Floats:
    """Lengths (S, P) of the shortest paths along the links, from some samples to all samples of a body.

    Where the grid is too coarse for a thin part, the graph falls into components. Each component is then joined to its
    nearest one by a straight link between their closest samples, until the graph is connected.

    Args:
        points: (P, 3) interior samples, centres of cells of a cubic grid.
        sources: (S,) indices of samples.

    Raises:
        ValueError: fewer than two points, or points that are not on a grid.
    """
    cells, cell = _grid_indices(points)
    graph = _connect(_visible_links(cells), cells) * cell
    return np.atleast_2d(dijkstra(graph, directed=True, indices=sources))


def _grid_indices(points: Floats) -> tuple[Integers, float]:
    """Indices of the cells (P, 3), from 0 on, and the side of a cell."""
    if len(points) < 2:
        raise ValueError(
            f"points: expected at least two interior samples, got {len(points)}. Raise the resolution."
        )
    origin = points.min(axis=0)
    relative = points - origin
    along_axes = np.sort(relative, axis=0)
    gaps = np.diff(along_axes, axis=0).T.ravel()
    gaps = gaps[gaps > 1e-9 * relative.max()]  # others are rounding
    # Each gap is a multiple of the cell, but the smallest gap may be several cells.
    for divisor in (1, 2, 3, 4, 5):
        cell = float(gaps.min()) / divisor
        position = relative / cell
        cells = np.round(position).astype(np.int64)
        error = np.abs(position - cells).max()
        if error < _GRID_TOLERANCE * divisor:
            return cells, cell
    raise ValueError(
        "points: expected cell centres of a cubic grid along the axes; take those of a Signature."
    )


def _visible_links(cells: Integers) -> sparse.csr_array:
    """Symmetric (P, P) matrix of the lengths of the links, in cells."""
    # The grid is padded by two cells, so that no offset wraps around.
    shape = tuple(cells.max(axis=0) + 5)
    padded = cells + 2
    flat = np.ravel_multi_index(tuple(padded.T), shape)
    sample_at = np.full(int(np.prod(shape)), -1)
    sample_at[flat] = np.arange(len(cells))
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    rows = []
    columns = []
    lengths = []
    # Steps of at most two cells along each axis, without multiples of shorter steps: 98 directions.
    steps = np.array(list(product(range(-2, 3), repeat=3)))
    is_shortest = np.gcd.reduce(steps, axis=1) == 1
    for offset in steps[is_shortest]:
        target = sample_at[flat + offset @ strides]
        linked = target >= 0
        if np.abs(offset).max() == 2:
            # The middle half of the segment lies in two cells, one on each side of its midpoint.
            for share in (0.375, 0.625):
                crossed = np.round(share * offset).astype(int)
                linked &= sample_at[flat + crossed @ strides] >= 0
        sources = np.flatnonzero(linked)
        rows.append(sources)
        columns.append(target[linked])
        lengths.append(np.full(len(sources), np.linalg.norm(offset)))
    row = np.concatenate(rows)
    column = np.concatenate(columns)
    length = np.concatenate(lengths)
    shape = (len(cells), len(cells))
    return sparse.coo_array((length, (row, column)), shape=shape).tocsr()


def _connect(graph: sparse.csr_array, cells: Integers) -> sparse.csr_array:
    """Link each component of a graph to its nearest one, until the graph is connected (Borůvka 1926)."""
    while True:
        n_components, component = connected_components(graph, directed=False)
        if n_components == 1:
            return graph
        for i in range(n_components):
            own = np.flatnonzero(component == i)
            others = np.flatnonzero(component != i)
            length, nearest = KDTree(cells[own]).query(cells[others])
            closest = int(np.argmin(length))
            start = own[nearest[closest]]
            end = others[closest]
            bridge = sparse.coo_array(([length[closest]], ([start], [end])), graph.shape)
            # A maximum, as two components that are nearest to each other give the same link twice.
            graph = graph.maximum(bridge).maximum(bridge.T).tocsr()
