"""Find the grid points outside a surface that may have holes. Lengths are in cells.

**A hole, or the mouth of a cup?** If a surface is nearly closed, the winding number tells inside from outside (Jacobson
et al. 2013). A surface is nearly closed if the winding numbers beside its faces deviate on average by less than 1/20
from whole numbers: bodies with 2 % missing have 0.01 to 0.03, a cup as deep as wide has 0.10.

In any other surface, an opening is a hole if the largest ball that passes through it has less than half the radius of
the largest ball behind it; the space behind a hole is inside. A wider opening is the mouth of a cup, a trouser leg or a
bell. It stays open, and the wall gets about a cell of thickness. A vase modelled as a solid, with two sides of its
wall, stays open at any width of the mouth: the winding number behind is near zero. Openings narrower than a cell are
always closed.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers, Singles
from igps.mesh.surface import area_vectors, face_areas, has_twins, lengths, signed_volume

MARGIN = 3  # cells around the bounding box of the surface
# Grid points this close to a triangle are wall, which the flood does not enter. A grid line that crosses a triangle has
# a point at most half a cell away from it, on one side or the other.
WALL = 0.5 + 1e-6
_MOUTH = 0.5  # minimal radius of a mouth, over that of the largest ball behind it
_TWO_SIDED = 0.25  # a wall has two sides if the winding number behind the opening is below this
# A surface is nearly closed below this mean deviation of winding numbers from whole numbers, beside this many faces.
_NEARLY_CLOSED = 0.05
_N_PROBES = 1500
_MAX_EXACT_PAIRS = 10**7  # points times faces up to which winding numbers are exact


@dataclass(frozen=True)
class OrientedSurface:
    """Surface whose connected parts are oriented for winding numbers: outward, as far as that is known."""

    vertices: Floats
    faces: Integers
    is_nearly_closed: bool

    @classmethod
    def of(cls, vertices: Floats, faces: Integers) -> Self:
        import igl

        rounded = np.round(vertices, 4)
        _, first, index = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
        vertices = vertices[first]
        faces = index.ravel()[faces]
        faces = faces[~has_twins(faces)]
        if not len(faces):
            return cls(vertices, faces, False)
        faces, part = igl.bfs_orient(faces)
        faces, _ = igl.orient_outward(vertices, faces, part[:, None])
        faces = np.asarray(faces, dtype=np.int64)
        if signed_volume(vertices, faces) < 0:
            faces = np.ascontiguousarray(faces[:, ::-1])
        surface = cls(vertices, faces, False)
        winding = surface.winding(_probe_points(vertices, faces))
        # Beside closed, outward oriented surfaces the numbers are 0, 1, 2, ...
        nearest = np.maximum(np.round(winding), 0)
        defect = np.abs(winding - nearest).mean()
        return replace(surface, is_nearly_closed=bool(defect < _NEARLY_CLOSED))

    @property
    def thickness(self) -> float:
        """Volume over area, cells: half of a plate's thickness, half of a rod's radius, a third of a ball's radius."""
        area = float(face_areas(self.vertices, self.faces).sum())
        return signed_volume(self.vertices, self.faces) / area

    def winding(self, points: NDArray[Any]) -> Floats:
        """Return the winding numbers (P,) about points (P, 3)."""
        if not len(points) or not len(self.faces):
            return np.zeros(len(points))
        import igl

        method = igl.winding_number
        if len(points) * len(self.faces) > _MAX_EXACT_PAIRS:
            # It is off by a tenth near triangles that are much longer than wide.
            method = igl.fast_winding_number
        points = points.astype(np.float64)
        return np.asarray(method(self.vertices, self.faces, points))


def _probe_points(vertices: Floats, faces: Integers) -> Floats:
    """Return points on the outer, then on the inner side of the centroids of faces chosen evenly by area."""
    normals = area_vectors(vertices, faces)
    areas = lengths(normals)
    shares = (np.arange(_N_PROBES) + 0.5) / _N_PROBES
    chosen = np.searchsorted(np.cumsum(areas), shares * areas.sum())
    chosen = np.minimum(chosen, len(areas) - 1)
    chosen = chosen[areas[chosen] > 0]
    middle = vertices[faces[chosen]].mean(axis=1)
    step = 0.25 * (normals[chosen] / areas[chosen, None])
    return np.concatenate([middle + step, middle - step])


def find_outside(distance: Singles, surface: OrientedSurface) -> tuple[Booleans, int]:
    """Return which grid points outside the walls a flood from outside reaches, and the number of closed openings."""
    label, _ = ndimage.label(distance > WALL)
    outside = label == label[0, 0, 0]
    if surface.is_nearly_closed:
        return _outside_by_winding(outside, distance, surface)
    cavities = _cavities(outside, surface)
    if not cavities.any():
        return outside, 0
    _, count = ndimage.label(cavities)
    from skimage.segmentation import watershed

    # Both sides spread in the order of the distance to the wall, so that they meet at the narrowest place.
    depth = ndimage.distance_transform_edt(outside)
    markers = np.ones(outside.shape, dtype=np.int64)
    within = (slice(1, -1),) * 3
    markers[within] = np.where(cavities[within], 2, 0)
    return watershed(-depth, markers, mask=outside) == 1, count


def _outside_by_winding(
    outside: Booleans, distance: Singles, surface: OrientedSurface
) -> tuple[Booleans, int]:
    near = np.argwhere(outside & np.isfinite(distance))
    # A third of the points beside the surface suffices to see whether the flood entered anywhere.
    is_probed = near.sum(axis=1) % 3 == 0
    probe = near[is_probed]
    leaked = probe[surface.winding(probe) > 0.5]
    if not len(leaked):
        return outside, 0
    # Check every flooded point near the leaks.
    low = leaked.min(axis=0) - 4
    high = leaked.max(axis=0) + 5
    # Where a base is missing, winding numbers are large beyond the bounding box, too, but no body reaches there.
    low = np.maximum(low, MARGIN)
    high = np.minimum(high, np.array(outside.shape) - MARGIN)
    box = tuple(map(slice, low, high))
    points = np.argwhere(outside[box]) + low
    points = points[surface.winding(points) > 0.5]
    inside = np.zeros_like(outside)
    inside[tuple(points.T)] = True
    touching = np.ones((3, 3, 3))
    _, count = ndimage.label(inside, structure=touching)
    return outside & ~inside, count


def _cavities(outside: Booleans, surface: OrientedSurface) -> Booleans:
    """Return the cores of the spaces behind holes, found by balls of growing radius."""
    depth = ndimage.distance_transform_edt(outside)
    cavities = np.zeros_like(outside)
    radius = 1.0
    while radius < depth.max() * _MOUTH:
        for core, peak in _closed_spaces(depth, radius):
            deepest = np.argwhere(core & (depth >= peak - 1e-9))[:8]
            if np.median(surface.winding(deepest)) >= _TWO_SIDED:
                cavities |= core
        radius *= 1.3
    return cavities


def _closed_spaces(depth: Floats, radius: float) -> Iterator[tuple[Booleans, float]]:
    """Yield the cores deeper than the radius, and the depth, of spaces that no mouth of this radius opens."""
    # Everything around the grid is outside.
    is_deep = np.pad(depth > radius, 1, constant_values=True)
    label, count = ndimage.label(is_deep)
    if count == 1:
        return
    open_label = label[0, 0, 0]
    label = label[1:-1, 1:-1, 1:-1]
    peaks = ndimage.maximum(depth, label, np.arange(count + 1))
    for k in range(1, count + 1):
        if k != open_label and peaks[k] * _MOUTH >= radius:
            yield label == k, peaks[k]
