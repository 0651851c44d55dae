"""A function on a grid that is negative in one body, and zero on its surface. Lengths are in cells.

It is made of the exact distances of the grid's points to the triangles.
"""

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from igps._arrays import Booleans, Floats, Integers, Singles, Surface
from igps.mesh._outside import MARGIN, WALL, OrientedSurface
from igps.mesh.surface import face_areas, sums

# How far from the surface exact distances are needed: marching cubes ask for both ends of the edges that cross it.
_BAND = 1.1
# Half the thickness that a sheet gets. More than half a cell, because a sheet may lie in the middle between two layers.
_HALF_SHEET = 0.55
# No value is closer to zero: marching cubes would make triangles without area.
LEAST = 0.02
# Least radius of the bars between pieces.
_BAR = 0.9
# Pieces of less than this share of the volume are specks.
SPECK_VOLUME = 2e-3


@dataclass(frozen=True)
class Grid:
    """Grid points at whole numbers of cells from the origin."""

    origin: Floats
    cell: float
    shape: tuple[int, int, int]

    @classmethod
    def around(cls, vertices: Floats, faces: Integers, cell: float) -> Self:
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
        near = np.sqrt(squared) <= (size - 1) / 2 * np.sqrt(3) + _BAND
        size //= 2
        corner = size * np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        blocks = (blocks[near][:, None] + corner).reshape(-1, 3)
        blocks = blocks[(blocks < shape).all(axis=1)]
    squared, _, point = igl.point_mesh_squared_distance(np.asfortranarray(blocks.astype(np.float64)), vertices, faces)
    distance = np.full(shape, np.inf, dtype=np.float32)
    nearest = np.zeros((*shape, 3), dtype=np.float32)
    inside = squared <= _BAND**2
    at = tuple(blocks[inside].T)
    distance[at], nearest[at] = np.sqrt(squared[inside]), point[inside]
    return distance, nearest


def level_set(distance: Singles, nearest: Singles, outside: Booleans, surface: OrientedSurface) -> Singles:
    """The signed distance of solids and, for what has no inside, the distance to a sheet of a cell's thickness."""
    from skimage.segmentation import watershed

    band = np.isfinite(distance)
    wall = distance <= WALL
    at = np.nonzero(band)
    foot, away = nearest[at], distance[at]
    way = (np.stack(at, axis=1) - foot) / np.maximum(away, 1e-6)[:, None]
    # A point of the wall belongs to the side that lies beyond it, away from the surface, or that of its deepest
    # neighbours where all beyond is wall.
    markers = np.where(wall, 0, np.where(outside, 1, 2)).astype(np.int32)
    doubtful = np.nonzero(away <= WALL)[0]
    for step in (0.75, 1.0, 1.25):
        beyond = _at(markers, foot[doubtful] + step * way[doubtful])
        sided = doubtful[beyond > 0]
        markers[tuple(index[sided] for index in at)] = beyond[beyond > 0]
        doubtful = doubtful[beyond == 0]
    markers = watershed(-np.where(band, distance, _BAND), markers, connectivity=3)
    inside = markers == 2
    solid = _has_inside(inside, at, foot, way)
    if surface.is_nearly_closed and not solid.all():
        # Walls too thin for the flood.
        thin = np.stack([index[~solid] for index in at], axis=1)
        inside[tuple(thin[surface.winding(thin) > 0.5].T)] = True
        solid = _has_inside(inside, at, foot, way)
    field = np.where(inside, -1, 1) * np.clip(distance, np.float32(LEAST), np.float32(_BAND))  # zero has no sign
    sheet = tuple(index[~solid] for index in at)
    field[sheet] = distance[sheet] - _HALF_SHEET
    field = np.where(np.abs(field) < LEAST, np.where(field < 0, -LEAST, LEAST), field)
    return without_bubbles(field.astype(np.float32))


def _has_inside(inside: Booleans, at: tuple[Integers, ...], foot: NDArray[Any], way: NDArray[Any]) -> Booleans:
    """Whether a point is inside or sees an inside when it looks through the surface where that is nearest."""
    solid = inside[at]
    for step in (0.25, 0.5, 0.75, 1.0):
        solid |= _at(inside, foot - step * way)
    return np.asarray(solid)


def _at(values: NDArray[Any], points: NDArray[Any]) -> NDArray[Any]:
    """The values at the grid points nearest to `points`."""
    index = np.clip(np.round(points).astype(np.int64), 0, np.array(values.shape) - 1)
    return np.asarray(values[tuple(index.T)])


def without_bubbles(field: Singles) -> Singles:
    """The field with everything filled that the outside does not reach."""
    label, count = ndimage.label(field > 0)
    if count > 1:
        field[(field > 0) & (label != label[0, 0, 0])] = -LEAST
    return field


def joined(field: Singles, notes: list[str], radius: float = 0.0) -> Singles:
    """The field of one piece: small ones dropped, the others joined by bars where the gaps are narrowest."""
    label, count = ndimage.label(field < 0)
    if count < 2:
        return field
    volume = np.bincount(label.ravel(), minlength=count + 1)
    volume[0] = 0
    small = volume < SPECK_VOLUME * volume.sum()
    dropped = np.nonzero(small)[0][1:]
    if len(dropped) and volume[dropped].sum() < 0.05 * volume.sum():
        gone = np.isin(label, dropped)
        field[gone] = -field[gone]
        label[gone] = 0
    pieces = np.unique(label)[1:]
    if len(pieces) < 2:
        return field
    away, index = ndimage.distance_transform_edt(label == 0, return_indices=True)
    owner = label[tuple(index)]
    neighbours = []
    positions = np.arange(field.size).reshape(field.shape)
    for axis in range(3):
        a = tuple(slice(None, -1) if i == axis else slice(None) for i in range(3))
        b = tuple(slice(1, None) if i == axis else slice(None) for i in range(3))
        found = (owner[a], owner[b], away[a] + away[b] + 1, positions[a], positions[b])
        neighbours.append([values[owner[a] != owner[b]] for values in found])
    i, j, width, p, q = (np.concatenate(values) for values in zip(*neighbours, strict=True))
    order = np.argsort(width, kind="stable")
    pair = np.minimum(i, j).astype(np.int64) * (count + 1) + np.maximum(i, j)
    _, narrowest = np.unique(pair[order], return_index=True)
    chosen = order[narrowest]
    graph = sparse.csr_array((width[chosen], (i[chosen], j[chosen])), shape=(count + 1,) * 2)
    tree = sparse.csgraph.minimum_spanning_tree(graph).tocoo()
    lookup = {(int(i[k]), int(j[k])): k for k in chosen}
    for row, column in zip(tree.row.tolist(), tree.col.tolist(), strict=True):
        k = lookup[row, column]
        a, b = (index.reshape(3, -1)[:, place].astype(np.float64) for place in (p[k], q[k]))
        _add_bar(field, a, b, max(radius, _BAR))
    notes.append(f"joined {len(pieces)} pieces by bars")
    return without_bubbles(field)


def _add_bar(field: Singles, a: Floats, b: Floats, radius: float) -> None:
    around = math.ceil(radius) + 1
    low = np.maximum(np.minimum(a, b).astype(int) - around, 0)
    high = np.minimum(np.maximum(a, b).astype(int) + around + 1, field.shape)
    box = tuple(map(slice, low, high))
    points = np.moveaxis(np.indices(high - low), 0, -1) + low
    along = np.clip(((points - a) @ (b - a)) / max(float((b - a) @ (b - a)), 1e-9), 0, 1)
    distance = np.linalg.norm(points - a - along[..., None] * (b - a), axis=-1)
    field[box] = np.minimum(field[box], distance - radius)
