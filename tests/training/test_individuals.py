"""Individuals of generated bodies differ by as much as they say, in shape, and are bodies themselves."""

import itertools

import numpy as np
import pytest
import trimesh
from numpy.linalg import norm
from training.shapes import GradedShapes, body_of, individual_of
from training.shapes.individuals import SHARES

N_INDIVIDUALS = 3


@pytest.fixture(scope="module")
def shapes():
    return GradedShapes(
        2,
        1,
        2,
        seed=3,
        n_vertices=(1500, 1800),
        n_individuals=N_INDIVIDUALS,
    )


def test_individuals_are_changed_by_a_hundredth_to_a_twentieth_of_the_root_of_the_area(shapes):
    """On a grid of their own; and no motion and scale, found by trimesh, takes the change back."""
    for number in range(2):
        body = shapes._body(number, 0)
        vertices, faces = body.surface(3000, np.eye(3))
        before = body.warp(vertices)
        size = trimesh.Trimesh(before, faces, process=False).area ** 0.5
        found = []
        for one in range(N_INDIVIDUALS):
            after = shapes._individual(number, 0, one).warp(vertices)
            found.append(after)
            step = norm(after - before, axis=1).max() / size
            assert SHARES[0] * 0.95 < step < SHARES[1] * 1.05
            _, aligned, _ = trimesh.registration.procrustes(after, before, reflection=False)
            left = norm(aligned - before, axis=1).max() / size
            assert 0.7 * step < left < 1.3 * step
        for one, other in itertools.combinations(found, 2):
            between = norm(one - other, axis=1).max() / size
            assert SHARES[0] * 0.5 < between < 2.1 * SHARES[1]


def test_poses_of_individuals_are_bodies_that_names_tell_apart(shapes):
    assert len(shapes) == 2 * N_INDIVIDUALS * 2 == len(set(shapes.names)) == len(shapes.labels)
    for index in (3, 11):
        made = shapes[index]
        surface = trimesh.Trimesh(made.vertices, made.faces, process=False)
        assert surface.is_watertight
        assert surface.volume > 0
        assert 1 - surface.euler_number // 2 == made.genus
        assert made.name == shapes.names[index]
        assert made.body == body_of(made.name)
        assert shapes.labels[index] == made.label == made.name.split("/")[0]
    first, second = shapes.class_names
    individuals = [individual_of(name) for name in shapes.names[::2]]
    assert individuals[:3] == [f"{first}/00/00", f"{first}/00/01", f"{first}/00/02"]
    assert individuals[3:] == [f"{second}/00/00", f"{second}/00/01", f"{second}/00/02"]
    assert len({body_of(name) for name in shapes.names}) == 2
    # Whatever else there is
    more = GradedShapes(3, 2, 3, seed=3, n_vertices=(1500, 1800), n_individuals=5)[7]
    assert more.name == shapes.names[5]
    assert np.array_equal(shapes[5].vertices, more.vertices)


def test_without_individuals_names_are_class_body_and_pose():
    plain = GradedShapes(
        1,
        1,
        1,
        seed=3,
        n_vertices=(1500, 1800),
    )
    assert plain.names == [f"{plain.class_names[0]}/00/00"]
    assert individual_of(plain.names[0]) == body_of(plain.names[0]) == f"{plain.class_names[0]}/00"
