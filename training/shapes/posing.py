"""Random poses: how rods bend at their joints, curl and twist."""

import numpy as np

from igps._arrays import Floats
from igps.mesh import surface
from training.shapes.rods import MAX_CURVATURE, Joint, Rig, Rod


def draw_turns(
    rig: Rig, rng: np.random.Generator, vigour: float, planar: bool = False
) -> list[Floats]:
    """Draw a pose: rotation vectors (n,3), radians, at the points of each rod.

    Args:
        rig: the rods.
        rng: source of the angles.
        vigour: share of the limits that is used, 0 to 1.
        planar: rods curl only about the first of their two axes, as sheets do.
    """
    turns = []
    for rod in rig.rods:
        # Every rod draws all of these numbers, whether they are used or not.
        shares = vigour * rng.uniform(0.0, 1.0, (len(rod.joints), 2)) ** 0.75
        waves = rng.uniform(-1.0, 1.0, (2, 3))
        waves /= np.abs(waves).max(axis=1, keepdims=True)
        twist = vigour * rod.twist * rng.uniform(-1.0, 1.0)
        signs = rng.choice([-1.0, 1.0], (len(rod.joints), 2))
        turn = np.zeros((len(rod.arc_lengths), 3))
        for joint, share, sign in zip(rod.joints, shares, signs, strict=True):
            turn += _bent(rod, joint, _joint_turn(joint, share, sign))
        if len(rod.arc_lengths) > 1:
            curled = _curled(rod, vigour * waves, planar)
            turn += curled + _twisted(rod, twist)
        turns.append(turn)
    return turns


def _joint_turn(joint: Joint, share: Floats, sign: Floats) -> Floats:
    """Rotation vector (3,) of a joint by shares (2,) of its limits, in the directions (2,) of both axes.

    If it is nearly blocked in a direction, as a knee is, it bends in the other one.
    """
    limit = np.where(sign > 0.0, joint.high, -joint.low)
    largest = np.maximum(joint.high, -joint.low)
    is_blocked = limit < 0.3 * largest
    direction = np.where(is_blocked, -sign, sign)
    limit = np.where(direction > 0.0, joint.high, -joint.low)
    angles = direction * share * limit
    return (joint.axes * angles).sum(axis=1)


def _bent(rod: Rod, joint: Joint, vector: Floats) -> Floats:
    """Rotation vectors (n,3) that bend a rod by `vector` in total, over a stretch that its thickness determines."""
    turns = np.zeros((len(rod.arc_lengths), 3))
    angle = float(np.sqrt((vector * vector).sum()))
    if angle < 1e-9:
        return turns
    if rod.is_hinge:
        turns[0] = vector
        return turns
    radius = float(np.interp(joint.position, rod.arc_lengths, rod.radii))
    step = rod.arc_lengths[1]
    half = max(angle * radius / MAX_CURVATURE, 1.5 * step)
    left = rod.length - joint.position
    if joint.is_root:
        half = min(half, 0.5 * left + 0.25 * step)
        middle = joint.position + half
    else:
        room = min(joint.position, left)
        half = min(half, max(room, 1.5 * step))
        middle = joint.position
    offset = (rod.arc_lengths - middle) / half
    bump = np.where(np.abs(offset) < 1.0, 1.0 + np.cos(np.pi * offset), 0.0)
    # The rod bends most where it is thin.
    bump *= (radius / rod.bending_radii) ** 2
    bump[0] = 0.0
    if bump.sum() == 0.0:
        return turns
    max_share = MAX_CURVATURE * step / rod.bending_radii / angle
    share = np.minimum(bump / bump.sum(), max_share)
    return share[:, None] * vector


def _curled(rod: Rod, waves: Floats, planar: bool) -> Floats:
    """Rotation vectors (n,3) of a curl: a constant curvature and two waves about each of the two axes of the rod."""
    if rod.curl == 0.0:
        return np.zeros((len(rod.arc_lengths), 3))
    t = rod.arc_lengths / rod.length
    even = np.ones_like(t)
    half_wave = 0.8 * np.cos(np.pi * t)
    whole_wave = 0.6 * np.cos(2.0 * np.pi * t)
    shapes = np.stack([even, half_wave, whole_wave])
    strengths = np.array([1.0, 0.0 if planar else 0.6])
    mixed = (waves[:, :, None] * shapes[None]).sum(axis=1)
    curvature = mixed * strengths[:, None]
    step = rod.arc_lengths[1]
    max_angle = MAX_CURVATURE * step / rod.bending_radii
    angles = curvature * rod.curl / len(t)
    angles = np.clip(angles, -max_angle, max_angle)
    angles[:, 0] = 0.0
    return np.einsum("kn,njk->nj", angles, rod.sides)


def _twisted(rod: Rod, angle: float) -> Floats:
    """Rotation vectors (n,3) of an even twist."""
    tangent = surface.unit(np.gradient(rod.points, axis=0))
    n_elements = len(rod.arc_lengths)
    share = np.full(n_elements, 1.0 / (n_elements - 1))
    share[0] = 0.0
    return angle * share[:, None] * tangent
