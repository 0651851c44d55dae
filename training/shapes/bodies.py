"""Bodies and their poses: a surface at rest, given by signed distances, with relief, and its bending."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from igps._arrays import Floats, Integers
from igps.mesh.surface import longest_side
from igps.shapes.meshing import defect, mesh, roughen
from igps.shapes.skeleton import Placed
from training.shapes.crossing import crossing_faces
from training.shapes.kinds import BodyClass, Motion
from training.shapes.plates import Plate
from training.shapes.posing import draw_turns
from training.shapes.rigging import Bone, bones_at_rest, limb_rig, strip_rig
from training.shapes.rods import Gaps, Rig, bend, bind, rod_motions

_MAX_DRAWS = 30
_MAX_POSES = 60
_TRIAL_VERTICES = 2400
_MAX_GRIDS = 6
_MIN_ANGLE = 1.0  # smallest angle of a face at rest, degrees
# Range of the strength of all changes of a body; weak changes give bodies that are as similar as two people.
_SPREAD = (0.3, 1.0)
_ROLL = 230.0  # largest rolling of a sheet, degrees
# Share of the poses in which limbs nearly touch: each is the closest of this number of poses.
_CLOSE_SHARE = 0.3
_N_CLOSE_DRAWS = 5


@dataclass(frozen=True)
class Warp:
    """A smooth deformation of space: a stretch along each axis, and long waves."""

    stretch: Floats  # (3,) factors
    waves: Floats  # (W,3) wave vectors
    steps: Floats  # (W,3) amplitudes
    phases: Floats  # (W,)

    @classmethod
    def draw(cls, rng: np.random.Generator, size: float, strength: float) -> Warp:
        """Draw a warp of a body of extent `size`: wavelengths of about `size`, gradients of about `strength`."""
        frequency = 2.0 * np.pi / (1.3 * size)
        waves = rng.normal(size=(3, 3)) * (frequency / np.sqrt(3.0))
        gradients = rng.normal(size=(3, 3)) * (strength / np.sqrt(3.0))
        return cls(
            stretch=np.exp(strength * rng.uniform(-1.0, 1.0, 3)),
            waves=waves,
            steps=gradients / np.linalg.norm(waves, axis=1, keepdims=True),
            phases=rng.uniform(0.0, 2.0 * np.pi, 3),
        )

    def __call__(self, points: Floats) -> Floats:
        moved = points * self.stretch
        for wave, step, phase in zip(self.waves, self.steps, self.phases, strict=True):
            angles = (points * wave).sum(axis=1) + phase
            moved = moved + np.sin(angles)[:, None] * step
        return moved


@dataclass(frozen=True)
class Body:
    """A body of a class."""

    bones: Sequence[Bone]
    rig: Rig  # rods before the warp
    genus: int  # number of handles of the surface
    motion: Motion
    warp: Callable[[Floats], Floats]  # deformation of the surface at rest
    # Amplitude and wavelength of bumps, and the seed of their positions
    relief: tuple[float, float, int]

    @property
    def placed(self) -> list[Placed]:
        return [bone.placed for bone in self.bones]

    def surface(self, target: int, rotation: Floats) -> tuple[Floats, Integers]:
        """Mesh the surface at rest, before the warp, with about `target` vertices, on a grid rotated by `rotation`."""
        turned = []
        for solid in self.placed:
            axes = (rotation[:, :, None] * solid.rotation[None]).sum(axis=1)
            offset = (rotation * solid.offset).sum(axis=1)
            turned.append(replace(solid, rotation=axes, offset=offset))
        vertices, faces, _ = mesh(turned, target)
        vertices = (vertices[:, :, None] * rotation[None]).sum(axis=1)
        amplitude, wavelength, seed = self.relief
        rng = np.random.default_rng(seed)
        return roughen(vertices, faces, amplitude, wavelength, rng), faces


@dataclass(frozen=True)
class Pose:
    """A body in a pose."""

    rest: Floats  # (V,3) vertices at rest
    bent: Floats  # (V,3) vertices in the pose
    faces: Integers  # (F,3)
    gap: float  # smallest gap between rods, see `Gaps`


def draw_body(body_class: BodyClass, kin: Sequence[int], seed: Sequence[int]) -> Body:
    """Draw a body of a class: the open choices of the class, proportions, thickness, warp and relief.

    Args:
        body_class: the class.
        kin: seed of the skeleton, which siblings share.
        seed: seed of all other draws.

    Raises:
        ValueError: no draw gave a sound surface.
    """
    fault: str | None = None
    for draw in range(_MAX_DRAWS):
        # Later draws deviate less: most failures are parts that meet, or parts that are too thin for the grid.
        rng = np.random.default_rng([*seed, draw])
        spread = rng.uniform(*_SPREAD) * (1.0 - 0.7 * draw / _MAX_DRAWS)
        of_skeleton = np.random.default_rng([*kin, draw])
        body = _draw_candidate(body_class, of_skeleton, rng, spread)
        for rotation in (np.eye(3), _random_rotation(rng)):
            vertices, faces = body.surface(_TRIAL_VERTICES, rotation)
            rest = body.warp(vertices)
            fault = _fault(rest, faces, body.genus, _TRIAL_VERTICES)
            if fault is not None:
                break
        else:
            return body
    raise ValueError(
        f"no sound body of {body_class.name} in {_MAX_DRAWS} draws, the last had {fault}"
    )


def draw_pose(body: Body, rng: np.random.Generator, target: int) -> Pose:
    """Draw a grid on which the surface of a body is meshed, and a pose in which the surface does not cross itself.

    In a share of the poses, limbs nearly touch.

    Raises:
        ValueError: no grid gave a sound surface, or no pose was free of crossings.
    """
    vertices, faces, rest = _mesh_body(body, rng, target)
    if body.motion == "rigid":
        return Pose(rest, rest, faces, np.inf)
    rig = body.rig
    if body.motion == "sheet":
        angle = rng.uniform(0.0, np.pi)
        direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        rig = _rig(body.bones, body.motion, direction)
    binding = bind(vertices, faces, rig, body.placed)
    warped = [replace(rod, points=body.warp(rod.points)) for rod in rig.rods]
    rig = Rig(tuple(warped), rig.rod_of_solid)
    gaps = Gaps.of(rig)
    vigour = float(rng.uniform(0.25, 1.0))
    n_wanted = _N_CLOSE_DRAWS if rng.uniform() < _CLOSE_SHARE else 1
    closest: Pose | None = None
    n_sound = 0
    for attempt in range(_MAX_POSES):
        # After ten attempts, rods bend less and less.
        share = vigour * (1.0 - 0.9 * max(attempt - 10, 0) / (_MAX_POSES - 10))
        turns = draw_turns(rig, rng, share, planar=body.motion == "sheet")
        motions = rod_motions(rig, turns)
        gap = gaps.smallest(rig, motions)
        if gap < 0.0:
            continue
        if closest is None or gap < closest.gap:
            bent = bend(rest, rig, binding, motions)
            if len(crossing_faces(bent, faces)):
                continue
            closest = Pose(rest, bent, faces, gap)
        n_sound += 1
        if n_sound >= n_wanted:
            break
    if closest is None:
        raise ValueError(f"none of {_MAX_POSES} poses was free of crossings")
    return closest


def _draw_candidate(
    body_class: BodyClass, kin: np.random.Generator, rng: np.random.Generator, spread: float
) -> Body:
    skeleton, motion = body_class.draw(kin)
    groups = sorted({part.group for part in skeleton.root.walk()})
    common = rng.uniform(-0.1, 0.22)  # of the thickness of all groups
    changes = rng.uniform(-1.0, 1.0, (len(groups), 2)) * (0.16, 0.24)
    proportions = {}
    for group, (thickness, length) in zip(groups, changes, strict=True):
        thick = float(np.exp(spread * (common + thickness)))
        long = float(np.exp(spread * length))
        proportions[group] = (thick, long)
    bones = bones_at_rest(skeleton, proportions)
    rig = _rig(bones, motion, np.array([1.0, 0.0, 0.0]))
    corners = np.concatenate([np.stack(bone.placed.bounds()) for bone in bones])
    # A sheet must stay nearly flat, because only a flat sheet rolls without stretching.
    strength = 0.05 if motion == "sheet" else 0.14 * spread
    warp = Warp.draw(rng, longest_side(corners), strength)
    thinnest = min(float(rod.radii.min()) for rod in rig.rods)
    amplitude = 0.14 * spread * thinnest * rng.uniform()
    wavelength = rng.uniform(0.25, 0.6)
    relief = (amplitude, wavelength, int(rng.integers(2**31)))
    return Body(bones, rig, skeleton.genus, motion, warp, relief)


def _mesh_body(
    body: Body, rng: np.random.Generator, target: int
) -> tuple[Floats, Integers, Floats]:
    """Vertices before the warp, faces, and vertices after it, on the first grid that gives a sound surface."""
    fault: str | None = None
    for _ in range(_MAX_GRIDS):
        vertices, faces = body.surface(target, _random_rotation(rng))
        rest = body.warp(vertices)
        fault = _fault(rest, faces, body.genus, target)
        if fault is None:
            return vertices, faces, rest
    raise ValueError(f"no sound surface on {_MAX_GRIDS} grids, the last had {fault}")


def _fault(vertices: Floats, faces: Integers, genus: int, target: int) -> str | None:
    fault = defect(vertices, faces, genus, target, _MIN_ANGLE)
    if fault is None and len(crossing_faces(vertices, faces)):
        return "a surface that crosses itself"
    return fault


def _rig(bones: Sequence[Bone], motion: Motion, direction: Floats) -> Rig:
    if motion == "sheet":
        plate = bones[0].solid
        assert isinstance(plate, Plate)
        axis = np.cross(np.array([0.0, 0.0, 1.0]), direction)
        return strip_rig(bones, direction, axis, plate.thick, np.radians(_ROLL))
    return limb_rig(bones, hinged=motion == "hinges")


def _random_rotation(rng: np.random.Generator) -> Floats:
    return np.asarray(Rotation.from_quat(rng.normal(size=4)).as_matrix())
