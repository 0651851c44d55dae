"""Typical damages of segmentation masks: those of the published figures, and others for the choice of measures."""

from collections.abc import Callable

import numpy as np

from igps._arrays import Booleans, Floats

DAMAGES = ("slices", "hole", "leak", "island", "label", "half")
VARIED = ("slices", "tunnel", "cavity", "leak", "island", "label", "blocks")


def damaged(
    whole: Booleans, spacing: Floats, how: str, random: np.random.Generator, others: Booleans
) -> tuple[Booleans, Floats]:
    """Apply one of the `DAMAGES` to a mask and its spacing.

    "label" leaves both unchanged: the caller changes the label. `others` are the voxels into which the mask may leak.
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt

    if how in ("label", "half"):
        return (whole, spacing) if how == "label" else (whole[::2, ::2, ::2], spacing * 2)
    box, mask, grid, ball = _surroundings(whole, spacing)
    positions, radius = grid[mask], _radius(mask, spacing)
    if how == "slices":
        lowest, highest = positions[:, 2].min(), positions[:, 2].max()
        mask = mask & (grid[..., 2] <= highest - 0.25 * (highest - lowest))
    if how == "hole":
        deepest = (
            np.argwhere((depth := distance_transform_edt(mask, spacing)) == depth.max())[0]
            * spacing
        )
        across = ((grid - deepest)[..., :2] ** 2).sum(axis=-1) <= max(
            0.25 * radius, 1.01 * spacing.max()
        ) ** 2
        mask = mask & ~across
    if how == "leak":
        mask = mask | ball(_on_skin(mask, spacing, random, others[box]), 0.6)
    if how == "island":
        outside = np.argwhere(~binary_dilation(mask, iterations=4)) * spacing
        mask = mask | ball(outside[random.integers(len(outside))], 0.25)
    changed = whole.copy()
    changed[box] = mask
    return changed, spacing


def varied(
    whole: Booleans, spacing: Floats, how: str, random: np.random.Generator, others: Booleans
) -> tuple[Booleans, Floats]:
    """Apply one of the damages `VARIED`, as `damaged` does; measures are chosen on these and not on the `DAMAGES`."""
    from scipy.ndimage import binary_dilation, distance_transform_edt

    if how == "label":
        return whole, spacing
    if how == "blocks":  # resampled to a grid twice as coarse and back
        first = [
            (np.arange(n) + k) // 2 * 2 - k
            for n, k in zip(whole.shape, random.integers(0, 2, 3), strict=True)
        ]
        return whole[np.ix_(*(np.maximum(index, 0) for index in first))], spacing
    box, mask, grid, ball = _surroundings(whole, spacing)
    depth = distance_transform_edt(mask, spacing)
    deep = grid[depth >= 0.6 * depth.max()]
    middle, size = deep[random.integers(len(deep))], random.uniform(0.15, 0.35)
    if how == "slices":
        along = (grid - middle)[..., random.integers(3)] * random.choice([-1, 1])
        lowest, highest = along[mask].min(), along[mask].max()
        mask = mask & (along <= highest - size * (highest - lowest))
    if how == "tunnel":
        direction = random.normal(size=3)
        across = np.linalg.norm(
            np.cross(grid - middle, direction / np.linalg.norm(direction)), axis=-1
        )
        mask = mask & (across > max(size * _radius(mask, spacing), 1.01 * spacing.max()))
    if how == "cavity":
        mask = mask & ~(ball(middle, size) & (depth > 1.01 * spacing.min()))
    if how == "leak":  # a cluster of three balls
        nearby = others[box] if random.random() < 0.5 else np.zeros_like(mask)
        middle, radius = _on_skin(mask, spacing, random, nearby), _radius(mask, spacing)
        for _ in range(3):
            mask, middle = (
                mask | ball(middle, random.uniform(0.3, 0.5)),
                middle + random.normal(size=3) * 0.2 * radius,
            )
    if how == "island":
        outside = grid[~binary_dilation(mask, iterations=2)]
        mask = mask | ball(outside[random.integers(len(outside))], size)
    changed = whole.copy()
    changed[box] = mask
    return changed, spacing


def _radius(mask: Booleans, spacing: Floats) -> float:
    """Return the radius of a ball with the volume of the mask."""
    return float(np.cbrt(3 / (4 * np.pi) * mask.sum() * spacing.prod()))


def _surroundings(
    whole: Booleans, spacing: Floats
) -> tuple[tuple[slice, ...], Booleans, Floats, Callable[[Floats, float], Booleans]]:
    """Return a box around the mask, the mask in the box, positions of its voxels, and a function that makes balls.

    The function takes a centre and a radius relative to that of the mask.
    """
    voxels = np.argwhere(whole)
    low, high = np.maximum(voxels.min(axis=0) - 8, 0), voxels.max(axis=0) + 9
    box = tuple(map(slice, low, high))
    mask = whole[box]
    radius = _radius(mask, spacing)
    grid = np.stack(np.meshgrid(*map(np.arange, mask.shape), indexing="ij"), axis=-1) * spacing

    def ball(middle: Floats, size: float) -> Booleans:
        inside: Booleans = ((grid - middle) ** 2).sum(axis=-1) <= max(
            size * radius, 1.01 * spacing.max()
        ) ** 2
        return inside

    return box, mask, grid, ball


def _on_skin(
    mask: Booleans, spacing: Floats, random: np.random.Generator, others: Booleans
) -> Floats:
    """Return the position of a random border voxel, if possible near another body."""
    from scipy.ndimage import binary_erosion, distance_transform_edt

    skin = mask & ~binary_erosion(mask)
    if others.any():
        near = skin & (distance_transform_edt(~others, spacing) <= 0.3 * _radius(mask, spacing))
        skin = near if near.any() else skin
    positions = np.argwhere(skin) * spacing
    chosen: Floats = positions[random.integers(len(positions))]
    return chosen
