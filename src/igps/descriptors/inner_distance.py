"""Inner distance: how far apart two points of a body are for something that cannot leave it (Ling and Jacobs 2007).

The interior samples are centres of cells of a cubic grid. They are the nodes of a graph that links each to those of the
5³ cells around it that it can see: 98 directions. The segment to a cell of the 3³ next ones may pass between two
cells, a longer one must run through cells of the body. A path along the links is never shorter than the inner distance
of the cells' body, and where all cells between two samples are inside, as in a box, at most `METRICATION` times
their Euclidean distance.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from igps._arrays import Floats, Integers, Singles
from igps._parameters import check_at_least, check_positive
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.descriptors._linear_histogram import linear_histogram
from igps.nn.descriptor import BodyDescriptor

METRICATION = 1.0495
"""Largest ratio of the length of a path of links to the Euclidean distance of its ends, in free space."""

# The largest distance from a multiple of the cell, in cells, that rounding can make.
_OFF_GRID = 1e-3


@dataclass(eq=False, repr=False)
class InnerDistance(BodyDescriptor):
    """Histogram of the lengths of the shortest paths inside the body between its interior samples, over √area.

    Source: Ling and Jacobs 2007 for the distance, Liu, Fang and Ramani 2009 for its histogram as a signature of a
    solid, there over samples of its surface. Pairs go from a random choice of the samples to all of them.
    """

    name = "inner_distance"
    source = "Liu, Fang and Ramani 2009"
    invariant_to = ("motion", "scale", "pose")
    requirements = Requirements()

    n_bins: int = 64  # distance bins, with a linear kernel
    max_distance: float = 3.0  # upper end of the last bin, in units of √area; larger distances go into it
    n_sources: int = 200  # samples from which paths start; all of them if there are fewer
    seed: int = 0  # of the choice of the sources

    def __post_init__(self) -> None:
        super().__init__()
        check_at_least(2, n_bins=self.n_bins)
        check_at_least(1, n_sources=self.n_sources)
        check_positive(max_distance=self.max_distance)

    def describe_body(self, body: Body) -> Singles:
        """(n_bins,) histogram that sums to 1; for errors see `inner_distances`."""
        points = body.interior.points
        n_sources = min(self.n_sources, len(points))
        sources = np.random.default_rng(self.seed).permutation(len(points))[:n_sources]
        lengths = inner_distances(points, sources)
        lengths[np.arange(n_sources), sources] = np.nan
        ratio = lengths[~np.isnan(lengths)] / np.sqrt(body.area)
        return linear_histogram([ratio / self.max_distance], [self.n_bins]).astype(np.float32)


def inner_distances(points: Floats, sources: Integers) -> Floats:
    """Lengths of the shortest paths along the links inside a body, from some of its samples to all.

    Where the grid is too coarse for a thin part, the cells fall into pieces. Each piece is then joined to its nearest
    one by a straight link between their closest samples, until all are one. From sources (S,) among the cell centres
    (P, 3) of a cubic grid they are (S, P).

    Raises:
        ValueError: fewer than two points, or points that are not on a grid.
    """
    cells, cell = _grid_indices(points)
    graph = _joined(_visible_links(cells), cells) * cell
    return np.atleast_2d(dijkstra(graph, directed=True, indices=sources))


def _grid_indices(points: Floats) -> tuple[Integers, float]:
    """(P, 3) indices of the cells, from 0 on, and the cell's side."""
    if len(points) < 2:
        raise ValueError(f"points: expected at least two interior samples, got {len(points)}. Raise the resolution.")
    origin = points.min(axis=0)
    relative = points - origin
    gaps = np.concatenate([np.diff(np.sort(column)) for column in relative.T])
    gaps = gaps[gaps > 1e-9 * relative.max()]
    # Each gap is a whole number of cells; where no two samples are neighbours in any plane, the least gap is several.
    for divisor in (1, 2, 3, 4, 5):
        cell = float(gaps.min()) / divisor
        position = relative / cell
        cells = np.round(position).astype(np.int64)
        if np.abs(position - cells).max() < _OFF_GRID * divisor:
            return cells, cell
    raise ValueError("points: expected cell centres of a cubic grid along the axes; take those of a Signature.")


def _visible_links(cells: Integers) -> sparse.csr_array:
    """(P, P) lengths of the links, in cells, both ways."""
    # Padded by two cells, so that no offset wraps around.
    shape = tuple(cells.max(axis=0) + 5)
    flat = np.ravel_multi_index(tuple((cells + 2).T), shape)
    number = np.full(int(np.prod(shape)), -1)
    number[flat] = np.arange(len(cells))
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    rows, columns, lengths = [], [], []
    for offset in _offsets():
        target = number[flat + offset @ strides]
        linked = target >= 0
        if np.abs(offset).max() == 2:
            # Between its first and its last quarter the segment crosses two cells, and changes over at the middle.
            for part in (0.375, 0.625):
                crossed = np.round(part * offset).astype(int)
                linked &= number[flat + crossed @ strides] >= 0
        rows.append(np.nonzero(linked)[0])
        columns.append(target[linked])
        lengths.append(np.full(linked.sum(), np.linalg.norm(offset)))
    entries = (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.coo_array(entries, shape=(len(cells), len(cells))).tocsr()


def _offsets() -> Integers:
    """(98, 3) steps of at most two cells along each axis, without those that are multiples of shorter ones."""
    steps = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return steps[np.gcd.reduce(steps, axis=1) == 1]


def _joined(graph: sparse.csr_array, cells: Integers) -> sparse.csr_array:
    """The graph with all its pieces linked, each to its nearest one (Borůvka 1926)."""
    while True:
        n_pieces, piece = connected_components(graph, directed=False)
        if n_pieces == 1:
            return graph
        ends = []
        for i in range(n_pieces):
            own, other = np.nonzero(piece == i)[0], np.nonzero(piece != i)[0]
            length, nearest = KDTree(cells[own]).query(cells[other])
            closest = int(np.argmin(length))
            ends.append((own[nearest[closest]], other[closest], length[closest]))
        a, b, length = (np.array(column) for column in zip(*ends, strict=True))
        # Two pieces that are nearest to each other give the same link twice, which must not add up.
        bridge = sparse.coo_array((length, (a.astype(int), b.astype(int))), shape=graph.shape).tocsr()
        graph = graph.maximum(bridge).maximum(bridge.T).tocsr()
