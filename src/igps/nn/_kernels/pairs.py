"""The count of pairs of points in a product of classes and bins, with two back ends.

All histograms of pairs are computed by `count_pairs`. On the CPU, compiled loops count, with their own gradient
(`pairs_by_loops`); on other devices, in programs of `torch.export`, and for second derivatives, operations of PyTorch
(`pairs_by_torch`). Both back ends count in double precision, do not store a matrix of all pairs, and have gradients by
the inputs of the values, the weights and the centres. For `torch.compile` the count is a single operator, as compiling
the blocks of a few large bodies would take minutes.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any

import torch
from torch import Tensor, library

from igps._tensors import with_axes_of
from igps.nn._kernels import batches
from igps.nn._kernels.pair_loops import VALUES
from igps.nn._kernels.pairs_by_loops import CompiledCount
from igps.nn._kernels.pairs_by_torch import (
    TEMPLATES,
    Layout,
    PairValues,
    bins_of,
    count_by_torch,
    with_tensors,
)

# Exists since PyTorch 2.7. Exported programs must run without this library, and therefore without its operator.
_is_exporting = getattr(torch.compiler, "is_exporting", lambda: False)


def class_pairs(n_classes: int) -> list[tuple[int, int]]:
    """Return the unordered pairs of classes in the order of a histogram's rows."""
    return list(combinations_with_replacement(range(n_classes), 2))


def count_pairs(
    classes: Tensor, weights: Tensor, n_classes: int, pairs: Sequence[PairValues], mask: Tensor
) -> Tensor:
    """Return the share of all pairs of points in each pair of classes and in each bin, for N shapes.

    An unordered pair of distinct points counts once. Each point belongs to M classes, with weights of sum 1; the pair
    counts in all combinations of the classes of its points, with the product of their weights. Along each axis, it is
    shared linearly between the two bins whose centres surround its value; the outer bins count all values beyond them.

    Args:
        classes: (N, P, M) integers from 0 to C − 1.
        weights: (N, P, M).
        n_classes: C.
        pairs: the values of the axes, of N shapes.
        mask: (N, P) true where a point is real; each shape has at least two points.

    Returns:
        (N, C(C+1)/2, B, ...) of sum 1 each, in the type of the first inputs, float32 at least; rows by `class_pairs`.
    """
    dtype = torch.promote_types(pairs[0].inputs[0].dtype, torch.float32)
    tensors = [weights]
    for pair in pairs:
        tensors += [*pair.inputs, *pair.centres]
    tensors = [tensor.to(dtype) for tensor in tensors]
    templates = [
        k
        for pair in pairs
        for k, template in enumerate(TEMPLATES)
        if pair.between is template.between
    ]
    is_compiled = torch.compiler.is_compiling() and not _is_exporting()
    with torch.autocast(classes.device.type, enabled=False):
        if is_compiled and len(templates) == len(pairs):
            counts = _operator(classes, n_classes, templates, mask, tensors)
        else:
            counts = _count(Layout(classes, n_classes, pairs, mask), tensors)
        n_points = mask.sum(dim=1).double()
        n_pairs = n_points * (n_points - 1) / 2
        shares = counts / with_axes_of(n_pairs, counts)
        return shares.to(dtype)


def _count(layout: Layout, tensors: list[Tensor]) -> Tensor:
    """Return float64 counts (N, C(C+1)/2, B, ...), by the back end for the device and type of the tensors."""
    has_loops = tensors[0].dtype in (torch.float32, torch.float64)
    if not has_loops or not batches.uses_loops(layout.mask.device):
        return count_by_torch(layout, *tensors)
    counts: Tensor = CompiledCount.apply(layout, *tensors)
    return counts


def _from_templates(templates: Sequence[int], tensors: list[Tensor]) -> list[PairValues]:
    """Return `TEMPLATES`, given by their indices, with the tensors that follow the weights."""
    return with_tensors([TEMPLATES[k] for k in templates], tensors[1:])


# The schema is explicit, as the first versions of PyTorch with custom operators cannot infer `list[int]`.
_ARGUMENTS = "Tensor classes, int n_classes, int[] templates, Tensor mask, Tensor[] tensors"


@library.custom_op("igps::count_pairs", mutates_args=(), schema=f"({_ARGUMENTS}) -> Tensor")
def _operator(
    classes: Tensor, n_classes: int, templates: list[int], mask: Tensor, tensors: list[Tensor]
) -> Tensor:
    """`_count` as an operator of PyTorch, with gradients by the tensors."""
    pairs = _from_templates(templates, tensors)
    return _count(Layout(classes, n_classes, pairs, mask), tensors)


@_operator.register_fake
def _(
    classes: Tensor, n_classes: int, templates: list[int], mask: Tensor, tensors: list[Tensor]
) -> Tensor:
    bins = bins_of(_from_templates(templates, tensors))
    n_rows = len(class_pairs(n_classes))
    return classes.new_empty(mask.shape[0], n_rows, *bins, dtype=torch.float64)


@library.custom_op(
    "igps::count_pairs_backward",
    mutates_args=(),
    schema=f"(Tensor upstream, {_ARGUMENTS}) -> Tensor[]",
)
def _gradients(
    upstream: Tensor,
    classes: Tensor,
    n_classes: int,
    templates: list[int],
    mask: Tensor,
    tensors: list[Tensor],
) -> list[Tensor]:
    keys = torch._C.DispatchKey
    # PyTorch disables autograd inside an operator.
    with (
        torch._C._SetExcludeDispatchKeyGuard(keys.AutogradFunctionality, False),
        torch._C._SetExcludeDispatchKeyGuard(keys.ADInplaceOrView, False),
        torch.enable_grad(),
    ):
        leaves = [tensor.detach().requires_grad_() for tensor in tensors]
        pairs = _from_templates(templates, leaves)
        counts = _count(Layout(classes, n_classes, pairs, mask), leaves)
        return list(torch.autograd.grad(counts, leaves, upstream))


@_gradients.register_fake
def _(
    upstream: Tensor,
    classes: Tensor,
    n_classes: int,
    templates: list[int],
    mask: Tensor,
    tensors: list[Tensor],
) -> list[Tensor]:
    return [torch.empty_like(tensor) for tensor in tensors]


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    classes, ctx.n_classes, ctx.templates, mask, tensors = inputs
    ctx.save_for_backward(classes, mask, *tensors)


def _backward(ctx: Any, upstream: Tensor) -> tuple[None, None, None, None, list[Tensor]]:
    classes, mask, *tensors = ctx.saved_tensors
    gradients = _gradients(upstream, classes, ctx.n_classes, ctx.templates, mask, tensors)
    return None, None, None, None, gradients


_operator.register_autograd(_backward, setup_context=_setup_context)


def check_pairs(pairs: Sequence[PairValues], mask: Tensor) -> None:
    """Raise a ValueError unless each shape has at least two points, and all inputs are finite.

    Under `torch.compile` and `torch.export` only shapes are checked, as traced code cannot look at values.
    """
    inputs = [values for pair in pairs for values in pair.inputs]
    for values in inputs:
        if values.shape[:2] != mask.shape:
            n = mask.shape[1]
            shape = tuple(values.shape[1:])
            raise ValueError(f"points: expected values for each of {n} points, got shape {shape}.")
    if torch.compiler.is_compiling():
        return
    n_points = int(mask.sum(dim=1).min())
    if n_points < 2:
        raise ValueError(f"points: expected at least two points to form a pair, got {n_points}.")
    for pair in pairs:
        for values in pair.inputs:
            _check_values(values.detach(), mask, are_squared=pair.kind != VALUES)


def _check_values(values: Tensor, mask: Tensor, are_squared: bool) -> None:
    """Raise a ValueError unless the values (N, P, ...) of real points are finite, and so their squares if needed."""
    dtype = torch.promote_types(values.dtype, torch.float32)
    max_square = torch.finfo(dtype).max / 8
    # Point by point only if the norm of all inputs is too large, or padding holds infinity or NaN.
    norm = float(torch.linalg.vector_norm(values, dtype=dtype))
    if norm**2 < max_square:
        return
    real = values[mask]
    if not bool(torch.isfinite(real).all()):
        raise ValueError("points: expected finite values, got NaN or infinity.")
    squares = real.square().sum(dim=-1)
    if are_squared and not bool((squares < max_square).all()):
        raise ValueError(
            "points: expected distances that can be squared, got larger ones. Choose a larger unit."
        )
