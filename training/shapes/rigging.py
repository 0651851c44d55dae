"""The rods of a body: from the bones of a skeleton to centre lines with joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
        placed = Placed(solid, frame, origin + frame[:, 2] * (part.lift * factors[2]), part.blend)
        bones.append(Bone(part, placed, parent, origin, frame))
        number = len(bones) - 1
        for child in part.children:
            at = origin + (frame * (factors * np.array(child.at))).sum(axis=1)
            place(child, number, frame @ child.turn, at)

    place(skeleton.root, -1, turned("z", 0.0), np.zeros(3))
    return bones


def limb_rig(bones: Sequence[Bone], hinged: bool = False) -> Rig:
    """Return a rod for each chain of successive bones, and for each bone that sits on a chain.

    Args:
        bones: bones at rest.
        hinged: whether joints are hinges, as those of tools, and nothing else bends.
    """
    successors = _successors(bones)
    rod_of_bone = np.full(len(bones), -1)
    rods: list[Rod] = []
    for number, bone in enumerate(bones):
        if rod_of_bone[number] >= 0:
            continue
        chain = [number]
        while not hinged and (successor := successors[chain[-1]]) is not None:
            chain.append(successor)
        rod_of_bone[chain] = len(rods)
        parent = -1
        attachment = 0.0
        if bone.parent >= 0:
            parent = int(rod_of_bone[bone.parent])
            attachment = projected(rods[parent], bone.origin[None])[0]
        rods.append(_rod([bones[i] for i in chain], bones, parent, attachment, hinged))
    for number, rod in enumerate(rods):
        solid = bones[int(np.argmax(rod_of_bone == number))].solid
        if len(rod.arc_lengths) == 1 and rod.parent >= 0 and not isinstance(solid, Cone):
            low, high = solid.box()
            rods[rod.parent] = _stiffened(
                rods[rod.parent], rod.attachment, 0.5 * float((high - low).max())
            )
    return Rig(tuple(rods), rod_of_bone)


def _stiffened(rod: Rod, attachment: float, half: float) -> Rod:
    """Reduce the bending of a rod near the attachment of a rigid solid of half extent `half`."""
    near = np.abs(rod.arc_lengths - attachment) < half
    return replace(
        rod,
        bending_radii=np.where(near, np.maximum(rod.bending_radii, 1.5 * half), rod.bending_radii),
    )


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
    half = 0.5 * float((np.abs(direction) * (high - low)).sum())
    arc_lengths = np.linspace(0.0, 2.0 * half, MAX_ELEMENTS)
    points = centre + (arc_lengths - half)[:, None] * direction
    sides = np.tile(np.stack([axis, np.cross(direction, axis)], axis=1), (len(arc_lengths), 1, 1))
    radii = np.full(len(arc_lengths), 0.5 * thickness)
    rod = Rod(-1, 0.0, points, arc_lengths, radii, radii, sides, curl=curl)
    return Rig((rod,), np.zeros(len(bones), dtype=np.int64))


def _successors(bones: Sequence[Bone]) -> list[int | None]:
    """The bone that continues each bone from its end: the only one there, or the longest of the straight ones."""
    successors: list[int | None] = []
    for number, bone in enumerate(bones):
        ahead = np.asarray(bone.tip) - bone.origin
        length = max(float(np.linalg.norm(ahead)), 1e-9)
        candidates: list[tuple[float, float, int]] = []  # cosine with this bone, length, index
        for other, child in enumerate(bones):
            if child.parent != number or not any(child.part.bend):
                continue
            reach = np.asarray(child.tip) - child.origin
            beyond = float(((child.origin - bone.origin) * ahead).sum()) / length**2
            aside = float(np.linalg.norm(np.cross(child.origin - bone.origin, ahead))) / length
            cosine = float((reach * ahead).sum()) / (
                length * max(float(np.linalg.norm(reach)), 1e-9)
            )
            if beyond > 0.85 and aside < 0.05 * length:
                candidates.append((cosine, float(np.linalg.norm(reach)), other))
        if len(candidates) > 1:
            candidates = sorted((x for x in candidates if x[0] > 0.9), key=lambda x: x[1])
        successors.append(candidates[-1][2] if candidates and candidates[-1][0] > -0.3 else None)
    return successors


def _rod(
    chain: Sequence[Bone], bones: Sequence[Bone], parent: int, attachment: float, hinged: bool
) -> Rod:
    """The rod of a chain of bones, with a single element if no bone can bend."""
    line, radii, frames, starts = _centre_line(chain, parent < 0)
    if len(line) == 1 or (parent >= 0 and not any(any(bone.part.bend) for bone in chain)):
        return Rod(
            parent, attachment, line[:1], np.zeros(1), radii[:1], radii[:1], frames[:1, :, :2]
        )
    line_lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    length = float(line_lengths[-1])
    radius = float(radii.mean())
    n = int(np.clip(np.ceil(length / (0.3 * radius)), 8, MAX_ELEMENTS))
    arc_lengths = np.linspace(0.0, length, n)
    points = np.stack([np.interp(arc_lengths, line_lengths, line[:, i]) for i in range(3)], axis=1)
    segment = np.clip(
        np.searchsorted(line_lengths, arc_lengths, side="right") - 1, 0, len(frames) - 1
    )
    sides = frames[segment][:, :, :2]
    radii = np.interp(arc_lengths, line_lengths, radii)
    rod = Rod(parent, attachment, points, arc_lengths, radii, radii, sides, is_hinge=hinged)
    spring = chain[0].solid
    if isinstance(spring, Helix):
        return replace(rod, curl=_OPENING_PER_TURN * spring.turns)
    rod = replace(
        rod, joints=_joints(chain, [float(line_lengths[start]) for start in starts], rod, bones)
    )
    if hinged:
        return rod
    slenderness = length / radius
    is_curling = len(chain) >= 3 and slenderness > _MIN_CURL_SLENDERNESS
    curl = min(np.radians(_CURL_LIMIT), 0.5 * slenderness) if is_curling else 0.06 * slenderness
    return replace(
        rod, curl=float(curl), twist=float(min(np.radians(_TWIST_LIMIT), _MAX_SHEAR * slenderness))
    )


def _joints(
    chain: Sequence[Bone], starts: Sequence[float], rod: Rod, bones: Sequence[Bone]
) -> tuple[Joint, ...]:
    """The joints of a rod; its bones start at the arc lengths `starts`."""
    joints = []
    radius = float(rod.radii.mean())
    for bone, previous, start in zip(chain, (None, *chain), starts, strict=False):
        axes = bone.frame[:, :2]
        if previous is None and rod.parent < 0:
            # The root bone is the spine, whose joint is in its middle.
            if rod.length > 2.0 * radius and not rod.is_hinge:
                spine = np.radians([_SPINE_LIMIT, _SPINE_LIMIT])
                middle = 0.5 * min(rod.length, float(np.linalg.norm(bone.tip - bone.origin)))
                joints.append(Joint(middle, axes, -spine, spine, False))
        elif any(bone.part.bend):
            low, high = _limits(bone, previous, rod.is_hinge)
            position = start
            if previous is None and not rod.is_hinge:
                # A limb bends where it leaves the body that carries it.
                outside = bones[bone.parent].placed.distance(*rod.points.T) > -0.2 * radius
                position = float(rod.arc_lengths[int(np.argmax(outside))]) if outside.any() else 0.0
            joints.append(Joint(position, axes, low, high, previous is None))
    return tuple(joints)


def _centre_line(chain: Sequence[Bone], is_root: bool) -> tuple[Floats, Floats, Floats, list[int]]:
    """Points, radii and frames along a chain of bones, and the index of the first point of each bone."""
    root = chain[0]
    if isinstance(root.solid, Helix):
        share = np.linspace(0.0, 1.0, MAX_ELEMENTS)
        local = np.array([root.solid.at(float(t)) for t in share])
        outward = surface.unit(local * np.array([1.0, 1.0, 0.0]))
        # A spring opens and closes about its axis.
        axes = np.stack(
            [np.tile([0.0, 0.0, 1.0], (len(share), 1)), outward, np.zeros_like(local)], axis=2
        )
        return root.placed.offset + local, np.full(len(share), root.solid.tube), axes, [0]
    if is_root and len(chain) == 1 and not isinstance(root.solid, Cone | Arc):
        # A trunk bends about its middle, along its longest side. A body without a long side is a rigid hub.
        low, high = root.solid.box()
        side = high - low
        longest = int(np.argmax(side))
        across = np.delete(np.arange(3), longest)
        if side[longest] < 1.6 * side[across].max():
            return root.placed.offset[None], np.array([0.5 * side.mean()]), root.frame[None], [0]
        reach = 0.42 * side[longest] * root.frame[:, longest]
        line = np.stack([root.placed.offset - reach, root.placed.offset + reach])
        frame = np.stack([*root.frame[:, across].T, root.frame[:, longest]], axis=1)
        return line, np.full(2, 0.25 * side[across].sum()), np.tile(frame, (2, 1, 1)), [0]
    points: list[Floats] = []
    radii: list[float] = []
    frames: list[Floats] = []
    starts: list[int] = []
    for bone in chain:
        starts.append(len(points))
        match bone.solid:
            case Arc(bow, angle, start, end):
                t = np.linspace(0.0, 1.0, 12)[:-1]
                local = np.stack(
                    [0.0 * t, bow * (1.0 - np.cos(t * angle)), bow * np.sin(t * angle)], axis=1
                )
                points += list(bone.origin + (bone.frame[None] * local[:, None]).sum(axis=2))
                radii += list(start + t * (end - start))
                frames += [bone.frame] * len(t)
            case solid:
                points.append(bone.origin)
                radii.append(solid.start if isinstance(solid, Cone) else bone.radius)
                frames.append(bone.frame)
    last = chain[-1]
    points.append(last.tip)
    radii.append(last.solid.end if isinstance(last.solid, Cone | Arc) else last.radius)
    frames.append(last.frame)
    return np.array(points), np.array(radii), np.array(frames), starts


def _limits(bone: Bone, previous: Bone | None, hinged: bool) -> tuple[Floats, Floats]:
    """Limits of raise and swing, radians. A knee that is bent at rest bends further to the same side."""
    factor, limit = (
        (_ROOT_FACTOR, _ROOT_LIMIT) if previous is None else (_INNER_FACTOR, _INNER_LIMIT)
    )
    high = np.radians(np.minimum(factor * np.array(bone.part.bend[:2], dtype=float), limit))
    if hinged:
        high = np.radians(1.4 * np.array(bone.part.bend[:2], dtype=float))
    low = -high
    if previous is not None:
        ahead = previous.frame[:, 2]
        bent = bone.frame[:, 2] - ahead
        lifted = float((np.cross(bone.frame[:, 0], bone.frame[:, 2]) * bent).sum())
        if abs(lifted) > 0.04:
            rest = float(np.arccos(np.clip((ahead * bone.frame[:, 2]).sum(), -1.0, 1.0)))
            forward = max(min(high[0], np.radians(150.0) - rest), 0.2)
            back = min(max(0.15 * high[0], 0.9 * rest), high[0])
            low[0], high[0] = (-back, forward) if lifted > 0.0 else (-forward, back)
    return low, high
