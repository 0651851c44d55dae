"""The largest balls that touch a surface at its samples, from inside and from outside."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from igps.nn._kernels.ball_loops import bends
from igps.nn._kernels.counted_pairs import can_count
from igps.nn._precision import full_precision

# Points that lie so nearly in the tangent plane, by the sine, tell of the sampled normal's error and not of a ball
_TANGENTIAL = 0.1
# The third smallest of all points' balls: a single sample with a wrong direction cannot make one small
_RANK = 3
# Radii over the unit of length: what is smaller is below any sampling, what is larger is flat
_SMALLEST, _LARGEST = 1e-3, 10.0


def ball_radii(points: Tensor, directions: Tensor) -> Tensor:
    """Radii of the largest balls without a sample inside that touch the surface at each sample.

    A ball that touches at x with centre x − r n passes through another point y where r = |x − y|² / (2 n·(x − y)); the
    largest empty one is the smallest of these. Those inside touch the surface at the medial axis' distance (Ma, Bae and
    Choi 2012), and so tell the local thickness.

    Args:
        points: (P, 3), in units of the body's size.
        directions: (P, 3) of length 1, outward.

    Returns:
        (P, 2) radii inside and outside, from 0.001 to 10; the latter where no sample is on that side.

    Raises:
        ValueError: fewer than three points, or values that are not finite.
    """
    if len(points) < _RANK:
        raise ValueError(f"samples: expected at least {_RANK} of each body, which tell its balls, got {len(points)}.")
    if not (torch.isfinite(points).all() and torch.isfinite(directions).all()):
        raise ValueError("samples: expected finite points and directions, got NaN or infinity.")
    if can_count(points, directions):
        places = _array(points)
        bent = np.zeros((len(points), 2), dtype=places.dtype)
        bends(places, _array(directions.to(points.dtype)), _TANGENTIAL, bent)
        return (1 / torch.from_numpy(bent)).clamp(_SMALLEST, _LARGEST)
    with full_precision():
        squares = torch.cdist(points, points, compute_mode="use_mm_for_euclid_dist").square().fill_diagonal_(torch.inf)
        # n·(x − y): how deep each point lies below the tangent plane of every other one
        depth = (directions * points).sum(dim=1, keepdim=True) - directions @ points.T
    flat = squares.sqrt() * _TANGENTIAL
    sides = []
    for height in (depth, -depth):
        radii = torch.where(height > flat, squares / (2 * height), torch.inf)
        sides.append(radii.topk(_RANK, dim=1, largest=False).values[:, -1])
    return torch.stack(sides, dim=1).clamp(_SMALLEST, _LARGEST)


def _array(vectors: Tensor) -> NDArray[np.float32]:
    """(3, P) of vectors (P, 3)."""
    return vectors.detach().T.contiguous().numpy()
