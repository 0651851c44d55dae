"""Plain numbers against closed forms."""

import math

import numpy as np
import pytest
import trimesh

from igps.mesh.mesh import Mesh
from igps.signature.measures import local_thickness, measures

ROTATION = trimesh.transformations.euler_matrix(0.4, 1.1, -0.7)[:3, :3]


def ball(*semi_axes):
    sphere = trimesh.creation.icosphere(subdivisions=4)
    return Mesh(sphere.vertices * semi_axes, sphere.faces)


def rod(length, radius):
    capsule = trimesh.creation.capsule(
        height=length,
        radius=radius,
        count=[48, 48],
    )
    return Mesh(capsule.vertices, capsule.faces)


def torus(major, minor):
    ring = trimesh.creation.torus(major, minor, major_sections=96, minor_sections=48)
    return Mesh(ring.vertices, ring.faces)


def of_ball(r):
    return {
        "volume": 4 / 3 * math.pi * r**3,
        "area": 4 * math.pi * r**2,
        "surface_volume_ratio": 3 / r,
        "sphericity": 1.0,
        "major_axis_length": 4 * r / math.sqrt(5),
        "least_axis_length": 4 * r / math.sqrt(5),
        "elongation": 1.0,
        "flatness": 1.0,
        "largest_diameter": 2 * r,
        "mean_thickness": 2 * r,
        "greatest_thickness": 2 * r,
        "extent": math.pi / 6,
        "convexity": 1.0,
        "n_pieces": 1.0,
        "euler_number": 1.0,
        "mean_curvature": 1 / r,
        "total_curvature": 4 * math.pi * r,
    }


def of_ellipsoid(a, b, c):
    """The area and the integral of the mean curvature by sums over a fine grid of the parameters."""
    u, v = np.meshgrid(
        np.linspace(0, np.pi, 2001),
        np.linspace(0, 2 * np.pi, 2001),
        indexing="ij",
    )
    x = np.sin(u) * np.cos(v)
    y = np.sin(u) * np.sin(v)
    z = np.cos(u)
    element = np.sin(u) * np.sqrt((b * c * x) ** 2 + (a * c * y) ** 2 + (a * b * z) ** 2)
    squares = (x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2
    position = (a * x) ** 2 + (b * y) ** 2 + (c * z) ** 2
    curvature = (a**2 + b**2 + c**2 - position) / (2 * (a * b * c) ** 2 * squares**1.5)
    step = np.pi**2 * 2 / 2000**2
    return {
        "volume": 4 / 3 * math.pi * a * b * c,
        "area": element.sum() * step,
        "major_axis_length": 4 * a / math.sqrt(5),
        "minor_axis_length": 4 * b / math.sqrt(5),
        "least_axis_length": 4 * c / math.sqrt(5),
        "elongation": b / a,
        "flatness": c / a,
        "largest_diameter": 2 * a,
        "greatest_thickness": 2 * c,
        "extent": math.pi / 6,
        "convexity": 1.0,
        "total_curvature": (curvature * element).sum() * step,
    }


def of_rod(length, r):
    volume = math.pi * r**2 * length + 4 / 3 * math.pi * r**3
    return {
        "volume": volume,
        "area": 2 * math.pi * r * length + 4 * math.pi * r**2,
        "largest_diameter": length + 2 * r,
        "mean_thickness": 2 * r,
        "greatest_thickness": 2 * r,
        "extent": volume / ((length + 2 * r) * 4 * r**2),
        "convexity": 1.0,
        "euler_number": 1.0,
        "total_curvature": math.pi * length + 4 * math.pi * r,
    }


def of_torus(major, minor):
    volume = 2 * math.pi**2 * major * minor**2
    hull = volume / 2 + math.pi * major**2 * 2 * minor + 4 / 3 * math.pi * minor**3 / 2
    return {
        "volume": volume,
        "area": 4 * math.pi**2 * major * minor,
        "major_axis_length": 4 * math.sqrt(major**2 / 2 + 3 / 8 * minor**2),
        "least_axis_length": 2 * minor,
        "largest_diameter": 2 * (major + minor),
        "mean_thickness": 2 * minor,
        "greatest_thickness": 2 * minor,
        "extent": volume / (4 * (major + minor) ** 2 * 2 * minor),
        "euler_number": 0.0,
        "total_curvature": 2 * math.pi**2 * major,
    } | {"hull": hull}


CLOSED_FORMS = {
    "ball": (ball(1.5, 1.5, 1.5), of_ball(1.5)),
    "ellipsoid": (ball(3, 2, 1), of_ellipsoid(3, 2, 1)),
    "rod": (rod(4, 0.5), of_rod(4, 0.5)),
    "torus": (torus(2, 0.5), of_torus(2, 0.5)),
}


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_measures_of_a_turned_body_are_those_of_closed_forms(name):
    mesh, expected = CLOSED_FORMS[name]
    moved = Mesh(
        mesh.vertices @ ROTATION.T + [5, -3, 2],
        mesh.faces,
    )
    found = measures(moved)
    for measure in expected.keys() - {"hull"}:
        assert found[measure] == pytest.approx(expected[measure], rel=0.01), measure


def test_no_ball_leaves_the_body_from_a_point_just_below_a_fine_surface() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=5)
    points = (1 - 1e-7) * sphere.triangles_center[::50]
    found = local_thickness(Mesh(sphere.vertices, sphere.faces), points)
    assert 0 < found.min() <= found.max() < 2.01


def test_thickness_of_a_box_falls_towards_its_edges_as_its_closed_form():
    sides = np.array([2, 1.2, 0.7])
    box = trimesh.creation.box(sides)
    found = measures(Mesh(box.vertices @ ROTATION.T, box.faces))
    # A ball of radius r contains a point if the box of the centres of all such balls is within r of it
    depths = np.random.default_rng(0).random((20_000, 3)) * sides / 2
    low = np.zeros(len(depths))
    high = np.full(len(depths), sides.min() / 2)
    for _ in range(30):
        r = (low + high) / 2
        to_centres = np.linalg.norm(
            np.maximum(r[:, None] - depths, 0),
            axis=1,
        )
        low = np.where(to_centres <= r, r, low)
        high = np.where(to_centres <= r, high, r)
    assert found["mean_thickness"] == pytest.approx(2 * low.mean(), rel=0.015)
    assert found["greatest_thickness"] == pytest.approx(0.7, rel=0.01)


def test_the_thickness_at_a_single_point_is_that_of_its_ball():
    found = local_thickness(
        ball(1.5, 1.5, 1.5),
        np.zeros((1, 3)),
    )
    assert found == pytest.approx([3.0], rel=0.01)
