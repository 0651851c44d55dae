"""The count of pairs by compiled loops on the CPU, and its gradient."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from igps._arrays import Booleans, Floats
from igps._threads import ALONE, Result, Team
from igps.nn._kernels.count_by_torch import count_by_torch
from igps.nn._kernels.pair_cells import COSINES, DISTANCES, VALUES, Axes, Numbers, Places
from igps.nn._kernels.pair_loops import count_block, gradient_block
from igps.nn._kernels.pair_values import PairValues, centres_of, cosine_factors, with_tensors
from igps.nn._precision import full_precision

# Pairs of a block, whose values stay in a core's second-level cache; more could overflow the integers of `pair_sums`
_BLOCK, _MOST_COLUMNS = 2**18, 2048
# Rows of a block whose inner products are one product of matrices
_STRIP = 128
# Of the blocks, which threads count side by side; one where counts of its own for each share would take gigabytes
_SHARES, _MOST_COUNTS = 4, 2**24


Blocks = Sequence[tuple[int, int]]


class Layout(NamedTuple):
    """The arguments of a count without gradients, see `count_pairs`."""

    classes: Tensor
    n_classes: int
    pairs: tuple[PairValues, ...]
    mask: Tensor


class CompiledCount(torch.autograd.Function):
    """(N, C(C+1)/2, B, ...) float64 counts by compiled loops, from the weights, and inputs and centres of the axes."""

    @staticmethod
    def forward(ctx: Any, layout: Layout, weights: Tensor, *tensors: Tensor) -> Tensor:
        ctx.layout, ctx.members = layout, (members := _Members(layout, weights.detach()))
        ctx.save_for_backward(weights, *tensors)

        def counts(number: int, team: Team) -> Tensor:
            shape = _Shape(layout, number, members, tensors)
            [total] = _summed(shape, shape.counts, team)
            return _folded(total, shape.bins)

        return torch.stack(_of_shapes(counts, len(weights)))

    @staticmethod
    @torch.autocast("cpu", enabled=False)
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        weights, *tensors = ctx.saved_tensors
        if torch.is_grad_enabled():  # derivatives of the gradient are asked for, which loops do not have
            layout, which = ctx.layout, ctx.needs_input_grad[1:]
            counts = count_by_torch(layout.classes, layout.n_classes, layout.pairs, layout.mask, weights, *tensors)
            leaves = [one for one, is_needed in zip((weights, *tensors), which, strict=True) if is_needed]
            given = iter(torch.autograd.grad(counts, leaves, upstream, create_graph=True, allow_unused=True))
            return None, *(next(given) if is_needed else None for is_needed in which)
        gradients = [torch.zeros_like(tensor) for tensor in (weights, *tensors)]

        def derivatives(number: int, team: Team) -> tuple[Tensor, list[Tensor]]:
            shape = _Shape(ctx.layout, number, ctx.members, tensors, upstream[number])
            return shape.order, _summed(shape, shape.gradients, team)

        for number, (order, sums) in enumerate(_of_shapes(derivatives, len(weights))):
            by_weights, by_centres, *by_inputs = sums
            along, remaining = iter(by_centres), iter(by_inputs)
            found = [by_weights.T]
            for one in ctx.layout.pairs:
                found += [next(remaining) for _ in one.inputs]
                found += [next(along)[: len(centres)] for centres in one.centres]
            for into, gradient in zip(gradients, found, strict=True):
                if into.ndim == 1:  # centres
                    into += gradient
                else:
                    into[number, order] = gradient.to(into.dtype)
        return None, *gradients


def _of_shapes(task: Callable[[int, Team], Result], n_shapes: int) -> list[Result]:
    """The result of a task for each shape: shapes side by side if there are as many as threads, else with a team."""
    with full_precision(), Team() as team:
        if n_shapes >= team.n_threads:
            return team.each(lambda number: task(number, ALONE), range(n_shapes))
        return [task(number, team) for number in range(n_shapes)]


def _summed(shape: _Shape, task: Callable[[Blocks], list[Tensor]], team: Team) -> list[Tensor]:
    """What a task finds in the blocks of a shape, in sum."""
    total, *others = team.each(task, shape.shares)
    # Each share has sums of its own, added in order: how many threads there are changes no bit.
    for other in others:
        for into, part in zip(total, other, strict=True):
            into += part
    return total


class _Members:
    """The points of all shapes in the order in which loops want them, real ones of the same classes side by side."""

    def __init__(self, layout: Layout, weights: Tensor) -> None:
        key = torch.zeros_like(layout.classes[..., 0])
        for classes, own in zip(layout.classes.unbind(2), weights.unbind(2), strict=True):
            key = key * layout.n_classes + torch.where(own > 0, classes, 0)
        last = torch.iinfo(key.dtype).max  # where padding goes
        self.order = torch.argsort(key.masked_fill(~layout.mask, last), dim=1, stable=True)
        by_order = self.order.unsqueeze(2).expand_as(layout.classes)
        self._classes = layout.classes.gather(1, by_order).int().transpose(1, 2).contiguous().numpy()
        self._weights = weights.gather(1, by_order).double().transpose(1, 2).contiguous().numpy()
        self._n_points = layout.mask.sum(dim=1).tolist()

    def of(self, number: int) -> tuple[Tensor, tuple[Places, Floats]]:
        """Of a shape (P,) its points in order, and (M, P) their classes and weights."""
        n = self._n_points[number]
        classes, weights = (np.ascontiguousarray(one[number, :, :n]) for one in (self._classes, self._weights))
        return self.order[number, :n], (classes, weights)


class _Shape:
    """The real points of one shape as the loops want them, and what is upstream of its counts for a gradient."""

    def __init__(
        self, layout: Layout, number: int, members: _Members, tensors: Sequence[Tensor], upstream: Tensor | None = None
    ) -> None:
        self.order, self.members = members.of(number)
        taken = [t.detach()[number].index_select(0, self.order) if t.ndim > 1 else t.detach() for t in tensors]
        self.pairs = with_tensors(layout.pairs, taken)
        centres = centres_of(self.pairs)
        self.bins, self.dtype = [len(one) for one in centres], centres[0].dtype
        kinds = [kind for one in self.pairs for kind in one.kinds]
        self.n_values, self.n_oriented = sum(kind != COSINES for kind in kinds), kinds.count(COSINES)
        self.centred = [_centred(one.inputs[0]) if DISTANCES in one.kinds else None for one in self.pairs]
        n_points, n_columns = len(self.order), min(len(self.order), _MOST_COLUMNS)
        n_matrices = self.n_values if upstream is None else self.n_values + 4 * self.n_oriented
        n_rows = min(max(1, _BLOCK // (n_columns * max(1, n_matrices))), n_columns)
        self.block = n_rows, n_columns
        blocks = [(row, column) for row in range(0, n_points, n_rows) for column in range(row, n_points, n_columns)]
        self.n_counts = layout.n_classes * (layout.n_classes + 1) // 2, math.prod(self.bins) << len(self.bins)
        n_shares = min(_SHARES, len(blocks)) if math.prod(self.n_counts) <= _MOST_COUNTS else 1
        self.shares = [blocks[k::n_shares] for k in range(n_shares)]
        none = torch.empty(0, 0, device="cpu")
        self.upstream = _unfolded(none if upstream is None else upstream.to(self.dtype)).numpy()
        norms, row = torch.zeros(self.n_values, n_points, dtype=self.dtype, device="cpu"), 0
        for one, centred in zip(self.pairs, self.centred, strict=True):
            if centred is not None:
                norms[row] = centred.square().sum(dim=1)
            row += sum(kind != COSINES for kind in one.kinds)
        vectors = [torch.stack([x.T for x in one.inputs], dim=1) for one in self.pairs if COSINES in one.kinds]
        oriented = norms.new_zeros(0, 2, 0, n_points)
        if vectors:
            oriented = pad_sequence(vectors, batch_first=True).transpose(1, 2).contiguous()
        padded = pad_sequence(centres, batch_first=True).numpy()
        gaps = _gaps(padded, self.bins)
        self.axes = Axes(np.array(kinds), norms.numpy(), oriented.numpy(), padded, np.array(self.bins), *gaps)
        classes, weights = self.members
        self.packs = kinds in ([VALUES], [DISTANCES]) and self.dtype == torch.float32
        self.packs = self.packs and len(classes) == 1 and bool((weights == 1).all())

    def counts(self, blocks: Blocks) -> list[Tensor]:
        """(C(C+1)/2, cells·2^K) float64 counts of some blocks, by the cell below and the corner of it."""
        total, room = torch.zeros(self.n_counts, dtype=torch.float64, device="cpu"), self._room(self.n_values)
        for row, column in blocks:
            values = self._part(room, row, column)
            self._fill(values, row, column)
            count_block(values.numpy(), self.axes, row, column, *self.members, self.packs, total.numpy())
        return [total]

    def gradients(self, blocks: Blocks) -> list[Tensor]:
        """Derivatives by the weights, by the centres, and by the inputs of each axis."""
        by_weights = torch.zeros(self.members[1].shape, dtype=torch.float64, device="cpu")
        by_centres = torch.zeros(self.axes.centres.shape, dtype=torch.float64, device="cpu")
        found = [[torch.zeros_like(x) for x in one.inputs] for one in self.pairs]
        room, turn_room = self._room(self.n_values), self._room(4 * self.n_oriented)
        for row, column in blocks:
            values, turns = self._part(room, row, column), self._part(turn_room, row, column)
            self._fill(values, row, column)
            gradient_block(
                values.numpy(), self.axes, row, column, *self.members, self.upstream,
                turns.view(-1, 4, *turns.shape[1:]).numpy(), by_weights.numpy(), by_centres.numpy(),
            )  # fmt: skip
            rows, columns = slice(row, row + values.shape[1]), slice(column, column + values.shape[2])
            remaining, turned = iter(values), iter(turns)
            for one, centred, into in zip(self.pairs, self.centred, found, strict=True):
                if centred is not None:
                    _pull(next(remaining), centred, rows, columns, into[0][:, : centred.shape[1]])
                    continue
                n = len(one.inputs)
                leaves = [x[where].requires_grad_() for where in (rows, columns) for x in one.inputs]
                with torch.enable_grad():
                    if COSINES in one.kinds:
                        factors = zip(cosine_factors(*leaves[:n]), cosine_factors(*leaves[n:]), strict=True)
                        measured = torch.stack([left @ right.T for (left, _), (_, right) in factors])
                        upstream = torch.stack([next(turned) for _ in measured])
                        _pull(next(turned), one.inputs[0], rows, columns, into[0])
                    else:
                        [measured] = one.between([x[None] for x in leaves[:n]], [x[None] for x in leaves[n:]])
                        upstream = torch.stack([next(remaining) for _ in measured])
                for k, gradient in enumerate(torch.autograd.grad(measured, leaves, upstream)):
                    into[k % n][rows if k < n else columns] += gradient
        return [by_weights, by_centres, *(gradient for of_axis in found for gradient in of_axis)]

    def _room(self, n_matrices: int) -> Tensor:
        return torch.empty(n_matrices * math.prod(self.block), dtype=self.dtype, device="cpu")

    def _part(self, room: Tensor, row: int, column: int) -> Tensor:
        """As much of a room as a block takes, (R, I, J)."""
        n_matrices = len(room) // math.prod(self.block)
        n = [min(most, len(self.order) - first) for most, first in zip(self.block, (row, column), strict=True)]
        return room[: n_matrices * math.prod(n)].view(n_matrices, *n)

    def _fill(self, values: Tensor, row: int, column: int) -> None:
        """Write what the loops find the values of a block in."""
        rows, columns = slice(row, row + values.shape[1]), slice(column, column + values.shape[2])
        into = iter(values)
        for one, centred in zip(self.pairs, self.centred, strict=True):
            if centred is not None:
                _products(centred, rows, columns, next(into))
            elif VALUES in one.kinds:
                between = one.between([x[None, rows] for x in one.inputs], [x[None, columns] for x in one.inputs])
                for value in between[0]:
                    next(into).copy_(value)


def _gaps(centres: Numbers, bins: Sequence[int]) -> tuple[Numbers, Booleans]:
    """(K, B − 1) one over the gaps between centres (K, B), and (K,) whether those of an axis are equal, see `Axes`."""
    inverse, equal = np.zeros((len(bins), centres.shape[1] - 1), centres.dtype), np.zeros(len(bins), bool)
    for k, n in enumerate(bins):
        gaps = np.diff(centres[k, :n])
        inverse[k, : n - 1] = 1 / gaps
        mean = float(centres[k, n - 1] - centres[k, 0]) / (n - 1)
        rounding = 8 * np.finfo(centres.dtype).eps * float(np.abs(centres[k, [0, n - 1]]).max())
        equal[k] = bool((np.abs(gaps - mean) <= rounding).all())
        if equal[k]:
            inverse[k, 0] = 1 / mean
    return inverse, equal


def _centred(points: Tensor) -> Tensor:
    """Points (P, D) about their centre, which keeps digits in the squares, without coordinates that are 0 at the end.

    Those that padding left there would only change how products are rounded.
    """
    mean = points.mean(dim=0)
    if not bool(mean[-1:].all()):
        used = (points != 0).any(dim=0).nonzero().flatten()
        points = points[:, : int(used[-1]) + 1 if len(used) else 0].contiguous()
        mean = points.mean(dim=0)
    return points - mean


def _products(points: Tensor, rows: slice, columns: slice, into: Tensor) -> None:
    """Write the inner products of some rows and columns, strip by strip from the first pair on that is counted.

    At the diagonal half of a block is no such pair, and the products take more time than the loops.
    """
    for row in range(rows.start, rows.stop, _STRIP):
        end, first = min(row + _STRIP, rows.stop), max(row, columns.start)
        part = into[row - rows.start : end - rows.start, first - columns.start :]
        torch.mm(points[row:end], points[first : columns.stop].T, out=part)


def _pull(by_squares: Tensor, points: Tensor, rows: slice, columns: slice, into: Tensor) -> None:
    """Add the derivatives by points (P, D) from those by the squares of the distances of some rows and columns."""
    x, y = points[rows], points[columns]
    into[rows] += 2 * (x * by_squares.sum(dim=1, keepdim=True) - by_squares @ y)
    into[columns] += 2 * (y * by_squares.sum(dim=0).unsqueeze(1) - by_squares.T @ x)


def _folded(total: Tensor, bins: Sequence[int]) -> Tensor:
    """(rows, B, ...) counts from (rows, cells·2^K), by the cell below and the corner of it."""
    counts = total.view(-1, *bins, *(2,) * len(bins))
    for axis in range(len(bins)):
        own, beyond = counts.unbind(1 + len(bins))
        # Beyond the last cell there is nothing to give, so that nothing is rolled over the end.
        counts = own + beyond.roll(1, dims=1 + axis)
    return counts


def _unfolded(upstream: Tensor) -> Tensor:
    """(rows, cells·2^K) derivatives by the counts of all corners, from those (rows, B, ...) of the bins."""
    n_axes = upstream.ndim - 1
    for axis in range(n_axes):
        upstream = torch.stack([upstream, upstream.roll(-1, dims=1 + axis)], dim=-1)
    return upstream.flatten(1).contiguous()
