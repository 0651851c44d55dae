"""The potential ∫ dS/|x − s| of a uniformly charged triangle mesh, with a bound on the relative error.

Near triangles are integrated in closed form (Wilton, Rao, Glisson, Schaubert, Al-Bundak and Butler 1984). Distant
triangles and clusters of triangles are replaced by the Taylor series of 1/r about their centroid up to second order;
the first-order term is zero. Let a patch have area A, radius R and mean squared distance σ² from its centroid. At a
distance d from the centroid, the remainder is at most A/d · Rσ²/d³ / (1 − R/d). The series is used only where this is
less than a given fraction of A/d. All contributions are positive, so it also bounds the relative error of the sum.

The series of the quarters of a near face replaces the closed form down to about half the distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from igps._arrays import Floats, Integers
from igps.mesh.surface import longest_side
from igps.signature._potential_loops import PatchTree, fill_potentials
from igps.signature.ordering import spatial_order

_BLOCK_SIZE = 32  # points for which the same patches are far
_BRANCHING = 8  # patches that are merged into one of the next level
# Of a face, relative to its longest side: flatter faces have no numerical normal
_MIN_HEIGHT = 1e-14


def surface_potential(
    vertices: Floats, faces: Integers, points: Floats, accuracy: float = 1e-3
) -> Floats:
    """Return ∫ dS/|x − s| (P,), length, over a triangle mesh, at points x (P, 3) inside, outside or on the surface.

    The accuracy is a proved bound on the relative error of every value. The largest error seen at 10⁻³ was 4·10⁻⁶, on
    26 bodies with and without needles: the remainders of patches have different signs.
    """
    corners = vertices[faces]
    centre = corners.mean(axis=(0, 1))
    scale = longest_side(vertices)
    corners = (corners - centre) / scale
    corners = corners[_relative_heights(corners) > _MIN_HEIGHT]
    x = (np.asarray(points, np.float64) - centre) / scale
    out = np.zeros(len(x))
    if not len(corners) or not len(x):
        return out
    corners = corners[spatial_order(corners.mean(axis=1), _BRANCHING)]
    levels = [_Patches.from_triangles(corners)]
    while len(levels[-1].areas) > 2 * _BRANCHING:
        levels.append(levels[-1].merged(_BRANCHING))
    whole_faces = levels[0]
    # Quarters have their centroids at the centroid of the face and half-way to its corners.
    quarters = _Patches(
        whole_faces.areas / 4,
        whole_faces.centres,
        whole_faces.covariances / 4,
        whole_faces.radii / 2,
    )
    squared_limits = np.square(quarters.min_distances(accuracy) + whole_faces.radii / 2)
    sizes = [len(level.areas) for level in levels]
    tree = PatchTree(
        np.concatenate([level.table for level in levels]),
        np.concatenate([level.min_distances(accuracy) for level in levels]),
        np.cumsum([0, *sizes]),
        _BRANCHING,
        squared_limits,
        _face_table(corners),
    )
    order = spatial_order(x, _BLOCK_SIZE)
    potentials = np.empty(len(x))
    fill_potentials(x[order], _BLOCK_SIZE, tree, potentials)
    out[order] = potentials * scale
    return out


def _relative_heights(corners: Floats) -> Floats:
    """Return the height of each triangle (F, 3, 3) over its longest side."""
    sides = np.roll(corners, -1, axis=1) - corners
    double_areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    squared_lengths = np.square(sides).sum(axis=2)
    return double_areas / squared_lengths.max(axis=1)


@dataclass(frozen=True)
class _Patches:
    """Pieces of the surface, with the moments that the series needs."""

    areas: Floats  # (n,)
    centres: Floats  # (n, 3) centroids
    covariances: Floats  # (n, 3, 3)
    radii: Floats  # (n,) of balls about the centroids that contain the patches

    @staticmethod
    def from_triangles(corners: Floats) -> _Patches:
        """Make a patch of each triangle (n, 3, 3)."""
        centres = corners.mean(axis=1)
        arms = corners - centres[:, None]
        normals = np.cross(arms[:, 0] - arms[:, 1], arms[:, 0] - arms[:, 2])
        areas = np.linalg.norm(normals, axis=1) / 2
        covariances = arms.transpose(0, 2, 1) @ arms / 12
        radii = np.linalg.norm(arms, axis=2).max(axis=1)
        return _Patches(areas, centres, covariances, radii)

    def merged(self, size: int) -> _Patches:
        """Merge each `size` consecutive patches into one."""
        starts = np.arange(0, len(self.areas), size)
        group = np.arange(len(self.areas)) // size
        areas = np.add.reduceat(self.areas, starts)
        centres = np.add.reduceat(self.areas[:, None] * self.centres, starts) / areas[:, None]
        arms = self.centres - centres[group]
        about_new_centres = self.covariances + arms[:, :, None] * arms[:, None]
        moments = self.areas[:, None, None] * about_new_centres
        covariances = np.add.reduceat(moments, starts) / areas[:, None, None]
        reach = np.linalg.norm(arms, axis=1) + self.radii
        radii = np.maximum.reduceat(reach, starts)
        return _Patches(areas, centres, covariances, radii)

    def min_distances(self, accuracy: float) -> Floats:
        """Return the distances (n,) from the centroids beyond which the series has this relative accuracy."""
        variances = np.trace(self.covariances, axis1=1, axis2=2)
        # With d = g + R/2, d² (d − R) = (g + R/2)² (g − R/2) ≥ g³ for g ≥ R.
        bounds = np.cbrt(self.radii * variances / accuracy)
        return np.maximum(bounds, 1.5 * self.radii) + self.radii / 2

    @property
    def table(self) -> Floats:
        """Columns (n, 10): centroid, area, and the quadratic form A·(3/2 C − ½ tr C·1) as xx, yy, zz, 2xy, 2xz, 2yz."""
        trace = np.trace(self.covariances, axis1=1, axis2=2)
        per_area = 1.5 * self.covariances - 0.5 * trace[:, None, None] * np.eye(3)
        form = self.areas[:, None, None] * per_area
        entries = form[:, (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)] * [1, 1, 1, 2, 2, 2]
        return np.concatenate([self.centres, self.areas[:, None], entries], axis=1)


def _face_table(corners: Floats) -> Floats:
    """Return corners, normal, outward side normals, side lengths and twice the area of each triangle as (F, 25)."""
    sides = np.roll(corners, -1, axis=1) - corners  # from each corner to the next
    normals = np.cross(sides[:, 0], sides[:, 1])
    double_areas = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / double_areas
    lengths = np.linalg.norm(sides, axis=2)
    outward = np.cross(sides / lengths[..., None], normals[:, None])
    columns = [corners.reshape(-1, 9), normals, outward.reshape(-1, 9), lengths, double_areas]
    return np.concatenate(columns, axis=1)
