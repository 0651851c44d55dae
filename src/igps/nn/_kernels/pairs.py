"""One count of pairs of points, into a product of classes and bins, with two back ends.

`count_pairs` is what every histogram of pairs comes down to. On the CPU it runs in compiled loops, with a gradient of
their own (`count_by_loops`); on other devices, where PyTorch traces it for `torch.compile` or `torch.export`, and for
derivatives of gradients, in operations of PyTorch (`count_by_torch`). Both count in double precision, hold no matrix of
all pairs, and have gradients by all that the values are computed from, by the weights and by the centres.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement

import torch
from torch import Tensor

from igps.nn._kernels.count_by_loops import CompiledCount, Layout
from igps.nn._kernels.count_by_torch import count_by_torch
from igps.nn._kernels.pair_cells import VALUES
from igps.nn._kernels.pair_values import PairValues


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
        if _is_compiled(dtype, classes.device):
            counts = CompiledCount.apply(Layout(classes, n_classes, tuple(pairs), mask), *tensors)
        else:
            counts = count_by_torch(classes, n_classes, pairs, mask, *tensors)
        n_points = mask.sum(dim=1).double().view(-1, *[1] * (counts.ndim - 1))
        return (counts / (n_points * (n_points - 1) / 2)).to(dtype)


def _is_compiled(dtype: torch.dtype, device: torch.device) -> bool:
    """Whether compiled loops count points of a type on a device."""
    return device.type == "cpu" and dtype in (torch.float32, torch.float64) and not torch.compiler.is_compiling()


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
            most = torch.finfo(torch.promote_types(x.dtype, torch.float32)).max / 8
            # All lengths at once: only where they are too large, or padding holds anything, one by one.
            if (
                float(torch.linalg.vector_norm(x.detach(), dtype=torch.promote_types(x.dtype, torch.float32))) ** 2
                < most
            ):
                continue
            real = x.detach()[mask]
            if not bool(torch.isfinite(real).all()):
                raise ValueError("points: expected finite values, got NaN or infinity.")
            if VALUES not in one.kinds and not bool((real.square().sum(dim=-1) < most).all()):
                raise ValueError(
                    "points: expected distances that can be squared, got larger ones; choose a larger unit."
                )
