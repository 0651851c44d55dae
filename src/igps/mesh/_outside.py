"""Which points of a grid lie outside a surface that may have holes; lengths are in cells.

**A hole, or a cup?** Where a surface is nearly closed, the winding number says what is inside (Jacobson et al. 2013).
It is if the winding numbers beside its faces are on average within 1/20 of whole numbers: bodies with 2 % missing have
0.01 to 0.03, a cup as deep as wide has 0.10. Of overlapping solids the faces hidden between them are left out first, or
thin bodies would have up to 0.10, too.

Anywhere else an opening is a hole, and what lies behind it inside, if a ball that passes through it has less than half
the radius of the largest ball behind it. Anything wider is the mouth of a cup, a trouser leg or a bell, and stays open,
with about a cell of wall. A wall with two sides, as of a vase that was modelled as a solid, stays open whatever the
width of its mouth, since the winding number behind is near zero. Openings narrower than a cell are always closed.
"""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers, Singles
from igps.mesh.surface import area_vectors, face_areas, signed_volume, unit

# Cells around the surface's bounding box.
MARGIN = 3
# Grid points so close to a triangle are its wall, through which the flood does not pass: a grid line that crosses a
# triangle has a point at most half a cell from it on either side.
WALL = 0.5 + 1e-6
# A mouth is wider than this share of the largest ball behind it.
_MOUTH = 0.5
# A wall has two sides where the winding number behind the opening is below this.
_TWO_SIDED = 0.25
# The winding numbers of a surface with small holes are so near to whole numbers, on average over so many places.
_NEARLY_CLOSED, _PROBES = 0.05, 1500
# So many parts of at least this share of the area may be turned to find the best orientation.
_TURNED, _SMALL_PART = 8, 0.01
# Faces with the inside on both sides are looked for where there are more than this share, if there are not too many
# faces to ask each.
_HIDDEN, _MANY_FACES = 0.02, 200_000
# Places times faces, up to which winding numbers are exact.
_FEW_PAIRS = 10**7


@dataclass(frozen=True)
class OrientedSurface:
    """The surface with each connected part turned outward as a whole, for its winding numbers."""

    vertices: Floats
    faces: Integers
    is_nearly_closed: bool

    @classmethod
    def of(cls, vertices: Floats, faces: Integers) -> Self:
        import igl

        _, first, index = np.unique(np.round(vertices, 4), axis=0, return_index=True, return_inverse=True)
        vertices, faces = vertices[first], index.ravel()[faces]
        faces = faces[(np.diff(np.sort(faces, axis=1), axis=1) > 0).all(axis=1)]
        if not len(faces):
            return cls(vertices, faces, False)
        faces, part = igl.bfs_orient(faces)
        faces, _ = igl.orient_outward(vertices, faces, part[:, None])
        faces = np.asarray(faces, dtype=np.int64)
        points = _beside(vertices, faces)
        # Outward is a guess where a part is bent. Turning one negates its share of the winding numbers: those of the
        # largest are turned that bring these closer to whole numbers.
        area = np.bincount(part, weights=face_areas(vertices, faces))
        large = [k for k in np.argsort(-area)[:_TURNED].tolist() if area[k] > _SMALL_PART * area.sum()]
        shares = [cls(vertices, faces[part == k], False).winding(points) for k in large]
        rest = cls(vertices, faces[~np.isin(part, large)], False).winding(points)
        total = np.sum([rest, *shares], axis=0)
        for _ in range(_TURNED if len(large) > 1 else 0):
            turned = [total - 2 * share for share in shares]
            best = min(range(len(large)), key=lambda i: _defect(turned[i]))
            if _defect(turned[best]) >= _defect(total) - 1e-3:
                break
            total, shares[best] = turned[best], -shares[best]
            faces = np.where((part == large[best])[:, None], faces[:, ::-1], faces)
        if signed_volume(vertices, faces) < 0:
            faces = np.ascontiguousarray(faces[:, ::-1])
        surface = cls(vertices, faces, _defect(total) < _NEARLY_CLOSED)
        hidden = total.reshape(2, -1).min(axis=0) > 0.5
        if surface.is_nearly_closed or hidden.mean() < _HIDDEN or len(faces) > _MANY_FACES:
            return surface
        bare = surface._without_hidden()
        return bare if bare.is_nearly_closed else surface

    @property
    def thickness(self) -> float:
        """Volume over area, cells: half of a plate's thickness, half of a rod's radius, a third of a ball's."""
        return signed_volume(self.vertices, self.faces) / float(face_areas(self.vertices, self.faces).sum())

    def winding(self, points: NDArray[Any]) -> Floats:
        if not len(points) or not len(self.faces):
            return np.zeros(len(points))
        import igl

        # The fast ones are off by a tenth near triangles that are much longer than wide.
        few = len(points) * len(self.faces) <= _FEW_PAIRS
        number = igl.winding_number if few else igl.fast_winding_number
        return np.asarray(number(self.vertices, self.faces, points.astype(np.float64)))

    def _without_hidden(self) -> Self:
        """Without the faces that have the inside on both sides, such as walls between solids put together.

        Solids that share some of their outer surface are each open there, which spoils the winding numbers around.
        """
        normals, middle = unit(area_vectors(self.vertices, self.faces)), self.vertices[self.faces].mean(axis=1)
        least = np.minimum(*(self.winding(middle + side * normals) for side in (0.25, -0.25)))
        faces = self.faces[least <= 0.5]
        if not len(faces):
            return self
        bare = replace(self, faces=faces)
        defect = _defect(bare.winding(_beside(self.vertices, faces)))
        return replace(bare, is_nearly_closed=defect < _NEARLY_CLOSED)


def _beside(vertices: Floats, faces: Integers) -> Floats:
    """Points outside, then inside of the middles of faces, chosen evenly by area from the first to the last."""
    normals = area_vectors(vertices, faces)
    area = np.linalg.norm(normals, axis=1)
    at = (np.arange(_PROBES) + 0.5) / _PROBES * area.sum()
    face = np.minimum(np.searchsorted(np.cumsum(area), at), len(area) - 1)
    face = face[area[face] > 0]
    middle, step = vertices[faces[face]].mean(axis=1), 0.25 * (normals[face] / area[face, None])
    return np.concatenate([middle + step, middle - step])


def _defect(winding: Floats) -> float:
    """Mean distance to 0, 1, 2, ...: zero beside closed surfaces that are turned outward."""
    return float(np.abs(winding - np.maximum(np.round(winding), 0)).mean())


def outside_of(distance: Singles, surface: OrientedSurface) -> tuple[Booleans, int]:
    """Which grid points the flood reaches, walls excepted, and how many openings were closed to it."""
    label, _ = ndimage.label(distance > WALL)
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
    markers = np.ones(outside.shape, dtype=np.int64)
    markers[1:-1, 1:-1, 1:-1] = np.where(cavities, 2, 0)[1:-1, 1:-1, 1:-1]
    return watershed(-depth, markers, mask=outside) == 1, count


def _outside_by_winding(outside: Booleans, distance: Singles, surface: OrientedSurface) -> tuple[Booleans, int]:
    near = np.argwhere(outside & np.isfinite(distance))
    # A third of the points beside the surface, in all directions, shows whether the flood went in anywhere.
    probe = near[near.sum(axis=1) % 3 == 0]
    leaked = probe[surface.winding(probe) > 0.5]
    if not len(leaked):
        return outside, 0
    # If it did, every point that it reached near these leaks is looked at.
    low, high = np.maximum(leaked.min(axis=0) - 4, 0), np.minimum(leaked.max(axis=0) + 5, outside.shape)
    box = tuple(map(slice, low, high))
    points = np.argwhere(outside[box]) + low
    inside = np.zeros_like(outside)
    # No body reaches beyond its bounding box, as the winding number does where a base is missing.
    points = points[((points >= MARGIN) & (points < np.array(outside.shape) - MARGIN)).all(axis=1)]
    inside[tuple(points[surface.winding(points) > 0.5].T)] = True
    _, count = ndimage.label(inside, structure=np.ones((3, 3, 3)))
    return outside & ~inside, count


def _cavities(outside: Booleans, surface: OrientedSurface) -> Booleans:
    """The middles of what lies behind holes: what only passages of less than half its width, measured by balls of a
    growing radius, connect with the outside."""
    depth = ndimage.distance_transform_edt(outside)
    found = np.zeros_like(outside)
    radius = 1.0
    while radius < depth.max() * _MOUTH:
        # Around the grid everything is outside.
        label, count = ndimage.label(np.pad(depth > radius, 1, constant_values=True))
        if count > 1:
            reached, label = label[0, 0, 0], label[1:-1, 1:-1, 1:-1]
            peak = ndimage.maximum(depth, label, np.arange(count + 1))
            for k in np.nonzero(peak * _MOUTH >= radius)[0]:
                if k not in (0, reached):
                    core = label == k
                    middle = np.argwhere(core & (depth >= peak[k] - 1e-9))[:8]
                    if np.median(surface.winding(middle)) >= _TWO_SIDED:
                        found |= core
        radius *= 1.3
    return found
