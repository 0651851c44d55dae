"""Plates, and builders of sheets and of parts of machines.

A builder draws proportions from the random generator `g`. Its other arguments are the structural choices that
distinguish classes.
"""

from dataclasses import dataclass

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
            share = np.clip(
                ((x - x0) * dx + (y - y0) * dy) / max(dx * dx + dy * dy, 1e-12), 0.0, 1.0
            )
            bar = np.hypot(x - x0 - share * dx, y - y0 - share * dy) - (
                start + (end - start) * share
            )
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
        return (
            np.hypot(np.maximum(a, 0.0), np.maximum(b, 0.0))
            + np.minimum(np.maximum(a, b), 0.0)
            - rounding
        )

    def box(self) -> tuple[Floats, Floats]:
        ends = [
            (x, y, r)
            for x0, y0, x1, y1, r0, r1 in self.bars
            for x, y, r in ((x0, y0, r0), (x1, y1, r1))
        ]
        x, y, r = np.array(ends).T
        low = np.array([(x - r).min(), (y - r).min()])
        high = np.array([(x + r).max(), (y + r).max()])
        half = 0.5 * self.thick
        return np.array([*low, -half]), np.array([*high, half])

    def stretched(self, thick: float, length: float) -> Solid:
        wide = np.sqrt(thick / length)  # bars become wider as the plate becomes thicker
        bars = tuple(
            (
                x0 * length,
                y0 * length,
                x1 * length,
                y1 * length,
                r0 * length * wide,
                r1 * length * wide,
            )
            for x0, y0, x1, y1, r0, r1 in self.bars
        )
        holes = tuple((x * length, y * length, r * length) for x, y, r in self.holes)
        return Plate(bars, holes, self.thick * thick, self.loops, self.fillet)

    def factors(self, thick: float, length: float) -> Floats:
        return np.array([length, length, thick])


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
    return Skeleton(Part(Plate(tuple(bars), _holes(g, bars[0], n_holes), thick, loops), "sheet"))


def _outline(g: np.random.Generator, outline: str) -> tuple[list[Bar], int]:
    """The bars of a sheet, of which the first is wide enough for holes, and the number of handles that bars form."""
    match outline:
        case "ribbon":
            half = g.uniform(1.1, 1.7)
            return [(-half, 0, half, 0, g.uniform(0.3, 0.42), g.uniform(0.24, 0.42))], 0
        case "disc":
            return [
                (-g.uniform(0.0, 0.3), 0, g.uniform(0.0, 0.3), 0, 0.75, g.uniform(0.65, 0.8))
            ], 0
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
            return [(0, 0, 0, 0, w, w)] + [
                (0, 0, reach * c, reach * s, 0.7 * w, 0.12) for c, s in circle(5)
            ], 0
        case "pelt":
            half = g.uniform(0.6, 0.9)
            w = g.uniform(0.34, 0.45)
            legs = [
                (s * 0.8 * half, 0.2 * t, s * (half + 0.25), t * g.uniform(0.65, 0.95), 0.2, 0.13)
                for s in (-1, 1)
                for t in (-1, 1)
            ]
            tail = [
                (half, 0.0, half + g.uniform(0.6, 1.0), 0.0, 0.13, 0.1),
                (-half, 0.0, -half - 0.4, 0.0, 0.22, 0.16),
            ]
            return [(-half, 0, half, 0, w, w), *legs, *tail], 0
        case "shirt":
            w = g.uniform(0.42, 0.52)
            half = g.uniform(0.5, 0.75)
            arm = g.uniform(0.35, 0.8)
            sleeves = [(half, s * 0.8 * w, half - 0.35, s * (w + arm), 0.24, 0.18) for s in (-1, 1)]
            return [(-half, 0, half, 0, w, 0.95 * w), *sleeves], 0
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
            return rows + [(x, -b, x, b, w, w) for x in (-a, 0.0, a)], 4
        case "comb":
            half = g.uniform(0.9, 1.2)
            w = g.uniform(0.26, 0.32)
            reach = g.uniform(0.6, 0.9)
            teeth = [
                (x, 0, x, reach, 0.12, 0.1) for x in np.linspace(-half, half, int(g.integers(4, 6)))
            ]
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
            return [
                (0, 0, 0.6, 0, g.uniform(0.55, 0.7), 0.3),
                (0.6, 0, g.uniform(1.6, 2.2), 0, 0.12, 0.11),
                (0, 0, -0.5, 0, 0.5, 0.2),
            ], 0
    raise AssertionError(outline)


def _holes(g: np.random.Generator, bar: Bar, count: int) -> tuple[Hole, ...]:
    """Separate holes along the middle of a bar, or in a circle if there is no room in a row."""
    if not count:
        return ()
    x0, y0, x1, y1, r0, r1 = bar
    straight = float(np.hypot(x1 - x0, y1 - y0))
    length = straight + 0.5 * (r0 + r1)
    radius = min(0.45 * min(r0, r1), 0.26 * length / count) * g.uniform(0.85, 1.1)
    if count > 1 and (straight == 0.0 or length < 3.2 * radius * count):
        return tuple(
            (0.55 * r0 * c, 0.55 * r0 * s, 0.3 * min(r0, r1)) for c, s in circle(count, 0.4)
        )
    ends = 0.25 * (r0 + r1) / max(straight, 1e-9)
    shares = np.linspace(-0.35 * ends, 1.0 + 0.35 * ends, count) if count > 1 else np.array([0.5])
    return tuple(
        (float(x0 + t * (x1 - x0)), float(y0 + t * (y1 - y0)), float(radius)) for t in shares
    )


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
            bars = [
                (0, 0, 0, 0, r, r),
                *(
                    (0.9 * r * c, 0.9 * r * s, (r + 0.18) * c, (r + 0.18) * s, w, 0.8 * w)
                    for c, s in circle(teeth)
                ),
            ]
            holes = [(0, 0, bore)]
        case "flange":
            r = g.uniform(0.75, 0.9)
            bars = [(0, 0, 0, 0, r, r)]
            holes = [
                (0, 0, 0.3 * r),
                *((0.72 * r * c, 0.72 * r * s, 0.13 * r) for c, s in circle(n + 1, 0.3)),
            ]
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
            holes = [(half, 0.0, 0.35 * w), (-half, 0.0, 0.35 * w), (0.0, 0.0, 0.35 * w)][
                : max(n - 1, 1)
            ]
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
            ears = [(*arc[i], arc[i][0] + 0.55, arc[i][1] * 1.1, 0.15, 0.2) for i in (0, 12)]
            bars = bars + ears
            holes = [(x + 0.55, y * 1.1, 0.09) for x, y in (arc[0], arc[12])][: max(n - 2, 0)]
            middle = arc[6]
    plate = Plate(tuple(bars), tuple(holes), thick, loops)
    return Skeleton(
        Part(plate, "plate", children=_attached(g, extra, kind, middle, holes, thick)), 0
    )


def _attached(
    g: np.random.Generator,
    extra: str,
    kind: str,
    middle: tuple[float, float],
    holes: list[Hole],
    thick: float,
) -> tuple[Part, ...]:
    """The attachment of a plate, around or beside its first hole: a collar, a shaft, an ear, or pins."""
    x, y = (holes[0][0], holes[0][1]) if holes else middle
    bore = holes[0][2] if holes else 0.0
    seat: Vector = (x, y, 0.0)
    match extra:
        case "plain":
            return ()
        case "collar":
            high = g.uniform(0.35, 0.8)
            if not bore:
                return (Part(Prism(24, 0.2, high, 0.06), "collar", at=seat, lift=0.5 * high),)
            wall = max(0.6 * bore, 0.13)
            tube = Shell(((bore + 0.5 * wall, 0.0), (bore + 0.5 * wall, high)), wall)
            return (Part(_Sleeve(tube), "collar", at=seat),)
        case "shaft":
            high = g.uniform(0.7, 1.2)
            rod = Cone(high, 0.14, g.uniform(0.11, 0.14))
            spot = (x + (1.45 * bore + 0.1 if bore else 0.0), y, 0.0)
            return (Part(rod, "shaft", at=spot),)
        case "ear":
            ring = Ring(g.uniform(0.24, 0.32), 0.11)
            spot = (x - (1.3 * bore + 0.12 if bore else 0.0), y, 0.0)
            return (Part(ring, "ear", at=spot, turn=turned("z", 90.0), lift=0.5 * thick + 0.2),)
        case "pins":
            pin = Cone(g.uniform(0.35, 0.6), 0.11, 0.1)
            reach = 1.45 * bore + 0.12 if bore else 0.2
            return tuple(
                Part(pin, "pin", at=(x + reach * c, y + reach * s, 0.0)) for c, s in circle(2, 0.5)
            )
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
