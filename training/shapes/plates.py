"""Plates, and builders of sheets and of parts of machines.

A builder draws proportions from the random generator `g`. Its other arguments are the structural choices that
distinguish classes.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from igps._arrays import Floats
from igps.shapes.skeleton import Part, Skeleton, circle, turned
from igps.shapes.solids import Cone, Shell, Solid, Vector
from training.shapes.polygons import Prism, rounded
from training.shapes.ring import Ring

# Coordinates (x, y) and (x, y) of the ends, and half widths there; a disc has length 0
Bar = tuple[float, float, float, float, float, float]
# Coordinates (x, y), and radius
Hole = tuple[float, float, float]


@dataclass(frozen=True)
class Plate(Solid):
    """A plate in the x-y plane, its outline a union of bars and discs, with round holes."""

    bars: tuple[Bar, ...]
    holes: tuple[Hole, ...]
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
                filled = overlap * overlap / (4.0 * self.fillet)
                flat = np.minimum(flat, bar) - filled
        assert flat is not None
        for cx, cy, radius in self.holes:
            to_centre = np.hypot(x - cx, y - cy)
            flat = np.maximum(flat, radius - to_centre)
        rounding = 0.35 * self.thick
        return rounded(flat + rounding, z, self.thick, rounding)

    def box(self) -> tuple[Floats, Floats]:
        ends = []
        for x0, y0, x1, y1, r0, r1 in self.bars:
            ends.append((x0, y0, r0))
            ends.append((x1, y1, r1))
        x, y, r = np.array(ends).T
        half = 0.5 * self.thick
        low = np.array([(x - r).min(), (y - r).min(), -half])
        high = np.array([(x + r).max(), (y + r).max(), half])
        return low, high

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


# Numbers of handles that the bars of sheets form
_LOOPS = {"frame": 1, "grid": 4}


def sheet(g: np.random.Generator, outline: str, n_holes: int) -> Skeleton:
    """Build a sheet, which bends about one axis at a time."""
    bars = _outline(g, outline)
    thick = g.uniform(0.1, 0.14)
    holes = _holes(g, bars[0], n_holes)
    plate = Plate(tuple(bars), holes, thick, _LOOPS.get(outline, 0))
    return Skeleton(Part(plate, "sheet"))


def _disc(x: float, y: float, radius: float) -> Bar:
    return (x, y, x, y, radius, radius)


def _path(points: Sequence[tuple[float, float]], half_width: float) -> list[Bar]:
    """Bars from each point to the next."""
    bars = []
    for start, end in itertools.pairwise(points):
        bars.append((*start, *end, half_width, half_width))
    return bars


def _outline(g: np.random.Generator, outline: str) -> list[Bar]:
    """The bars of a sheet, of which the first is wide enough for holes."""
    match outline:
        case "ribbon":
            half = g.uniform(1.1, 1.7)
            start = g.uniform(0.3, 0.42)
            end = g.uniform(0.24, 0.42)
            return [(-half, 0, half, 0, start, end)]
        case "disc":
            left = g.uniform(0.0, 0.3)
            right = g.uniform(0.0, 0.3)
            end = g.uniform(0.65, 0.8)
            return [(-left, 0, right, 0, 0.75, end)]
        case "leaf":
            half = g.uniform(0.7, 0.9)
            tip = g.uniform(0.9, 1.3)
            stem = g.uniform(0.6, 1.0)
            return [
                (-0.2, 0, 0.25, 0, 0.5 * half, 0.72 * half),
                (0.25, 0, tip, 0, 0.6 * half, 0.1),
                (-0.2 - stem, 0, 0, 0, 0.1, 0.12),
            ]
        case "cross":
            a = g.uniform(0.8, 1.2)
            b = g.uniform(0.6, 1.0)
            w = g.uniform(0.24, 0.34)
            narrow = 0.9 * w
            return [(-a, 0, a, 0, w, w), (0, -b, 0, b, narrow, narrow)]
        case "star":
            reach = g.uniform(0.8, 1.1)
            w = g.uniform(0.3, 0.4)
            bars = [_disc(0, 0, w)]
            for x, y in circle(5):
                bars.append((0, 0, reach * x, reach * y, 0.7 * w, 0.12))
            return bars
    return _outline_with_limbs(g, outline)


def _outline_with_limbs(g: np.random.Generator, outline: str) -> list[Bar]:
    """The bars of the other sheets, which have limbs or are made of thin bars."""
    match outline:
        case "pelt":
            half = g.uniform(0.6, 0.9)
            w = g.uniform(0.34, 0.45)
            bars: list[Bar] = [(-half, 0, half, 0, w, w)]
            for side, end in itertools.product((-1, 1), (-1, 1)):
                reach = end * g.uniform(0.65, 0.95)
                root = side * 0.8 * half
                foot = side * (half + 0.25)
                bars.append((root, 0.2 * end, foot, reach, 0.2, 0.13))
            tip = half + g.uniform(0.6, 1.0)
            tail = (half, 0.0, tip, 0.0, 0.13, 0.1)
            head = (-half, 0.0, -half - 0.4, 0.0, 0.22, 0.16)
            return [*bars, tail, head]
        case "shirt":
            w = g.uniform(0.42, 0.52)
            half = g.uniform(0.5, 0.75)
            arm = g.uniform(0.35, 0.8)
            cuff = half - 0.35
            bars = [(-half, 0.0, half, 0.0, w, 0.95 * w)]
            for side in (-1, 1):
                shoulder = side * 0.8 * w
                bars.append((half, shoulder, cuff, side * (w + arm), 0.24, 0.18))
            return bars
        case "frame":
            a = g.uniform(0.7, 1.2)
            b = g.uniform(0.6, 0.8)
            w = g.uniform(0.16, 0.24)
            first = (-a, -b)
            return _path([first, (a, -b), (a, b), (-a, b), first], w)
        case "grid":
            a = g.uniform(0.8, 1.1)
            b = g.uniform(0.65, 0.85)
            w = g.uniform(0.12, 0.15)
            rows = [(-a, y, a, y, w, w) for y in (-b, 0.0, b)]
            columns = [(x, -b, x, b, w, w) for x in (-a, 0.0, a)]
            return rows + columns
        case "comb":
            half = g.uniform(0.9, 1.2)
            w = g.uniform(0.26, 0.32)
            reach = g.uniform(0.6, 0.9)
            n_teeth = int(g.integers(4, 6))
            places = np.linspace(-half, half, n_teeth)
            teeth = [(x, 0, x, reach, 0.12, 0.1) for x in places]
            return [(-half, 0.0, half, 0.0, w, w), *teeth]
        case "fork":
            half = g.uniform(0.5, 0.8)
            w = g.uniform(0.26, 0.34)
            tip = half + 0.7
            return [
                (-half, 0, half, 0, w, w),
                (half, 0, tip, 0.5, 0.2, 0.14),
                (half, 0, tip, -0.5, 0.2, 0.14),
                (-half, 0, -half - 0.6, 0, 0.2, 0.2),
            ]
        case "kite":
            wide = g.uniform(0.55, 0.7)
            long = g.uniform(1.6, 2.2)
            body = (0, 0, 0.6, 0, wide, 0.3)
            tail = (0.6, 0, long, 0, 0.12, 0.11)
            nose = (0, 0, -0.5, 0, 0.5, 0.2)
            return [body, tail, nose]
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
        return tuple((away * x, away * y, 0.3 * narrow) for x, y in circle(count, 0.4))
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
    outline = _machine_outline(g, kind, n)
    holes = tuple(outline.holes)
    loops = 1 if kind == "triangle" else 0
    plate = Plate(tuple(outline.bars), holes, thick, loops)
    x, y = outline.middle
    seat = holes[0] if holes else (x, y, 0.0)
    attached = _attached(g, extra, seat, thick)
    return Skeleton(Part(plate, "plate", children=attached), 0)


class _Outline(NamedTuple):
    """The outline of a part of a machine."""

    bars: Sequence[Bar]
    holes: Sequence[Hole]
    middle: tuple[float, float] = (0.0, 0.0)  # where an attachment sits if there is no hole


def _machine_outline(g: np.random.Generator, kind: str, n: int) -> _Outline:
    match kind:
        case "gear":
            r = g.uniform(0.55, 0.7)
            bore = g.uniform(0.16, 0.24)
            teeth = 4 + 2 * n
            w = min(0.11, 1.1 * r / teeth)
            inner = 0.9 * r
            outer = r + 0.18
            bars = [_disc(0, 0, r)]
            for x, y in circle(teeth):
                bars.append((inner * x, inner * y, outer * x, outer * y, w, 0.8 * w))
            return _Outline(bars, [(0, 0, bore)])
        case "flange":
            r = g.uniform(0.75, 0.9)
            away = 0.72 * r
            holes = [(0.0, 0.0, 0.3 * r)]
            for x, y in circle(n + 1, 0.3):
                holes.append((away * x, away * y, 0.13 * r))
            return _Outline([_disc(0, 0, r)], holes)
        case "lever":
            half = g.uniform(0.7, 1.1)
            large = g.uniform(0.36, 0.48)
            small = g.uniform(0.24, 0.36)
            shaft = (-half, 0, half, 0, 0.18, 0.16)
            bars = [_disc(-half, 0, large), _disc(half, 0, small), shaft]
            holes = [(-half, 0.0, 0.5 * large), (half, 0.0, 0.5 * small)]
            return _Outline(bars, holes[: max(n - 1, 1)])
        case "triangle":
            r = g.uniform(0.75, 0.95)
            w = g.uniform(0.24, 0.3)
            corners = [(r * x, r * y * g.uniform(0.85, 1.2)) for x, y in circle(3)]
            holes = [(x, y, 0.45 * w) for x, y in corners]
            return _Outline(_path([*corners, corners[0]], w), holes[:n])
        case "bracket":
            half = g.uniform(0.55, 0.8)
            w = g.uniform(0.4, 0.55)
            radius = 0.35 * w
            holes = [(half, 0.0, radius), (-half, 0.0, radius), (0.0, 0.0, radius)]
            return _Outline([(-half, 0.0, half, 0.0, w, w)], holes[: max(n - 1, 1)])
        case "cam":
            r = g.uniform(0.5, 0.62)
            throw = g.uniform(0.5, 0.8)
            holes = [(0.0, 0.0, 0.4 * r)]
            if n > 2:
                holes.append((throw, 0.0, 0.16 * r))
            return _Outline([(0, 0, throw, 0, r, 0.4 * r)], holes)
        case _:
            r = g.uniform(0.6, 0.75)
            w = g.uniform(0.17, 0.22)
            angles = np.linspace(0.35, 2.0 * np.pi - 0.35, 13)
            arc = [(r * float(np.cos(a)), r * float(np.sin(a))) for a in angles]
            bars = _path(arc, w)
            holes = []
            for x, y in (arc[0], arc[-1]):
                ear = (x + 0.55, y * 1.1)
                bars.append((x, y, *ear, 0.15, 0.2))
                holes.append((*ear, 0.09))
            return _Outline(bars, holes[: max(n - 2, 0)], arc[6])


def _attached(g: np.random.Generator, extra: str, seat: Hole, thick: float) -> tuple[Part, ...]:
    """The attachment of a plate of some thickness, around or beside a hole; if there is none, its radius is 0."""
    x, y, bore = seat
    place: Vector = (x, y, 0.0)
    match extra:
        case "plain":
            return ()
        case "collar":
            high = g.uniform(0.35, 0.8)
            if not bore:
                boss = Prism(24, 0.2, high, 0.06)
                return (Part(boss, "collar", at=place, lift=0.5 * high),)
            wall = max(0.6 * bore, 0.13)
            radius = bore + 0.5 * wall
            sleeve = _Sleeve(((radius, 0.0), (radius, high)), wall)
            return (Part(sleeve, "collar", at=place),)
        case "shaft":
            high = g.uniform(0.7, 1.2)
            rod = Cone(high, 0.14, g.uniform(0.11, 0.14))
            aside = 1.45 * bore + 0.1 if bore else 0.0
            return (Part(rod, "shaft", at=(x + aside, y, 0.0)),)
        case "ear":
            ring = Ring(g.uniform(0.24, 0.32), 0.11)
            aside = 1.3 * bore + 0.12 if bore else 0.0
            beside = (x - aside, y, 0.0)
            lift = 0.5 * thick + 0.2
            return (Part(ring, "ear", at=beside, turn=turned("z", 90.0), lift=lift),)
        case "pins":
            pin = Cone(g.uniform(0.35, 0.6), 0.11, 0.1)
            reach = 1.45 * bore + 0.12 if bore else 0.2
            pins = []
            for dx, dy in circle(2, 0.5):
                beside = (x + reach * dx, y + reach * dy, 0.0)
                pins.append(Part(pin, "pin", at=beside))
            return tuple(pins)
    raise AssertionError(extra)


class _Sleeve(Shell):
    """A tube around a hole of a plate, which adds no handle."""

    @property
    def genus(self) -> int:
        return 0

    def stretched(self, thick: float, length: float) -> Solid:
        profile = tuple((radius, height * length) for radius, height in self.profile)
        return _Sleeve(profile, self.wall)
