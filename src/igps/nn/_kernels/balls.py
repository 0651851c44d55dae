"""The largest balls that touch a surface at its samples, from inside and from outside."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from igps._arrays import Real, Singles
from igps._compiled import compiled
from igps.nn._kernels import blocks
from igps.nn._precision import full_precision

# Points that lie so nearly in the tangent plane, by the sine, tell of the sampled normal's error and not of a ball
_TANGENTIAL = 0.1
# The third smallest of all points' balls: a single sample with a wrong direction cannot make one small
_RANK = 3
# Radii over the unit of length: what is smaller is below any sampling, what is larger is flat
_SMALLEST, _LARGEST = 1e-3, 10.0
_NORMAL = 2.0**-126  # the smallest normal number of single precision


def ball_radii(points: Tensor, directions: Tensor, mask: Tensor) -> Tensor:
    """Radii of the largest balls without a sample inside that touch the surface at each sample.

    A ball that touches at x with centre x − r n passes through another point y where r = |x − y|² / (2 n·(x − y)); the
    largest empty one is the smallest of these. Those inside touch the surface at the medial axis' distance (Ma, Bae and
    Choi 2012), and so tell the local thickness.

    Args:
        points: (N, P, 3), in units of the body's size.
        directions: (N, P, 3) of length 1, outward.
        mask: (N, P) true where a sample is real.

    Returns:
        (N, P, 2) radii inside and outside, from 0.001 to 10; the latter where no sample is on that side. 1 where
        padded.

    Raises:
        ValueError: fewer than three points of a shape, or values that are not finite.
    """
    dtype = torch.promote_types(points.dtype, torch.float32)
    points, directions = points.to(dtype), directions.to(dtype)
    if not torch.compiler.is_compiling():
        if (fewest := int(mask.sum(dim=1).min())) < _RANK:
            raise ValueError(f"samples: expected at least {_RANK} of each body, which tell its balls, got {fewest}.")
        if not (torch.isfinite(points[mask]).all() and torch.isfinite(directions[mask]).all()):
            raise ValueError("samples: expected finite points and directions, got NaN or infinity.")
    differentiable = torch.is_grad_enabled() and (points.requires_grad or directions.requires_grad)
    if differentiable or not blocks.in_loops(points.device):
        found = blocks.of_bodies(_radii, points, directions, mask)
    else:
        found = torch.ones_like(points[..., :2])
        for into, places, ways, real in zip(found, points, directions, mask, strict=True):
            bent = np.zeros((int(real.sum()), 2), into.numpy().dtype)
            bends(_array(places[real]), _array(ways[real]), _TANGENTIAL, bent)
            into[real] = 1 / torch.from_numpy(bent)
    return torch.where(mask[:, :, None], found.clamp(_SMALLEST, _LARGEST), 1)


def _radii(points: Tensor, directions: Tensor, mask: Tensor) -> Tensor:
    """(N, P, 2) radii by operations of PyTorch, differentiable."""
    # In double precision: the nearest points decide, and of theirs products of matrices leave few digits.
    dtype = points.dtype
    points, directions = (one.masked_fill(~mask[:, :, None], 0).double() for one in (points, directions))
    with full_precision():
        lengths = points.square().sum(dim=2)
        squares = (lengths[:, :, None] + lengths[:, None] - 2 * points @ points.mT).clamp_min(0)
        # n·(x − y): how deep each point lies below the tangent plane of every other one
        depth = (directions * points).sum(dim=2, keepdim=True) - directions @ points.mT
    none = ~mask[:, None, :] | torch.eye(mask.shape[1], dtype=torch.bool, device=points.device)
    flat = squares.sqrt() * _TANGENTIAL
    sides = []
    for height in (depth, -depth):
        counts = (height > flat) & ~none
        radii = torch.where(counts, squares / torch.where(counts, 2 * height, 1), torch.inf)
        sides.append(radii.topk(_RANK, dim=2, largest=False).values[..., -1])
    return torch.stack(sides, dim=2).to(dtype)


def _array(vectors: Tensor) -> Singles:
    """(3, P) of vectors (P, 3)."""
    return vectors.detach().T.contiguous().numpy()


@compiled()
def bends(points: NDArray[Real], directions: NDArray[Real], tangential: float, found: NDArray[Real]) -> None:
    """Write one over the third smallest radius of each point's balls, inside and outside, to (P, 2); 0 for none.

    A row of pairs at a time, and no matrix of all of them.

    Args:
        points: (3, P), and their directions (3, P).
        tangential: sine of the angle to the tangent plane up to which points do not count.
        found: (P, 2), zeros.
    """
    n = points.shape[1]
    one = points.dtype.type(1)
    least = one * tangential * tangential
    smallest = one * _NORMAL
    of_row = np.empty(n, points.dtype)
    for i in range(n):
        x, y, z = points[0, i], points[1, i], points[2, i]
        a, b, c = directions[0, i], directions[1, i], directions[2, i]
        for j in range(n):
            u, v, w = x - points[0, j], y - points[1, j], z - points[2, j]
            square = u * u + v * v + w * w
            depth = a * u + b * v + c * w
            counts = depth * depth > least * square
            of_row[j] = (depth + depth) / max(square, smallest) if counts else 0 * one
        for side in range(2):
            first = second = third = 0 * one
            for j in range(n):
                bend = of_row[j] if side == 0 else -of_row[j]
                if bend > third:
                    if bend > first:
                        first, second, third = bend, first, second
                    elif bend > second:
                        second, third = bend, second
                    else:
                        third = bend
            found[i, side] = third
