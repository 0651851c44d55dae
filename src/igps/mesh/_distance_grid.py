"""A grid around a surface, and the exact distances of its points to the triangles. Lengths are in cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from igps._arrays import Floats, Integers, Singles, Surface
from igps.mesh.surface import face_areas, sums

# How far from the surface exact distances are needed: marching cubes ask for both ends of the edges that cross it.
BAND = 1.1
# Cells around the surface's bounding box.
MARGIN = 3


@dataclass(frozen=True)
class Grid:
    """Grid points at whole numbers of cells from the origin."""

    origin: Floats
    cell: float
    shape: tuple[int, int, int]

    @classmethod
    def around(cls, vertices: Floats, faces: Integers, cell: float) -> Grid:
        low, high = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
        counts = np.ceil((high - low) / cell).astype(int) + 1 + 2 * MARGIN
        # The body in the middle, so that moving it moves the grid.
        origin = (low + high) / 2 - (counts - 1) / 2 * cell
        return cls(origin, cell, (int(counts[0]), int(counts[1]), int(counts[2])))

    def to_cells(self, points: Floats) -> Floats:
        return (points - self.origin) / self.cell

    def from_cells(self, points: Floats) -> Floats:
        return points * self.cell + self.origin


def cell_sizes(vertices: Floats, faces: Integers, resolution: int, spacing: float) -> tuple[float, float]:
    """The usual size of a cell, and the least, with as many cells as a cube, and about as many on the surface.

    The least is smaller for long bodies alone: the usual grid has twice `resolution` along the longest side at most.
    """
    corners = vertices[faces]
    sides = np.ptp(corners.reshape(-1, 3), axis=0)
    longest, area = float(sides.max()), float(face_areas(vertices, faces).sum())
    by_volume = float(np.prod(np.maximum(sides, longest / 1000)) ** (1 / 3)) / resolution
    by_area = float(np.sqrt(area / (6 * resolution**2)))
    least = max(min(max(by_volume, by_area), longest / (0.8 * resolution)), spacing)
    return max(least, longest / (2 * resolution)), least


def rounded(vertices: Floats, faces: Integers) -> Surface:
    """Vertices put together within quarters of a cell, and the different triangles that remain."""
    lattice = np.round(vertices * 4).astype(np.int64)
    _, index, count = np.unique(lattice, axis=0, return_inverse=True, return_counts=True)
    index = index.ravel()
    # The mean of those put together: vertices of the lattice would shift the surface.
    mean = sums(index, vertices, len(count)) / count[:, None]
    faces = np.sort(index[faces], axis=1)
    return mean, np.unique(faces[(np.diff(faces, axis=1) > 0).all(axis=1)], axis=0)


def distances(vertices: Floats, faces: Integers, shape: tuple[int, int, int]) -> tuple[Singles, Singles]:
    """(X, Y, Z) distances of the grid points in the band around the surface, infinite elsewhere, and the nearest places
    (X, Y, Z, 3). Blocks of eight cells are halved where the surface may be near."""
    import igl

    vertices, faces = np.asfortranarray(vertices), np.asfortranarray(faces)
    size = 8
    blocks = np.stack(np.meshgrid(*(np.arange(0, n, size) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    while size > 1:
        centre = np.asfortranarray(blocks + (size - 1) / 2)
        squared, _, _ = igl.point_mesh_squared_distance(centre, vertices, faces)
        near = np.sqrt(squared) <= (size - 1) / 2 * np.sqrt(3) + BAND
        size //= 2
        corner = size * np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        blocks = (blocks[near][:, None] + corner).reshape(-1, 3)
        blocks = blocks[(blocks < shape).all(axis=1)]
    squared, _, point = igl.point_mesh_squared_distance(np.asfortranarray(blocks.astype(np.float64)), vertices, faces)
    distance = np.full(shape, np.inf, dtype=np.float32)
    nearest = np.zeros((*shape, 3), dtype=np.float32)
    inside = squared <= BAND**2
    at = tuple(blocks[inside].T)
    distance[at], nearest[at] = np.sqrt(squared[inside]), point[inside]
    return distance, nearest
