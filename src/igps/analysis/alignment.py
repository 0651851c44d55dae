"""Rigid alignment of a body to another, without mirroring."""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from igps._arrays import Floats
from igps.mesh.mesh import Mesh
from igps.mesh.surface import area_vectors, lengths, unit

_N_COARSE, _N_FINE, _N_TARGET = 200, 1000, 6000  # points on the surfaces
_N_COARSE_STEPS, _N_FINE_STEPS = 10, 30
_KEPT = 0.8  # share of the points whose gaps are nearest to the median that count: a local difference moves nothing
_MIN_TURN = 1e-5  # radians; smaller steps end the alignment


@dataclass(frozen=True, eq=False)
class Motion:
    """A rotation, a scale, and a translation."""

    turn: Floats  # (3, 3), determinant 1
    scale: float
    shift: Floats  # (3,) length

    def of(self, points: Floats) -> Floats:
        """Move points (N, 3)."""
        return self.scale * points @ self.turn.T + self.shift

    def back(self, points: Floats) -> Floats:
        """Move points (N, 3) the opposite way."""
        return (points - self.shift) @ self.turn / self.scale


@dataclass(frozen=True, eq=False)
class _Target:
    points: Floats  # (N, 3)
    normals: Floats  # (N, 3)
    tree: cKDTree


def rigid_motion(body: Mesh, target: Mesh, *, scale: float = 1.0) -> Motion:
    """Return the motion that lays a body onto another, after it is scaled.

    The bodies are first laid centre on centre. In the frame of the patient they are turned from there; bodies without
    a frame are tried with their principal axes in all 24 ways. Then points on the body move towards the tangent planes
    of the nearest points of the target (Chen and Medioni 1992): those four fifths whose gaps are nearest to the median.
    """
    points, _ = _spread(body, _N_FINE)
    target_points, normals = _spread(target, _N_TARGET)
    aim = _Target(target_points, normals, cKDTree(target_points))
    centre = points.mean(axis=0)
    goal = target_points.mean(axis=0)
    starts = [np.eye(3)]
    if body.frame is None or target.frame is None:
        starts = _turns(points - centre, target_points - goal)
    coarse = points[:: _N_FINE // _N_COARSE]
    candidates = []
    for turn in starts:
        shift = goal - scale * turn @ centre
        start = Motion(turn, scale, shift)
        if len(starts) > 1:
            start = _fitted(start, coarse, aim, _N_COARSE_STEPS)
        candidates.append(start)
    best = min(candidates, key=lambda motion: _misfit(motion, coarse, aim))
    return _fitted(best, points, aim, _N_FINE_STEPS)


def _spread(mesh: Mesh, n: int) -> tuple[Floats, Floats]:
    """Return points (n, 3) spread over a surface by area, in random order, and the normals there."""
    random = np.random.default_rng(0)
    vectors = area_vectors(mesh.vertices, mesh.faces)
    ends = lengths(vectors).cumsum()
    shares = (np.arange(n) + random.random(n)) / n
    faces = np.searchsorted(ends, shares * ends[-1])
    chosen = random.permutation(np.minimum(faces, len(ends) - 1))
    weights = random.dirichlet(np.ones(3), n)
    corners = mesh.vertices[mesh.faces[chosen]]
    points = np.einsum("nk,nkc->nc", weights, corners)
    return points, unit(vectors[chosen])


def _turns(points: Floats, target: Floats) -> list[Floats]:
    """Return the 24 rotations that lay the principal axes of centred points on those of others."""
    _, _, own = np.linalg.svd(points, full_matrices=False)
    _, _, others = np.linalg.svd(target, full_matrices=False)
    turns = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            axes = np.eye(3)[list(order)] * signs
            turn = others.T @ axes @ own
            if np.linalg.det(turn) > 0:
                turns.append(turn)
    return turns


def _fitted(motion: Motion, points: Floats, target: _Target, n_steps: int) -> Motion:
    n_kept = int(_KEPT * len(points))
    for _ in range(n_steps):
        moved = motion.of(points)
        _, nearest = target.tree.query(moved)
        steps = target.points[nearest] - moved
        gaps = (steps * target.normals[nearest]).sum(axis=1)
        gaps -= np.median(gaps)  # a body that is larger all around stays where it is
        kept = np.argsort(np.abs(gaps))[:n_kept]
        normals = target.normals[nearest[kept]]
        centre = moved.mean(axis=0)
        size = lengths(moved - centre).mean()
        arms = (moved[kept] - centre) / size
        columns = np.hstack([np.cross(arms, normals), normals])
        # Bodies of revolution leave a turn free: the smallest solution does not turn them
        solution, *_ = np.linalg.lstsq(columns, gaps[kept], rcond=1e-3)
        angles = solution[:3] / size
        turn = Rotation.from_rotvec(angles).as_matrix()
        shift = turn @ (motion.shift - centre) + centre + solution[3:]
        motion = Motion(turn @ motion.turn, motion.scale, shift)
        if np.linalg.norm(solution) < _MIN_TURN * size:
            break
    return motion


def _misfit(motion: Motion, points: Floats, target: _Target) -> float:
    """Return the mean distance of the points that count from the target."""
    distances, _ = target.tree.query(motion.of(points))
    n_kept = int(_KEPT * len(points))
    kept = np.sort(distances)[:n_kept]
    return float(kept.mean())
