"""Nearest neighbours, and the largest balls that touch a surface at its samples, from inside and from outside."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from igps._arrays import Integers, Real
from igps._compiled import compiled
from igps.nn._kernels import batches
from igps.nn._precision import full_precision


def smallest(values: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Return the n smallest entries (..., P, n) of each row of (..., P, T), in ascending order, and their columns.

    There is no gradient. The columns of infinite entries are undefined. On the CPU the first of equal entries is taken,
    so that descriptions do not depend on the version of PyTorch.
    """
    values = values.detach()
    if not batches.uses_loops(values.device):
        top = values.topk(n, dim=-1, largest=False)
        return top.values, top.indices
    # Faster than PyTorch, which copies and partly sorts each row.
    rows = values.contiguous().numpy().reshape(-1, values.shape[-1])
    entries = np.full((len(rows), n), np.inf, rows.dtype)
    columns = np.zeros((len(rows), n), np.int64)
    if n:
        keep_smallest(rows, entries, columns)
    shape = (*values.shape[:-1], n)
    return torch.from_numpy(entries.reshape(shape)), torch.from_numpy(columns.reshape(shape))


@compiled()
def keep_smallest(values: NDArray[Real], entries: NDArray[Real], columns: Integers) -> None:
    """Write the smallest entries of each row of (P, T) and their columns to (P, n); `entries` starts as infinity."""
    last = entries.shape[1] - 1
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            value = values[i, j]
            if value < entries[i, last]:
                k = last
                while k > 0 and entries[i, k - 1] > value:
                    entries[i, k], columns[i, k] = entries[i, k - 1], columns[i, k - 1]
                    k -= 1
                entries[i, k] = value
                columns[i, k] = j


# Sine of the smallest angle to the tangent plane. Below it, the error of the sampled normal determines the radius.
_MIN_SINE = 0.1
_RANK = 3  # the third smallest radius is taken, so that no single sample with a wrong direction makes a ball small
# Bounds of radii, in the unit of the points: smaller radii are finer than any sampling, larger ones are flat.
_MIN_RADIUS, _MAX_RADIUS = 1e-3, 10.0
_MIN_NORMAL = 2.0**-126  # smallest normal number of single precision


def ball_radii(points: Tensor, directions: Tensor, mask: Tensor) -> Tensor:
    """Return the radii of the largest balls that touch the surface at each sample and contain no other sample.

    A ball with centre x − r n touches the surface at x, and passes through another point y if
    r = |x − y|² / (2 n·(x − y)). The largest empty ball has the smallest radius; for robustness, the third
    smallest is returned. The centres of inner balls lie on the medial axis (Ma, Bae and Choi 2012), so that their radii
    measure the local thickness.

    Args:
        points: (N, P, 3), in units of the body's size.
        directions: (N, P, 3) of length 1, outward.
        mask: (N, P) true where a sample is real.

    Returns:
        (N, P, 2) radii inside and outside, from 0.001 to 10; 10 for fewer than three samples on a side, 1 where padded.

    Raises:
        ValueError: a shape has fewer than three points, or values are not finite.
    """
    dtype = torch.promote_types(points.dtype, torch.float32)
    points = points.to(dtype)
    directions = directions.to(dtype)
    if not torch.compiler.is_compiling():
        _check_samples(points[mask], directions[mask], mask)
    has_gradient = torch.is_grad_enabled() and (points.requires_grad or directions.requires_grad)
    if has_gradient or not batches.uses_loops(points.device):
        radii = batches.map_bodies(_radii_by_torch, points, directions, mask)
    else:
        radii = torch.ones_like(points[..., :2])
        for number, is_real in enumerate(mask):
            x = points[number, is_real]
            radii[number, is_real] = _radii_by_loops(x, directions[number, is_real])
    return torch.where(mask[:, :, None], radii.clamp(_MIN_RADIUS, _MAX_RADIUS), 1)


def _check_samples(points: Tensor, directions: Tensor, mask: Tensor) -> None:
    n_points = int(mask.sum(dim=1).min())
    if n_points < _RANK:
        raise ValueError(
            f"samples: expected at least {_RANK} of each body for its balls, got {n_points}."
        )
    if not (torch.isfinite(points).all() and torch.isfinite(directions).all()):
        raise ValueError("samples: expected finite points and directions, got NaN or infinity.")


def _radii_by_loops(points: Tensor, directions: Tensor) -> Tensor:
    """Return radii (P, 2) for points and directions (P, 3) of one body, without gradients."""
    x = points.detach().T.contiguous().numpy()
    n = directions.detach().T.contiguous().numpy()
    row = np.empty(len(points), x.dtype)
    curvatures = np.zeros((len(points), 2), x.dtype)
    write_curvatures(x, n, _MIN_SINE, row, curvatures)
    return 1 / torch.from_numpy(curvatures)


def _radii_by_torch(points: Tensor, directions: Tensor, mask: Tensor) -> Tensor:
    """Return radii (N, P, 2) by differentiable operations of PyTorch."""
    # In double precision, as matrix products lose digits of the nearest points, which decide.
    dtype = points.dtype
    is_padding = ~mask
    points = points.masked_fill(is_padding[:, :, None], 0).double()
    directions = directions.masked_fill(is_padding[:, :, None], 0).double()
    with full_precision():
        lengths = points.square().sum(dim=2)
        squares = lengths[:, :, None] + lengths[:, None] - 2 * points @ points.mT
        squares = squares.clamp_min(0)
        # n·(x − y): the depth of each point y below the tangent plane at x
        depth = (directions * points).sum(dim=2, keepdim=True) - directions @ points.mT
    is_self = torch.eye(mask.shape[1], dtype=torch.bool, device=points.device)
    is_excluded = is_padding[:, None, :] | is_self
    min_height = squares.sqrt() * _MIN_SINE
    sides = []
    for height in (depth, -depth):
        counts = (height > min_height) & ~is_excluded
        diameters = torch.where(counts, 2 * height, 1)
        radii = torch.where(counts, squares / diameters, torch.inf)
        nearest = radii.topk(_RANK, dim=2, largest=False).values
        sides.append(nearest[..., -1])
    return torch.stack(sides, dim=2).to(dtype)


@compiled()
def write_curvatures(
    points: NDArray[Real],
    directions: NDArray[Real],
    min_sine: float,
    row: NDArray[Real],
    out: NDArray[Real],
) -> None:
    """Write 1 / third smallest radius inside and outside at each point to (P, 2); 0 if there are fewer than three.

    Points and directions are (3, P). Pairs are processed row by row, in scratch space (P,), without a matrix of all.
    """
    n = points.shape[1]
    one = points.dtype.type(1)
    min_square = one * min_sine * min_sine
    min_normal = one * _MIN_NORMAL
    for i in range(n):
        x = points[0, i]
        y = points[1, i]
        z = points[2, i]
        a = directions[0, i]
        b = directions[1, i]
        c = directions[2, i]
        for j in range(n):
            u = x - points[0, j]
            v = y - points[1, j]
            w = z - points[2, j]
            square = u * u + v * v + w * w
            depth = a * u + b * v + c * w
            counts = depth * depth > min_square * square
            row[j] = (depth + depth) / max(square, min_normal) if counts else 0 * one
        for side in range(2):
            first = second = third = 0 * one
            for j in range(n):
                curvature = row[j] if side == 0 else -row[j]
                if curvature > third:
                    if curvature > first:
                        first, second, third = curvature, first, second
                    elif curvature > second:
                        second, third = curvature, second
                    else:
                        third = curvature
            out[i, side] = third
