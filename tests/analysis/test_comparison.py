"""`compare`: rows, failures and distances of descriptors side by side."""

import pytest
import torch
from torch.testing import assert_close

from igps.analysis.comparison import compare
from igps.data.dataset import SignatureDataset
from igps.descriptors import descriptor
from igps.descriptors.literature.d2 import D2
from igps.retrieval import retrieval_scores
from own_descriptors import CONFIG, Broken, Height, Slow, changed, write_egg

KEYS = ["descriptor", "nn", "ft", "st", "e", "dcg", "adr", "adr_self", "map"]
KEYS += ["seconds_per_mesh", "n_models", "invariant_to"]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Three balls and three long eggs; the last ball is an egg by its height."""
    folder = tmp_path_factory.mktemp("collection")
    for label, heights in (("ball", (1.0, 1.1, 2.3)), ("egg", (2.2, 2.4, 2.6))):
        for i, height in enumerate(heights):
            write_egg(folder / "meshes" / label / f"{i}.off", height, subdivisions=2)
    return folder / "meshes"


@pytest.fixture(scope="module")
def dataset(root):
    collection = SignatureDataset(root, CONFIG, root.parent / "cache")
    assert collection.precompute(n_workers=1, progress=False) == []
    return collection


def run(dataset, *chosen, n_workers=1):
    results = list(compare(dataset, chosen, n_workers=n_workers, progress=False))
    assert [result.descriptor for result in results] == list(chosen)
    return {result.descriptor.name: result for result in results}


def test_result_is_what_heights_give(dataset):
    result = run(dataset, Height("tall"))["tall"]
    heights = torch.tensor([1.0, 1.1, 2.3, 2.2, 2.4, 2.6]) * 2
    assert result.distances is not None
    assert_close(
        result.distances,
        (heights[:, None] - heights).abs(),
        atol=1e-5,
        rtol=0,
    )
    assert result.names == dataset.bodies.names
    assert result.labels == ("ball", "ball", "ball", "egg", "egg", "egg")
    row = result.row()
    assert list(row) == KEYS
    expected = retrieval_scores((heights[:, None] - heights).abs(), result.labels).mean()
    assert {name: row[name] for name in expected} == pytest.approx(expected)
    assert 0 < row["nn"] < 1
    assert row["descriptor"] == "tall"
    assert row["n_models"] == 6
    assert row["invariant_to"] == ["motion"]
    assert not result.failures
    assert result.error is None


@pytest.mark.parametrize(
    ("fault", "reason"), [("raise", "a height of 4.8 is too much"), ("nan", "not finite")]
)
def test_a_mesh_that_one_descriptor_cannot_describe_is_its_failure_alone(dataset, fault, reason):
    results = run(dataset, Height("picky", "egg/1.off", fault), Height("fine"))
    (failure,) = results["picky"].failures
    assert failure.id == "egg/1.off"
    assert reason in failure.error
    assert "1.off" in failure.error
    assert results["picky"].row()["n_models"] == 5
    assert results["picky"].labels == ("ball", "ball", "ball", "egg", "egg")
    alone = run(dataset.subset([0, 1, 2, 3, 5]), Height("fine"))["fine"]
    assert results["picky"].row()["map"] == pytest.approx(alone.row()["map"])
    assert results["fine"].row()["n_models"] == 6


def test_strict_stops_at_the_first_failure(dataset):
    chosen = [Height("fine"), Height("picky", "egg/1.off")]
    results = compare(dataset, chosen, n_workers=1, strict=True, progress=False)
    assert next(results).descriptor.name == "fine"
    with pytest.raises(ValueError, match=r"picky: .*too much"):
        next(results)


@pytest.mark.parametrize(
    ("hopeless", "described", "reason"),
    [
        (Height("hopeless", "off"), 0, "no mesh could be described"),
        (Broken("hopeless"), 6, "RuntimeError: out of order"),
        (Height("hopeless", "egg/1.off", "shape"), 6, "shape"),
    ],
)
def test_a_descriptor_without_scores_does_not_stop_the_others(dataset, hopeless, described, reason):
    results = run(dataset, hopeless, Height("fine"))
    row = results["hopeless"].row()
    assert list(row) == KEYS
    for key in KEYS[1:9]:
        assert row[key] is None
    assert row["n_models"] == described
    assert reason in (results["hopeless"].error or "")
    assert results["fine"].scores is not None


def test_seconds_are_the_processor_time_of_a_description(dataset):
    seconds = run(dataset.subset([0, 1]), Slow("slow"))["slow"].seconds_per_mesh
    assert seconds is not None
    assert 0.05 <= seconds < 0.3


def test_distances_by_blocks_are_the_same(dataset, monkeypatch):
    whole = run(dataset, Height("tall"))["tall"].distances
    monkeypatch.setattr("igps.analysis.comparison._BLOCK_ENTRIES", 24)
    parts = run(dataset, Height("tall"))["tall"].distances
    assert_close(parts, whole, rtol=0, atol=0)


def test_processes_give_what_one_does_and_one_that_is_killed_costs_one_mesh(dataset):
    chosen = [Height("fine"), Height("deadly", "ball/0.off", "kill")]
    results = run(dataset, *chosen, n_workers=2)
    (failure,) = results["deadly"].failures
    assert failure.id == "ball/0.off"
    assert "killed" in failure.error
    assert results["deadly"].names == dataset.bodies.names[1:]
    expected = run(dataset, Height("fine"))["fine"].distances
    assert expected is not None
    assert results["fine"].distances is not None
    assert_close(results["fine"].distances, expected, rtol=0, atol=0)


def test_signatures_without_what_a_descriptor_needs_are_refused_before_work(dataset):
    with pytest.raises(
        ValueError, match="n_eigenpairs: this descriptor needs signatures of at least 250, got 20"
    ):
        next(
            compare(
                dataset,
                [Height(), descriptor("interior")],
                progress=False,
            )
        )


def test_two_of_one_name_are_refused(dataset):
    """They would be one row of a table, and one file."""
    with pytest.raises(
        ValueError, match=r"descriptors: expected different names, got d2 more than once"
    ):
        next(
            compare(
                dataset,
                [D2(), Height(), changed(D2(), n_bins=8)],
                progress=False,
            )
        )


def test_collection_without_classes_is_refused(root):
    plain = SignatureDataset([root / "egg" / "0.off"], CONFIG, root.parent / "cache")
    with pytest.raises(ValueError, match="classes"):
        next(compare(plain, [Height("tall")]))
