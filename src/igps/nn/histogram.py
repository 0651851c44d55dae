"""Joint histograms of the distances between all pairs of points, split by the potential of both ends."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations_with_replacement
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import one_hot, pad

from igps.nn.bins import OrderedCentres, middles

Result = TypeVar("Result")

# Rows and columns of a block of pairs: its float32 distances fill half of a core's second-level cache.
_BLOCK = 512
# Counts of one class that a block of rows keeps, so that they stay in that cache as well.
_BLOCK_COUNTS = 2**16
# Entries for each centre in the table from a distance to its interval.
_TABLE_PER_CENTRE = 64
# Moments of a shape that are kept from forward to backward; more are counted a second time.
_MOST_KEPT = 2**22


def pair_histogram(
    embedding: Tensor,
    potential: Tensor,
    *,
    distance_range: float = 4.0,
    potential_range: float = 1.5,
    n_classes: int = 4,
    n_bins: int = 64,
) -> Tensor:
    """Histogram of pairwise distances for every unordered pair of potential classes (Rustamov 2010, section 4).

    Each unordered pair of distinct points counts once, in the row of the classes of its ends. Classes are `n_classes`
    equal intervals of [0, `potential_range`]. Bins have their centres in the middle of `n_bins` equal intervals of
    [0, `distance_range`]; a distance counts in the two bins whose centres surround it, in linear proportion. What lies
    beyond a range counts in its last class or bin.

    Args:
        embedding: (P, D) points; their Euclidean distances are counted.
        potential: (P,) non-negative.
        distance_range: largest distance told apart.
        potential_range: largest potential told apart.
        n_classes: C.
        n_bins: B.

    Returns:
        (C(C+1)/2, B) in the embedding's type, float32 at least, of sum 1; row order (0,0), (0,1), … (0,C−1), (1,1), …

    Raises:
        ValueError: fewer than two points, shapes that do not match, or values that are not finite.
    """
    _check(embedding, potential)
    embedding = _single_at_least(embedding)
    if n_classes < 1 or n_bins < 2 or distance_range <= 0 or potential_range <= 0:
        raise ValueError(
            "expected n_classes >= 1, n_bins >= 2 and positive ranges, got "
            f"{n_classes=}, {n_bins=}, {distance_range=}, {potential_range=}."
        )
    level = (potential * (n_classes / potential_range)).long().clamp_(max=n_classes - 1)
    # Sorted by class, a block of pairs has one class at either end, and needs no class index of its own.
    order = torch.argsort(level, stable=True)
    points = embedding.detach()[order] * (n_bins / distance_range)
    groups = points.split(torch.bincount(level, minlength=n_classes).tolist())
    with torch.autocast(embedding.device.type, enabled=False):
        rows = [_group_histogram(groups[a], groups[b], a == b, n_bins) for a, b in class_pairs(n_classes)]
    counts = torch.stack(rows)
    n_points = len(points)
    return (counts / (n_points * (n_points - 1) / 2)).to(embedding.dtype)


def class_pairs(n_classes: int) -> list[tuple[int, int]]:
    """The unordered pairs of classes in the order of a histogram's rows."""
    return list(combinations_with_replacement(range(n_classes), 2))


def _group_histogram(p: Tensor, q: Tensor, same: bool, n_bins: int) -> Tensor:
    """(B,) float64 linear-kernel counts of the distances, in units of a bin, between two groups of points."""
    total = torch.zeros(2, n_bins, dtype=torch.float64, device=p.device)
    p_norm, q_norm = p.square().sum(dim=1), q.square().sum(dim=1)
    for i in range(0, len(p), _BLOCK):
        rows = slice(i, i + _BLOCK)
        for j in range(i if same else 0, len(q), _BLOCK):
            columns = slice(j, j + _BLOCK)
            squared = torch.addmm(p_norm[rows, None] + q_norm[columns], p[rows], q[columns].T, alpha=-2)
            if same and i == j:
                above = torch.triu_indices(len(squared), len(squared), 1, device=p.device)
                squared = squared[above[0], above[1]]
            # Position on the axis of bin centres, the first centre at 0; below it and beyond the last, held there.
            position = squared.clamp_(min=0.25).sqrt_().sub_(0.5).clamp_(max=n_bins - 1).flatten()
            lower = position.int()
            total[0] += torch.bincount(lower, minlength=n_bins)
            total[1] += torch.bincount(lower, weights=position.frac_(), minlength=n_bins)
    count, upper_share = total
    counts = count - upper_share
    counts[1:] += upper_share[:-1]
    return counts


def _check(embedding: Tensor, potential: Tensor) -> None:
    if embedding.ndim != 2 or potential.shape != embedding.shape[:1]:
        raise ValueError(
            "expected an embedding of shape (P, D) and a potential of shape (P,), got "
            f"{tuple(embedding.shape)} and {tuple(potential.shape)}."
        )
    if len(embedding) < 2:
        raise ValueError(f"embedding: expected at least two points to form a pair, got {len(embedding)}.")
    if not (torch.isfinite(embedding).all() and torch.isfinite(potential).all()):
        raise ValueError("embedding, potential: expected finite values, got NaN or infinity.")
    if (potential < 0).any():
        raise ValueError("potential: expected non-negative values, got a negative one.")


def potential_memberships(potential: Tensor, centres: Tensor) -> Tensor:
    """Soft classes: linear kernels (hats) around ascending centres; all in the first below it, in the last beyond it.

    Args:
        potential: (..., P), or any other scalar of the points.
        centres: (C,) ascending.

    Returns:
        (..., P, C) non-negative, rows of sum 1; differentiable in both arguments.
    """
    # How far past each centre on the way to the next, 0 to 1: successive differences are the hats, and sum to 1.
    passed = ((potential.unsqueeze(-1) - centres[:-1]) / centres.diff()).clamp(0, 1)
    return pad(passed, (1, 0), value=1.0) - pad(passed, (0, 1))


@torch.compiler.disable
def soft_pair_histogram(
    embedding: Tensor,
    memberships: Tensor,
    centres: Tensor,
    *,
    points: Tensor | None = None,
    euclidean_centres: Tensor | None = None,
) -> Tensor:
    """Histogram of pairwise distances with soft classes and bins of any width, differentiable in every argument.

    An unordered pair {i, j} of distinct points counts m_ia·m_jb + m_ib·m_ja in the pair of classes a < b and m_ia·m_ja
    in a = b, each shared between the two bins whose centres surround the distance, in linear proportion; distances
    below the first or beyond the last centre count there. With `points`, their Euclidean distance is one more dimension
    of bins, shared out in the same way.

    The (P, P) distances are never held at once. A gradient by the embedding or the points takes a second pass over the
    pairs; so does one by the memberships, if there are too many numbers, about 2·P·C·B or 4·P·C·B·E, to keep for it.

    Args:
        embedding: (P, D) points; their Euclidean distances are counted.
        memberships: (P, C) non-negative, rows of sum 1; the more of them are zero, the faster.
        centres: (B,) ascending bin centres of the distance.
        points: (P, 3) positions, length.
        euclidean_centres: (E,) ascending bin centres of the distance between positions, length.

    Returns:
        (C(C+1)/2, B), or (C(C+1)/2, B, E), in the embedding's type, float32 at least, of sum 1; row order (0,0), (0,1),
        … (0,C−1), (1,1), …

    Raises:
        ValueError: fewer than two points, shapes that do not match, values that are not finite, memberships that are
            negative or do not sum to 1, centres that do not ascend, or only one of `points` and `euclidean_centres`.
    """
    axes = [(embedding, centres)]
    if points is not None and euclidean_centres is not None:
        axes.append((points, euclidean_centres))
    elif points is not None or euclidean_centres is not None:
        raise ValueError("points, euclidean_centres: expected both or neither, got one of them.")
    _check_soft(memberships, axes)
    dtype = _single_at_least(embedding).dtype
    order = _by_class(memberships.detach())
    ordered = [(points[order].to(dtype), centres.to(dtype)) for points, centres in axes]
    with torch.autocast(embedding.device.type, enabled=False):
        return _SoftPairHistogram.apply(memberships[order].to(dtype), *(tensor for axis in ordered for tensor in axis))


def _single_at_least(values: Tensor) -> Tensor:
    return values.float() if values.dtype in (torch.float16, torch.bfloat16) else values


def _check_soft(memberships: Tensor, axes: Sequence[tuple[Tensor, Tensor]]) -> None:
    for points, centres in axes:
        if points.ndim != 2 or memberships.ndim != 2 or len(points) != len(memberships) or centres.ndim != 1:
            raise ValueError(
                "expected points of shape (P, D), memberships of shape (P, C) and centres of shape (B,), got "
                f"{tuple(points.shape)}, {tuple(memberships.shape)} and {tuple(centres.shape)}."
            )
        if len(points) < 2:
            raise ValueError(f"embedding: expected at least two points to form a pair, got {len(points)}.")
        if not torch.isfinite(points).all():
            raise ValueError("embedding, points: expected finite values, got NaN or infinity.")
        ascending = len(centres) > 1 and bool((centres.diff() > 0).all()) and 0 < centres[-1].item() < math.inf
        if not ascending:
            raise ValueError(
                "centres: expected at least two finite values in ascending order, the last one positive, got "
                f"{centres.tolist()}."
            )
    # Both comparisons are false for NaN.
    if not bool((memberships >= 0).all() & ((memberships.sum(dim=1) - 1).abs() < 1e-3).all()):
        raise ValueError("memberships: expected non-negative rows of sum 1, got others; divide each row by its sum.")


def _by_class(memberships: Tensor) -> Tensor:
    """(P,) order that has the members of a class next to each other where classes overlap as hats do."""
    n_classes = memberships.shape[1]
    level = memberships @ torch.arange(n_classes, dtype=memberships.dtype, device=memberships.device)
    return torch.argsort((memberships > 0).int().argmax(dim=1) + level / n_classes)


class _SoftPairHistogram(torch.autograd.Function):
    """`soft_pair_histogram` of memberships (P, C) and, for each axis, points (P, D) and centres (B,)."""

    @staticmethod
    def forward(ctx: Any, memberships: Tensor, *axes: Tensor) -> Tensor:
        pairs = _BlockedPairs(memberships, axes)
        keep = ctx.needs_input_grad[0] and pairs.n_moments <= _MOST_KEPT

        def task(rows: slice) -> tuple[Tensor, Tensor | None]:
            moments = pairs.moments(rows)
            return (moments @ pairs.memberships[rows]).double(), moments if keep else None

        between_classes, kept = zip(*pairs.over_rows(task), strict=True)
        moments = torch.stack(between_classes).sum(dim=0)
        ctx.save_for_backward(memberships, moments, *axes, *(kept if keep else ()))
        ctx.n_axes = len(pairs.axes)
        histogram = _bins(moments, [centres.double() for centres in axes[1::2]])
        # Of the ordered pairs counted here, the unordered pairs of a class with itself are one half.
        n_points, n_classes = memberships.shape
        a, b = torch.tensor(class_pairs(n_classes), device=memberships.device).T
        share = torch.where(a == b, 1, 2).double() / (n_points * (n_points - 1))
        return (histogram[..., a, b] * share).movedim(-1, 0).to(memberships.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (memberships, moments), tensors = ctx.saved_tensors[:2], ctx.saved_tensors[2:]
        axes, kept = tensors[: 2 * ctx.n_axes], tensors[2 * ctx.n_axes :]
        n_points, n_classes = memberships.shape
        a, b = torch.tensor(class_pairs(n_classes), device=upstream.device).T
        row = torch.zeros(n_classes, n_classes, dtype=torch.long, device=upstream.device)
        row[a, b] = row[b, a] = torch.arange(len(a), device=upstream.device)
        by_count = upstream.double()[row].movedim((0, 1), (-2, -1)) / (n_points * (n_points - 1))
        with torch.enable_grad():
            leaves = [leaf.detach().double().requires_grad_() for leaf in (moments, *axes[1::2])]
            by_moment, *by_centres = torch.autograd.grad(_bins(leaves[0], leaves[1:]), leaves, by_count)
        by_moment = by_moment.to(upstream.dtype)
        by_memberships = None
        by_points: list[Tensor | None] = [None] * ctx.n_axes
        wanted = [k for k in range(ctx.n_axes) if ctx.needs_input_grad[1 + 2 * k]]
        with torch.autocast(upstream.device.type, enabled=False):
            if wanted or (ctx.needs_input_grad[0] and not kept):
                pairs = _BlockedPairs(memberships, axes)
            # Either end of a pair may be the row: hence the factors of 2.
            if ctx.needs_input_grad[0]:
                from_row = 2 * by_moment.flatten(0, -2).T

                def task(rows: slice) -> Tensor:
                    return from_row @ pairs.moments(rows).flatten(0, -2)

                blocks = [from_row @ part.flatten(0, -2) for part in kept] if kept else pairs.over_rows(task)
                by_memberships = torch.cat(blocks, dim=1).T
            if wanted:
                parts = zip(*pairs.over_rows(lambda rows: pairs.gradients(rows, by_moment, wanted)), strict=True)
                for k, part in zip(wanted, parts, strict=True):
                    by_points[k] = 2 * torch.cat(part)
        by_axes = zip(by_points, (gradient.to(upstream.dtype) for gradient in by_centres), strict=True)
        return by_memberships, *(gradient for axis in by_axes for gradient in axis)


def _bins(moments: Tensor, centres: Sequence[Tensor]) -> Tensor:
    """(B, ..., C, C) counts in the bins of each axis, from (C, 2^axes, n_cells, C) moments (see `_BlockedPairs`)."""
    n_axes = len(centres)
    counts = moments.unflatten(2, [len(centre) + 1 for centre in centres]).unflatten(1, (2,) * n_axes)
    counts = counts.permute(*(1 + k + part for k in range(n_axes) for part in (0, n_axes)), 0, -1)
    for k, centre in enumerate(centres):
        count, excess = counts.unbind(k)
        over_rest = (-1, *[1] * (count.ndim - k - 1))
        n_inner = len(centre) - 1
        below, inner, beyond = count.split((1, n_inner, 1), dim=k)
        # The excess was measured from where the centres are; the difference, 0, tells what moving them does.
        moved = (centre.detach() - centre)[:-1].view(over_rest)
        upper = (excess.narrow(k, 1, n_inner) + moved * inner) / centre.diff().view(over_rest)
        counts = torch.cat([below, upper], dim=k) + torch.cat([inner - upper, beyond], dim=k)
    return counts


class _Axis:
    """Distances of one set of points, and the interval between bin centres that each falls into.

    Interval 0 is below the first centre, interval q from centre q−1 to q, interval B beyond the last.
    """

    def __init__(self, points: Tensor, centres: Tensor) -> None:
        self.points = points - points.mean(dim=0)  # keeps digits in the squared distances
        self.norm = self.points.square().sum(dim=1)
        self.n_intervals = len(centres) + 1
        self.floor = pad(centres, (1, 0))
        self.ceiling = pad(centres, (0, 1), value=math.inf)
        # For equal steps of distance, the number of centres in the steps below. With the centres of its own step a
        # distance is compared one by one, so that its interval is exact whatever the layout.
        self.n_steps = _TABLE_PER_CENTRE * len(centres)
        self.steps_per_length = self.n_steps / float(centres[-1])
        in_step = torch.bincount(self._step(centres), minlength=self.n_steps + 1)
        self.n_below = (in_step.cumsum(0) - in_step).int()
        self.most_in_a_step = int(in_step.max())

    def _step(self, distance: Tensor) -> Tensor:
        return (distance * self.steps_per_length).clamp_(0, self.n_steps).int()

    def distances(self, columns: slice, rows: slice) -> Tensor:
        """(J, I) between the points of the columns and of the rows."""
        norms = self.norm[columns, None] + self.norm[rows]
        return norms.addmm_(self.points[columns], self.points[rows].T, alpha=-2).clamp_(min=0).sqrt_()

    def intervals(self, distance: Tensor) -> Tensor:
        """(J, I) int32."""
        interval = _take(self.n_below, self._step(distance))
        for _ in range(self.most_in_a_step):
            interval += distance >= _take(self.ceiling, interval)
        return interval

    def gradient(self, slope: Tensor, distance: Tensor, columns: slice, rows: slice) -> Tensor:
        """(I, D) gradient of the points of the rows, from the (J, I) derivatives by distance."""
        # Coincident points have no direction to move apart in.
        pull = torch.where(distance > 0, slope / distance, 0)
        return self.points[rows] * pull.sum(dim=0)[:, None] - pull.T @ self.points[columns]


class _Chunk:
    """Distances of some columns to the rows, one (J, I) tensor an axis; their excess over the lower centre; the cell.

    The cell, (J, I) int32, is the flat position in (n_cells + 1, I) of the combined interval of all axes and the row.
    """

    def __init__(self, axes: Sequence[_Axis], columns: slice, rows: slice) -> None:
        n_rows = rows.stop - rows.start
        self.columns = columns
        self.distances = [axis.distances(columns, rows) for axis in axes]
        self.excess = []
        n_cells, cell = 1, torch.zeros_like(self.distances[0], dtype=torch.int32)
        for axis, distance in zip(axes, self.distances, strict=True):
            interval = axis.intervals(distance)
            self.excess.append(distance - _take(axis.floor, interval))
            n_cells *= axis.n_intervals
            cell = cell.mul_(axis.n_intervals).add_(interval)
        cell.diagonal(columns.start - rows.start).fill_(n_cells)  # a point with itself is no pair
        self.cell = cell.mul_(n_rows).add_(torch.arange(n_rows, dtype=torch.int32, device=cell.device))


class _BlockedPairs:
    """Sums over all ordered pairs of points, a block of rows and columns at a time.

    The moments of a cell of intervals, one interval an axis, are sums over the pairs in it: of the weight, and of its
    products with the excess of each axis's distance over the lower centre of its interval. As a hat is linear within
    an interval, a histogram and its gradients by the centres depend on the pairs through these moments alone.
    """

    def __init__(self, memberships: Tensor, axes: Sequence[Tensor]) -> None:
        self.memberships = memberships.detach()
        self.axes = [
            _Axis(points.detach(), centres.detach()) for points, centres in zip(axes[::2], axes[1::2], strict=True)
        ]
        self.n_cells = math.prod(axis.n_intervals for axis in self.axes)
        self.n_moments = memberships.numel() * 2 ** len(self.axes) * self.n_cells

    def over_rows(self, task: Callable[[slice], Result]) -> list[Result]:
        """Results of a task for blocks of rows, worked on by as many cores as this thread may use."""
        n_points = len(self.memberships)
        n_threads = torch.get_num_threads() if self.memberships.device.type == "cpu" else 1
        most = min(_BLOCK, max(1, _BLOCK_COUNTS // self.n_cells))
        size = -(-n_points // (-(-n_points // (most * n_threads)) * n_threads))
        blocks = [slice(i, min(i + size, n_points)) for i in range(0, n_points, size)]
        if n_threads == 1:
            return [task(rows) for rows in blocks]
        # One single-threaded block a core: splitting each small operation over all cores waits for the slowest.
        try:
            with ThreadPoolExecutor(n_threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
                return list(pool.map(task, blocks))
        finally:
            torch.set_num_threads(n_threads)

    def _chunks(self, rows: slice) -> Iterator[_Chunk]:
        n_points = len(self.memberships)
        size = _BLOCK * _BLOCK // (rows.stop - rows.start)
        for j in range(0, n_points, size):
            yield _Chunk(self.axes, slice(j, min(j + size, n_points)), rows)

    def _members(self, columns: slice) -> Iterator[tuple[int, Tensor | slice, Tensor]]:
        """Every class with members among the columns: its number, which columns, and their membership (J', 1)."""
        for b, membership in enumerate(self.memberships[columns].T):
            index = membership.nonzero().flatten()
            if len(index):
                first, last = int(index[0]), int(index[-1])
                # A range of rows needs no copy.
                member = slice(first, last + 1) if last - first < len(index) else index
                yield b, member, membership[member, None]

    def moments(self, rows: slice) -> Tensor:
        """(C, 2^axes, n_cells, I) moments of the pairs of each row's point with the members of each class."""
        n_rows, n_classes = rows.stop - rows.start, self.memberships.shape[1]
        total = self.memberships.new_zeros(n_classes, 2 ** len(self.axes), self.n_cells, n_rows)
        for chunk in self._chunks(rows):
            for b, member, membership in self._members(chunk.columns):
                cell = chunk.cell[member].flatten()
                weights = _products(membership.expand(-1, n_rows), [excess[member] for excess in chunk.excess])
                for into, weight in zip(total[b], weights, strict=True):
                    count = torch.bincount(cell, weight.flatten(), minlength=(self.n_cells + 1) * n_rows)
                    into += count.view(-1, n_rows)[:-1]
        return total

    def gradients(self, rows: slice, by_moment: Tensor, wanted: Sequence[int]) -> list[Tensor]:
        """(I, D) gradients of the points of the rows, of each axis wanted, from those by the (C, ..., C) moments."""
        n_rows = rows.stop - rows.start
        tables = []
        for k in wanted:
            slopes = by_moment.unflatten(1, (2,) * len(self.axes)).select(1 + k, 1)
            slopes = slopes.reshape(len(by_moment), -1, *by_moment.shape[2:]) @ self.memberships[rows].T
            tables.append(pad(slopes, (0, 0, 0, 1)).flatten(2))
        total = [torch.zeros_like(self.axes[k].points[rows]) for k in wanted]
        for chunk in self._chunks(rows):
            for k, table, into in zip(wanted, tables, total, strict=True):
                others = [excess for other, excess in enumerate(chunk.excess) if other != k]
                slope = torch.zeros_like(chunk.distances[k])
                for b, member, membership in self._members(chunk.columns):
                    cell = chunk.cell[member]
                    weights = _products(membership.expand(-1, n_rows), [excess[member] for excess in others])
                    slope[member] += sum(weight * _take(t, cell) for weight, t in zip(weights, table[b], strict=True))
                into += self.axes[k].gradient(slope, chunk.distances[k], chunk.columns, rows)
        return total


def _products(weight: Tensor, factors: Sequence[Tensor]) -> list[Tensor]:
    """The weight times every subset of the factors; the last factor alternates fastest."""
    products = [weight]
    for factor in factors:
        products = [part for product in products for part in (product, product * factor)]
    return products


def _take(table: Tensor, index: Tensor) -> Tensor:
    return table.index_select(0, index.flatten()).view_as(index)


class PairHistogram(nn.Module):
    """Pair histograms of a padded batch of shapes, with hard, soft or learned classes and bins.

    Hard classes and no further dimension is `pair_histogram`, which has no gradient. All else is `soft_pair_histogram`:
    soft classes are `potential_memberships` of centres in the middle of the hard classes; classes of further scalars
    multiply those of the potential; Euclidean distance is one more dimension of bins. Learned layouts are soft ones,
    and start as those.

    Args:
        n_classes, n_bins, distance_range, potential_range: see `pair_histogram`.
        soft: whether a point belongs to the two classes whose centres surround its potential, or to the nearest.
        learnable: whether all centres are parameters; implies `soft`.
        attributes: class centres, ascending, of named scalars of the points, in the scalars' unit; the class of the
            first name changes slowest, after that of the potential.
        n_euclidean_bins: E, bins of the Euclidean distance; 0 for none.
        euclidean_range: largest Euclidean distance told apart, in units of √area.

    Raises:
        ValueError: an impossible layout.
    """

    def __init__(
        self,
        n_classes: int = 4,
        n_bins: int = 64,
        distance_range: float = 4.0,
        potential_range: float = 1.5,
        *,
        soft: bool = False,
        learnable: bool = False,
        attributes: Mapping[str, Sequence[float]] | None = None,
        n_euclidean_bins: int = 0,
        euclidean_range: float = 1.0,
    ) -> None:
        super().__init__()
        self.n_classes = n_classes
        self.n_bins = n_bins
        self.distance_range = distance_range
        self.potential_range = potential_range
        self.soft = soft or learnable
        self.distance_centres = OrderedCentres(middles(n_bins, distance_range, "bins"), learnable)
        self.potential_centres = OrderedCentres(middles(n_classes, potential_range, "classes"), learnable)
        self.attribute_centres = nn.ModuleDict(
            {name: OrderedCentres(start, learnable) for name, start in (attributes or {}).items()}
        )
        self.euclidean_centres = (
            OrderedCentres(middles(n_euclidean_bins, euclidean_range, "euclidean_bins"), learnable)
            if n_euclidean_bins
            else None
        )

    @property
    def n_cells(self) -> int:
        """Cells of a histogram, over all its dimensions."""
        n_classes = self.n_classes * math.prod(len(centres.start) for centres in self.attribute_centres.values())  # type: ignore[arg-type, misc]
        n_euclidean_bins = 1 if self.euclidean_centres is None else len(self.euclidean_centres.start)
        return len(class_pairs(n_classes)) * self.n_bins * n_euclidean_bins

    @torch.compiler.disable
    def forward(
        self,
        embedding: Tensor,
        potential: Tensor,
        mask: Tensor,
        *,
        attributes: Mapping[str, Tensor] | None = None,
        points: Tensor | None = None,
    ) -> Tensor:
        """Histograms of N shapes.

        Args:
            embedding: (N, P, D).
            potential: (N, P).
            mask: (N, P) true where a point is real.
            attributes: named scalars of the points, each (N, P); those that have centres are looked up.
            points: (N, P, 3) positions in units of √area; for Euclidean bins.

        Returns:
            (N, C(C+1)/2, B), or (N, C(C+1)/2, B, E), C counting the combinations of all classes.

        Raises:
            ValueError: an attribute or the positions are missing; see `pair_histogram` and `soft_pair_histogram`.
        """
        attributes = attributes or {}
        if missing := [name for name in self.attribute_centres if name not in attributes]:
            raise ValueError(f"attributes: expected {missing} among them, got {sorted(attributes)}.")
        if vectors := [name for name in self.attribute_centres if attributes[name].ndim != 2]:
            raise ValueError(f"attributes: expected scalars to split by, but {vectors} are directions.")
        if self.euclidean_centres is not None and points is None:
            raise ValueError("points: expected positions for the Euclidean bins, got None.")
        return torch.stack(
            [
                self._histogram(
                    embedding[i, real],
                    potential[i, real],
                    [attributes[name][i, real] for name in self.attribute_centres],
                    None if points is None else points[i, real],
                )
                for i, real in enumerate(mask)
            ]
        )

    def _histogram(
        self, embedding: Tensor, potential: Tensor, attributes: Sequence[Tensor], points: Tensor | None
    ) -> Tensor:
        if not (self.soft or self.attribute_centres or self.euclidean_centres):
            return pair_histogram(
                embedding,
                potential,
                distance_range=self.distance_range,
                potential_range=self.potential_range,
                n_classes=self.n_classes,
                n_bins=self.n_bins,
            )
        memberships = self._memberships(potential, self.potential_centres())
        for values, centres in zip(attributes, self.attribute_centres.values(), strict=True):
            classes = self._memberships(values, centres())
            memberships = (memberships[:, :, None] * classes[:, None, :]).flatten(1)
        if self.euclidean_centres is None:
            return soft_pair_histogram(embedding, memberships, self.distance_centres())
        return soft_pair_histogram(
            embedding, memberships, self.distance_centres(), points=points, euclidean_centres=self.euclidean_centres()
        )

    def _memberships(self, values: Tensor, centres: Tensor) -> Tensor:
        if not torch.isfinite(values).all():
            raise ValueError("potential, attributes: expected finite values, got NaN or infinity.")
        return potential_memberships(values, centres) if self.soft else _nearest(values, centres)

    def extra_repr(self) -> str:
        return (
            f"n_classes={self.n_classes}, n_bins={self.n_bins}, distance_range={self.distance_range}, "
            f"potential_range={self.potential_range}, soft={self.soft}"
        )


def _nearest(values: Tensor, centres: Tensor) -> Tensor:
    """(P, C) memberships, 1 in the class whose centre is nearest."""
    between = (centres[1:] + centres[:-1]) / 2
    return one_hot(torch.bucketize(values, between, right=True), len(centres)).to(values.dtype)
