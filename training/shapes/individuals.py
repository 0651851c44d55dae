"""Individuals of a body: small smooth changes of its surface at rest, like those between people of the same build."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from igps._arrays import Floats, Integers
from igps.mesh.surface import face_areas
from training.shapes.bodies import Body, Warp

SHARES = (0.01, 0.05)
"""Range of the largest displacement of a vertex, in units of √area."""

_N_REGIONS = 4  # regions with local changes, in addition to the global change
_RADII = (0.08, 0.3)  # range of the radii of regions, in units of √area
_TRIAL_VERTICES = 2400


@dataclass(frozen=True)
class Change:
    """A smooth deformation of space: a global warp, and regions that swell or in which limbs grow longer.

    The nearest similarity is subtracted, because a motion or a change of scale does not make another individual.
    """

    waves: Warp  # the global change
    centres: Floats  # (L,3) of the regions
    axes: Floats  # (L,3)
    radii: Floats  # (L,)
    swells: Floats  # (L,) strength of the growth perpendicular to the axis
    grows: Floats  # (L,) strength of the growth along the axis, beyond the centre
    similarity: Floats  # (7,) coefficients of the subtracted similarity, see `_similarity_basis`
    step: float  # factor of the whole change

    @classmethod
    def draw(
        cls,
        rng: np.random.Generator,
        vertices: Floats,
        faces: Integers,
        shares: tuple[float, float],
    ) -> Change:
        """Draw a change of a surface, whose largest displacement in units of √area is within `shares`."""
        size = float(np.sqrt(face_areas(vertices, faces).sum()))
        low, high = np.log(_RADII)
        radii = size * np.exp(rng.uniform(low, high, _N_REGIONS))
        seeds = vertices[rng.integers(len(vertices), size=_N_REGIONS)]
        middle = vertices.mean(axis=0)
        centres = []
        axes = []
        for seed, radius in zip(seeds, radii, strict=True):
            away = np.linalg.norm(vertices - seed, axis=1)
            region = vertices[away < radius]
            centre = region.mean(axis=0)
            _, _, principal = np.linalg.svd(region - centre, full_matrices=False)
            axis = principal[0]
            is_inward = axis @ (centre - middle) < 0.0
            centres.append(centre)
            axes.append(-axis if is_inward else axis)
        swells, grows = rng.normal(size=(2, _N_REGIONS)) * rng.uniform(0.2, 1.0, (2, 1))
        change = cls(
            waves=Warp.draw(rng, 2.0 * size, 0.5 * rng.uniform(0.2, 1.0)),
            centres=np.array(centres),
            axes=np.array(axes),
            radii=radii,
            swells=swells,
            grows=grows,
            similarity=np.zeros(7),
            step=1.0,
        )
        basis = _similarity_basis(vertices).reshape(-1, 7)
        steps = change(vertices) - vertices
        similarity, *_ = np.linalg.lstsq(basis, steps.reshape(-1), rcond=None)
        change = replace(change, similarity=similarity.astype(np.float64))
        steps = change(vertices) - vertices
        largest = float(np.linalg.norm(steps, axis=1).max())
        low, high = np.log(shares)
        share = float(np.exp(rng.uniform(low, high)))
        return replace(change, step=size * share / largest)

    def __call__(self, points: Floats) -> Floats:
        steps = self.waves(points) - points
        regions = (self.centres, self.axes, self.radii, self.swells, self.grows)
        for centre, axis, radius, swell, grow in zip(*regions, strict=True):
            positions = points - centre
            along = positions @ axis
            across = positions - along[:, None] * axis
            distances = np.linalg.norm(across, axis=1)
            near = np.exp(-0.5 * (distances**2 + along**2) / radius**2)
            beside = np.exp(-0.5 * (distances / radius) ** 2)
            beyond = radius * np.logaddexp(0.0, along / radius) * beside
            swelling = 0.3 * swell * near[:, None] * across
            growth = 0.15 * grow * beyond[:, None] * axis
            steps = steps + swelling + growth
        similar = _similarity_basis(points) @ self.similarity
        return points + self.step * (steps - similar)


@dataclass(frozen=True)
class ChangedWarp:
    """A deformation of space, followed by a change."""

    first: Callable[[Floats], Floats]
    second: Change

    def __call__(self, points: Floats) -> Floats:
        return self.second(self.first(points))


def individual(body: Body, rng: np.random.Generator, shares: tuple[float, float] = SHARES) -> Body:
    """Draw an individual of a body: the body with a `Change` of its surface at rest."""
    vertices, faces = body.surface(_TRIAL_VERTICES, np.eye(3))
    change = Change.draw(rng, body.warp(vertices), faces, shares)
    return replace(body, warp=ChangedWarp(body.warp, change))


def _similarity_basis(points: Floats) -> Floats:
    """(P,3,7) displacements of points (P,3) by translations, infinitesimal rotations, and scaling."""
    x, y, z = points.T
    zero = np.zeros(len(points))
    about_x = np.stack([zero, -z, y], 1)
    about_y = np.stack([z, zero, -x], 1)
    about_z = np.stack([-y, x, zero], 1)
    turns = np.stack([about_x, about_y, about_z], axis=2)
    shifts = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([shifts, turns, points[:, :, None]], axis=2)
