"""The rods of a body: from the bones of a skeleton to centre lines with joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from igps._arrays import Floats
from igps.mesh import surface
from igps.shapes.skeleton import Part, Placed, Skeleton, turned
from igps.shapes.solids import Arc, Cone, Solid
from training.shapes.rods import MAX_ELEMENTS, Joint, Rig, Rod, projected
from training.shapes.springs import Helix

# Largest shear of the surface by a twist; the area grows by half its square.
_MAX_SHEAR = 0.22
# Limits of joints: factors of those of the skeleton, which are meant for joints without creases, and largest angles in
# degrees. A root joint is the first joint of a limb, and inner joints are the others.
_ROOT_FACTOR = 2.6
_ROOT_LIMIT = 80.0
_INNER_FACTOR = 4.5
_INNER_LIMIT = 135.0
_SPINE_LIMIT = 30.0
_TWIST_LIMIT = 55.0
_CURL_LIMIT = 320.0
# Largest bending of the wire of an opening spring, radians for each turn.
_OPENING_PER_TURN = 0.7
# Smallest ratio of length to radius at which a limb of three bones or more curls.
_MIN_CURL_SLENDERNESS = 6.0


@dataclass(frozen=True, eq=False)
class Bone:
    """A part of a skeleton at rest."""

    part: Part
    placed: Placed
    parent: int  # index of the parent bone; −1 for the root
    origin: Floats  # (3,) position of its joint in the world
    frame: Floats  # (3,3) its axes as columns

    @property
    def solid(self) -> Solid:
        return self.placed.solid

    @property
    def tip(self) -> Floats:
        """The far end of the centre line, (3,)."""
        match self.solid:
            case Cone(length, _, _):
                return self.origin + self.frame[:, 2] * length
            case Arc() as arc:
                return self.origin + (self.frame * np.array(arc.tip())).sum(axis=1)
        high = float(self.solid.box()[1][2])
        return self.placed.offset + self.frame[:, 2] * high

    @property
    def radius(self) -> float:
        """Half the mean width."""
        match self.solid:
            case Cone(_, start, end) | Arc(_, _, start, end):
                return 0.5 * (start + end)
        low, high = self.solid.box()
        return 0.25 * float((high - low)[:2].sum())


def bones_at_rest(skeleton: Skeleton, proportions: dict[str, tuple[float, float]]) -> list[Bone]:
    """Return the bones of a skeleton with all angles zero, parents before children.

    Args:
        skeleton: the skeleton.
        proportions: factors of thickness and length by group of parts; 1 for other groups.
    """
    bones: list[Bone] = []

    def place(part: Part, parent: int, frame: Floats, origin: Floats) -> None:
        thick, length = proportions.get(part.group, (1.0, 1.0))
        solid = part.solid.stretched(thick, length)
        factors = part.solid.factors(thick, length)
        lift = part.lift * factors[2]
        centre = origin + frame[:, 2] * lift
        placed = Placed(solid, frame, centre, part.blend)
        bones.append(Bone(part, placed, parent, origin, frame))
        number = len(bones) - 1
        for child in part.children:
            local = factors * np.array(child.at)
            joint = origin + (frame * local).sum(axis=1)
            place(child, number, frame @ child.turn, joint)

    place(skeleton.root, -1, turned("z", 0.0), np.zeros(3))
    return bones


def limb_rig(bones: Sequence[Bone], hinged: bool = False) -> Rig:
    """Return a rod for each chain of successive bones, and for each bone that sits on a chain.

    Args:
        bones: bones at rest.
        hinged: whether joints are hinges, as those of tools, and nothing else bends.
    """
    successors = [None] * len(bones) if hinged else _successors(bones)
    rod_of_bone = np.full(len(bones), -1)
    rods: list[Rod] = []
    for number, bone in enumerate(bones):
        if rod_of_bone[number] >= 0:
            continue
        chain = [number]
        successor = successors[number]
        while successor is not None:
            chain.append(successor)
            successor = successors[successor]
        rod_of_bone[chain] = len(rods)
        parent = -1
        attachment = 0.0
        if bone.parent >= 0:
            parent = int(rod_of_bone[bone.parent])
            attachment = projected(rods[parent], bone.origin[None])[0]
        links = [bones[i] for i in chain]
        rods.append(_rod(links, bones, parent, attachment, hinged))
    for number, rod in enumerate(rods):
        first = int(np.argmax(rod_of_bone == number))
        solid = bones[first].solid
        is_rigid = len(rod.arc_lengths) == 1
        if is_rigid and rod.parent >= 0 and not isinstance(solid, Cone):
            low, high = solid.box()
            half = 0.5 * float((high - low).max())
            carrier = rods[rod.parent]
            rods[rod.parent] = _stiffened(carrier, rod.attachment, half)
    return Rig(tuple(rods), rod_of_bone)


def _stiffened(rod: Rod, attachment: float, half: float) -> Rod:
    """Reduce the bending of a rod near the attachment of a rigid solid of half extent `half`."""
    near = np.abs(rod.arc_lengths - attachment) < half
    stiff = np.maximum(rod.bending_radii, 1.5 * half)
    bending_radii = np.where(near, stiff, rod.bending_radii)
    return replace(rod, bending_radii=bending_radii)


def strip_rig(
    bones: Sequence[Bone], direction: Floats, axis: Floats, thickness: float, curl: float
) -> Rig:
    """Return a single rod along `direction` for a whole body, such as a sheet, which bends about `axis`.

    Args:
        bones: bones at rest.
        direction, axis: (3,) unit vectors, perpendicular.
        thickness: thickness of the body perpendicular to both.
        curl: largest curl over the whole length, radians.
    """
    corners = np.concatenate([np.stack(bone.placed.bounds()) for bone in bones])
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    centre = 0.5 * (low + high)
    extent = high - low
    half = 0.5 * float((np.abs(direction) * extent).sum())
    arc_lengths = np.linspace(0.0, 2.0 * half, MAX_ELEMENTS)
    along = arc_lengths - half
    across = np.cross(direction, axis)
    frame = np.stack([axis, across], axis=1)
    radii = np.full(MAX_ELEMENTS, 0.5 * thickness)
    rod = Rod(
        parent=-1,
        attachment=0.0,
        points=centre + along[:, None] * direction,
        arc_lengths=arc_lengths,
        radii=radii,
        bending_radii=radii,
        sides=np.tile(frame, (MAX_ELEMENTS, 1, 1)),
        curl=curl,
    )
    return Rig((rod,), np.zeros(len(bones), dtype=np.int64))


def _successors(bones: Sequence[Bone]) -> list[int | None]:
    """The bone that continues each bone from its end: the only one there, or the longest of the straight ones."""
    successors: list[int | None] = []
    for number, bone in enumerate(bones):
        ahead = np.asarray(bone.tip) - bone.origin
        length = max(float(np.linalg.norm(ahead)), 1e-9)
        candidates = []
        for other, child in enumerate(bones):
            if child.parent != number or not any(child.part.bend):
                continue
            offset = child.origin - bone.origin
            beyond = float((offset * ahead).sum()) / length**2
            aside = float(np.linalg.norm(np.cross(offset, ahead))) / length
            if beyond <= 0.85 or aside >= 0.05 * length:
                continue
            reach = np.asarray(child.tip) - child.origin
            child_length = float(np.linalg.norm(reach))
            cosine = float((reach * ahead).sum()) / (length * max(child_length, 1e-9))
            candidates.append(_Successor(other, cosine, child_length))
        if len(candidates) > 1:
            candidates = [one for one in candidates if one.cosine > 0.9]
            candidates.sort(key=attrgetter("length"))
        successor = None
        if candidates and candidates[-1].cosine > -0.3:
            successor = candidates[-1].number
        successors.append(successor)
    return successors


class _Successor(NamedTuple):
    """A bone that may continue another."""

    number: int
    cosine: float  # between both
    length: float


def _rod(
    chain: Sequence[Bone], bones: Sequence[Bone], parent: int, attachment: float, hinged: bool
) -> Rod:
    """The rod of a chain of bones, with a single element if no bone can bend."""
    line = _centre_line(chain, parent < 0)
    sides = line.frames[:, :, :2]
    can_bend = parent < 0 or any(any(bone.part.bend) for bone in chain)
    if len(line.points) == 1 or not can_bend:
        radii = line.radii[:1]
        return Rod(parent, attachment, line.points[:1], np.zeros(1), radii, radii, sides[:1])
    steps = np.linalg.norm(np.diff(line.points, axis=0), axis=1)
    line_lengths = np.concatenate([[0.0], np.cumsum(steps)])
    length = float(line_lengths[-1])
    radius = float(line.radii.mean())
    n_wanted = np.ceil(length / (0.3 * radius))
    n = int(np.clip(n_wanted, 8, MAX_ELEMENTS))
    arc_lengths = np.linspace(0.0, length, n)
    columns = [np.interp(arc_lengths, line_lengths, column) for column in line.points.T]
    following = np.searchsorted(line_lengths, arc_lengths, side="right")
    segment = np.clip(following - 1, 0, len(sides) - 1)
    radii = np.interp(arc_lengths, line_lengths, line.radii)
    rod = Rod(
        parent,
        attachment,
        np.stack(columns, axis=1),
        arc_lengths,
        radii,
        bending_radii=radii,
        sides=sides[segment],
        is_hinge=hinged,
    )
    spring = chain[0].solid
    if isinstance(spring, Helix):
        return replace(rod, curl=_OPENING_PER_TURN * spring.turns)
    bone_starts = [float(line_lengths[start]) for start in line.starts]
    rod = replace(rod, joints=_joints(chain, bone_starts, rod, bones))
    if hinged:
        return rod
    slenderness = length / radius
    curl = 0.06 * slenderness
    if len(chain) >= 3 and slenderness > _MIN_CURL_SLENDERNESS:
        curl = min(np.radians(_CURL_LIMIT), 0.5 * slenderness)
    twist = min(np.radians(_TWIST_LIMIT), _MAX_SHEAR * slenderness)
    return replace(rod, curl=float(curl), twist=float(twist))


def _joints(
    chain: Sequence[Bone], starts: Sequence[float], rod: Rod, bones: Sequence[Bone]
) -> tuple[Joint, ...]:
    """The joints of a rod; its bones start at the arc lengths `starts`."""
    joints = []
    radius = float(rod.radii.mean())
    for bone, previous, start in zip(chain, (None, *chain), starts, strict=False):
        axes = bone.frame[:, :2]
        is_first = previous is None
        if is_first and rod.parent < 0:
            # The root bone is the spine, whose joint is in its middle.
            if rod.length > 2.0 * radius and not rod.is_hinge:
                limits = np.radians([_SPINE_LIMIT, _SPINE_LIMIT])
                spine_length = float(np.linalg.norm(bone.tip - bone.origin))
                middle = 0.5 * min(rod.length, spine_length)
                joints.append(Joint(middle, axes, -limits, limits, is_root=False))
        elif any(bone.part.bend):
            low, high = _limits(bone, previous, rod.is_hinge)
            position = start
            if is_first and not rod.is_hinge:
                # A limb bends where it leaves the body that carries it.
                carrier = bones[bone.parent].placed
                is_outside = carrier.distance(*rod.points.T) > -0.2 * radius
                first = int(np.argmax(is_outside))
                position = float(rod.arc_lengths[first]) if is_outside.any() else 0.0
            joints.append(Joint(position, axes, low, high, is_root=is_first))
    return tuple(joints)


class _Line(NamedTuple):
    """The centre line of a chain of bones."""

    points: Floats  # (n,3)
    radii: Floats  # (n,)
    frames: Floats  # (n,3,3)
    starts: Sequence[int] = (0,)  # index of the first point of each bone


def _centre_line(chain: Sequence[Bone], is_root: bool) -> _Line:
    root = chain[0]
    if isinstance(root.solid, Helix):
        return _line_of_wire(root.solid, root.placed.offset)
    if is_root and len(chain) == 1 and not isinstance(root.solid, Cone | Arc):
        return _line_of_trunk(root)
    return _line_of_limb(chain)


def _line_of_wire(helix: Helix, offset: Floats) -> _Line:
    """The line of a spring, which opens and closes about its axis."""
    shares = np.linspace(0.0, 1.0, MAX_ELEMENTS)
    local = np.array([helix.at(float(share)) for share in shares])
    upward = np.tile([0.0, 0.0, 1.0], (len(shares), 1))
    outward = surface.unit(local * np.array([1.0, 1.0, 0.0]))
    frames = np.stack([upward, outward, np.zeros_like(local)], axis=2)
    radii = np.full(len(shares), helix.tube)
    return _Line(offset + local, radii, frames)


def _line_of_trunk(root: Bone) -> _Line:
    """The line of a trunk, which bends about its middle, along its longest side; without a long side, a rigid hub."""
    low, high = root.solid.box()
    centre = root.placed.offset
    side = high - low
    longest = int(np.argmax(side))
    across = np.delete(np.arange(3), longest)
    if side[longest] < 1.6 * side[across].max():
        radius = 0.5 * side.mean()
        return _Line(centre[None], np.array([radius]), root.frame[None])
    axis = root.frame[:, longest]
    reach = 0.42 * side[longest] * axis
    ends = np.stack([centre - reach, centre + reach])
    first, second = root.frame[:, across].T
    frame = np.stack([first, second, axis], axis=1)
    radius = 0.25 * side[across].sum()
    return _Line(ends, np.full(2, radius), np.tile(frame, (2, 1, 1)))


def _line_of_limb(chain: Sequence[Bone]) -> _Line:
    points: list[Floats] = []
    radii: list[float] = []
    frames: list[Floats] = []
    starts: list[int] = []
    for bone in chain:
        starts.append(len(points))
        match bone.solid:
            case Arc(bow, angle, start, end):
                share = np.linspace(0.0, 1.0, 12)[:-1]
                turn = share * angle
                forward = bow * (1.0 - np.cos(turn))
                upward = bow * np.sin(turn)
                local = np.stack([0.0 * share, forward, upward], axis=1)
                steps = (bone.frame[None] * local[:, None]).sum(axis=2)
                points += list(bone.origin + steps)
                radii += list(start + share * (end - start))
                frames += [bone.frame] * len(share)
            case solid:
                points.append(bone.origin)
                radii.append(solid.start if isinstance(solid, Cone) else bone.radius)
                frames.append(bone.frame)
    last = chain[-1]
    points.append(last.tip)
    radii.append(last.solid.end if isinstance(last.solid, Cone | Arc) else last.radius)
    frames.append(last.frame)
    return _Line(np.array(points), np.array(radii), np.array(frames), starts)


def _limits(bone: Bone, previous: Bone | None, hinged: bool) -> tuple[Floats, Floats]:
    """Limits of raise and swing, radians. A knee that is bent at rest bends further to the same side."""
    bend = np.array(bone.part.bend[:2], dtype=float)
    if hinged:
        degrees = 1.4 * bend
    elif previous is None:
        degrees = np.minimum(_ROOT_FACTOR * bend, _ROOT_LIMIT)
    else:
        degrees = np.minimum(_INNER_FACTOR * bend, _INNER_LIMIT)
    high = np.radians(degrees)
    low = -high
    if previous is None:
        return low, high
    ahead = previous.frame[:, 2]
    own = bone.frame[:, 2]
    lift = np.cross(bone.frame[:, 0], own)
    lifted = float((lift * (own - ahead)).sum())
    if abs(lifted) <= 0.04:
        return low, high
    cosine = np.clip((ahead * own).sum(), -1.0, 1.0)
    rest = float(np.arccos(cosine))
    room = np.radians(150.0) - rest
    forward = max(min(high[0], room), 0.2)
    back = min(max(0.15 * high[0], 0.9 * rest), high[0])
    if lifted > 0.0:
        low[0] = -back
        high[0] = forward
    else:
        low[0] = -forward
        high[0] = back
    return low, high
