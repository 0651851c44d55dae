"""One count of pairs of points, into a product of classes and bins, with two back ends.

`count_pairs` is what every histogram of pairs comes down to. On the CPU it runs in compiled loops, with a gradient of
their own (`count_by_loops`); on other devices, in programs of `torch.export`, and for derivatives of gradients, in
operations of PyTorch (`count_by_torch`). Both count in double precision, hold no matrix of all pairs, and have
gradients by all that the values are computed from, by the weights and by the centres. To `torch.compile` the count is
one operator: block by block, that of a few large bodies would take minutes to compile.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any

import torch
from torch import Tensor, library

from igps.nn._kernels import blocks
from igps.nn._kernels.count_by_loops import CompiledCount, Layout
from igps.nn._kernels.count_by_torch import count_by_torch
from igps.nn._kernels.pair_cells import VALUES
from igps.nn._kernels.pair_values import WAYS, PairValues, centres_of, with_tensors

# Since PyTorch 2.7. An exported program must run without this library, and so without its operator.
_is_exporting = getattr(torch.compiler, "is_exporting", lambda: False)


def class_pairs(n_classes: int) -> list[tuple[int, int]]:
    """The unordered pairs of classes in the order of a histogram's rows."""
    return list(combinations_with_replacement(range(n_classes), 2))


def count_pairs(classes: Tensor, weights: Tensor, n_classes: int, pairs: Sequence[PairValues], mask: Tensor) -> Tensor:
    """The share of all pairs of points in each pair of classes and in each bin, of N shapes.

    An unordered pair of distinct points counts once. Each point is in M classes, by weights of sum 1; the pair counts
    in every combination of its ends' classes by the product of their weights. Along each axis it is shared out linearly
    between the two bins whose centres surround its value; beyond the outer centres it counts there.

    Args:
        classes: (N, P, M) integers from 0 to C − 1.
        weights: (N, P, M).
        n_classes: C.
        pairs: the values of the axes, of N shapes.
        mask: (N, P) true where a point is real; at least two are in each shape.

    Returns:
        (N, C(C+1)/2, B, ...) of sum 1 each, in the type of the first inputs, float32 at least; row order (0,0), (0,1),
        … (0,C−1), (1,1), …
    """
    dtype = torch.promote_types(pairs[0].inputs[0].dtype, torch.float32)
    tensors = [weights, *(tensor for one in pairs for tensor in (*one.inputs, *one.centres))]
    tensors = [tensor.to(dtype) for tensor in tensors]
    with torch.autocast(classes.device.type, enabled=False):
        ways = [k for one in pairs for k, way in enumerate(WAYS) if one.between is way.between]
        if torch.compiler.is_compiling() and not _is_exporting() and len(ways) == len(pairs):
            counts = _operator(classes, n_classes, ways, mask, tensors)
        else:
            counts = _count(classes, n_classes, pairs, mask, tensors)
        n_points = mask.sum(dim=1).double().view(-1, *[1] * (counts.ndim - 1))
        return (counts / (n_points * (n_points - 1) / 2)).to(dtype)


def _count(classes: Tensor, n_classes: int, pairs: Sequence[PairValues], mask: Tensor, tensors: list[Tensor]) -> Tensor:
    """(N, C(C+1)/2, B, ...) float64 counts, by the back end that is there for the tensors."""
    if blocks.in_loops(classes.device) and tensors[0].dtype in (torch.float32, torch.float64):
        counts: Tensor = CompiledCount.apply(Layout(classes, n_classes, tuple(pairs), mask), *tensors)
        return counts
    return count_by_torch(classes, n_classes, pairs, mask, *tensors)


def _known(ways: Sequence[int], tensors: list[Tensor]) -> list[PairValues]:
    """The `WAYS` of these numbers, with the tensors that follow the weights."""
    return with_tensors([WAYS[k] for k in ways], tensors[1:])


# Spelled out: the first versions of PyTorch with custom operators cannot infer `list[int]`.
_ARGUMENTS = "Tensor classes, int n_classes, int[] ways, Tensor mask, Tensor[] tensors"


@library.custom_op("igps::count_pairs", mutates_args=(), schema=f"({_ARGUMENTS}) -> Tensor")
def _operator(classes: Tensor, n_classes: int, ways: list[int], mask: Tensor, tensors: list[Tensor]) -> Tensor:
    """What `_count` counts; gradients flow to the tensors."""
    return _count(classes, n_classes, _known(ways, tensors), mask, tensors)


@_operator.register_fake
def _(classes: Tensor, n_classes: int, ways: list[int], mask: Tensor, tensors: list[Tensor]) -> Tensor:
    bins = [len(one) for one in centres_of(_known(ways, tensors))]
    return classes.new_empty(mask.shape[0], n_classes * (n_classes + 1) // 2, *bins, dtype=torch.float64)


@library.custom_op("igps::count_pairs_backward", mutates_args=(), schema=f"(Tensor upstream, {_ARGUMENTS}) -> Tensor[]")
def _gradients(
    upstream: Tensor, classes: Tensor, n_classes: int, ways: list[int], mask: Tensor, tensors: list[Tensor]
) -> list[Tensor]:
    keys = torch._C.DispatchKey
    # PyTorch switches autograd off inside of an operator
    with (
        torch._C._SetExcludeDispatchKeyGuard(keys.AutogradFunctionality, False),
        torch._C._SetExcludeDispatchKeyGuard(keys.ADInplaceOrView, False),
        torch.enable_grad(),
    ):
        leaves = [one.detach().requires_grad_() for one in tensors]
        counts = _count(classes, n_classes, _known(ways, leaves), mask, leaves)
        return list(torch.autograd.grad(counts, leaves, upstream))


@_gradients.register_fake
def _(
    upstream: Tensor, classes: Tensor, n_classes: int, ways: list[int], mask: Tensor, tensors: list[Tensor]
) -> list[Tensor]:
    return [torch.empty_like(one) for one in tensors]


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    classes, ctx.n_classes, ctx.ways, mask, tensors = inputs
    ctx.save_for_backward(classes, mask, *tensors)


def _backward(ctx: Any, upstream: Tensor) -> tuple[None, None, None, None, list[Tensor]]:
    classes, mask, *tensors = ctx.saved_tensors
    return None, None, None, None, _gradients(upstream, classes, ctx.n_classes, ctx.ways, mask, tensors)


_operator.register_autograd(_backward, setup_context=_keep)


def check_pairs(pairs: Sequence[PairValues], mask: Tensor) -> None:
    """Raise a ValueError unless each shape has two points at least, and all that pairs are measured by is finite.

    Under `torch.compile` and `torch.export` nothing is checked, as nothing can be raised.
    """
    for x in (x for one in pairs for x in one.inputs):
        if x.shape[:2] != mask.shape:
            raise ValueError(
                f"points: expected one of each of the {mask.shape[1]} points, got shape {tuple(x.shape[1:])}."
            )
    if torch.compiler.is_compiling():
        return
    if (fewest := int(mask.sum(dim=1).min())) < 2:
        raise ValueError(f"points: expected at least two points to form a pair, got {fewest}.")
    for one in pairs:
        for x in one.inputs:
            dtype = torch.promote_types(x.dtype, torch.float32)
            most = torch.finfo(dtype).max / 8
            # All lengths at once: only where they are too large, or padding holds anything, one by one.
            if float(torch.linalg.vector_norm(x.detach(), dtype=dtype)) ** 2 < most:
                continue
            real = x.detach()[mask]
            if not bool(torch.isfinite(real).all()):
                raise ValueError("points: expected finite values, got NaN or infinity.")
            if VALUES not in one.kinds and not bool((real.square().sum(dim=-1) < most).all()):
                raise ValueError(
                    "points: expected distances that can be squared, got larger ones; choose a larger unit."
                )
