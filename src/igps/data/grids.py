"""Images and grids of values, on disk or in memory, as arrays with their place in the world."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from igps._arrays import Booleans, Floats

_MAX_VALUE = 1e15  # larger values are placeholders for missing values, such as 7e18 at the border of some grids
_LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def is_known(values: NDArray[Any]) -> Booleans:
    """Return which values are finite and no placeholders for missing values."""
    return np.isfinite(values) & (np.abs(values) < _MAX_VALUE)


@dataclass(frozen=True, eq=False)
class Grid:
    """Values of voxels, and the affine from their indices to the world."""

    values: NDArray[Any]  # (X, Y, Z)
    affine: Floats  # (4, 4)

    def to_voxels(self, points: Floats) -> Floats:
        """Return the indices (P, 3), not rounded, of points (P, 3) of the world."""
        to_indices = np.linalg.inv(self.affine[:3, :3])
        return (points - self.affine[:3, 3]) @ to_indices.T

    def to_world(self, indices: Floats) -> Floats:
        """Return the points (P, 3) of the world at indices (P, 3)."""
        return indices @ self.affine[:3, :3].T + self.affine[:3, 3]

    def at(self, points: Floats) -> Floats:
        """Return values (P,) at points (P, 3), interpolated linearly; NaN more than half a voxel outside."""
        indices = self.to_voxels(points)
        size = np.array(self.values.shape)
        is_within = (indices > -0.5) & (indices < size - 0.5)
        inside = is_within.all(axis=1)
        found = np.full(len(points), np.nan)
        if not inside.any():
            return found
        indices = indices[inside]
        # A large image is converted only where it is needed
        low = np.floor(indices.min(axis=0)).astype(int)
        high = np.ceil(indices.max(axis=0)).astype(int)
        low = np.clip(low, 0, size - 1)
        high = np.clip(high, 0, size - 1)
        block = self.values[tuple(map(slice, low, high + 1))].astype(np.float64)
        known = is_known(block)
        places = (indices - low).T
        interpolate = partial(map_coordinates, coordinates=places, order=1, mode="nearest")
        weight = interpolate(known.astype(np.float64))
        sums = interpolate(np.where(known, block, 0.0))
        means = sums / np.maximum(weight, 0.5)
        found[inside] = np.where(weight > 0.5, means, np.nan)
        return found


def grid_of(image: Any, spacing: Sequence[float] | None = None) -> Grid:
    """Return an image in memory as a grid, in RAS millimetres if it has a place in the world.

    Args:
        image: an array (X, Y, Z), with `spacing`; or an image of nibabel, SimpleITK or TorchIO, or a tensor of MONAI,
            with one channel. They are recognised by their attributes, so that none of these packages is needed.
        spacing: sides of a voxel of an array; 1 if None.

    Raises:
        TypeError: not an image.
        ValueError: not three axes, or `spacing` with an image that has its own.
    """
    if hasattr(image, "GetDirection"):
        values, affine = _of_simpleitk(image)
    elif hasattr(image, "affine"):
        content = image.dataobj if hasattr(image, "dataobj") else image.data
        values = np.asarray(content)
        affine = np.asarray(image.affine, dtype=np.float64)
    elif isinstance(image, np.ndarray) or hasattr(image, "__array__"):
        sides = (1.0, 1.0, 1.0) if spacing is None else spacing
        return Grid(_one_channel(np.asarray(image)), np.diag([*sides, 1.0]))
    else:
        kind = f"{type(image).__module__}.{type(image).__qualname__}"
        raise TypeError(
            f"image: expected an array, or an image of nibabel, SimpleITK, TorchIO or MONAI, got {kind}."
        )
    if spacing is not None:
        raise ValueError("spacing: expected None with an image that has its own. Leave it out.")
    return Grid(_one_channel(values), affine)


def _of_simpleitk(image: Any) -> tuple[NDArray[Any], Floats]:
    import SimpleITK

    affine = np.eye(4)
    if image.GetDimension() == 3:
        axes = np.reshape(image.GetDirection(), (3, 3))
        affine[:3, :3] = axes * image.GetSpacing()
        affine[:3, 3] = image.GetOrigin()
    return SimpleITK.GetArrayViewFromImage(image).T, _LPS_TO_RAS @ affine


def _one_channel(values: NDArray[Any]) -> NDArray[Any]:
    """Return values (X, Y, Z) of an array that may have a first or a last axis of one channel."""
    if values.ndim == 4 and values.shape[0] == 1:
        return values[0]
    if values.ndim == 4 and values.shape[-1] == 1:
        return values[..., 0]
    if values.ndim != 3:
        raise ValueError(
            f"image: expected three axes, or one channel besides, got shape {values.shape}. Choose one channel."
        )
    return values
