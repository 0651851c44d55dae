"""Surfaces laid onto each other: what a known motion leaves, and closed forms of how far apart they are."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.linalg import norm
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from igps.duplicates._alignment import (
    SurfaceSamples,
    TriangleSurface,
    changed_share,
    offset_in_place,
    surface_distance,
)

Array = NDArray[np.float64]


def even_directions(n, seed=0):
    """(n, 3) spread evenly over the sphere by the golden angle, turned at random."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    ring = np.sqrt(1 - z**2)
    directions = np.column_stack(
        [
            ring * np.cos(angle),
            ring * np.sin(angle),
            z,
        ]
    )
    return Rotation.random(random_state=seed).apply(directions)


def ellipsoid(axes, n=1500, seed=0):
    """Samples of an ellipsoid, denser where it is pointed."""
    directions = even_directions(n, seed)
    normals = directions / axes
    normals /= norm(normals, axis=1, keepdims=True)
    return SurfaceSamples.of(directions * axes, normals, 1.0)


def bumpy(amplitude, n=2000, seed=0):
    """The surface r = 1 + a·P₄(cos θ), P₄ of Legendre, with the normals of its level set."""
    directions = even_directions(n, seed)
    z = directions[:, 2]
    value = (35 * z**4 - 30 * z**2 + 3) / 8
    slope = (140 * z**3 - 60 * z) / 8
    radius = 1 + amplitude * value
    # ∇(|x| − a·P₄(z/|x|)) = u − a·P₄′·(e_z − z·u)/r
    upward = np.eye(3)[2] - z[:, None] * directions
    normals = directions - amplitude * (slope / radius)[:, None] * upward
    normals /= norm(normals, axis=1, keepdims=True)
    return SurfaceSamples.of(
        radius[:, None] * directions,
        normals,
        4 * np.pi,
    )


def moved(samples, seed, mirror, scale):
    turn = Rotation.random(random_state=seed).as_matrix() * (-1 if mirror else 1)
    shuffled = np.random.default_rng(seed).permutation(len(samples.points))
    points = (scale * samples.points @ turn.T + [3.0, -1.0, 2.0])[shuffled]
    return SurfaceSamples.of(
        points,
        (samples.normals @ turn.T)[shuffled],
        scale**2,
    )


@pytest.mark.parametrize(
    ("seed", "mirror", "scale"),
    [(1, False, 1.0), (2, True, 7.0)],
)
def test_a_motion_a_mirror_and_a_scale_leave_nothing(seed, mirror, scale):
    """Of a body without any symmetry: two ellipsoids beside each other."""
    one = ellipsoid((1.0, 0.6, 0.4))
    other = ellipsoid((0.5, 0.3, 0.7), 500, seed=4)
    beside = other.points + np.array([0.9, 0.5, 0.3])
    points = np.concatenate([one.points, beside])
    normals = np.concatenate([one.normals, other.normals])
    body = SurfaceSamples.of(points, normals, 1.0)
    again = moved(body, seed, mirror, scale)
    assert_allclose(again.extents, body.extents, rtol=1e-9)
    assert surface_distance(body, again) < 1e-5


def test_a_ball_and_a_bumpy_one_are_as_far_apart_as_the_bumps_are_high():
    """P₄ is orthogonal to all that a shift or a scale does to a ball, so that its mean square, 1/9, stays."""
    expected = 0.1 / 3 / np.sqrt(4 * np.pi)
    found = surface_distance(bumpy(0.0), bumpy(0.1, seed=5))
    assert found == pytest.approx(expected, rel=0.15)


def test_a_rotated_body_with_equal_principal_axes_is_aligned():
    """All principal moments are equal, so that the principal axes do not determine the rotation."""
    body = bumpy(0.15)
    again = moved(body, 7, mirror=True, scale=2.0)
    assert surface_distance(body, again) < 0.1 * surface_distance(body, bumpy(0.0, seed=3))


def rough(amplitude, n, seed):
    """Points and normals of an ellipsoid that is ruffled along one axis, by waves much shorter than a patch."""
    axes = np.array([1.0, 0.7, 0.45])
    wave = 0.02
    directions = even_directions(n, seed)
    smooth = directions / axes
    steepness = norm(smooth, axis=1, keepdims=True)
    phase = 2 * np.pi * (directions * axes)[:, :1] / wave
    points = directions * axes + amplitude * np.cos(phase) * smooth / steepness
    return points, smooth / steepness


def test_fine_relief_cancels_but_another_shape_does_not():
    """Ripples within a patch of ten samples average out; their root mean square is amplitude/√2."""
    amplitude, area = 0.01, 6.1
    plain, ruffled = (
        SurfaceSamples.of(
            *rough(a, 2000, seed),
            area,
        )
        for a, seed in ((0.0, 1), (amplitude, 2))
    )
    high = amplitude / np.sqrt(2) / np.sqrt(area)
    lost = surface_distance(plain, ruffled)
    assert lost < 0.55 * high
    # The same height, all of it outward in one half of the body and inward in the other.
    shifted, normals = rough(0.0, 2000, 3)
    turned = shifted * [1, 1, 1] + 2 * high * np.sqrt(area) * normals * np.sin(3 * shifted[:, :1])
    assert surface_distance(plain, SurfaceSamples.of(turned, normals, area)) > 2 * lost


def triangles(axes, subdivisions):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(ball.vertices * axes), np.asarray(ball.faces)


def test_the_surface_itself_tells_more_than_samples():
    """Few samples of a curved surface leave their tangent planes; the surface leaves what its triangles do."""
    axes = (1.0, 0.6, 0.4)
    vertices, faces = triangles(axes, 5)
    few = [ellipsoid(axes, 300, seed) for seed in (1, 2)]
    with_surface = [
        replace(
            one,
            surface=lambda: TriangleSurface(vertices, faces),
        )
        for one in few
    ]
    assert surface_distance(*with_surface) < 0.05 * surface_distance(*few)


def test_nearest_points_of_a_surface():
    """Against trimesh's loop over all triangles, and above the middle of each face, where its normal stands."""
    vertices, faces = triangles((1.0, 0.6, 0.4), 2)
    surface = TriangleSurface(vertices, faces)
    body = trimesh.Trimesh(vertices, faces, process=False)
    anywhere = np.random.default_rng(0).uniform(
        -1,
        1,
        (40, 3),
    )
    expected, _, _ = trimesh.proximity.closest_point_naive(body, anywhere)
    found, _ = surface.nearest(SurfaceSamples(anywhere, anywhere))
    assert_allclose(found, expected, atol=1e-12)
    above = body.triangles_center + 0.01 * body.face_normals
    points, normals = surface.nearest(SurfaceSamples(above, body.face_normals))
    assert_allclose(points, body.triangles_center, atol=1e-12)
    assert_allclose(normals, body.face_normals, atol=1e-9)


def test_in_place_nothing_is_moved():
    """A ball and itself moved by h along a line: h/√3, the root mean square of h·cos θ; laid onto itself, nothing."""
    vertices, faces = triangles((1.0, 1.0, 1.0), 5)
    step = np.array([0.0, 0.0, 0.02])
    ball = replace(
        ellipsoid((1.0, 1.0, 1.0)),
        surface=lambda: TriangleSurface(vertices, faces),
    )
    shifted = TriangleSurface(vertices + step, faces)
    beside = SurfaceSamples(ball.points + step, ball.normals, lambda: shifted)
    assert offset_in_place(ball, shifted) == pytest.approx(0.02 / np.sqrt(3), rel=0.03)
    assert surface_distance(ball, beside) < 1e-4


def test_distances_beyond_an_edge_are_those_to_the_edge():
    """Closed form: 0.05 from points to the nearest edge of a box; the planes of its sides are nearer."""
    box = trimesh.creation.box((1.0, 1.0, 0.1))
    x = np.linspace(-0.4, 0.4, 30)
    points = np.column_stack([x, np.full(30, 0.53), np.full(30, 0.09)])
    beyond = SurfaceSamples(
        points,
        np.tile([0.0, 0.6, 0.8], (30, 1)),
    )
    assert offset_in_place(beyond, TriangleSurface(box.vertices, box.faces)) == pytest.approx(0.05)


def test_thin_sheets_of_other_widths_are_told_apart():
    """The planes of both sheets nearly coincide, so that only distances beside the smaller sheet separate them."""

    def sheet(length, width):
        n = 40
        x, y = np.meshgrid(
            (np.arange(n) + 0.5) / n * length,
            (np.arange(n) + 0.5) / n * width,
        )
        top = np.column_stack(
            [
                x.ravel(),
                y.ravel(),
                np.full(n * n, 0.003 * length),
            ]
        )
        up = np.tile([0.0, 0.0, 1.0], (n * n, 1))
        points = np.concatenate([top, top * [1, 1, -1]])
        return SurfaceSamples.of(
            points,
            np.concatenate([up, -up]),
            2 * length * width,
        )

    same = surface_distance(sheet(2.0, 1.0), sheet(4.0, 2.0))
    assert same < 1e-5
    # At unit area, the sheets end at 0.5 and 0.61, or at 0.53 and 0.58 if scaled by a tenth. Points farther than the
    # gap of 0.044 then add at least √(0.011²/3 · 0.02 / 2), or √(0.068²/3 · 0.11 / 2) without scaling.
    assert (
        0.0006
        < surface_distance(
            sheet(2.0, 1.0),
            sheet(3.0, 1.0),
        )
        < 0.009
    )


def test_what_is_farther_than_asked_for_is_told_to_be():
    one = bumpy(0.0)
    other = bumpy(0.1, seed=5)
    far = surface_distance(one, other)
    assert far / 3 < surface_distance(one, other, max_distance=far / 3) <= far
    assert surface_distance(one, other, max_distance=1.01 * far) == far


def part(step=0.0, boss=0.0, hole=4.0, sections=32):
    """A chiral plate of 45 mm with a step, a boss, and a hole of so many segments."""
    plate = trimesh.creation.box((45, 30, 8))
    block = trimesh.creation.box((10, 8, 12))
    block.apply_translation((14, -9, 5 + step))
    stud = trimesh.creation.cylinder(3, 12, sections=sections)
    stud.apply_translation((6 + boss, 5, 6))
    drill = trimesh.creation.cylinder(hole, 40, sections=sections)
    drill.apply_translation((-12, 6, 0))
    solid = trimesh.boolean.union([plate, block, stud], engine="manifold")
    return sampled(trimesh.boolean.difference([solid, drill], engine="manifold"))


def sampled(body):
    points, faces = trimesh.sample.sample_surface(
        body,
        1500,
        seed=len(body.faces),
    )
    samples = SurfaceSamples.of(points, body.face_normals[faces], body.area)
    vertices = (body.vertices - points.mean(axis=0)) / body.area**0.5
    surface = TriangleSurface(
        vertices,
        np.asarray(body.faces, dtype=np.int64),
    )
    return replace(samples, surface=lambda: surface)


@pytest.mark.parametrize(
    "change",
    [{"step": 0.45}, {"boss": 0.45}, {"hole": 4.2}],
    ids=["a higher step", "a boss moved", "a wider hole"],
)
def test_a_changed_part_is_told_from_another_level_of_detail(change):
    """One percent of the length, in a few places. Fewer segments lie as far apart, but on round places alone."""
    assert changed_share(part(), part(**change), 5e-4) > 0.015
    for n_segments in (8, 16):
        assert changed_share(part(), part(sections=n_segments), 5e-4) < 0.005


def test_only_a_reflection_lays_a_chiral_part_onto_its_mirror_image():
    one = part()
    assert one.surface is not None
    surface = one.surface()
    mirror = np.array([-1.0, 1.0, 1.0])
    mirrored = TriangleSurface(
        surface._vertices * mirror,
        np.ascontiguousarray(surface._faces[:, ::-1]),
    )
    other = SurfaceSamples.of(one.points * mirror, one.normals * mirror, 1.0)
    other = replace(other, surface=lambda: mirrored)
    apart = {side: surface_distance(one, other, side=side) for side in ("same", "mirrored")}
    assert apart["mirrored"] < 1e-4
    assert apart["same"] > 100 * apart["mirrored"]
