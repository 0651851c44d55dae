"""Bending a surface by rigid motions that change smoothly over it: dual quaternion skinning.

A rigid motion is a unit dual quaternion, a pair of quaternions (w, x, y, z): ``real`` turns, and ``dual`` is half the
translation times ``real``. The weighted mean of several, over its length, is a rigid motion again, so that a joint
neither collapses nor loses volume when it is twisted (Kavan, Collins, Žára and O'Sullivan 2007).
"""

from typing import NamedTuple

import numpy as np

from igps._arrays import Floats


class Motions(NamedTuple):
    """Rigid motions: real and dual parts, (..., 4) each; the real parts have length 1."""

    real: Floats
    dual: Floats


IDENTITY = Motions(np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(4))


def turn_about(centre: Floats, rotation: Floats) -> Motions:
    """Rotations by vectors (..., 3), radians, about points (..., 3)."""
    angle = np.sqrt((rotation * rotation).sum(axis=-1, keepdims=True))
    real = np.concatenate([np.cos(0.5 * angle), 0.5 * np.sinc(angle / (2.0 * np.pi)) * rotation], axis=-1)
    # x ↦ R x + (c − R c).
    return motion(real, centre - _rotated(real, centre))


def motion(real: Floats, translation: Floats) -> Motions:
    """Turn by unit quaternions (..., 4), then move by (..., 3)."""
    half = np.concatenate([np.zeros_like(translation[..., :1]), 0.5 * translation], axis=-1)
    return Motions(real, product(half, real))


def after(first: Motions, second: Motions) -> Motions:
    """The motions that do ``second`` and then ``first``."""
    return Motions(
        product(first.real, second.real), product(first.real, second.dual) + product(first.dual, second.real)
    )


def normalized(motions: Motions) -> Motions:
    """Sums of dual quaternions made rigid motions again."""
    length = np.sqrt((motions.real * motions.real).sum(axis=-1, keepdims=True))
    return Motions(motions.real / length, motions.dual / length)


def moved(motions: Motions, points: Floats) -> Floats:
    """Points (..., 3), each by its motion."""
    # Twice the dual part times the conjugate of the real one is the translation, exactly so where a blend has left a
    # component along the real part too.
    conjugate = motions.real * np.array([1.0, -1.0, -1.0, -1.0])
    return _rotated(motions.real, points) + 2.0 * product(motions.dual, conjugate)[..., 1:]


def product(a: Floats, b: Floats) -> Floats:
    """Products of quaternions (..., 4)."""
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def _rotated(real: Floats, points: Floats) -> Floats:
    axis = real[..., 1:]
    across = np.cross(axis, points)
    return points + 2.0 * (real[..., :1] * across + np.cross(axis, across))
