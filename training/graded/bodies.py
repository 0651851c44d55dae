"""A body: its rest surface, given by signed distances, what it looks like in detail, and how it is bent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from igps._arrays import Floats, Integers
from igps.mesh.surface import longest_side
from igps.shapes.meshing import defect, mesh, roughen
from igps.shapes.skeleton import Placed
from training.graded.crossing import crossing_faces
from training.graded.kinds import BodyClass, Motion
from training.graded.plates import Plate
from training.graded.rods import Bone, Gaps, Rig, at_rest, bend, bind, carry, draw_turns, limbs, strip

_MAX_DRAWS = 30
_MAX_POSES = 60
_TRIAL_VERTICES = 2400
_MAX_GRIDS = 6
_MIN_ANGLE = 1.0  # degrees, before the surface is bent
# How far bodies lie from their skeleton, as a share of the widest: some are nearly as alike as two people.
_SPREAD = (0.3, 1.0)
# How far a sheet is rolled, degrees.
_ROLL = 230.0
# Of a body's limbs, some poses are chosen from so many for those that nearly touch.
_CLOSE_SHARE, _CLOSE_DRAWS = 0.3, 5


@dataclass(frozen=True)
class Warp:
    """A smooth change of the whole body: a stretch along each axis and slow waves."""

    stretch: Floats  # (3,) factors
    waves: Floats  # (W,3) wave vectors
    steps: Floats  # (W,3) amplitudes
    phases: Floats  # (W,)

    @classmethod
    def draw(cls, rng: np.random.Generator, size: float, strength: float) -> Warp:
        """Waves about as long as the body of extent ``size``, with gradients of about ``strength``."""
        waves = rng.normal(size=(3, 3)) * (2.0 * np.pi / (1.3 * size) / np.sqrt(3.0))
        steps = rng.normal(size=(3, 3)) * (strength / np.sqrt(3.0)) / np.linalg.norm(waves, axis=1, keepdims=True)
        return cls(np.exp(strength * rng.uniform(-1.0, 1.0, 3)), waves, steps, rng.uniform(0.0, 2.0 * np.pi, 3))

    def __call__(self, points: Floats) -> Floats:
        moved = points * self.stretch
        for wave, step, phase in zip(self.waves, self.steps, self.phases, strict=True):
            moved = moved + np.sin((points * wave).sum(axis=1) + phase)[:, None] * step
        return moved


@dataclass(frozen=True)
class Body:
    """One body of a class."""

    bones: Sequence[Bone]  # at rest
    rig: Rig  # its rods, of the surface before the warp
    genus: int  # handles of the surface
    motion: Motion  # how it moves
    warp: Callable[[Floats], Floats]  # what changes the whole surface at rest
    relief: tuple[float, float, int]  # amplitude and wavelength of bumps on it, and the seed of their places

    @property
    def placed(self) -> list[Placed]:
        return [bone.placed for bone in self.bones]

    def surface(self, target: int, rotation: Floats) -> tuple[Floats, Integers]:
        """The surface at rest, before the warp, of about ``target`` vertices on a grid turned by ``rotation``."""
        turned = [
            replace(one, rotation=_product(rotation, one.rotation), offset=(rotation * one.offset).sum(axis=1))
            for one in self.placed
        ]
        vertices, faces, _ = mesh(turned, target)
        vertices = (vertices[:, :, None] * rotation[None]).sum(axis=1)
        amplitude, wavelength, seed = self.relief
        return roughen(vertices, faces, amplitude, wavelength, np.random.default_rng(seed)), faces


@dataclass(frozen=True)
class Pose:
    """A body in one pose, the vertices at rest beside those bent."""

    rest: Floats
    bent: Floats
    faces: Integers
    gap: float


def draw_body(body_class: BodyClass, kin: Sequence[int], seed: Sequence[int]) -> Body:
    """Draw a body: what its class leaves open, proportions, thickness, warp and relief.

    Args:
        body_class: its class.
        kin: seed of the skeleton, which bodies may have in common.
        seed: of all else.

    Raises:
        ValueError: no draw gave a sound surface.
    """
    found: str | None = None
    for draw in range(_MAX_DRAWS):
        # Later draws are nearer to the class: most failures are parts that meet, or are too thin for the grid.
        rng = np.random.default_rng([*seed, draw])
        spread = rng.uniform(*_SPREAD) * (1.0 - 0.7 * draw / _MAX_DRAWS)
        body = _drawn(body_class, np.random.default_rng([*kin, draw]), rng, spread)
        for rotation in (np.eye(3), _random_rotation(rng)):
            vertices, faces = body.surface(_TRIAL_VERTICES, rotation)
            found = _fault(body.warp(vertices), faces, body.genus, _TRIAL_VERTICES)
            if found is not None:
                break
        else:
            return body
    raise ValueError(f"no sound body of {body_class.name} in {_MAX_DRAWS} draws, the last had {found}")


def draw_pose(body: Body, rng: np.random.Generator, target: int) -> Pose:
    """Draw the grid that a body's surface is meshed on, and a pose of it.

    A pose is drawn again where the surface would cross itself. Some are chosen from several for limbs that nearly
    touch.

    Raises:
        ValueError: no grid gave a sound surface, or no pose was free of crossings.
    """
    vertices, faces, rest = _meshed(body, rng, target)
    if body.motion == "rigid":
        return Pose(rest, rest, faces, np.inf)
    rig = body.rig
    if body.motion == "sheet":
        angle = rng.uniform(0.0, np.pi)
        rig = _rig(body.bones, body.motion, np.array([np.cos(angle), np.sin(angle), 0.0]))
    binding = bind(vertices, faces, rig, body.placed)
    rig = Rig(tuple(replace(rod, points=body.warp(rod.points)) for rod in rig.rods), rig.owner)
    gaps = Gaps.of(rig)
    vigour = float(rng.uniform(0.25, 1.0))
    n_wanted = _CLOSE_DRAWS if rng.uniform() < _CLOSE_SHARE else 1
    found: Pose | None = None
    n_sound = 0
    for attempt in range(_MAX_POSES):
        # Later attempts bend less.
        share = vigour * (1.0 - 0.9 * max(attempt - 10, 0) / (_MAX_POSES - 10))
        carried = carry(rig, draw_turns(rig, rng, share, planar=body.motion == "sheet"))
        gap = gaps.least(rig, carried)
        if gap < 0.0:
            continue
        if found is None or gap < found.gap:
            bent = bend(rest, rig, binding, carried)
            if len(crossing_faces(bent, faces)):
                continue
            found = Pose(rest, bent, faces, gap)
        n_sound += 1
        if n_sound >= n_wanted:
            break
    if found is None:
        raise ValueError(f"no pose in {_MAX_POSES} was free of crossings")
    return found


def _drawn(body_class: BodyClass, kin: np.random.Generator, rng: np.random.Generator, spread: float) -> Body:
    skeleton, motion = body_class.draw(kin)
    groups = sorted({part.group for part in skeleton.root.walk()})
    thickness = rng.uniform(-0.1, 0.22)
    changes = rng.uniform(-1.0, 1.0, (len(groups), 2)) * (0.16, 0.24)
    proportions = {
        group: (float(np.exp(spread * (thickness + thick))), float(np.exp(spread * length)))
        for group, (thick, length) in zip(groups, changes, strict=True)
    }
    bones = at_rest(skeleton, proportions)
    rig = _rig(bones, motion, np.array([1.0, 0.0, 0.0]))
    corners = np.concatenate([np.stack(bone.placed.bounds()) for bone in bones])
    # A sheet stays nearly flat, or it could not be rolled without stretching it.
    warp = Warp.draw(rng, longest_side(corners), 0.05 if motion == "sheet" else 0.14 * spread)
    thinnest = min(float(rod.radii.min()) for rod in rig.rods)
    relief = (0.14 * spread * thinnest * rng.uniform(), rng.uniform(0.25, 0.6), int(rng.integers(2**31)))
    return Body(bones, rig, skeleton.genus, motion, warp, relief)


def _meshed(body: Body, rng: np.random.Generator, target: int) -> tuple[Floats, Integers, Floats]:
    """The surface before and after the warp, on the first grid that gives a sound one."""
    found: str | None = None
    for _ in range(_MAX_GRIDS):
        vertices, faces = body.surface(target, _random_rotation(rng))
        rest = body.warp(vertices)
        found = _fault(rest, faces, body.genus, target)
        if found is None:
            return vertices, faces, rest
    raise ValueError(f"no sound surface on {_MAX_GRIDS} grids, the last had {found}")


def _fault(vertices: Floats, faces: Integers, genus: int, target: int) -> str | None:
    found = defect(vertices, faces, genus, target, _MIN_ANGLE)
    if found is None and len(crossing_faces(vertices, faces)):
        return "a surface that crosses itself"
    return found


def _rig(bones: Sequence[Bone], motion: Motion, direction: Floats) -> Rig:
    if motion == "sheet":
        plate = bones[0].solid
        assert isinstance(plate, Plate)
        axis = np.cross(np.array([0.0, 0.0, 1.0]), direction)
        return strip(bones, direction, axis, plate.thick, np.radians(_ROLL))
    return limbs(bones, hinged=motion == "hinges")


def _random_rotation(rng: np.random.Generator) -> Floats:
    return np.asarray(Rotation.from_quat(rng.normal(size=4)).as_matrix())


def _product(a: Floats, b: Floats) -> Floats:
    return (a[:, :, None] * b[None]).sum(axis=1)
