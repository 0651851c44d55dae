"""Individuals of a body: small smooth changes of its surface at rest, as people differ beside their build."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from igps._arrays import Floats, Integers
from igps.mesh.surface import face_areas
from training.graded.bodies import Body, Warp

# How far the point that moves most is moved, as a share of the root of the area.
SHARES = (0.01, 0.05)
_LOCAL = 4  # changes of a place, beside one of the whole
_RADII = (0.08, 0.3)  # of a place, as a share of the root of the area
_TRIAL_VERTICES = 2400


@dataclass(frozen=True)
class Change:
    """A smooth change of space: waves through the whole body; places that swell, and limbs that grow longer.

    A change that is only a motion or a scale is none, so the similarity that is nearest is taken off.
    """

    waves: Warp  # of the whole
    centres: Floats  # (L,3) of the places
    axes: Floats  # (L,3)
    radii: Floats  # (L,)
    swells: Floats  # (L,) across the axis
    grows: Floats  # (L,) along it beyond the centre
    similarity: Floats  # (7,) what is taken off, of the columns that `_columns` makes
    step: float  # factor of all

    @classmethod
    def draw(cls, rng: np.random.Generator, vertices: Floats, faces: Integers) -> Change:
        """Draw a change of a surface, its largest step a share of the root of the area between `SHARES`."""
        size = float(np.sqrt(face_areas(vertices, faces).sum()))
        low, high = np.log(_RADII)
        radii = size * np.exp(rng.uniform(low, high, _LOCAL))
        centres, axes = np.empty((_LOCAL, 3)), np.empty((_LOCAL, 3))
        for i, near in enumerate(rng.integers(len(vertices), size=_LOCAL)):
            place = vertices[np.linalg.norm(vertices - vertices[near], axis=1) < radii[i]]
            centres[i] = place.mean(axis=0)
            axis = np.linalg.svd(place - centres[i], full_matrices=False)[2][0]
            axes[i] = axis * np.where(axis @ (centres[i] - vertices.mean(axis=0)) < 0.0, -1.0, 1.0)
        swells, grows = rng.normal(size=(2, _LOCAL)) * rng.uniform(0.2, 1.0, (2, 1))
        waves = Warp.draw(rng, 2.0 * size, 0.5 * rng.uniform(0.2, 1.0))
        change = cls(waves, centres, axes, radii, swells, grows, np.zeros(7), 1.0)
        columns = _columns(vertices)
        steps = change(vertices) - vertices
        fitted = np.linalg.lstsq(columns.reshape(-1, 7), steps.reshape(-1), rcond=None)[0].astype(np.float64)
        change = replace(change, similarity=fitted)
        largest = float(np.linalg.norm(change(vertices) - vertices, axis=1).max())
        return replace(change, step=size * float(np.exp(rng.uniform(*np.log(SHARES)))) / largest)

    def __call__(self, points: Floats) -> Floats:
        steps = self.waves(points) - points
        for centre, axis, radius, swell, grow in zip(
            self.centres, self.axes, self.radii, self.swells, self.grows, strict=True
        ):
            places = points - centre
            along = places @ axis
            across = places - along[:, None] * axis
            distances = np.linalg.norm(across, axis=1)
            near = np.exp(-0.5 * (distances**2 + along**2) / radius**2)
            beyond = radius * np.logaddexp(0.0, along / radius) * np.exp(-0.5 * (distances / radius) ** 2)
            steps = steps + 0.3 * swell * near[:, None] * across + 0.15 * grow * beyond[:, None] * axis
        return points + self.step * (steps - _columns(points) @ self.similarity)


@dataclass(frozen=True)
class ChangedWarp:
    """One change after another."""

    first: Callable[[Floats], Floats]
    second: Change

    def __call__(self, points: Floats) -> Floats:
        return self.second(self.first(points))


def individual(body: Body, rng: np.random.Generator) -> Body:
    """A body that is nearly this one: its surface at rest is changed by a hundredth to a twentieth of √area."""
    vertices, faces = body.surface(_TRIAL_VERTICES, np.eye(3))
    return replace(body, warp=ChangedWarp(body.warp, Change.draw(rng, body.warp(vertices), faces)))


def _columns(points: Floats) -> Floats:
    """(P,3,7): the steps of points (P,3) in a shift, a small turn and a change of scale."""
    x, y, z = points.T
    zero = np.zeros(len(points))
    turns = np.stack([np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], axis=2)
    return np.concatenate([np.broadcast_to(np.eye(3), (len(points), 3, 3)), turns, points[:, :, None]], axis=2)
