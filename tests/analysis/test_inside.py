"""Where inside a signal lies: against closed forms in a ball, and against loops over samples."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from igps.analysis.inside import (
    OF_CLASS,
    brightest,
    column_names,
    has_unit,
    inside_numbers,
)
from igps.analysis.inside_collection import inside_config
from igps.mesh.mesh import Mesh
from igps.signature.signature import Samples, Signature, SignatureConfig, compute_signature

RANDOM = np.random.default_rng(0)
P, K = 300, 6


def with_values(signature, **values):
    return replace(signature, interior=signature.interior.with_attributes(values))


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    config = inside_config(SignatureConfig(n_surface_samples=50))
    return compute_signature(Mesh(mesh.vertices, mesh.faces), config)


@pytest.fixture(scope="module")
def made():
    """Samples that belong to no mesh, whose numbers can be counted by loops."""
    points = RANDOM.normal(size=(P, 3))
    functions = RANDOM.normal(size=(P, K)).astype(np.float32)
    values = {
        "depth": RANDOM.uniform(size=P).astype(np.float32),
        "ct": RANDOM.gamma(2.0, size=P).astype(np.float32),
        "pet": RANDOM.normal(size=P).astype(np.float32),
    }
    samples = Samples(points, functions, values)
    eigenvalues = np.array([1.0, 1.5, 1.52, 4.0, 7.0, 9.0])
    return Signature(eigenvalues, samples, samples, 1.0, 1.0, SignatureConfig(n_eigenpairs=K))


def test_names_are_those_of_the_numbers(made):
    names = column_names(["ct", "pet"])
    assert list(inside_numbers(made, ["ct", "pet"])) == names
    assert len(set(names)) == len(names)
    assert "ct.core.mean" in names


def test_radius_in_a_ball_has_the_means_of_its_closed_form(ball):
    radius = np.linalg.norm(ball.interior.points, axis=1)
    numbers = inside_numbers(with_values(ball, r=radius), ["r"])

    def mean(low, high):
        """The mean radius between two shares of the volume."""
        return 0.75 * (high ** (4 / 3) - low ** (4 / 3)) / (high - low)

    third = 1 / 3
    outer = 2 / 3
    for names, low, high in (
        (("deep", "core"), 0, third),
        (("mantle", "middle"), third, outer),
        (("rim", "ends"), outer, 1),
    ):
        for name in names:  # in a ball, the potential grows with the radius
            assert numbers[f"r.{name}.mean"] == pytest.approx(mean(low, high), abs=0.01)
    assert numbers["r.rim.bright"] == pytest.approx(1)
    assert numbers["r.axis1.correlation"] < 0.05
    assert numbers["r.axis1.outward"] > 0.99


def test_height_in_a_ball_lies_along_its_first_axis_however_it_is_turned(ball):
    for direction in np.eye(3)[1:]:
        height = ball.interior.points @ direction
        numbers = inside_numbers(with_values(ball, h=height), ["h"])
        assert numbers["h.axis1.correlation"] == pytest.approx(1, abs=1e-3)
        assert abs(numbers["h.rim.contrast"]) < 0.05


def test_neither_signs_nor_bases_of_multiplets_matter(made):
    functions = made.interior.eigenfunctions.copy()
    functions[:, [0, 3, 5]] *= -1
    turn = np.array(
        [
            [np.cos(1), -np.sin(1)],
            [np.sin(1), np.cos(1)],
        ]
    )
    functions[:, 1:3] = functions[:, 1:3] @ turn
    level = np.array([1.0, 1.5, 1.5, 4.0, 7.0, 9.0])  # an exact multiplet
    same = replace(made, eigenvalues=level)
    turned = replace(same, interior=replace(made.interior, eigenfunctions=functions))
    expected = inside_numbers(same, ["ct", "pet"])
    assert inside_numbers(turned, ["ct", "pet"]) == pytest.approx(expected, abs=1e-4)


def test_other_units_change_only_the_numbers_that_have_a_unit(made):
    ct = made.interior.attributes["ct"].astype(np.float64)
    numbers = inside_numbers(made, ["ct"])
    changed = inside_numbers(with_values(made, ct=3 * ct - 1000), ["ct"])
    for name, number in numbers.items():
        is_spread = name.endswith(".sd")
        expected = 3 * number - 1000 * (not is_spread) if has_unit(name) else number
        assert changed[name] == pytest.approx(expected, rel=1e-3, abs=1e-3), name


def test_classes_are_counted_by_a_loop(made):
    ct = made.interior.attributes["ct"].astype(np.float64)
    embedded = made.interior.eigenfunctions / np.sqrt(made.eigenvalues)
    numbers = inside_numbers(made, ["ct"])
    order_of = {
        ("core", "middle", "ends"): np.argsort((embedded**2).sum(axis=1)),
        ("rim", "mantle", "deep"): np.argsort(made.interior.attributes["depth"]),
    }
    bright = set(np.argsort(ct)[-P // 10 :].tolist())
    for names, order in order_of.items():
        for name, members in zip(names, np.split(order, 3), strict=True):
            others = np.setdiff1d(np.arange(P), members)
            expected = {
                "mean": ct[members].mean(),
                "sd": ct[members].std(),
                "median": np.median(ct[members]),
                "q10": np.quantile(ct[members], 0.1),
                "q90": np.quantile(ct[members], 0.9),
                "contrast": (ct[members].mean() - ct[others].mean()) / ct.std(),
                "bright": len(bright & set(members.tolist())) / len(bright),
            }
            assert set(expected) == set(OF_CLASS)
            for key, number in expected.items():
                assert numbers[f"ct.{name}.{key}"] == pytest.approx(number, rel=1e-5), (name, key)


def test_variogram_and_moran_are_counted_by_a_loop(made):
    ct = made.interior.attributes["ct"].astype(np.float64)
    embedded = made.interior.eigenfunctions.astype(np.float64) / np.sqrt(made.eigenvalues)
    distance = np.linalg.norm(
        embedded[:, None] - embedded,
        axis=2,
    )
    pairs = sorted((distance[i, j], i, j) for i in range(P) for j in range(i))
    n_near = round(0.05 * len(pairs))
    n_middle = round(0.5 * len(pairs))
    numbers = inside_numbers(made, ["ct"])
    bounds = {
        "near": (0, n_near),
        "middle": (n_near, n_middle),
        "far": (n_middle, len(pairs)),
    }
    for name, (start, end) in bounds.items():
        half = np.mean([(ct[i] - ct[j]) ** 2 / 2 for _, i, j in pairs[start:end]])
        assert numbers[f"ct.variogram.{name}"] == pytest.approx(half / ct.var(), rel=1e-3)
    centred = ct - ct.mean()
    neighbours = {i: [] for i in range(P)}
    for _, i, j in pairs[:n_near]:
        neighbours[i].append(j)
        neighbours[j].append(i)
    own = [i for i in range(P) if neighbours[i]]
    above = sum(centred[i] * centred[neighbours[i]].mean() for i in own)
    below = sum(centred[i] ** 2 for i in own)
    assert numbers["ct.moran"] == pytest.approx(above / below, abs=2e-3)


def test_two_attributes_are_compared_at_the_same_samples(made):
    ct = made.interior.attributes["ct"].astype(np.float64)
    same = inside_numbers(
        with_values(made, twice=2 * ct, minus=-(ct**3)),
        ["ct", "twice", "minus"],
    )
    assert same["ct_and_twice.correlation"] == pytest.approx(1)
    assert same["ct_and_twice.overlap"] == pytest.approx(1)
    assert same["ct_and_twice.information"] == pytest.approx(2, abs=1e-3)  # bits, of four quarters
    assert same["ct_and_minus.rank_correlation"] == pytest.approx(-1)
    assert same["ct_and_minus.overlap"] == 0
    unrelated = inside_numbers(made, ["ct", "pet"])
    assert abs(unrelated["ct_and_pet.correlation"]) < 0.2
    assert unrelated["ct_and_pet.information"] < 0.1


def test_a_constant_has_no_numbers_that_compare_its_values(made):
    numbers = inside_numbers(
        with_values(made, ct=np.full(P, 7.0)),
        ["ct", "pet"],
    )
    for name, number in numbers.items():
        if name.startswith("pet"):
            assert np.isfinite(number), name
        elif has_unit(name):
            assert number == (0 if name.endswith(".sd") else 7), name
        else:
            assert np.isnan(number), name


def test_equal_values_share_the_brightest_tenth():
    assert_allclose(brightest(np.arange(20.0)), [0] * 18 + [1, 1])
    assert_allclose(brightest(np.array([1.0] * 5 + [0] * 15)), [0.4] * 5 + [0] * 15)
    assert_allclose(
        brightest(np.array([2.0] + [1] * 4 + [0] * 15))[:5],
        [1] + [0.25] * 4,
    )


def test_a_missing_attribute_and_one_of_several_values_are_refused(made):
    with pytest.raises(ValueError, match="expected 'mr', got ct, depth, pet"):
        inside_numbers(made, ["mr"])
    with pytest.raises(ValueError, match="got 3"):
        inside_numbers(
            with_values(made, colour=np.ones((P, 3))),
            ["colour"],
        )
