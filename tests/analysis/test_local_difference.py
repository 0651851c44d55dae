import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from igps.analysis.local_difference import local_difference, misfit, offsets
from igps.mesh.mesh import Mesh


def ball(radius, unit=None):
    body = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return Mesh(
        body.vertices + np.array([3.0, -2, 1]),
        body.faces,
        unit=unit,
        frame="RAS",
    )


def test_a_larger_ball_lies_outside_by_the_difference_of_the_radii():
    reference = ball(10.0, "mm")
    found = offsets(ball(12.0, "mm"), reference)
    assert_allclose(found, 2.0, atol=0.08)
    assert_allclose(offsets(ball(1.2, "cm"), reference), found, atol=1e-6)
    at_equal_volume = offsets(ball(12.0, "mm"), reference, keep_size=False)
    assert_allclose(at_equal_volume, 0.0, atol=0.08)
    assert misfit(found[None], reference) == pytest.approx(2 / (10 * np.sqrt(4 * np.pi)), rel=0.03)


def test_a_bump_is_found_at_its_place_on_a_turned_body():
    body = trimesh.creation.icosphere(subdivisions=4)
    body.vertices *= [30.0, 20.0, 14.0]
    reference = Mesh(body.vertices, body.faces, unit="mm", frame="RAS")
    weight = np.exp(-np.square(body.vertices - [-20.0, 10.0, 8.0]).sum(axis=1) / 50)
    pushed = body.vertices + 3 * weight[:, None] * body.vertex_normals
    turn = Rotation.from_euler("xyz", [8, -6, 10], degrees=True)
    other = Mesh(
        turn.apply(pushed) + np.array([5.0, 5, 5]),
        body.faces,
        unit="mm",
        frame="RAS",
    )
    found = offsets(other, reference)
    assert np.linalg.norm(body.vertices[found.argmax()] - body.vertices[weight.argmax()]) < 6
    assert found.max() == pytest.approx(3 * weight.max(), rel=0.25)
    assert np.abs(found[weight < 0.01]).max() < 0.5


def test_the_difference_is_the_coefficient_of_the_group_in_a_regression():
    random = np.random.default_rng(0)
    groups = np.array(["a", "b"])[random.integers(0, 2, 40)]
    age = random.normal(size=40) + (groups == "b")
    scanner = np.array(["x", "y"])[random.integers(0, 2, 40)]
    rows = random.normal(size=(40, 30)) + age[:, None] + (scanner == "x")[:, None]
    rows[groups == "b", :3] += 6.0
    found = local_difference(
        rows,
        groups,
        strata=scanner,
        covariates=age[:, None],
    )
    columns = np.column_stack([groups == "b", age, scanner == "x", np.ones(40)]).astype(float)
    coefficients = np.linalg.lstsq(columns, rows, rcond=None)[0]
    assert_allclose(found.offset, coefficients[0], rtol=1e-9)
    assert found.groups == ("a", "b")
    assert np.flatnonzero(found.is_significant).tolist() == [0, 1, 2]


def test_groups_of_nothing_differ_somewhere_in_one_of_twenty_draws():
    random = np.random.default_rng(1)
    groups = ["a"] * 10 + ["b"] * 10
    n_rejected = 0
    for seed in range(200):
        rows = random.normal(size=(20, 25))
        found = local_difference(rows, groups, n_permutations=99, seed=seed)
        n_rejected += bool(found.is_significant.any())
    assert 2 <= n_rejected <= 20  # binomial with mean 10, both ends beyond 2.5 standard deviations


def test_other_than_two_groups_are_refused():
    with pytest.raises(ValueError, match="expected two, got 3: a, b, c"):
        local_difference(np.zeros((3, 4)), ["a", "b", "c"])
