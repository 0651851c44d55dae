"""From any triangles, or points, to the closed surface of one body: distances, a flood, marching cubes.

What a flood from outside cannot reach is the body. The grid's points carry their exact distance to the triangles,
negative in the body, so that the surface of a solid lies where it was; only what has no inside, a sheet or a wire, is
given about a cell of it. Marching cubes draw the surface (Lewiner et al. 2003), and quadrics simplify it (Garland and
Heckbert 1997).

**A hole, or a cup?** Where a surface is nearly closed, which its own faces tell by their winding numbers (their mean
distance to whole numbers is below 1/20: bodies with 2 % missing have 0.01 to 0.03, a cup as deep as wide has 0.10), the
winding number says what is inside (Jacobson et al. 2013). Anywhere else an opening is a hole, and what lies behind it
inside, if a ball that passes through it has less than half the radius of the largest ball behind it. Anything wider is
the mouth of a cup, a trouser leg or a bell, and stays open, with about a cell of wall. A wall with two sides, as of a
vase that was modelled as a solid, stays open whatever the width of its mouth, since the winding number behind is near
zero. Openings narrower than a cell are always closed.

**Several pieces** become one body: those of less than a five-hundredth of the volume are dropped, the others joined by
straight bars of about a cell's radius, each where the gap is narrowest (a minimum spanning tree of the gaps).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.spatial import cKDTree

from igps.geometry.mesh import Mesh, MeshError
from igps.geometry.surface import area_vectors

# All lengths below are in cells.
# Grid points so close to a triangle are its wall, through which the flood does not pass: a grid line that crosses a
# triangle has a point at most half a cell from it on either side.
_WALL = 0.5 + 1e-6
# How far from the surface exact distances are needed: marching cubes ask for both ends of the edges that cross it.
_BAND = 1.1
# Half the thickness that a sheet gets. More than half a cell, because a sheet may lie in the middle between two layers.
_HALF_SHEET = 0.55
# No value is closer to zero: marching cubes would make triangles without area.
_LEAST = 0.02
_BAR = 0.9
# Least cosine between the normals of triangles in a flat place.
_FLAT = 0.95
_MARGIN = 3
# A mouth is wider than this share of the largest ball behind it.
_MOUTH = 0.5
# A wall has two sides where the winding number behind the opening is below this.
_TWO_SIDED = 0.25
# The winding numbers of a surface with small holes are so near to whole numbers, on average over so many places.
_NEARLY_CLOSED, _PROBES = 0.05, 1500
# So many parts of at least this share of the area may be turned to find the best orientation.
_TURNED, _SMALL_PART = 8, 0.01
_SPECK_AREA, _SPECK_VOLUME = 2e-3, 2e-3
_SPECK_CELLS = 64
# Faces beyond which vertices are first rounded to a quarter of a cell, so that time and memory stay bounded.
_MANY_FACES = 400_000
_MANY_POINTS = 200_000


def watertight(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64] | None = None,
    *,
    normals: NDArray[np.float64] | None = None,
    resolution: int = 96,
    max_vertices: int | None = 5000,
    name: str = "mesh",
) -> Mesh:
    """The closed, oriented, edge-manifold surface of one body from triangles in any state, or from points.

    Solids keep their surface, sheets get about a cell, small openings are closed, and what cannot be seen from outside
    is filled; see the module's text for what counts as a hole and how pieces are joined.

    Args:
        vertices: (V, 3) positions, any length unit.
        faces: (F, 3) vertex indices in any order and orientation, or None for a cloud of points.
        normals: (V, 3) of a cloud, of any length and either sign; estimated from the neighbours if None.
        resolution: the grid has about as many cells as a cube of this side; flat and long bodies get up to twice as
            many along their longest side.
        max_vertices: the surface is simplified to so many; None keeps all.
        name: what error messages call the surface.

    Returns:
        The body, with a note of what was done.

    Raises:
        ImportError: libigl or scikit-image is not installed.
        MeshError: there is no surface (fewer than ten points, no triangle with an area).
    """
    if resolution < 8:
        raise ValueError(f"resolution: expected at least 8, got {resolution}.")
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise MeshError(f"{name}: vertices: expected finite numbers of shape (V, 3). Export the file again.")
    notes: list[str] = []
    spacing = 0.0
    if faces is None or len(faces) == 0:
        vertices, faces, spacing = _splats(vertices, normals, resolution, name)
        notes.append("points joined by small discs")
    vertices, faces = _with_area(vertices, np.asarray(faces, dtype=np.int64), name)
    vertices, faces = _without_specks(vertices, faces, notes)
    grid = _Grid.around(vertices, faces, resolution, spacing)
    vertices = grid.to_cells(vertices)
    if len(faces) > _MANY_FACES:
        vertices, faces = _rounded(vertices, faces)
    distance, nearest = _distances(vertices, faces, grid.shape)
    oriented = _Oriented.of(vertices, faces)
    outside, closed = _outside(distance, oriented)
    if closed:
        notes.append(f"closed {closed} openings")
    field = _joined(_level_set(distance, nearest, outside, oriented), notes)
    surface_vertices, surface_faces = _marched(field, name)
    notes.append(f"made watertight on a grid of {' x '.join(str(n) for n in grid.shape)} cells")
    if max_vertices is not None:
        surface_vertices, surface_faces = _simplified(surface_vertices, surface_faces, max_vertices)
    return Mesh(grid.from_cells(surface_vertices), surface_faces, name=name, notes=tuple(notes))


@dataclass(frozen=True)
class _Grid:
    """Grid points at whole numbers of cells from the origin."""

    origin: NDArray[np.float64]
    cell: float
    shape: tuple[int, int, int]

    @classmethod
    def around(cls, vertices: NDArray[np.float64], faces: NDArray[np.int64], resolution: int, spacing: float) -> _Grid:
        low, high = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
        sides = high - low
        longest = float(sides.max())
        area = float(np.linalg.norm(area_vectors(vertices, faces), axis=1).sum())
        # As many cells as the cube, and about as many on the surface as on that of the cube.
        by_volume = float(np.prod(np.maximum(sides, longest / 1000)) ** (1 / 3)) / resolution
        by_area = np.sqrt(area / (6 * resolution**2))
        cell = float(np.clip(max(by_volume, by_area), longest / (2 * resolution), longest / (0.8 * resolution)))
        cell = max(cell, spacing)
        counts = np.ceil(sides / cell).astype(int) + 1 + 2 * _MARGIN
        # The body in the middle, so that moving it moves the grid.
        origin = (low + high) / 2 - (counts - 1) / 2 * cell
        return cls(origin, cell, (int(counts[0]), int(counts[1]), int(counts[2])))

    def to_cells(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return (points - self.origin) / self.cell

    def from_cells(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return points * self.cell + self.origin


def _with_area(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], name: str
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    area = np.linalg.norm(area_vectors(vertices, faces), axis=1)
    diagonal = float(np.linalg.norm(np.ptp(vertices[faces].reshape(-1, 3), axis=0)))
    keep = area > 1e-14 * diagonal**2
    if not keep.any():
        raise MeshError(
            f"{name}: no triangle has an area; a surface was expected. If the file holds lines, give them thickness."
        )
    return vertices, faces[keep]


def _without_specks(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The faces without groups that lie apart from everything else and have next to no area."""
    corners = vertices[faces]
    low, side = corners.min(axis=(0, 1)), float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    cell = side / _SPECK_CELLS
    points, face = _spread(corners, cell)
    index = np.floor((points - low) / cell).astype(np.int64) + 1
    occupied = np.zeros(index.max(axis=0) + 2, dtype=bool)
    occupied[tuple(index.T)] = True
    label, count = ndimage.label(occupied, structure=np.ones((3, 3, 3)))
    if count == 1:
        return vertices, faces
    group = np.zeros(len(faces), dtype=np.int64)
    group[face] = label[tuple(index.T)]
    area = np.linalg.norm(area_vectors(vertices, faces), axis=1)
    share = np.bincount(group, weights=area, minlength=count + 1) / area.sum()
    keep = (share >= _SPECK_AREA)[group]
    # Where everything is in crumbs, no crumb is a speck.
    if keep.all() or area[keep].sum() < 0.98 * area.sum():
        return vertices, faces
    notes.append(f"dropped {len(np.unique(group[~keep]))} specks")
    return _without_specks(vertices, faces[keep], notes)


def _spread(corners: NDArray[np.float64], spacing: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points on triangles, at most about `spacing` apart, and the triangle of each."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    n = np.clip(np.ceil(edges / spacing), 1, 4 * _SPECK_CELLS).astype(np.int64)
    points, owner = [], []
    for k in np.unique(n):
        i, j = np.nonzero(np.add.outer(np.arange(k + 1), np.arange(k + 1)) <= k)
        weights = np.stack([i, j, k - i - j], axis=1) / k
        of_n = np.nonzero(n == k)[0]
        points.append(np.einsum("pi,fij->fpj", weights, corners[of_n]).reshape(-1, 3))
        owner.append(np.repeat(of_n, len(weights)))
    return np.concatenate(points), np.concatenate(owner)


def _rounded(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices put together within quarters of a cell, and the different triangles that remain."""
    lattice = np.round(vertices * 4).astype(np.int64)
    _, index, count = np.unique(lattice, axis=0, return_inverse=True, return_counts=True)
    index = index.ravel()
    # The mean of those put together: no vertex of the lattice, which would shift the surface.
    mean = np.stack([np.bincount(index, weights=vertices[:, i]) for i in range(3)], axis=1) / count[:, None]
    faces = np.sort(index[faces], axis=1)
    faces = np.unique(faces[(np.diff(faces, axis=1) > 0).all(axis=1)], axis=0)
    return mean, faces


def _distances(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], shape: tuple[int, int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Distance of the grid points in the band around the surface, infinite elsewhere, and the nearest points.

    Blocks of eight cells are halved where the surface may be near.

    Returns:
        (X, Y, Z) distances and (X, Y, Z, 3) nearest points, cells.
    """
    igl = _igl()
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


@dataclass(frozen=True)
class _Oriented:
    """The surface with each connected part turned outward as a whole, for its winding numbers."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    is_nearly_closed: bool

    @classmethod
    def of(cls, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> _Oriented:
        igl = _igl()
        _, first, index = np.unique(np.round(vertices, 4), axis=0, return_index=True, return_inverse=True)
        vertices, faces = vertices[first], index.ravel()[faces]
        faces = faces[(np.diff(np.sort(faces, axis=1), axis=1) > 0).all(axis=1)]
        if not len(faces):
            return cls(vertices, faces, False)
        faces, part = igl.bfs_orient(faces)
        faces, _ = igl.orient_outward(vertices, faces, part[:, None])
        faces = np.asarray(faces, dtype=np.int64)
        middle, normals = _probes(vertices, faces)
        points = np.concatenate([middle + 0.25 * normals, middle - 0.25 * normals])
        # Outward is a guess where a part is bent. Turning one negates its share of the winding numbers: those of the
        # largest are turned that bring these closer to whole numbers.
        area = np.bincount(part, weights=np.linalg.norm(area_vectors(vertices, faces), axis=1))
        large = [k for k in np.argsort(-area)[:_TURNED].tolist() if area[k] > _SMALL_PART * area.sum()]
        shares = [cls(vertices, faces[part == k], False).winding(points) for k in large]
        rest = cls(vertices, faces[~np.isin(part, large)], False).winding(points)
        total = np.sum([rest, *shares], axis=0)
        for _ in range(_TURNED):
            turned = [total - 2 * share for share in shares]
            best = min(range(len(large)), key=lambda i: _defect(turned[i]), default=None)
            if len(large) < 2 or best is None or _defect(turned[best]) >= _defect(total) - 1e-3:
                break
            total, shares[best] = turned[best], -shares[best]
            faces = np.where((part == large[best])[:, None], faces[:, ::-1], faces)
        centred = vertices - vertices.mean(axis=0)
        if np.einsum("ij,ij->", centred[faces[:, 0]], area_vectors(centred, faces)) < 0:
            faces = np.ascontiguousarray(faces[:, ::-1])
        return cls(vertices, faces, _defect(total) < _NEARLY_CLOSED)

    def winding(self, points: NDArray[Any]) -> NDArray[np.float64]:
        if not len(points) or not len(self.faces):
            return np.zeros(len(points))
        return np.asarray(_igl().fast_winding_number(self.vertices, self.faces, points.astype(np.float64)))


def _probes(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middles of faces, chosen evenly by area from the first to the last, and their unit normals."""
    normals = area_vectors(vertices, faces)
    area = np.linalg.norm(normals, axis=1)
    at = (np.arange(_PROBES) + 0.5) / _PROBES * area.sum()
    face = np.minimum(np.searchsorted(np.cumsum(area), at), len(area) - 1)
    face = face[area[face] > 0]
    return vertices[faces[face]].mean(axis=1), normals[face] / area[face, None]


def _defect(winding: NDArray[np.float64]) -> float:
    """Mean distance to 0, 1, 2, ...: zero beside closed surfaces that are turned outward."""
    return float(np.abs(winding - np.maximum(np.round(winding), 0)).mean())


def _outside(distance: NDArray[np.float32], surface: _Oriented) -> tuple[NDArray[np.bool_], int]:
    """Which grid points the flood reaches, walls excepted, and how many openings were closed to it."""
    label, _ = ndimage.label(distance > _WALL)
    outside = label == label[0, 0, 0]
    if surface.is_nearly_closed:
        return _outside_by_winding(outside, distance, surface)
    cavities = _cavities(outside, surface)
    if not cavities.any():
        return outside, 0
    _, count = ndimage.label(cavities)
    from skimage.segmentation import watershed

    # Both sides spread in the order of the distance to the wall, so that they meet in the narrowest place.
    depth = ndimage.distance_transform_edt(outside)
    markers = np.where(cavities, 2, 0)
    markers[_border(outside.shape)] = 1
    return watershed(-depth, markers, mask=outside) == 1, count


def _outside_by_winding(
    outside: NDArray[np.bool_], distance: NDArray[np.float32], surface: _Oriented
) -> tuple[NDArray[np.bool_], int]:
    near = np.argwhere(outside & np.isfinite(distance))
    # A third of the points beside the surface, in all directions, shows whether the flood went in anywhere.
    probe = near[near.sum(axis=1) % 3 == 0]
    leaked = probe[surface.winding(probe) > 0.5]
    if not len(leaked):
        return outside, 0
    # Where it went in, all it reached near the leak is asked.
    margin = 4
    low = np.maximum(leaked.min(axis=0) - margin, 0)
    high = np.minimum(leaked.max(axis=0) + margin + 1, outside.shape)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    points = np.argwhere(outside[box]) + low
    inside = np.zeros_like(outside)
    # No body reaches beyond its bounding box, as the winding number does where a base is missing.
    points = points[((points >= _MARGIN) & (points < np.array(outside.shape) - _MARGIN)).all(axis=1)]
    inside[tuple(points[surface.winding(points) > 0.5].T)] = True
    _, count = ndimage.label(inside, structure=np.ones((3, 3, 3)))
    return outside & ~inside, count


def _cavities(outside: NDArray[np.bool_], surface: _Oriented) -> NDArray[np.bool_]:
    """The middles of what lies behind holes: connected to the outside only by passages of less than half their width.

    The passages are measured by balls of a growing radius.
    """
    depth = ndimage.distance_transform_edt(outside)
    found = np.zeros_like(outside)
    radius = 1.0
    while radius < depth.max() * _MOUTH:
        # Around the grid everything is outside.
        label, count = ndimage.label(np.pad(depth > radius, 1, constant_values=True))
        if count > 1:
            reached = label[0, 0, 0]
            label = label[1:-1, 1:-1, 1:-1]
            peak = ndimage.maximum(depth, label, np.arange(count + 1))
            for k in np.nonzero(peak * _MOUTH >= radius)[0]:
                if k not in (0, reached):
                    core = label == k
                    middle = np.argwhere(core & (depth >= peak[k] - 1e-9))[:8]
                    if np.median(surface.winding(middle)) >= _TWO_SIDED:
                        found |= core
        radius *= 1.3
    return found


def _border(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    border = np.ones(shape, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    return border


def _level_set(
    distance: NDArray[np.float32], nearest: NDArray[np.float32], outside: NDArray[np.bool_], surface: _Oriented
) -> NDArray[np.float32]:
    """The signed distance of solids and, for what has no inside, the distance to a sheet of a cell's thickness."""
    from skimage.segmentation import watershed

    band = np.isfinite(distance)
    wall = distance <= _WALL
    at = np.nonzero(band)
    foot, away = nearest[at], distance[at]
    way = (np.stack(at, axis=1) - foot) / np.maximum(away, 1e-6)[:, None]
    # A point of the wall belongs to the side that lies beyond it, away from the surface; where that is all wall, to
    # that of its deepest neighbours.
    markers = np.where(wall, 0, np.where(outside, 1, 2)).astype(np.int32)
    doubtful = np.nonzero(away <= _WALL)[0]
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
    field = np.where(inside, -1, 1) * np.minimum(distance, np.float32(_BAND))
    sheet = tuple(index[~solid] for index in at)
    field[sheet] = distance[sheet] - _HALF_SHEET
    field = np.where(np.abs(field) < _LEAST, np.where(field < 0, -_LEAST, _LEAST), field)
    return _without_bubbles(field.astype(np.float32))


def _has_inside(
    inside: NDArray[np.bool_],
    at: tuple[NDArray[np.int64], ...],
    foot: NDArray[np.floating[Any]],
    way: NDArray[np.floating[Any]],
) -> NDArray[np.bool_]:
    """Whether a point is inside or sees an inside when it looks through the surface where that is nearest."""
    solid = inside[at]
    for step in (0.25, 0.5, 0.75, 1.0):
        solid |= _at(inside, foot - step * way)
    return np.asarray(solid)


def _at(values: NDArray[Any], points: NDArray[np.floating[Any]]) -> NDArray[Any]:
    """The values at the grid points nearest to `points`."""
    index = np.clip(np.round(points).astype(np.int64), 0, np.array(values.shape) - 1)
    return np.asarray(values[tuple(index.T)])


def _without_bubbles(field: NDArray[np.float32]) -> NDArray[np.float32]:
    """What the outside does not reach is filled."""
    label, count = ndimage.label(field > 0)
    if count > 1:
        field[(field > 0) & (label != label[0, 0, 0])] = -_LEAST
    return field


def _joined(field: NDArray[np.float32], notes: list[str]) -> NDArray[np.float32]:
    """The field of one piece: small ones dropped, the others joined by bars where the gaps are narrowest."""
    label, count = ndimage.label(field < 0)
    if count < 2:
        return field
    volume = np.bincount(label.ravel(), minlength=count + 1)
    volume[0] = 0
    small = volume < _SPECK_VOLUME * volume.sum()
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
    first, second, gap, here, there = [], [], [], [], []
    positions = np.arange(field.size).reshape(field.shape)
    for axis in range(3):
        a = tuple(slice(None, -1) if i == axis else slice(None) for i in range(3))
        b = tuple(slice(1, None) if i == axis else slice(None) for i in range(3))
        differ = owner[a] != owner[b]
        first.append(owner[a][differ])
        second.append(owner[b][differ])
        gap.append((away[a] + away[b])[differ] + 1)
        here.append(positions[a][differ])
        there.append(positions[b][differ])
    i, j, width, p, q = (np.concatenate(part) for part in (first, second, gap, here, there))
    order = np.argsort(width, kind="stable")
    pair = np.minimum(i, j).astype(np.int64) * (count + 1) + np.maximum(i, j)
    _, narrowest = np.unique(pair[order], return_index=True)
    chosen = order[narrowest]
    graph = sparse.csr_array((width[chosen], (i[chosen], j[chosen])), shape=(count + 1,) * 2)
    tree = sparse.csgraph.minimum_spanning_tree(graph).tocoo()
    lookup = {(int(i[k]), int(j[k])): k for k in chosen}
    for row, column in zip(tree.row.tolist(), tree.col.tolist(), strict=True):
        k = lookup[row, column]
        ends = [np.array([index[d].ravel()[position] for d in range(3)], dtype=np.float64) for position in (p[k], q[k])]
        _add_bar(field, ends[0], ends[1])
    notes.append(f"joined {len(pieces)} pieces by bars")
    return _without_bubbles(field)


def _add_bar(field: NDArray[np.float32], a: NDArray[np.float64], b: NDArray[np.float64]) -> None:
    low = np.maximum(np.minimum(a, b).astype(int) - 2, 0)
    high = np.minimum(np.maximum(a, b).astype(int) + 3, field.shape)
    box = tuple(slice(low[d], high[d]) for d in range(3))
    points = np.stack(np.meshgrid(*(np.arange(low[d], high[d]) for d in range(3)), indexing="ij"), axis=-1)
    along = np.clip(((points - a) @ (b - a)) / max(float((b - a) @ (b - a)), 1e-9), 0, 1)
    distance = np.linalg.norm(points - a - along[..., None] * (b - a), axis=-1)
    field[box] = np.minimum(field[box], distance - _BAR)


def _marched(field: NDArray[np.float32], name: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The closed surface on which the field is zero; grid points are filled where it would touch itself."""
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise ImportError('watertight needs scikit-image: pip install "interior-gps[shapes]".') from error
    for _ in range(20):
        if not (field.min() < 0 < field.max()):
            raise MeshError(
                f"{name}: no point of the grid lies in the body, which is too thin everywhere for its length. "
                "Give it some thickness."
            )
        vertices, faces, _, _ = marching_cubes(field, 0.0, allow_degenerate=True)
        # Downward gradients point outward here.
        faces = faces.astype(np.int64)
        bad = _bad_edges(faces, len(vertices))
        if not len(bad):
            break
        # The four or eight grid points around a place where the surface meets itself.
        for vertex in np.unique(bad):
            low, high = np.floor(vertices[vertex]).astype(int), np.ceil(vertices[vertex]).astype(int)
            box = tuple(slice(max(low[d], 1), min(high[d] + 1, field.shape[d] - 1)) for d in range(3))
            field[box] = np.minimum(field[box], -_LEAST)
        field = _without_bubbles(field)
    else:
        raise MeshError(f"{name}: no closed surface came of it. Raise the resolution.")
    return _largest(vertices.astype(np.float64), faces)


def _bad_edges(faces: NDArray[np.int64], n_vertices: int) -> NDArray[np.int64]:
    """(E, 2) vertices of the edges that are not run through once in each direction."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    forward, n_forward = np.unique(start * n_vertices + end, return_counts=True)
    backward = np.unique(end * n_vertices + start)
    bad = np.concatenate([forward[n_forward > 1], np.setxor1d(forward, backward)])
    return np.stack([bad // n_vertices, bad % n_vertices], axis=1)


def _largest(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    graph = sparse.coo_array((np.ones(len(start), dtype=np.int8), (start, end)), shape=(len(vertices),) * 2)
    count, label = sparse.csgraph.connected_components(graph, directed=False)
    if count > 1:
        part = label[faces[:, 0]]
        centred = vertices - vertices.mean(axis=0)
        six_volumes = np.einsum("ij,ij->i", centred[faces[:, 0]], area_vectors(centred, faces))
        volume = np.abs(np.bincount(part, weights=six_volumes, minlength=count))
        faces = faces[part == np.argmax(volume)]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _simplified(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], max_vertices: int
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    surplus = len(vertices) - max_vertices
    if surplus <= 0:
        return vertices, faces
    igl = _igl()
    scale = float(np.ptp(vertices, axis=0).max())
    points, triangles = vertices / scale, faces
    # The shortest edges first, which marching cubes leave in plenty and which need no quadrics: that is much faster.
    for collapse, n_vertices in ((igl.decimate, 3 * max_vertices), (igl.qslim, max_vertices)):
        target = len(triangles) - 2 * (len(points) - n_vertices)
        if len(points) > n_vertices:
            points, triangles, *_ = collapse(
                np.asfortranarray(points), np.asfortranarray(triangles.astype(np.int32)), target
            )
    triangles = np.asarray(triangles, dtype=np.int64)
    if len(triangles) == 0 or len(_bad_edges(triangles, len(points))) or not np.isfinite(points).all():
        return vertices, faces
    points, triangles = _largest(points * scale, triangles)
    return points, _flipped(points, triangles)


def _flipped(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """The faces after edges were turned where the two angles that face them are more than 180° together.

    Quadrics leave long thin triangles in flat places; there these flips lead to a Delaunay triangulation, on which the
    cotangent weights are positive. Edges where the surface bends stay.
    """
    for _ in range(30):
        n = len(vertices)
        start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        opposite = np.roll(faces, 1, axis=1).ravel()
        forward = start * n + end
        order = np.argsort(forward)
        # The other side of each side of a face, and each pair once.
        twin = order[np.searchsorted(forward[order], end * n + start)]
        side = np.nonzero(start < end)[0]
        other = twin[side]
        a, b, c, d = start[side], end[side], opposite[side], opposite[other]
        pa, pb, pc, pd = vertices[a], vertices[b], vertices[c], vertices[d]
        gain = _angle(pc, pa, pb) + _angle(pd, pb, pa) - np.pi
        old = [np.cross(pb - pa, pc - pa), np.cross(pa - pb, pd - pb)]
        new = [np.cross(pd - pc, pb - pc), np.cross(pc - pd, pa - pd)]
        mean = old[0] + old[1]
        # A triangle so thin that it has no direction may go either way.
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        mean = mean / np.maximum(length, 1e-30)
        flat = np.ones(len(side), dtype=bool)
        for vectors in (*old, *new):
            size = np.linalg.norm(vectors, axis=1)
            flat &= (np.einsum("ij,ij->i", vectors, mean) > _FLAT * size) | (size < 1e-3 * length[:, 0])
        exists = np.isin(np.minimum(c, d) * n + np.maximum(c, d), np.minimum(start, end) * n + np.maximum(start, end))
        wanted = np.nonzero((gain > 1e-3) & flat & ~exists & (c != d))[0]
        # Every face takes part in the best of its flips only, and no two flips make the same edge.
        best = np.full(len(faces), -np.inf)
        for sides in (side, other):
            np.maximum.at(best, sides[wanted] // 3, gain[wanted])
        wanted = wanted[(gain[wanted] >= best[side[wanted] // 3]) & (gain[wanted] >= best[other[wanted] // 3])]
        _, once = np.unique(np.minimum(c, d)[wanted] * n + np.maximum(c, d)[wanted], return_index=True)
        wanted = wanted[once]
        taken, count = np.unique(np.concatenate([side[wanted] // 3, other[wanted] // 3]), return_counts=True)
        alone = ~np.isin(side[wanted] // 3, taken[count > 1]) & ~np.isin(other[wanted] // 3, taken[count > 1])
        wanted = wanted[alone]
        if not len(wanted):
            break
        faces = faces.copy()
        faces[side[wanted] // 3] = np.stack([c[wanted], d[wanted], b[wanted]], axis=1)
        faces[other[wanted] // 3] = np.stack([d[wanted], c[wanted], a[wanted]], axis=1)
    return faces


def _angle(at: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    u, v = a - at, b - at
    return np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.einsum("ij,ij->i", u, v))


def _splats(
    points: NDArray[np.float64], normals: NDArray[np.float64] | None, resolution: int, name: str
) -> tuple[NDArray[np.float64], NDArray[np.int64], float]:
    """A disc (a hexagon) around each point of a cloud, and the spacing of the points."""
    if len(points) < 10:
        raise MeshError(
            f"{name}: a cloud of {len(points)} points; at least 10 are needed for a surface. Check that the file holds "
            "faces, or scan more points."
        )
    side = float(np.ptp(points, axis=0).max())
    if side == 0:
        raise MeshError(f"{name}: all points are in one place; a surface was expected. Check the file.")
    if len(points) > _MANY_POINTS:
        # One point in each half of a cell.
        lattice = np.floor((points - points.min(axis=0)) / (side / (4 * resolution))).astype(np.int64)
        _, first = np.unique(lattice, axis=0, return_index=True)
        points, normals = points[first], None if normals is None else normals[first]
    tree = cKDTree(points)
    away, neighbours = tree.query(points, k=min(13, len(points)))
    # A disc reaches the third ring of neighbours or so in an even cloud; where points are rare, it does not run wild.
    own = away[:, min(6, away.shape[1] - 1)]
    spacing = float(np.median(own))
    radius = np.clip(own, spacing / 2, 2 * spacing)
    if normals is None:
        local = points[neighbours] - points[neighbours].mean(axis=1, keepdims=True)
        _, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", local, local))
        normals = axes[:, :, 0]
    normals = np.asarray(normals, dtype=np.float64)
    if normals.shape != points.shape or not np.isfinite(normals).all():
        raise MeshError(f"{name}: normals: expected finite numbers of shape {points.shape}. Leave them out.")
    # Two directions of the plane: the axis least along the normal gives the first.
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    u = np.cross(normals, axis)
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)
    v = np.cross(normals, u)
    v /= np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12)
    angle = np.arange(6) * np.pi / 3
    rim = points[:, None] + radius[:, None, None] * (
        np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None]
    )
    corner = np.arange(6)
    fan = np.stack([corner[[0, 0, 0, 0]], corner[[1, 2, 3, 4]], corner[[2, 3, 4, 5]]], axis=1)
    faces = (6 * np.arange(len(points))[:, None, None] + fan).reshape(-1, 3)
    return rim.reshape(-1, 3), faces, spacing / 2


def _igl() -> Any:
    try:
        import igl
    except ImportError as error:
        raise ImportError('watertight needs libigl: pip install "interior-gps[igl]".') from error
    return igl
