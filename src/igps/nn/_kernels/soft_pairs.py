"""The histogram of pair distances with soft classes and bins of any width, and its gradients."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from igps._parallel import on_threads
from igps._threads import n_threads as available_threads
from igps.nn._kernels.counted_pairs import can_count, count_pairs
from igps.nn._kernels.hard_pairs import check_points, class_pairs, single_at_least
from igps.nn._precision import full_precision

Result = TypeVar("Result")

# Rows and columns of a block of pairs: its float32 distances fill half of a core's second-level cache.
_BLOCK = 512
# Counts of one class that a block of rows keeps, so that they stay in that cache as well.
_BLOCK_COUNTS = 2**16
# Entries for each centre in the table from a distance to its interval.
_TABLE_PER_CENTRE = 64
# Moments of a shape that are kept from forward to backward; more are counted a second time.
_MOST_KEPT = 2**22


def soft_pair_histogram(memberships: Tensor, axes: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """Histogram of pairwise distances with soft classes and bins of any width, differentiable in every argument.

    An unordered pair {i, j} of distinct points counts m_ia·m_jb + m_ib·m_ja in the pair of classes a < b and m_ia·m_ja
    in a = b, each shared between the two bins whose centres surround the distance, in linear proportion; distances
    below the first or beyond the last centre count there. Each further axis, such as the distance in space beside that
    in an embedding, is one more dimension of bins, shared out in the same way.

    The (P, P) distances are never held at once. A gradient by the points takes a second pass over the pairs; so does
    one by the memberships, if there are too many numbers, about P·C·∏(2B), to keep for it.

    Args:
        memberships: (P, C) non-negative, rows of sum 1; the more of them are zero, the faster.
        axes: of each dimension of bins the points (P, D), whose Euclidean distances are counted, and the ascending
            centres (B,), in the same unit.

    Returns:
        (C(C+1)/2, B, ...), in the type of the first points, float32 at least, of sum 1; row order (0,0), (0,1),
        … (0,C−1), (1,1), …

    Raises:
        ValueError: fewer than two points, shapes that do not match, values that are not finite, memberships that are
            negative or do not sum to 1, or centres that do not ascend.
    """
    _check(memberships, axes)
    dtype = single_at_least(axes[0][0]).dtype
    if can_count(memberships, *(tensor for axis in axes for tensor in axis)):
        return count_pairs(memberships, axes).to(dtype)
    order = _by_class(memberships.detach())
    ordered = [(points[order].to(dtype), centres.to(dtype)) for points, centres in axes]
    with torch.autocast(memberships.device.type, enabled=False), full_precision():
        return _SoftPairHistogram.apply(memberships[order].to(dtype), *(tensor for axis in ordered for tensor in axis))


def _check(memberships: Tensor, axes: Sequence[tuple[Tensor, Tensor]]) -> None:
    for points, centres in axes:
        if points.ndim != 2 or memberships.ndim != 2 or len(points) != len(memberships) or centres.ndim != 1:
            raise ValueError(
                "expected points of shape (P, D), memberships of shape (P, C) and centres of shape (B,), got "
                f"{tuple(points.shape)}, {tuple(memberships.shape)} and {tuple(centres.shape)}."
            )
        check_points(points)
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
        with torch.autocast(upstream.device.type, enabled=False), full_precision():
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
        # The two moments are rounded apart: held to a share of the count, so that neither bin becomes negative. What is
        # added is 0, and has the gradient.
        share = upper.detach().clamp(min=0).minimum(inner.detach())
        upper = share + (upper - upper.detach())
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
        n_threads = available_threads() if self.memberships.device.type == "cpu" else 1
        most = min(_BLOCK, max(1, _BLOCK_COUNTS // self.n_cells))
        size = -(-n_points // (-(-n_points // (most * n_threads)) * n_threads))
        blocks = [slice(i, min(i + size, n_points)) for i in range(0, n_points, size)]
        return list(on_threads(task, blocks, n_threads))

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
