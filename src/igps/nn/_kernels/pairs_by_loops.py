"""The count of pairs by compiled loops on the CPU, and its gradient."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from igps._arrays import Booleans, Floats
from igps._threads import SERIAL, Result, Team
from igps.nn._kernels.pair_loops import (
    COSINES,
    DISTANCES,
    VALUES,
    Axes,
    Derivatives,
    Indices,
    Members,
    Numbers,
    count_block,
    gradient_block,
    new_row,
    new_sums,
)
from igps.nn._kernels.pairs_by_torch import (
    Inputs,
    Layout,
    centres_of,
    cosine_products,
    count_by_torch,
    with_tensors,
)
from igps.nn._precision import full_precision

# Maximum numbers of values and of columns in a block, which then stays in a core's second-level cache.
_BLOCK_SIZE = 2**18
_MAX_COLUMNS = 2048
_STRIP_ROWS = 128  # rows of a block whose inner products are computed by one matrix product
# Number of shares of the blocks, which threads process in parallel. Each share has its own counts; with more counts
# than the maximum, there is only one share, as several would take gigabytes.
_N_SHARES = 4
_MAX_COUNTS = 2**24

Blocks = Sequence[tuple[int, int]]


class CompiledCount(torch.autograd.Function):
    """Float64 counts (N, C(C+1)/2, B, ...) by compiled loops, from the weights, and the inputs and centres of axes."""

    @staticmethod
    def forward(ctx: Any, layout: Layout, weights: Tensor, *tensors: Tensor) -> Tensor:
        ctx.shapes = shapes = _Shapes(layout, weights.detach(), tensors)
        ctx.save_for_backward(weights, *tensors)
        ctx.products = [None] * len(weights)
        has_gradient = any(ctx.needs_input_grad)

        def counts(number: int, team: Team) -> Tensor:
            shape = _Shape(shapes, number, tensors)
            if has_gradient:
                ctx.products[number] = shape.keep_products()
            [total] = _sum_shares(shape, shape.counts, team)
            return _add_corners_to_bins(total, shapes.bins)

        return torch.stack(_map_shapes(counts, len(weights)))

    @staticmethod
    @torch.autocast("cpu", enabled=False)
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        layout = ctx.shapes.layout
        arguments = ctx.saved_tensors
        if torch.is_grad_enabled():  # for second derivatives, which the loops do not have
            counts = count_by_torch(layout, *arguments)
            leaves = [tensor for tensor in arguments if tensor.requires_grad]
            found = torch.autograd.grad(
                counts, leaves, upstream, create_graph=True, allow_unused=True
            )
            by_leaf = iter(found)
            return None, *(next(by_leaf) if x.requires_grad else None for x in arguments)
        _, *tensors = arguments
        totals = [torch.zeros_like(tensor) for tensor in arguments]

        def derivatives(number: int, team: Team) -> tuple[Tensor, list[Tensor]]:
            shape = _Shape(ctx.shapes, number, tensors, upstream[number])
            shape.products = ctx.products[number]
            return shape.order, _sum_shares(shape, shape.gradients, team)

        for number, (order, sums) in enumerate(_map_shapes(derivatives, len(upstream))):
            by_weights, by_centres, *by_inputs = sums
            axes = iter(by_centres)
            inputs = iter(by_inputs)
            gradients = [by_weights.T]
            for pair in layout.pairs:
                gradients += [next(inputs) for _ in pair.inputs]
                gradients += [next(axes)[: len(centres)] for centres in pair.centres]
            for total, gradient in zip(totals, gradients, strict=True):
                if total.ndim == 1:  # centres
                    total += gradient
                else:
                    total[number, order] = gradient.to(total.dtype)
        return None, *totals


def _map_shapes(task: Callable[[int, Team], Result], n_shapes: int) -> list[Result]:
    """Run a task for each shape: on parallel threads if there are enough shapes, else one by one with a team."""
    with full_precision(), Team() as team:
        if n_shapes >= team.n_threads:
            return team.each(lambda number: task(number, SERIAL), range(n_shapes))
        return [task(number, team) for number in range(n_shapes)]


def _sum_shares(shape: _Shape, task: Callable[[Blocks], list[Tensor]], team: Team) -> list[Tensor]:
    """Return the sum of a task's results for the shares of a shape's blocks."""
    total, *others = team.each(task, shape.shares)
    # The shares are added in order, so that the number of threads does not change any bit of the result.
    for other in others:
        for tensor, part in zip(total, other, strict=True):
            tensor += part
    return total


class _Shapes:
    """What all shapes share, and their points, ordered so that points with the same classes are adjacent."""

    def __init__(self, layout: Layout, weights: Tensor, tensors: Sequence[Tensor]) -> None:
        self.layout = layout
        key = torch.zeros_like(layout.classes[..., 0])
        for classes, share in zip(layout.classes.unbind(2), weights.unbind(2), strict=True):
            key = key * layout.n_classes + torch.where(share > 0, classes, 0)
        last = torch.iinfo(key.dtype).max  # sorts padding to the end
        key = key.masked_fill(~layout.mask, last)
        self.order = torch.argsort(key, dim=1, stable=True)
        by_order = self.order.unsqueeze(2).expand_as(layout.classes)
        sorted_classes = layout.classes.gather(1, by_order).int()
        sorted_weights = weights.gather(1, by_order).double()
        self.members = (
            sorted_classes.mT.contiguous().numpy(),
            sorted_weights.mT.contiguous().numpy(),
        )
        self.members_to_count = _without_zeros(*self.members)
        self.n_points: list[int] = layout.mask.sum(dim=1).tolist()
        centres = [x.detach() for x in centres_of(with_tensors(layout.pairs, tensors))]
        self.bins = [len(x) for x in centres]
        self.dtype = centres[0].dtype
        n_cells = math.prod(self.bins)
        n_corners = 2 ** len(self.bins)
        self.sums_shape = layout.n_classes, n_cells, n_corners
        self.n_counts = layout.n_classes * (layout.n_classes + 1) // 2, n_cells * n_corners
        kinds: list[int] = []
        self.matrices: list[slice] = []  # those of the values of each pair, none for cosines
        self.n_values = 0
        for pair in layout.pairs:
            n_matrices = 0 if pair.kind == COSINES else len(pair.centres)
            kinds += [pair.kind] * max(n_matrices, 1)
            self.matrices.append(slice(self.n_values, self.n_values + n_matrices))
            self.n_values += n_matrices
        self.n_oriented = kinds.count(COSINES)
        padded = pad_sequence(centres, batch_first=True).numpy()
        empty = np.empty(0)  # in place of the norms and vectors of each shape
        gaps = _inverse_gaps(padded, self.bins)
        self.axes = Axes(np.array(kinds), empty, empty, padded, np.array(self.bins), *gaps)


def _without_zeros(classes: Indices, weights: Floats) -> tuple[Indices, Floats]:
    """Return one class for each point in place of (N, M, P), if all weights are 0 or 1."""
    largest = weights.max(axis=1, keepdims=True)
    if weights.shape[1] == 1 or not (largest == 1).all():
        return classes, weights
    only = weights.argmax(axis=1, keepdims=True)
    return np.take_along_axis(classes, only, axis=1), largest


class _Shape:
    """The arguments of the loops for one shape, without padding; for a gradient also the derivatives by its counts."""

    def __init__(
        self,
        shapes: _Shapes,
        number: int,
        tensors: Sequence[Tensor],
        upstream: Tensor | None = None,
    ) -> None:
        n_points = shapes.n_points[number]
        self.shapes = shapes
        self.n_points = n_points
        self.order = shapes.order[number, :n_points]
        self.products: Tensor | None = None  # of `keep_products`
        padded = shapes.members_to_count if upstream is None else shapes.members
        classes, weights = (np.ascontiguousarray(x[number, :, :n_points]) for x in padded)
        changes = (np.diff(classes) != 0) | (np.diff(weights) != 0)
        differs = np.ones(n_points, bool)
        differs[1:] = changes.any(axis=0)
        self.members = Members(classes, weights, differs)
        own = []
        for tensor in tensors:
            is_of_points = tensor.ndim > 1  # and not centres
            values = tensor.detach()
            own.append(values[number].index_select(0, self.order) if is_of_points else values)
        self.pairs = with_tensors(shapes.layout.pairs, own)
        n_matrices = shapes.n_values
        self.upstream = np.empty(0)
        if upstream is not None:
            n_matrices += 4 * shapes.n_oriented
            self.upstream = _copy_bins_to_corners(upstream.to(shapes.dtype)).numpy()
        n_columns = min(n_points, _MAX_COLUMNS)
        n_rows = max(1, _BLOCK_SIZE // (n_columns * max(1, n_matrices)))
        n_rows = min(n_rows, n_columns)
        self.block = n_rows, n_columns
        blocks = [
            (row, column)
            for row in range(0, n_points, n_rows)
            for column in range(row, n_points, n_columns)
        ]
        n_shares = min(_N_SHARES, len(blocks)) if math.prod(shapes.n_counts) <= _MAX_COUNTS else 1
        self.shares = [blocks[k::n_shares] for k in range(n_shares)]
        self.centred: list[Tensor | None] = []  # points of each pair whose distances are counted
        norms = torch.zeros(shapes.n_values, n_points, dtype=shapes.dtype, device="cpu")
        vectors = []
        for pair, matrices in zip(self.pairs, shapes.matrices, strict=True):
            centred = None
            if pair.kind == DISTANCES:
                centred = _centre(pair.inputs[0])
                norms[matrices] = centred.square().sum(dim=1)
            elif pair.kind == COSINES:
                vectors.append(torch.stack([x.T for x in pair.inputs], dim=1))
            self.centred.append(centred)
        oriented = norms.new_zeros(0, 2, 0, n_points)
        if vectors:
            oriented = pad_sequence(vectors, batch_first=True).transpose(1, 2).contiguous()
        self.axes = shapes.axes._replace(norms=norms.numpy(), oriented=oriented.numpy())

    def keep_products(self) -> Tensor | None:
        """Return the inner products of a body of one axis and block, which its gradient needs again."""
        is_one_block = [len(blocks) for blocks in self.shares] == [1]
        # With cosines, the gradient has smaller blocks.
        is_one_axis = self.shapes.n_values == 1 and self.shapes.n_oriented == 0
        if not is_one_block or not is_one_axis or self.centred[0] is None:
            return None
        rows, columns = self._slices(0, 0)
        self.products = self._values(rows, columns)
        return self.products

    def counts(self, blocks: Blocks) -> list[Tensor]:
        """Return the float64 counts (C(C+1)/2, cells·2^K) of blocks, for all corners of each cell."""
        total = torch.zeros(self.shapes.n_counts, dtype=torch.float64, device="cpu")
        for row, column in blocks:
            values = self._values(*self._slices(row, column))
            n_columns = values.shape[2]
            sums = new_sums(self.members, column, n_columns, self.shapes.sums_shape)
            result = new_row(self.axes, n_columns)
            place = (row, column)
            count_block(values.numpy(), self.axes, place, self.members, total.numpy(), sums, result)
        return [total]

    def gradients(self, blocks: Blocks) -> list[Tensor]:
        """Return the derivatives by the weights, the centres, and the inputs of each axis."""
        by_weights = torch.zeros(self.members.weights.shape, dtype=torch.float64, device="cpu")
        by_centres = torch.zeros(self.axes.centres.shape, dtype=torch.float64, device="cpu")
        by_inputs = [[torch.zeros_like(x) for x in pair.inputs] for pair in self.pairs]
        for row, column in blocks:
            rows, columns = self._slices(row, column)
            values = self._values(rows, columns)
            by_cosines = values.new_empty(self.shapes.n_oriented, 4, *values.shape[1:])
            derivatives = Derivatives(
                by_cosines.numpy(),
                by_weights.numpy(),
                by_centres.numpy(),
                np.empty(len(by_centres)),
            )
            gradient_block(
                values.numpy(),
                self.axes,
                (row, column),
                self.members,
                self.upstream,
                derivatives,
                new_row(self.axes, values.shape[2]),
            )
            sides = (rows, columns)
            remaining = iter(by_cosines)
            for pair, centred, matrices, totals in zip(
                self.pairs, self.centred, self.shapes.matrices, by_inputs, strict=True
            ):
                if pair.kind == COSINES:
                    upstream = next(remaining)
                    _add_by_inputs(_cosine_products, upstream[:3], pair.inputs, sides, totals)
                    _add_by_points(upstream[3], pair.inputs[0], sides, totals[0])
                elif centred is None:
                    _add_by_inputs(pair.between, values[matrices], pair.inputs, sides, totals)
                else:
                    total = totals[0][:, : centred.shape[1]]
                    _add_by_points(values[matrices.start], centred, sides, total)
        return [by_weights, by_centres, *itertools.chain(*by_inputs)]

    def _slices(self, row: int, column: int) -> tuple[slice, slice]:
        """Return the rows and columns of the block that starts at a row and column."""
        n_rows, n_columns = self.block
        rows = slice(row, min(row + n_rows, self.n_points))
        return rows, slice(column, min(column + n_columns, self.n_points))

    def _values(self, rows: slice, columns: slice) -> Tensor:
        """Return the values (R, I, J) of a block, or the inner products for distances, as `count_block` takes them."""
        if self.products is not None:
            return self.products.clone()
        shape = rows.stop - rows.start, columns.stop - columns.start
        values = torch.empty(self.shapes.n_values, *shape, dtype=self.shapes.dtype, device="cpu")
        for pair, centred, matrices in zip(
            self.pairs, self.centred, self.shapes.matrices, strict=True
        ):
            if centred is not None:
                _write_products(centred, rows, columns, values[matrices.start])
            elif pair.kind == VALUES:
                between = pair.between(*_at(pair.inputs, rows, columns))
                values[matrices] = between[0]
        return values


def _at(inputs: Sequence[Tensor], rows: slice, columns: slice) -> tuple[list[Tensor], list[Tensor]]:
    """Return the inputs (1, I, ...) of the points of rows, and (1, J, ...) of those of columns."""
    return [x[None, rows] for x in inputs], [x[None, columns] for x in inputs]


def _add_by_inputs(
    between: Callable[[Inputs, Inputs], Tensor],
    upstream: Tensor,
    inputs: Sequence[Tensor],
    sides: tuple[slice, slice],
    totals: Sequence[Tensor],
) -> None:
    """Add derivatives by inputs to totals, from those by values (k, I, J), of which `between` returns (1, k, I, J)."""
    rows, columns = _at(inputs, *sides)
    leaves = [*rows, *columns]
    for leaf in leaves:
        leaf.requires_grad_()
    with torch.enable_grad():
        values = between(rows, columns)
    gradients = iter(torch.autograd.grad(values, leaves, upstream[None]))
    for side in sides:
        for total in totals:
            total[side] += next(gradients)[0]


def _cosine_products(rows: Inputs, columns: Inputs) -> Tensor:
    """Return the `cosine_products`, of which the cosines are made, as one tensor (1, 3, I, J)."""
    return torch.stack(cosine_products(rows, columns), dim=1)


def _inverse_gaps(centres: Numbers, bins: Sequence[int]) -> tuple[Numbers, Booleans]:
    """Return `inverse_gaps` (K, B − 1) and `has_equal_gaps` (K,) of `Axes`, for centres (K, B)."""
    inverse = np.zeros((len(bins), centres.shape[1] - 1), centres.dtype)
    is_equal = np.zeros(len(bins), bool)
    for k, n in enumerate(bins):
        own = centres[k, :n]
        gaps = np.diff(own)
        inverse[k, : n - 1] = 1 / gaps
        mean = float(own[-1] - own[0]) / (n - 1)
        largest = float(np.abs(own).max())
        rounding = 8 * np.finfo(centres.dtype).eps * largest
        is_equal[k] = (np.abs(gaps - mean) <= rounding).all()
        if is_equal[k]:
            inverse[k, 0] = 1 / mean
    return inverse, is_equal


def _centre(points: Tensor) -> Tensor:
    """Return points (P, D) relative to their mean, without trailing coordinates that are 0 for all points.

    Centring preserves digits in the squares. Trailing zeros, which come from padding, would change the rounding.
    """
    mean = points.mean(dim=0)
    if not bool(mean[-1:].all()):
        used = (points != 0).any(dim=0).nonzero().flatten().tolist()
        n_used = used[-1] + 1 if used else 0
        points = points[:, :n_used].contiguous()
        mean = points.mean(dim=0)
    return points - mean


def _write_products(points: Tensor, rows: slice, columns: slice, out: Tensor) -> None:
    """Write the inner products of rows and columns, strip by strip, from the first counted pair of each strip on.

    In a block on the diagonal, half of the pairs are not counted, and products take more time than the loops.
    """
    for row in range(rows.start, rows.stop, _STRIP_ROWS):
        end = min(row + _STRIP_ROWS, rows.stop)
        first = max(row, columns.start)
        part = out[row - rows.start : end - rows.start, first - columns.start :]
        torch.mm(points[row:end], points[first : columns.stop].T, out=part)


def _add_by_points(
    by_squares: Tensor, points: Tensor, sides: tuple[slice, slice], total: Tensor
) -> None:
    """Add the derivatives by points (P, D) to a total, from the derivatives by squared distances (I, J)."""
    rows, columns = sides
    x = points[rows]
    y = points[columns]
    if rows == columns:  # one product in place of two
        both = by_squares + by_squares.T
        total[rows] += 2 * (x * both.sum(dim=1, keepdim=True) - both @ x)
        return
    by_row = by_squares.sum(dim=1, keepdim=True)
    by_column = by_squares.sum(dim=0).unsqueeze(1)
    total[rows] += 2 * (x * by_row - by_squares @ y)
    total[columns] += 2 * (y * by_column - by_squares.T @ x)


def _add_corners_to_bins(total: Tensor, bins: Sequence[int]) -> Tensor:
    """Return the counts (rows, B, ...) of bins from the counts (rows, cells·2^K) of the corners of cells."""
    counts = total.view(-1, *bins, *(2,) * len(bins))
    for axis in range(len(bins)):
        lower, upper = counts.unbind(1 + len(bins))
        # The upper corners of the last cell are 0, so that rolling moves nothing to the first bin.
        counts = lower + upper.roll(1, dims=1 + axis)
    return counts


def _copy_bins_to_corners(upstream: Tensor) -> Tensor:
    """Return derivatives (rows, cells·2^K) by the counts of corners from derivatives (rows, B, ...) by bins."""
    n_axes = upstream.ndim - 1
    for axis in range(n_axes):
        above = upstream.roll(-1, dims=1 + axis)
        upstream = torch.stack([upstream, above], dim=-1)
    return upstream.flatten(1).contiguous()
