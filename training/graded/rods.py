"""How a body is bent: as rods, each a centre line that carries the surface around it.

A limb bends like a beam: its cross-sections stay as they are and turn one after another, which leaves area and volume
as they were as long as the bending radius is greater than the limb's own. So a joint of 130 degrees is not a hinge but
a stretch of the limb, the longer the thicker the limb; a tentacle curls anywhere. All turns are about the points of the
centre lines at rest, in the frame at rest: the motion of a rod's element is that of the one before it, after the turn
between the two. Surfaces follow by dual quaternion skinning with weights diffused over the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from igps._arrays import Floats, Integers
from igps.mesh import surface
from igps.shapes.skeleton import Part, Placed, Skeleton, turned
from igps.shapes.solids import Arc, Cone, Solid
from training.graded.plates import Helix
from training.graded.skinning import IDENTITY, Motions, after, moved, normalized, turn_about

# Radius of a limb over the radius at which it is bent, at most: at 1 the inner side would be a crease.
_TIGHTEST = 0.75
# Shear of the surface by a twist, at most: the area grows by half its square.
_SHEAR = 0.22
# Where a limb joins another body, its weights go over within about this share of its radius.
_DIFFUSION = 0.45
# How far beyond the limits of the skeleton, which are those of a joint without creases, limbs are bent: at their roots
# and at their inner joints, degrees.
_ROOT_FACTOR, _ROOT_LIMIT = 2.6, 80.0
_INNER_FACTOR, _INNER_LIMIT = 4.5, 135.0
_SPINE_LIMIT = 30.0
_TWIST_LIMIT = 55.0
_CURL_LIMIT = 320.0
# A spring's wire is bent by so much a turn, radians, as it opens.
_OPENING = 0.7
# From so many radii on, a limb of three parts or more curls.
_SLENDER = 6.0
_MOST_ELEMENTS = 48
# Elements whose distance at rest is more than so many times the sum of their radii may not come together; nearer ones
# belong to the same crease.
_APART = 1.7


@dataclass(frozen=True, eq=False)
class Bone:
    """A part of a skeleton at rest."""

    part: Part
    placed: Placed
    parent: int  # number of the bone that holds it, −1 of the root
    origin: Floats  # (3,) its joint in the world
    frame: Floats  # (3,3) its axes as columns

    @property
    def solid(self) -> Solid:
        return self.placed.solid

    @property
    def tip(self) -> Floats:
        """The far end of the bone's centre line, (3,)."""
        match self.solid:
            case Cone(length, _, _):
                return self.origin + self.frame[:, 2] * length
            case Arc() as arc:
                return self.origin + (self.frame * np.array(arc.tip())).sum(axis=1)
        high = float(self.solid.box()[1][2])
        return self.placed.offset + self.frame[:, 2] * high

    @property
    def radius(self) -> float:
        """Half the width of the bone, the mean over its length."""
        match self.solid:
            case Cone(_, start, end) | Arc(_, _, start, end):
                return 0.5 * (start + end)
        low, high = self.solid.box()
        return 0.25 * float((high - low)[:2].sum())


@dataclass(frozen=True)
class Joint:
    """Where a rod is bent on purpose."""

    at: float  # arc length along the rod
    axes: Floats  # (3,2) axes of raise and swing at rest
    low: Floats  # (2,) limits of the angles, radians
    high: Floats  # likewise
    is_root: bool  # the rod is bent beyond this place, not around it


@dataclass(frozen=True)
class Rod:
    """A centre line at rest."""

    parent: int  # number of the rod that carries it, −1 of the first
    held: float  # arc length along the parent where it is carried
    points: Floats  # (n,3) of the centre line
    along: Floats  # (n,) their arc lengths
    radii: Floats  # (n,)
    girth: Floats  # (n,) the radii with those of whatever sits stiffly on the rod, which is not bent there
    sides: Floats  # (n,3,2) two directions across the rod
    joints: tuple[Joint, ...] = ()  # where it bends
    curl: float = 0.0  # radians, the most that it curls over its whole length
    twist: float = 0.0  # radians, the most that it is twisted over its whole length
    is_hinge: bool = False  # its first joint is a hinge: all of it turns as one

    @property
    def length(self) -> float:
        return float(self.along[-1])


@dataclass(frozen=True)
class Rig:
    """Rods, parents before children, and (solids,) the rod of each solid."""

    rods: tuple[Rod, ...]
    owner: Integers


@dataclass(frozen=True)
class Binding:
    """How much each vertex goes with each rod, (V,R), and which element of it, as an arc length, (V,R)."""

    weights: Floats
    along: Floats


def at_rest(skeleton: Skeleton, proportions: dict[str, tuple[float, float]]) -> list[Bone]:
    """The bones of a skeleton with all angles zero, parents first.

    Args:
        skeleton: the body.
        proportions: factors of thickness and length of each group of parts; 1 where a group is missing.
    """
    bones: list[Bone] = []

    def place(part: Part, parent: int, frame: Floats, origin: Floats) -> None:
        thick, length = proportions.get(part.group, (1.0, 1.0))
        solid, factors = part.solid.stretched(thick, length), part.solid.factors(thick, length)
        placed = Placed(solid, frame, origin + frame[:, 2] * (part.lift * factors[2]), part.blend)
        bones.append(Bone(part, placed, parent, origin, frame))
        number = len(bones) - 1
        for child in part.children:
            at = origin + (frame * (factors * np.array(child.at))).sum(axis=1)
            place(child, number, frame @ child.turn, at)

    place(skeleton.root, -1, turned("z", 0.0), np.zeros(3))
    return bones


def limbs(bones: Sequence[Bone], hinged: bool = False) -> Rig:
    """The rods of a skeleton: chains of bones that go on from one another, and whatever sits on them.

    Args:
        bones: at rest.
        hinged: joints are hinges, as of tools, and nothing else bends.
    """
    after_it = _successors(bones)
    owner = np.full(len(bones), -1)
    rods: list[Rod] = []
    for number, bone in enumerate(bones):
        if owner[number] >= 0:
            continue
        chain = [number]
        while not hinged and after_it[chain[-1]] is not None:
            chain.append(after_it[chain[-1]])  # type: ignore[arg-type]
        owner[chain] = len(rods)
        parent, held = -1, 0.0
        if bone.parent >= 0:
            parent = int(owner[bone.parent])
            held = _projected(rods[parent], bone.origin[None])[0]
        rods.append(_rod([bones[i] for i in chain], bones, parent, held, hinged))
    for number, rod in enumerate(rods):
        solid = bones[int(np.argmax(owner == number))].solid
        if len(rod.along) == 1 and rod.parent >= 0 and not isinstance(solid, Cone):
            low, high = solid.box()
            rods[rod.parent] = _stiffened(rods[rod.parent], rod.held, 0.5 * float((high - low).max()))
    return Rig(tuple(rods), owner)


def _stiffened(rod: Rod, held: float, half: float) -> Rod:
    """The rod with something of half the extent ``half`` sitting on it."""
    near = np.abs(rod.along - held) < half
    return replace(rod, girth=np.where(near, np.maximum(rod.girth, 1.5 * half), rod.girth))


def strip(bones: Sequence[Bone], direction: Floats, axis: Floats, thickness: float, curl: float) -> Rig:
    """One rod for a whole body, such as a sheet, which is bent about ``axis`` along ``direction``.

    Args:
        bones: at rest.
        direction, axis: (3,) unit vectors, perpendicular.
        thickness: of the body in the direction in which it bends.
        curl: radians over the whole length.
    """
    corners = np.concatenate([np.stack(bone.placed.bounds()) for bone in bones])
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre, half = 0.5 * (low + high), 0.5 * float((np.abs(direction) * (high - low)).sum())
    along = np.linspace(0.0, 2.0 * half, _MOST_ELEMENTS)
    points = centre + (along - half)[:, None] * direction
    sides = np.tile(np.stack([axis, np.cross(direction, axis)], axis=1), (len(along), 1, 1))
    radii = np.full(len(along), 0.5 * thickness)
    rod = Rod(-1, 0.0, points, along, radii, radii, sides, curl=curl)
    return Rig((rod,), np.zeros(len(bones), dtype=np.int64))


def draw_turns(rig: Rig, rng: np.random.Generator, vigour: float, planar: bool = False) -> list[Floats]:
    """Draw a pose: the turns (n,3), radians, at the points of each rod.

    Args:
        rig: the rods.
        rng: where the angles come from.
        vigour: share of the limits that is used, 0 to 1.
        planar: bend about the first of the rods' two axes alone, as a sheet can.
    """
    turns = []
    for rod in rig.rods:
        turn = np.zeros((len(rod.along), 3))
        # Drawn whether used or not: the same number for every rod.
        angles = vigour * rng.uniform(0.0, 1.0, (len(rod.joints), 2)) ** 0.75
        waves = rng.uniform(-1.0, 1.0, (2, 3))
        waves /= np.abs(waves).max(axis=1, keepdims=True)
        twist = vigour * rod.twist * rng.uniform(-1.0, 1.0)
        sign = rng.choice([-1.0, 1.0], (len(rod.joints), 2))
        for joint, share, side in zip(rod.joints, angles, sign, strict=True):
            limit = np.where(side > 0.0, joint.high, -joint.low)
            # Where one side is nearly closed, as of a knee, the other is taken more often.
            free = np.where(limit < 0.3 * np.maximum(joint.high, -joint.low), -1.0, 1.0) * side
            limit = np.where(free > 0.0, joint.high, -joint.low)
            vector = (joint.axes * (free * share * limit)).sum(axis=1)
            turn += _bent(rod, joint, vector)
        if len(rod.along) > 1:
            turn += _curled(rod, vigour * waves, planar) + _twisted(rod, twist)
        turns.append(turn)
    return turns


def carry(rig: Rig, turns: Sequence[Floats]) -> list[Motions]:
    """The motions (n,) of the elements of each rod; element j begins at point j."""
    carried: list[Motions] = []
    for rod, turn in zip(rig.rods, turns, strict=True):
        motion = IDENTITY if rod.parent < 0 else _between(rig.rods[rod.parent], carried[rod.parent], np.array(rod.held))
        steps = turn_about(rod.points, turn)
        real, dual = np.empty((len(turn), 4)), np.empty((len(turn), 4))
        for j in range(len(turn)):
            motion = after(motion, Motions(steps.real[j], steps.dual[j]))
            real[j], dual[j] = motion
        carried.append(normalized(Motions(real, dual)))
    return carried


def bind(vertices: Floats, faces: Integers, rig: Rig, placed: Sequence[Placed]) -> Binding:
    """The weights of the vertices: of the nearest solid's rod, diffused over the surface by an implicit heat step.

    The arc lengths along a rod are diffused with its weights, which continues them smoothly onto its neighbours.
    """
    n_rods = len(rig.rods)
    if n_rods == 1:
        return Binding(np.ones((len(vertices), 1)), _projected(rig.rods[0], vertices)[:, None])
    distances = np.stack([solid.distance(*vertices.T) for solid in placed])
    nearest = rig.owner[np.argmin(distances, axis=0)]
    known = np.zeros((len(vertices), 2 * n_rods))
    width = np.zeros(len(vertices))
    for number, rod in enumerate(rig.rods):
        own = np.nonzero(nearest == number)[0]
        if not len(own):
            continue
        along = _projected(rod, vertices[own])
        known[own, number], known[own, n_rods + number] = 1.0, along
        width[own] = np.interp(along, rod.along, rod.radii)
    diffused = _diffused(vertices, faces, known, _DIFFUSION * width)
    weights = np.maximum(diffused[:, :n_rods], 0.0)
    weights[weights < 1e-3] = 0.0
    along = diffused[:, n_rods:] / np.maximum(diffused[:, :n_rods], 1e-6)
    along = np.clip(along, 0.0, np.array([rod.length for rod in rig.rods]))
    return Binding(weights / weights.sum(axis=1, keepdims=True), along)


def bend(vertices: Floats, rig: Rig, binding: Binding, carried: Sequence[Motions]) -> Floats:
    """The vertices (V,3) carried by the rods."""
    real, dual = np.zeros((len(vertices), 4)), np.zeros((len(vertices), 4))
    for number, rod in enumerate(rig.rods):
        own = np.nonzero(binding.weights[:, number])[0]
        motions = _between(rod, carried[number], binding.along[own, number])
        weights = binding.weights[own, number, None]
        real[own] += weights * motions.real
        dual[own] += weights * motions.dual
    return moved(normalized(Motions(real, dual)), vertices)


@dataclass(frozen=True)
class Gaps:
    """Which elements may not come together: pairs of them that are apart at rest, and the radii of all."""

    first: Integers
    second: Integers
    reach: Floats

    @classmethod
    def of(cls, rig: Rig) -> Gaps:
        points = np.concatenate([rod.points for rod in rig.rods])
        radii = np.concatenate([rod.radii for rod in rig.rods])
        distance = np.sqrt(((points[:, None] - points[None]) ** 2).sum(axis=2))
        first, second = np.nonzero(np.triu(distance > _APART * (radii[:, None] + radii[None])))
        return cls(first, second, radii[first] + radii[second])

    def least(self, rig: Rig, carried: Sequence[Motions]) -> float:
        """The least gap between elements in a pose, negative where they cross; infinite where none could meet."""
        points = np.concatenate([moved(motions, rod.points) for rod, motions in zip(rig.rods, carried, strict=True)])
        gap = np.sqrt(((points[self.first] - points[self.second]) ** 2).sum(axis=1)) - self.reach
        return float(gap.min(initial=np.inf))


def _successors(bones: Sequence[Bone]) -> list[int | None]:
    """The bone that goes on from the end of each: alone there, or the longest of those that go straight on."""
    found: list[int | None] = []
    for number, bone in enumerate(bones):
        end = np.asarray(bone.tip)
        ahead = end - bone.origin
        length = max(float(np.linalg.norm(ahead)), 1e-9)
        at_end: list[tuple[float, float, int]] = []
        for other, child in enumerate(bones):
            if child.parent != number or not any(child.part.bend):
                continue
            reach = np.asarray(child.tip) - child.origin
            beyond = float(((child.origin - bone.origin) * ahead).sum()) / length**2
            aside = float(np.linalg.norm(np.cross(child.origin - bone.origin, ahead))) / length
            straight = float((reach * ahead).sum()) / (length * max(float(np.linalg.norm(reach)), 1e-9))
            if beyond > 0.85 and aside < 0.05 * length:
                at_end.append((straight, float(np.linalg.norm(reach)), other))
        if len(at_end) > 1:
            at_end = sorted((one for one in at_end if one[0] > 0.9), key=lambda one: one[1])
        found.append(at_end[-1][2] if at_end and at_end[-1][0] > -0.3 else None)
    return found


def _rod(chain: Sequence[Bone], bones: Sequence[Bone], parent: int, held: float, hinged: bool) -> Rod:
    """The rod of a chain of bones, which has one element where nothing in it can bend."""
    line, radii, frames, starts = _centre_line(chain, parent < 0)
    if len(line) == 1 or (parent >= 0 and not any(any(bone.part.bend) for bone in chain)):
        return Rod(parent, held, line[:1], np.zeros(1), radii[:1], radii[:1], frames[:1, :, :2])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    length, radius = float(along[-1]), float(radii.mean())
    n = int(np.clip(np.ceil(length / (0.3 * radius)), 8, _MOST_ELEMENTS))
    even = np.linspace(0.0, length, n)
    points = np.stack([np.interp(even, along, line[:, i]) for i in range(3)], axis=1)
    which = np.clip(np.searchsorted(along, even, side="right") - 1, 0, len(frames) - 1)
    even_radii = np.interp(even, along, radii)
    rod = Rod(parent, held, points, even, even_radii, even_radii, frames[which][:, :, :2], is_hinge=hinged)
    spring = chain[0].solid
    if isinstance(spring, Helix):
        return replace(rod, curl=_OPENING * spring.turns)
    rod = replace(rod, joints=_joints(chain, [float(along[start]) for start in starts], rod, bones))
    if hinged:
        return rod
    slender = length / radius
    curl = min(np.radians(_CURL_LIMIT), 0.5 * slender) if len(chain) >= 3 and slender > _SLENDER else 0.06 * slender
    return replace(rod, curl=float(curl), twist=float(min(np.radians(_TWIST_LIMIT), _SHEAR * slender)))


def _joints(chain: Sequence[Bone], starts: Sequence[float], rod: Rod, bones: Sequence[Bone]) -> tuple[Joint, ...]:
    """The joints of a rod, of which ``starts`` are the arc lengths where its bones begin."""
    joints = []
    radius = float(rod.radii.mean())
    for bone, before, at in zip(chain, (None, *chain), starts, strict=False):
        axes = bone.frame[:, :2]
        if before is None and rod.parent < 0:
            # The first bone of all: its joint is the spine's, in its middle.
            if rod.length > 2.0 * radius and not rod.is_hinge:
                spine = np.radians([_SPINE_LIMIT, _SPINE_LIMIT])
                middle = 0.5 * min(rod.length, float(np.linalg.norm(bone.tip - bone.origin)))
                joints.append(Joint(middle, axes, -spine, spine, False))
        elif any(bone.part.bend):
            low, high = _limits(bone, before, rod.is_hinge)
            if before is None and not rod.is_hinge:
                # A limb bends from where it comes out of the body that holds it.
                outside = bones[bone.parent].placed.distance(*rod.points.T) > -0.2 * radius
                at = float(rod.along[int(np.argmax(outside))]) if outside.any() else 0.0
            joints.append(Joint(at, axes, low, high, before is None))
    return tuple(joints)


def _centre_line(chain: Sequence[Bone], is_root: bool) -> tuple[Floats, Floats, Floats, list[int]]:
    """Points, radii and frames along a chain of bones, and the number of each bone's first point."""
    root = chain[0]
    if isinstance(root.solid, Helix):
        share = np.linspace(0.0, 1.0, _MOST_ELEMENTS)
        local = np.array([root.solid.at(float(t)) for t in share])
        outward = surface.unit(local * np.array([1.0, 1.0, 0.0]))
        # It opens and closes about its axis.
        axes = np.stack([np.tile([0.0, 0.0, 1.0], (len(share), 1)), outward, np.zeros_like(local)], axis=2)
        return root.placed.offset + local, np.full(len(share), root.solid.tube), axes, [0]
    if is_root and len(chain) == 1 and not isinstance(root.solid, Cone | Arc):
        # A trunk bends about its middle, along its longest side; anything else is a hub.
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
                local = np.stack([0.0 * t, bow * (1.0 - np.cos(t * angle)), bow * np.sin(t * angle)], axis=1)
                points += list(bone.origin + (bone.frame[None] * local[:, None]).sum(axis=2))
                radii += list(start + t * (end - start))
                frames += [bone.frame] * len(t)
            case Cone(_, start, _):
                points.append(bone.origin)
                radii.append(start)
                frames.append(bone.frame)
            case _:
                points.append(bone.origin)
                radii.append(bone.radius)
                frames.append(bone.frame)
    last = chain[-1]
    points.append(last.tip)
    radii.append(last.solid.end if isinstance(last.solid, Cone | Arc) else last.radius)
    frames.append(last.frame)
    return np.array(points), np.array(radii), np.array(frames), starts


def _limits(bone: Bone, before: Bone | None, hinged: bool) -> tuple[Floats, Floats]:
    """Limits of raise and swing, radians; a knee that is bent at rest bends on to the same side."""
    factor, most = (_ROOT_FACTOR, _ROOT_LIMIT) if before is None else (_INNER_FACTOR, _INNER_LIMIT)
    high = np.radians(np.minimum(factor * np.array(bone.part.bend[:2], dtype=float), most))
    if hinged:
        high = np.radians(1.4 * np.array(bone.part.bend[:2], dtype=float))
    low = -high
    if before is not None:
        ahead = before.frame[:, 2]
        bent = bone.frame[:, 2] - ahead
        lifted = float((np.cross(bone.frame[:, 0], bone.frame[:, 2]) * bent).sum())
        if abs(lifted) > 0.04:
            rest = float(np.arccos(np.clip((ahead * bone.frame[:, 2]).sum(), -1.0, 1.0)))
            room = max(min(high[0], np.radians(150.0) - rest), 0.2)
            back = min(max(0.15 * high[0], 0.9 * rest), high[0])
            low[0], high[0] = (-back, room) if lifted > 0.0 else (-room, back)
    return low, high


def _projected(rod: Rod, points: Floats) -> Floats:
    """Arc lengths (V,) along a rod of the feet of points (V,3)."""
    if len(rod.along) == 1:
        return np.zeros(len(points))
    _, nearest = cKDTree(rod.points).query(points)
    tangent = surface.unit(np.gradient(rod.points, axis=0))
    ahead = ((points - rod.points[nearest]) * tangent[nearest]).sum(axis=1)
    step = rod.along[1]
    return np.clip(rod.along[nearest] + np.clip(ahead, -step, step), 0.0, rod.length)


def _between(rod: Rod, motions: Motions, along: Floats) -> Motions:
    """The motions at arc lengths (V,): between those of the two elements whose middles are nearest."""
    if len(rod.along) == 1:
        shape = (*along.shape, 4)
        return Motions(np.broadcast_to(motions.real[0], shape), np.broadcast_to(motions.dual[0], shape))
    place = np.clip(along / rod.along[1] - 0.5, 0.0, len(rod.along) - 1.0)
    lower = np.minimum(place.astype(np.int64), len(rod.along) - 2)
    share = (place - lower)[..., None]
    blend = [(1.0 - share) * part[lower] + share * part[lower + 1] for part in motions]
    return normalized(Motions(*blend))


def _bent(rod: Rod, joint: Joint, vector: Floats) -> Floats:
    """The turns (n,3) that bend a rod by a rotation vector around a joint, as gently as its thickness asks."""
    turns = np.zeros((len(rod.along), 3))
    angle = float(np.sqrt((vector * vector).sum()))
    if angle < 1e-9:
        return turns
    if rod.is_hinge:
        turns[0] = vector
        return turns
    radius = float(np.interp(joint.at, rod.along, rod.radii))
    step = rod.along[1]
    half = max(angle * radius / _TIGHTEST, 1.5 * step)
    if joint.is_root:
        half = min(half, 0.5 * (rod.length - joint.at) + 0.25 * step)
        middle = joint.at + half
    else:
        half = min(half, max(min(joint.at, rod.length - joint.at), 1.5 * step))
        middle = joint.at
    offset = (rod.along - middle) / half
    bump = np.where(np.abs(offset) < 1.0, 1.0 + np.cos(np.pi * offset), 0.0)
    # It bends where it is thin; and the turn at a point lies about the axis where a section there lies across.
    bump *= (radius / rod.girth) ** 2
    bump[0] = 0.0
    if bump.sum() == 0.0:
        return turns
    share = bump / bump.sum()
    tightest = _TIGHTEST * step / rod.girth / angle
    return np.minimum(share, tightest)[:, None] * vector


def _curled(rod: Rod, waves: Floats, planar: bool) -> Floats:
    """Turns (n,3) of a rod that curls: a constant curvature and two waves about each of its two axes."""
    if rod.curl == 0.0:
        return np.zeros((len(rod.along), 3))
    t = rod.along / rod.length
    shapes = np.stack([np.ones_like(t), 0.8 * np.cos(np.pi * t), 0.6 * np.cos(2.0 * np.pi * t)])
    curvature = (waves[:, :, None] * shapes[None]).sum(axis=1) * np.array([1.0, 0.0 if planar else 0.6])[:, None]
    step = rod.along[1]
    tightest = _TIGHTEST * step / rod.girth
    amount = np.clip(curvature * rod.curl / len(t), -tightest, tightest)
    amount[:, 0] = 0.0
    return np.einsum("kn,njk->nj", amount, rod.sides)


def _twisted(rod: Rod, angle: float) -> Floats:
    """Turns (n,3) of a rod that is twisted evenly."""
    tangent = surface.unit(np.gradient(rod.points, axis=0))
    share = np.full(len(rod.along), 1.0 / (len(rod.along) - 1))
    share[0] = 0.0
    return angle * share[:, None] * tangent


def _diffused(vertices: Floats, faces: Integers, values: Floats, width: Floats) -> Floats:
    """Values (V,C) after two implicit heat steps over the surface, by about ``width`` (V,)."""
    corners = vertices[faces]
    edges = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    squared = np.einsum("fij,fij->fi", edges, edges)
    double_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)[:, None]
    cotangents = (squared.sum(axis=1, keepdims=True) - 2.0 * squared) / (2.0 * np.maximum(double_area, 1e-12))
    # No weight of an edge is negative, so that no weight of a vertex becomes negative.
    conductance = np.maximum(cotangents, 0.02) * 0.25 * (width[faces] ** 2).mean(axis=1)[:, None]
    i, j = np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel()
    n = len(vertices)
    off = coo_array((conductance.ravel(), (i, j)), shape=(n, n)).tocsc()
    off = off + off.T
    mass = surface.vertex_areas(vertices, faces)
    matrix = (diags_array(mass + np.asarray(off.sum(axis=1)).ravel()) - off).tocsc()
    solver = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)
    for _ in range(2):
        values = solver.solve(mass[:, None] * values)
    return values
