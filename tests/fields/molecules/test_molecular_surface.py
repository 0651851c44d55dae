"""Surfaces of molecules against closed forms and brute force."""

import numpy as np
import pytest
from numpy.linalg import norm
from scipy.spatial import cKDTree
from tests.fields.molecules.balls_in_contact import (
    ball,
    excluded_of_ring,
    excluded_of_two,
    molecule,
    union_of_two,
)

from igps.fields.molecules.molecular_surface import molecular_surface
from igps.mesh.errors import MeshError

PROBE = 1.4
# A direction along no axis of the grid.
ASLANT = np.array([2.0, -1.0, 1.5]) / norm([2.0, -1.0, 1.5])


def chain(n, seed=0):
    """A random walk of steps of 1.5 Å."""
    steps = np.random.default_rng(seed).normal(size=(n, 3))
    return np.cumsum(
        1.5 * steps / norm(steps, axis=1, keepdims=True),
        axis=0,
    )


@pytest.mark.parametrize(
    ("kind", "added", "radius"),
    [
        ("excluded", 0.0, 1.5),
        ("accessible", PROBE, 1.8),
        ("van_der_waals", 0.0, 3.0),
    ],
)
def test_a_ball_has_its_area_and_volume(kind, added, radius):
    mesh = molecular_surface(
        molecule([0.1, 0.2, 0.3], radius),
        kind,
        spacing=0.5,
    )
    assert (mesh.area, mesh.volume) == pytest.approx(ball(radius + added), rel=0.01)
    away = norm(mesh.vertices - [0.1, 0.2, 0.3], axis=1)
    np.testing.assert_allclose(away, radius + added, rtol=0.02)
    assert mesh.unit == "Å"


@pytest.mark.parametrize("apart", [0.8, 2.5, 3.6, 4.6])
def test_the_excluded_surface_of_two_balls_is_two_caps_and_a_saddle(apart):
    two = molecule(
        [0.3 * ASLANT, (0.3 + apart) * ASLANT],
        (1.9, 1.5),
    )
    mesh = molecular_surface(two, spacing=0.5)
    expected = excluded_of_two(1.9, 1.5, apart, PROBE)
    assert (mesh.area, mesh.volume) == pytest.approx(expected, rel=0.01)
    assert mesh.genus == 0


@pytest.mark.parametrize(
    "radii",
    [(1.7, 1.7), (1.9, 1.5)],
)
@pytest.mark.parametrize("apart", [5.2, 5.5, 6.2])
def test_where_the_neck_is_too_thin_for_the_grid_or_none_a_thread_adds_hardly_any_area(
    radii, apart
):
    mesh = molecular_surface(
        molecule([0.3 * ASLANT, (0.3 + apart) * ASLANT], radii),
        spacing=0.5,
    )
    closed_form = np.add(ball(radii[0]), ball(radii[1]))
    if apart < 6:
        closed_form = excluded_of_two(*radii, apart, PROBE)
    assert (mesh.area, mesh.volume) == pytest.approx(tuple(closed_form), rel=0.01)
    assert mesh.genus == 0


def test_far_balls_are_joined_by_threads():
    radii = [1.7, 2.5, 2.0]
    apart = molecule(
        [0 * ASLANT, 9 * ASLANT, [20, 0, 0]],
        radii,
    )
    whole = molecular_surface(apart, spacing=0.5, max_vertices=600)
    expected = np.sum([ball(r) for r in radii], axis=0).tolist()
    assert [whole.area, whole.volume] == pytest.approx(expected, rel=0.01)
    assert whole.genus == 0
    assert len(whole.vertices) < 620
    assert any("joined 3 pieces by threads" in note for note in whole.notes)


@pytest.mark.parametrize("apart", [2.0, 5.0])
def test_the_accessible_surface_of_two_balls_is_that_of_larger_ones(apart):
    two = molecule([0 * ASLANT, apart * ASLANT], [1.9, 1.5])
    mesh = molecular_surface(two, "accessible", spacing=0.5)
    expected = union_of_two(1.9 + PROBE, 1.5 + PROBE, apart)
    assert (mesh.area, mesh.volume) == pytest.approx(expected, rel=0.01)


def test_a_speck_is_left_out_with_a_note_but_not_what_all_is_made_of(monkeypatch):
    found = molecular_surface(
        molecule(
            [[0, 0, 0], [14, 0, 0]],
            [8.0, 0.9],
        )
    )
    assert "left out 1 speck" in found.notes
    expected = pytest.approx(
        4 / 3 * np.pi * 8**3,
        rel=0.01,
    )
    assert found.volume == expected
    # As if there were some hundreds
    monkeypatch.setattr("igps.fields.molecules.molecular_surface.SPECK_VOLUME", 0.2)
    found = molecular_surface(
        molecule([[9.0 * i, 0, 0] for i in range(6)], [1.7] * 6),
        spacing=0.5,
    )
    expected = pytest.approx(
        6 * 4 / 3 * np.pi * 1.7**3,
        rel=0.02,
    )
    assert found.volume == expected


def test_a_ring_of_balls_has_a_hole():
    n, apart = 8, 4.2
    mesh = molecular_surface(
        molecule(_ring(n, apart), np.full(n, 1.7)),
        spacing=0.5,
    )
    expected = excluded_of_ring(n, 1.7, apart, PROBE)
    assert (mesh.area, mesh.volume) == pytest.approx(expected, rel=0.01)
    assert mesh.genus == 1


def _ring(n, apart):
    angle = 2 * np.pi * np.arange(n) / n
    across = np.cross(ASLANT, [0, 0, 1.0])
    across /= norm(across)
    other = np.cross(ASLANT, across)
    radius = apart / (2 * np.sin(np.pi / n))
    return radius * (np.outer(np.cos(angle), across) + np.outer(np.sin(angle), other))


def spiral(n):
    """Points spread evenly over the unit sphere."""
    i = np.arange(n)
    up = 1 - (2 * i + 1) / n
    turn = np.pi * (1 + 5**0.5) * i
    around = np.sqrt(1 - up**2)
    return np.stack(
        [around * np.cos(turn), around * np.sin(turn), up],
        axis=1,
    )


def test_the_excluded_surface_is_a_probe_away_from_where_a_probe_may_be():
    """By brute force: places of the probe on fine spheres around all atoms."""
    at = chain(40)
    mesh = molecular_surface(
        molecule(at, np.full(40, 1.7)),
        spacing=0.4,
        max_vertices=None,
    )
    places = (at[:, None] + (1.7 + PROBE) * spiral(6000)).reshape(-1, 3)
    free = cKDTree(at).query(places)[0] > 1.7 + PROBE - 1e-6
    distance = cKDTree(places[free]).query(mesh.vertices)[0]
    # Places are 0.14 apart; vertices stand out where the surface is bent, so that faces do not cut corners.
    assert np.quantile(np.abs(distance - PROBE), 0.99) < 0.08
    assert abs(np.mean(distance) - PROBE) < 0.02


def test_no_probe_is_the_surface_of_the_balls():
    two = molecule([0 * ASLANT, 2 * ASLANT], [1.7, 1.7])
    without = molecular_surface(two, probe=0, spacing=0.5)
    expected = molecular_surface(two, "van_der_waals", spacing=0.5)
    np.testing.assert_array_equal(without.vertices, expected.vertices)
    expected = pytest.approx(
        union_of_two(1.7, 1.7, 2.0)[1],
        rel=0.01,
    )
    assert without.volume == expected


def test_swallowed_and_doubled_balls_change_nothing():
    at = chain(30)
    once = molecular_surface(molecule(at, np.full(30, 1.7)))
    radii = np.r_[np.full(60, 1.7), np.zeros(15), np.full(15, 0.4)]
    more = molecular_surface(molecule(np.r_[at, at, at], radii))
    np.testing.assert_allclose(more.vertices, once.vertices, atol=1e-9)


def test_hollows_are_filled():
    mesh = molecular_surface(
        molecule(
            8 * spiral(120),
            np.full(120, 1.7),
        )
    )
    assert mesh.genus == 0
    assert mesh.volume > ball(8.0)[1]
    assert any("1 hollow inside: filled" in note for note in mesh.notes)


def test_a_simplified_surface_keeps_the_volume():
    body = molecule(chain(200), np.full(200, 1.7))
    whole = molecular_surface(body, max_vertices=None)
    fewer = molecular_surface(body, max_vertices=1500)
    assert len(whole.vertices) > 2000
    assert len(fewer.vertices) == 1500
    assert fewer.volume == pytest.approx(whole.volume, rel=0.01)


def test_a_simplified_surface_has_the_area_of_the_fine_one():
    body = molecule(chain(60), np.full(60, 1.7))
    fine = molecular_surface(body, max_vertices=None)
    coarse = molecular_surface(body, max_vertices=60)
    assert coarse.area == fine.area
    triangles = coarse.vertices[coarse.faces]
    sides = triangles[:, 1:] - triangles[:, :1]
    own = norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2
    assert abs(own / fine.area - 1) > 0.01


def test_the_accessible_area_is_that_of_points_which_no_other_ball_covers():
    at = chain(40, seed=1)
    found = molecular_surface(molecule(at, np.full(40, 1.7)), "accessible").area
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    directions /= norm(directions, axis=1, keepdims=True)
    n_free = 0
    for i, centre in enumerate(at):
        away = centre + 3.1 * directions[:, None] - np.delete(at, i, axis=0)
        distance = norm(away, axis=2)
        n_free += int((distance > 3.1).all(axis=1).sum())
    expected = pytest.approx(
        4 * np.pi * 3.1**2 * n_free / 4000,
        rel=0.01,
    )
    assert found == expected


def test_stray_atoms_are_named_with_the_remedy():
    far = molecule(
        [[0, 0, 0], [9999, 9999, 9999]],
        [1.7, 1.7],
    )
    words = "balls: expected a grid of .* Raise the spacing, or remove stray atoms"
    with pytest.raises(MeshError, match=words):
        molecular_surface(far)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"kind": "solvent"}, "kind: expected one of excluded"),
        ({"probe": -1.0}, "probe: expected"),
        ({"probe": float("nan")}, "probe: expected"),
        ({"spacing": 0.0}, "spacing: expected"),
    ],
)
def test_wrong_parameters_are_named(wrong, said):
    with pytest.raises(ValueError, match=said):
        molecular_surface(molecule([0, 0, 0], 1.7), **wrong)
