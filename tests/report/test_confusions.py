"""The worst confusions, against a loop over the matrix of distances."""

import numpy as np
import pytest
import torch
from pages import LABELS, NAMES, comparison_folder, distances_of, retrieval_folder, worst_by_a_loop

from igps.report.page_data import data_of
from igps.report.results import Results, System, read_results


def random_collection(n, n_classes, spread, seed):
    """Whole numbers as distances, so that many are equal, between shapes that lie nearer to those of their class."""
    rng = np.random.default_rng(seed)
    codes = rng.integers(n_classes, size=n)
    points = 10 * codes[:, None] * [1.0, 0.3] + rng.normal(0, spread, (n, 2))
    distances = np.rint(np.linalg.norm(points[:, None] - points[None], axis=2)).astype(np.float32)
    return distances, tuple(f"class {code}" for code in codes)


def worst_of(distances, labels, names):
    system = System("any", names, labels, torch.from_numpy(distances))
    return data_of(Results("retrieve", names, labels, (system,)), {})["systems"][0]["worst"]


@pytest.mark.parametrize("spread", [1.0, 4.0, 8.0, 30.0])
@pytest.mark.parametrize(
    ("n", "n_classes"),
    [(12, 3), (60, 5), (90, 40)],
)
def test_the_worst_are_those_of_a_loop(n, n_classes, spread):
    """From almost nothing wrong to chance; names in an order of their own; of 40 classes some have one shape."""
    distances, labels = random_collection(n, n_classes, spread, seed=n)
    names = tuple(f"{number:03d}.off" for number in np.random.default_rng(1).permutation(n))
    assert worst_of(distances, labels, names) == worst_by_a_loop(distances, labels, names)


def test_a_wrong_nearest_comes_before_a_right_one():
    """By hand: on a line, b is far from its class; the a's are wrong only where b takes a place in their first tier."""
    names = ("a0", "a1", "a2", "b0", "b1")
    labels = ("a", "a", "a", "b", "b")
    places = np.array([0.0, 1.0, 5.0, 2.5, 9.0])
    found = worst_of(
        np.abs(places[:, None] - places[None]).astype(np.float32),
        labels,
        names,
    )
    # b0 finds a1, a0 and a2 (2.5 both, in this order), then b1; b1 finds a2 (4), then b0; a2 finds b0, then a1.
    assert found == [
        {"query": 3, "rank": 4, "wrong": [1, 2, 3]},
        {"query": 4, "rank": 2, "wrong": [1]},
        {"query": 2, "rank": 2, "wrong": [1]},
        {"query": 0, "rank": 1, "wrong": [2]},
        {"query": 1, "rank": 1, "wrong": [2]},
    ]


def test_of_many_the_twenty_worst_and_of_right_ones_none():
    distances, labels = random_collection(60, 5, 30.0, seed=2)
    assert len(worst_of(distances, labels, tuple(map(str, range(60))))) == 20
    together = np.array(
        [[0.0 if one == other else 1.0 for other in labels] for one in labels], dtype=np.float32
    )
    assert worst_of(together, labels, tuple(map(str, range(60)))) == []


def test_each_descriptor_has_its_own(tmp_path):
    """The second does not describe the last mesh; without labels, or with classes of one, there are none."""
    systems = data_of(read_results(comparison_folder(tmp_path / "compare")), {})["systems"]
    for seed, system in enumerate(systems):
        n = len(NAMES) - seed
        expected = worst_by_a_loop(
            distances_of(seed)[:n, :n],
            LABELS[:n],
            NAMES[:n],
        )
        assert system["worst"] == expected
    assert systems[0]["worst"] != systems[1]["worst"]
    for labels in ((), NAMES):
        (system,) = data_of(read_results(retrieval_folder(tmp_path / "retrieve", labels)), {})[
            "systems"
        ]
        assert system["worst"] is None


def test_numbers_are_those_of_all_shapes():
    """Of a descriptor that does not describe the first mesh."""
    distances, labels = random_collection(12, 3, 8.0, seed=3)
    names = tuple(f"{i:02d}" for i in range(12))
    system = System(
        "any",
        names[1:],
        labels[1:],
        torch.from_numpy(distances[1:, 1:]),
    )
    (made,) = data_of(Results("compare", names, labels, (system,)), {})["systems"]
    expected = worst_by_a_loop(
        distances[1:, 1:],
        labels[1:],
        names[1:],
    )
    assert made["worst"] == [{**one, "query": one["query"] + 1} for one in expected]
