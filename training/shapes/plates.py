"""Plates, and builders of sheets and of parts of machines.

A builder draws proportions from the random generator `g`. Its other arguments are the structural choices that
distinguish classes.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from igps._arrays import Floats
from igps.shapes.skeleton import Part, Skeleton, circle, turned
from igps.shapes.solids import Cone, Shell, Solid, Vector
from training.shapes.polygons import Prism
from training.shapes.ring import Ring

Bar = tuple[float, float, float, float, float, float]
Hole = tuple[float, float, float]


@dataclass(frozen=True)
class Plate(Solid):
    """A plate in the x-y plane, its outline a union of bars and discs, with round holes."""

    # Coordinates (x, y) and (x, y) of the ends, and half widths there; a disc has length 0
    bars: tuple[Bar, ...]
    holes: tuple[Hole, ...]  # coordinates (x, y), and radius
    thick: float  # thickness
    loops: int = 0  # number of handles that bars form; holes are counted separately
    fillet: float = 0.06  # distance within which corners between bars are filled

    @property
    def genus(self) -> int:
        return self.loops + len(self.holes)

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        flat: Floats | None = None
        for x0, y0, x1, y1, start, end in self.bars:
            dx = x1 - x0
            dy = y1 - y0
            squared_length = max(dx * dx + dy * dy, 1e-12)
            along = (x - x0) * dx + (y - y0) * dy
            share = np.clip(along / squared_length, 0.0, 1.0)
            half_width = start + (end - start) * share
            to_line = np.hypot(x - x0 - share * dx, y - y0 - share * dy)
            bar = to_line - half_width
            if flat is None:
                flat = bar
            else:
                overlap = np.maximum(self.fillet - np.abs(flat - bar), 0.0)
                flat = np.minimum(flat, bar) - overlap * overlap / (4.0 * self.fillet)
        assert flat is not None
        for cx, cy, radius in self.holes:
            flat = np.maximum(flat, radius - np.hypot(x - cx, y - cy))
        rounding = 0.35 * self.thick
        a = flat + rounding
        b = np.abs(z) - (0.5 * self.thick - rounding)
        outside = np.hypot(np.maximum(a, 0.0), np.maximum(b, 0.0))
        inside = np.minimum(np.maximum(a, b), 0.0)
        return outside + inside - rounding

    def box(self) -> tuple[Floats, Floats]:
        ends = []
        for x0, y0, x1, y1, r0, r1 in self.bars:
            ends.append((x0, y0, r0))
            ends.append((x1, y1, r1))
        x, y, r = np.array(ends).T
        low = np.array([(x - r).min(), (y - r).min()])
        high = np.array([(x + r).max(), (y + r).max()])
        half = 0.5 * self.thick
        return np.array([*low, -half]), np.array([*high, half])

    def stretched(self, thick: float, length: float) -> Solid:
        wide = np.sqrt(thick / length)  # bars become wider as the plate becomes thicker
        bars = np.array(self.bars) * length
        bars[:, 4:] *= wide
        holes = np.array(self.holes).reshape(-1, 3) * length
        return Plate(_rows(bars), _rows(holes), self.thick * thick, self.loops, self.fillet)

    def factors(self, thick: float, length: float) -> Floats:
        return np.array([length, length, thick])


def _rows(numbers: Floats) -> tuple[Any, ...]:
    return tuple(map(tuple, numbers.tolist()))


SHEETS = (
    "ribbon",
    "disc",
    "leaf",
    "cross",
    "star",
    "pelt",
    "shirt",
    "frame",
    "grid",
    "comb",
    "fork",
    "kite",
)


def sheet(g: np.random.Generator, outline: str, n_holes: int) -> Skeleton:
    """Build a sheet, which bends about one axis at a time."""
    bars, loops = _outline(g, outline)
    thick = g.uniform(0.1, 0.14)
    holes = _holes(g, bars[0], n_holes)
    plate = Plate(tuple(bars), holes, thick, loops)
    return Skeleton(Part(plate, "sheet"))


def _outline(g: np.random.Generator, outline: str) -> tuple[list[Bar], int]:
    """The bars of a sheet, of which the first is wide enough for holes, and the number of handles that bars form."""
    match outline:
        case "ribbon":
            half = g.uniform(1.1, 1.7)
            start = g.uniform(0.3, 0.42)
            end = g.uniform(0.24, 0.42)
            return [(-half, 0, half, 0, start, end)], 0
        case "disc":
            left = g.uniform(0.0, 0.3)
            right = g.uniform(0.0, 0.3)
            end = g.uniform(0.65, 0.8)
            return [(-left, 0, right, 0, 0.75, end)], 0
        case "leaf":
            half = g.uniform(0.7, 0.9)
            tip = g.uniform(0.9, 1.3)
            stem = g.uniform(0.6, 1.0)
            return [
                (-0.2, 0, 0.25, 0, 0.5 * half, 0.72 * half),
                (0.25, 0, tip, 0, 0.6 * half, 0.1),
                (-0.2 - stem, 0, 0, 0, 0.1, 0.12),
            ], 0
        case "cross":
            a = g.uniform(0.8, 1.2)
            b = g.uniform(0.6, 1.0)
            w = g.uniform(0.24, 0.34)
            return [(-a, 0, a, 0, w, w), (0, -b, 0, b, 0.9 * w, 0.9 * w)], 0
    return _outline_with_limbs(g, outline)


def _outline_with_limbs(g: np.random.Generator, outline: str) -> tuple[list[Bar], int]:
    """The bars and handles of the other sheets, which have limbs or are made of thin bars."""
    match outline:
        case "star":
            reach = g.uniform(0.8, 1.1)
            w = g.uniform(0.3, 0.4)
            disc = (0, 0, 0, 0, w, w)
            arms = [(0, 0, reach * c, reach * s, 0.7 * w, 0.12) for c, s in circle(5)]
            return [disc, *arms], 0
        case "pelt":
            half = g.uniform(0.6, 0.9)
            w = g.uniform(0.34, 0.45)
            legs = []
            for s, t in itertools.product((-1, 1), (-1, 1)):
                reach = t * g.uniform(0.65, 0.95)
                legs.append((s * 0.8 * half, 0.2 * t, s * (half + 0.25), reach, 0.2, 0.13))
            end = half + g.uniform(0.6, 1.0)
            tail = (half, 0.0, end, 0.0, 0.13, 0.1)
            head = (-half, 0.0, -half - 0.4, 0.0, 0.22, 0.16)
            return [(-half, 0, half, 0, w, w), *legs, tail, head], 0
        case "shirt":
            w = g.uniform(0.42, 0.52)
            half = g.uniform(0.5, 0.75)
            arm = g.uniform(0.35, 0.8)
            trunk = (-half, 0, half, 0, w, 0.95 * w)
            cuff = half - 0.35
            sleeves = [(half, s * 0.8 * w, cuff, s * (w + arm), 0.24, 0.18) for s in (-1, 1)]
            return [trunk, *sleeves], 0
        case "frame":
            a = g.uniform(0.7, 1.2)
            b = g.uniform(0.6, 0.8)
            w = g.uniform(0.16, 0.24)
            corners = [(-a, -b), (a, -b), (a, b), (-a, b)]
            return [(*corners[i], *corners[(i + 1) % 4], w, w) for i in range(4)], 1
        case "grid":
            a = g.uniform(0.8, 1.1)
            b = g.uniform(0.65, 0.85)
            w = g.uniform(0.12, 0.15)
            rows = [(-a, y, a, y, w, w) for y in (-b, 0.0, b)]
            columns = [(x, -b, x, b, w, w) for x in (-a, 0.0, a)]
            return rows + columns, 4
        case "comb":
            half = g.uniform(0.9, 1.2)
            w = g.uniform(0.26, 0.32)
            reach = g.uniform(0.6, 0.9)
            n_teeth = int(g.integers(4, 6))
            places = np.linspace(-half, half, n_teeth)
            teeth = [(x, 0, x, reach, 0.12, 0.1) for x in places]
            return [(-half, 0.0, half, 0.0, w, w), *teeth], 0
        case "fork":
            half = g.uniform(0.5, 0.8)
            w = g.uniform(0.26, 0.34)
            return [
                (-half, 0, half, 0, w, w),
                (half, 0, half + 0.7, 0.5, 0.2, 0.14),
                (half, 0, half + 0.7, -0.5, 0.2, 0.14),
                (-half, 0, -half - 0.6, 0, 0.2, 0.2),
            ], 0
        case "kite":
            wide = g.uniform(0.55, 0.7)
            long = g.uniform(1.6, 2.2)
            body = (0, 0, 0.6, 0, wide, 0.3)
            tail = (0.6, 0, long, 0, 0.12, 0.11)
            nose = (0, 0, -0.5, 0, 0.5, 0.2)
            return [body, tail, nose], 0
    raise AssertionError(outline)


def _holes(g: np.random.Generator, bar: Bar, count: int) -> tuple[Hole, ...]:
    """Separate holes along the middle of a bar, or in a circle if there is no room in a row."""
    if not count:
        return ()
    x0, y0, x1, y1, r0, r1 = bar
    narrow = min(r0, r1)
    straight = float(np.hypot(x1 - x0, y1 - y0))
    length = straight + 0.5 * (r0 + r1)
    largest = min(0.45 * narrow, 0.26 * length / count)
    radius = largest * g.uniform(0.85, 1.1)
    has_room = straight != 0.0 and length >= 3.2 * radius * count
    if count > 1 and not has_room:
        away = 0.55 * r0
        return tuple((away * c, away * s, 0.3 * narrow) for c, s in circle(count, 0.4))
    shares = np.array([0.5])
    if count > 1:
        ends = 0.25 * (r0 + r1) / max(straight, 1e-9)
        shares = np.linspace(-0.35 * ends, 1.0 + 0.35 * ends, count)
    holes = []
    for share in shares:
        x = float(x0 + share * (x1 - x0))
        y = float(y0 + share * (y1 - y0))
        holes.append((x, y, float(radius)))
    return tuple(holes)


MACHINES = ("gear", "flange", "lever", "triangle", "bracket", "cam", "clamp")


def machine(g: np.random.Generator, kind: str, extra: str, n: int) -> Skeleton:
    """Build a rigid part of a machine: a plate with holes or teeth, and an attachment."""
    thick = g.uniform(0.18, 0.34)
    bars: list[Bar]
    holes: list[Hole]
    loops = 0
    middle = (0.0, 0.0)
    match kind:
        case "gear":
            r = g.uniform(0.55, 0.7)
            bore = g.uniform(0.16, 0.24)
            teeth = 4 + 2 * n
            w = min(0.11, 1.1 * r / teeth)
            inner = 0.9 * r
            outer = r + 0.18
            bars = [(0, 0, 0, 0, r, r)]
            for c, s in circle(teeth):
                bars.append((inner * c, inner * s, outer * c, outer * s, w, 0.8 * w))
            holes = [(0, 0, bore)]
        case "flange":
            r = g.uniform(0.75, 0.9)
            bars = [(0, 0, 0, 0, r, r)]
            away = 0.72 * r
            holes = [(0, 0, 0.3 * r)]
            for c, s in circle(n + 1, 0.3):
                holes.append((away * c, away * s, 0.13 * r))
        case "lever":
            half = g.uniform(0.7, 1.1)
            r0 = g.uniform(0.36, 0.48)
            r1 = g.uniform(0.24, 0.36)
            bars = [
                (-half, 0, -half, 0, r0, r0),
                (half, 0, half, 0, r1, r1),
                (-half, 0, half, 0, 0.18, 0.16),
            ]
            holes = [(-half, 0.0, 0.5 * r0), (half, 0.0, 0.5 * r1)][: max(n - 1, 1)]
            middle = (-half, 0.0)
        case "triangle":
            r = g.uniform(0.75, 0.95)
            w = g.uniform(0.24, 0.3)
            corners = [(r * c, r * s * g.uniform(0.85, 1.2)) for c, s in circle(3)]
            bars = [(*corners[i], *corners[(i + 1) % 3], w, w) for i in range(3)]
            holes = [(x, y, 0.45 * w) for x, y in corners][:n]
            loops = 1
            middle = corners[0]
        case "bracket":
            half = g.uniform(0.55, 0.8)
            w = g.uniform(0.4, 0.55)
            bars = [(-half, 0.0, half, 0.0, w, w)]
            places = (half, -half, 0.0)[: max(n - 1, 1)]
            holes = [(x, 0.0, 0.35 * w) for x in places]
        case "cam":
            r = g.uniform(0.5, 0.62)
            throw = g.uniform(0.5, 0.8)
            bars = [(0, 0, throw, 0, r, 0.4 * r)]
            holes = [(0.0, 0.0, 0.4 * r), (throw, 0.0, 0.16 * r)][: 1 + (n > 2)]
        case _:
            r = g.uniform(0.6, 0.75)
            w = g.uniform(0.17, 0.22)
            angles = np.linspace(0.35, 2.0 * np.pi - 0.35, 13)
            arc = [(r * float(np.cos(a)), r * float(np.sin(a))) for a in angles]
            bars = [(*arc[i], *arc[i + 1], w, w) for i in range(12)]
            ears = [(x + 0.55, y * 1.1) for x, y in (arc[0], arc[12])]
            for end, ear in zip((arc[0], arc[12]), ears, strict=True):
                bars.append((*end, *ear, 0.15, 0.2))
            holes = [(x, y, 0.09) for x, y in ears[: max(n - 2, 0)]]
            middle = arc[6]
    plate = Plate(tuple(bars), tuple(holes), thick, loops)
    attached = _attached(g, extra, kind, middle, holes, thick)
    return Skeleton(Part(plate, "plate", children=attached), 0)


def _attached(
    g: np.random.Generator,
    extra: str,
    kind: str,
    middle: tuple[float, float],
    holes: list[Hole],
    thick: float,
) -> tuple[Part, ...]:
    """The attachment of a plate, around or beside its first hole: a collar, a shaft, an ear, or pins."""
    x, y = middle
    bore = 0.0
    if holes:
        x, y, bore = holes[0]
    seat: Vector = (x, y, 0.0)
    match extra:
        case "plain":
            return ()
        case "collar":
            high = g.uniform(0.35, 0.8)
            if not bore:
                boss = Prism(24, 0.2, high, 0.06)
                return (Part(boss, "collar", at=seat, lift=0.5 * high),)
            wall = max(0.6 * bore, 0.13)
            radius = bore + 0.5 * wall
            tube = Shell(((radius, 0.0), (radius, high)), wall)
            return (Part(_Sleeve(tube), "collar", at=seat),)
        case "shaft":
            high = g.uniform(0.7, 1.2)
            rod = Cone(high, 0.14, g.uniform(0.11, 0.14))
            aside = 1.45 * bore + 0.1 if bore else 0.0
            return (Part(rod, "shaft", at=(x + aside, y, 0.0)),)
        case "ear":
            ring = Ring(g.uniform(0.24, 0.32), 0.11)
            aside = 1.3 * bore + 0.12 if bore else 0.0
            spot = (x - aside, y, 0.0)
            lift = 0.5 * thick + 0.2
            return (Part(ring, "ear", at=spot, turn=turned("z", 90.0), lift=lift),)
        case "pins":
            pin = Cone(g.uniform(0.35, 0.6), 0.11, 0.1)
            reach = 1.45 * bore + 0.12 if bore else 0.2
            pins = []
            for c, s in circle(2, 0.5):
                spot = (x + reach * c, y + reach * s, 0.0)
                pins.append(Part(pin, "pin", at=spot))
            return tuple(pins)
    raise AssertionError((extra, kind))


@dataclass(frozen=True)
class _Sleeve(Solid):
    """A tube around a hole of a plate, which adds no handle."""

    tube: Shell

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        return self.tube.distance(x, y, z)

    def box(self) -> tuple[Floats, Floats]:
        return self.tube.box()

    def stretched(self, thick: float, length: float) -> Solid:
        tube = self.tube.stretched(1.0, length)
        assert isinstance(tube, Shell)
        return _Sleeve(tube)
