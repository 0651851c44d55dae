"""Bending a surface by rigid motions that change smoothly over it: dual quaternion skinning.

A rigid motion is a unit dual quaternion, a pair of quaternions (w, x, y, z): `real` is the rotation, and `dual` is
half the translation times `real`. The weighted mean of several motions, divided by its length, is again a rigid
motion. A joint therefore neither collapses nor loses volume when it is twisted (Kavan, Collins, Žára and O'Sullivan
2007).
"""

from typing import NamedTuple

import numpy as np

from igps._arrays import Floats


class Motions(NamedTuple):
    """Rigid motions: real parts (..., 4) of length 1, and dual parts (..., 4)."""

    real: Floats
    dual: Floats


IDENTITY = Motions(np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(4))


def rotations_about(centre: Floats, rotation: Floats) -> Motions:
    """Return the rotations by vectors (..., 3), radians, about points (..., 3)."""
    angle = np.sqrt((rotation * rotation).sum(axis=-1, keepdims=True))
    scalar = np.cos(0.5 * angle)
    vector = 0.5 * np.sinc(angle / (2.0 * np.pi)) * rotation
    real = np.concatenate([scalar, vector], axis=-1)
    # x ↦ R x + (c − R c).
    return motion(real, centre - _rotated(real, centre))


def motion(real: Floats, translation: Floats) -> Motions:
    """Return the motions that rotate by unit quaternions (..., 4) and then translate by (..., 3)."""
    zero = np.zeros_like(translation[..., :1])
    half = np.concatenate([zero, 0.5 * translation], axis=-1)
    return Motions(real, product(half, real))


def compose(first: Motions, second: Motions) -> Motions:
    """Return the motions that apply `second`, then `first`."""
    real = product(first.real, second.real)
    moved = product(first.real, second.dual)
    dual = moved + product(first.dual, second.real)
    return Motions(real, dual)


def normalized(motions: Motions) -> Motions:
    """Return the rigid motions that are multiples of sums of dual quaternions."""
    squares = motions.real * motions.real
    length = np.sqrt(squares.sum(axis=-1, keepdims=True))
    return Motions(motions.real / length, motions.dual / length)


def transform(motions: Motions, points: Floats) -> Floats:
    """Return points (..., 3) after one motion each."""
    # The translation is twice the dual part times the conjugate of the real part. This also holds for blends, whose
    # dual part may have a component along the real part.
    conjugate = motions.real * np.array([1.0, -1.0, -1.0, -1.0])
    translation = 2.0 * product(motions.dual, conjugate)[..., 1:]
    return _rotated(motions.real, points) + translation


def product(a: Floats, b: Floats) -> Floats:
    """Return the products of quaternions (..., 4)."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return np.stack([w, x, y, z], axis=-1)


def _rotated(real: Floats, points: Floats) -> Floats:
    axis = real[..., 1:]
    across = np.cross(axis, points)
    step = real[..., :1] * across + np.cross(axis, across)
    return points + 2.0 * step
