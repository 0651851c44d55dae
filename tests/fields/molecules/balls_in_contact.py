"""Closed forms of the surfaces of balls, and molecules made of balls."""

import math

import numpy as np
from scipy.integrate import quad

from igps.fields.molecules.molecule import Molecule


def molecule(positions, radii):
    positions = np.atleast_2d(np.asarray(positions, dtype=float))
    radii = np.atleast_1d(np.asarray(radii, dtype=float))
    n = len(radii)
    none = np.zeros(n)
    return Molecule(
        "balls",
        positions,
        radii,
        none,
        np.arange(n),
        ("X",) * n,
        positions,
        none,
    )


def ball(r):
    """Area and volume."""
    return 4 * math.pi * r**2, 4 / 3 * math.pi * r**3


def cap(r, height):
    """Area, without its disc, and volume."""
    return 2 * math.pi * r * height, math.pi * height**2 * (3 * r - height) / 3


def union_of_two(r, s, apart):
    """Area and volume of two balls that cross."""
    x = (apart**2 + r**2 - s**2) / (2 * apart)
    parts = ball(r), ball(s), cap(r, r - x), cap(s, s - apart + x)
    area, volume = (a + b - c - d for a, b, c, d in zip(*parts, strict=True))
    return area, volume


def saddle(r, s, apart, probe):
    """Where a probe that touches two balls rolls around them: the inner side of a torus.

    Returns:
        Its area; the volume within, between the circles in which it leaves the balls; how far these circles lie from
        the balls' centres, towards the other ball. Where the torus crosses itself, two pieces end in a cusp each.
    """
    a = r + probe
    b = s + probe
    x = (apart**2 + a**2 - b**2) / (2 * apart)
    radius = math.sqrt(a**2 - x**2)
    from_first = x * r / a
    from_second = (apart - x) * s / b
    ends = -math.asin((x - from_first) / probe), math.asin((apart - x - from_second) / probe)
    cusp = math.acos(radius / probe) if radius < probe else 0.0

    def width(t):
        return radius - probe * math.cos(t)

    def slice_of(t):
        return width(t) ** 2 * probe * math.cos(t)

    area = volume = 0.0
    for low, high in ((ends[0], -cusp), (cusp, ends[1])):
        area += 2 * math.pi * probe * quad(width, low, high)[0]
        volume += math.pi * quad(slice_of, low, high)[0]
    return area, volume, from_first, from_second


def excluded_of_two(r, s, apart, probe):
    """Area and volume of what a probe leaves of the space around two balls nearer than its diameter."""
    area, volume, x, y = saddle(r, s, apart, probe)
    parts = cap(r, r + x), cap(s, s + y)
    return area + parts[0][0] + parts[1][0], volume + parts[0][1] + parts[1][1]


def excluded_of_ring(n, r, apart, probe):
    """The same of n balls in a ring, each of which the probe touches with its neighbours alone."""
    area, volume, x, _ = saddle(r, r, apart, probe)
    whole = ball(r)
    off = cap(r, r - x)
    return n * (area + whole[0] - 2 * off[0]), n * (volume + whole[1] - 2 * off[1])
