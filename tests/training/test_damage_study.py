"""`damage`: its scores against a loop over the damaged meshes, and what it says of those that cannot be described."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from training.studies.damage import DamageResult, damage, damaged
from training.studies.damages import DAMAGES

import igps
from conftest import as_trimesh
from igps.data.dataset import SignatureDataset
from igps.mesh.errors import MeshError
from igps.mesh.loading import load_mesh
from igps.mesh.mending import mend
from igps.mesh.mesh import Mesh
from igps.signature.signature import SignatureConfig
from own_descriptors import Height, Root, write_egg

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60)
HEIGHTS = {"low": (1.0, 1.3, 1.1), "high": (1.35, 2.0, 2.6)}


@pytest.fixture
def dataset(tmp_path: Path) -> SignatureDataset:
    """Eggs of two classes that touch, so that some nearest neighbours are of the wrong one."""
    for label, heights in HEIGHTS.items():
        for height in heights:
            write_egg(tmp_path / "meshes" / label / f"{height}.off", height, 2)
    return SignatureDataset(tmp_path / "meshes", CONFIG, tmp_path / "cache")


def study(dataset: SignatureDataset, *descriptors: igps.Descriptor, **options):  # type: ignore[no-untyped-def]
    return damage(dataset, descriptors, n_workers=1, **options)


def nearest_neighbours(
    queries: list[float], gallery: list[float], labels: tuple[str, ...]
) -> float:
    """Share of the queries whose nearest of the gallery, but for its own twin, is of its class."""
    hits = 0
    for i, query in enumerate(queries):
        others = [j for j in range(len(gallery)) if j != i]
        hits += labels[min(others, key=lambda j: abs(query - gallery[j]))] == labels[i]
    return hits / len(queries)


def first_tier(queries: list[float], gallery: list[float], labels: tuple[str, ...]) -> float:
    """Mean share of a query's class, but for its own twin, among as many of the nearest."""
    shares = []
    for i, query in enumerate(queries):
        others = sorted(
            (j for j in range(len(gallery)) if j != i), key=lambda j: abs(query - gallery[j])
        )
        size = sum(label == labels[i] for label in labels) - 1
        shares.append(sum(labels[j] == labels[i] for j in others[:size]) / size)
    return float(np.mean(shares))


def test_scores_are_those_of_damaged_queries_in_the_clean_gallery(
    dataset: SignatureDataset,
) -> None:
    names = ["soup", "holes", "noise"]
    found = study(dataset, Root(), damages=names, seed=3)["root"]
    assert list(found) == names
    labels = dataset.bodies.labels or ()
    clean = [float(np.sqrt(as_trimesh(load_mesh(path)).area)) for path in dataset.bodies.paths]
    for name in names:
        spoiled = []
        for path in dataset.bodies.paths:
            vertices, faces = DAMAGES[name].apply(load_mesh(path), 3)
            spoiled.append(float(np.sqrt(as_trimesh(mend(vertices, faces)).area)))
        result = found[name]
        assert (result.n_given, result.usable, result.notes) == (6, 1.0, {})
        for score, of in (("nn", nearest_neighbours), ("ft", first_tier)):
            assert result.scores[score] == pytest.approx(of(spoiled, clean, labels))
            assert result.clean[score] == pytest.approx(of(clean, clean, labels))
            assert result.loss(score) == pytest.approx(
                of(clean, clean, labels) - of(spoiled, clean, labels)
            )
    # The classes overlap: the loops tell right from wrong, and the damages differ.
    assert 0 < found["soup"].clean["ft"] < 1


def test_what_cannot_be_described_is_left_out_of_both_sides(dataset: SignatureDataset) -> None:
    bad = dataset.bodies.names[0]
    found = study(dataset, Height("height", bad=bad), damages=["turned"])["height"]["turned"]
    assert found.usable == pytest.approx(5 / 6)
    assert list(found.notes) == [bad]
    assert "is too much" in found.notes[bad]
    labels = (dataset.bodies.labels or ())[1:]
    heights = [float(np.ptp(load_mesh(path).vertices[:, 2])) for path in dataset.bodies.paths[1:]]
    expected = nearest_neighbours(heights, heights, labels)
    assert found.scores["nn"] == pytest.approx(expected)
    assert found.loss("nn") == pytest.approx(0)


def test_where_nothing_is_mended_most_damage_is_refused(dataset: SignatureDataset) -> None:
    found = study(dataset, Root(), damages=["soup", "noise"], mending="never")["root"]
    assert found["soup"].usable == 0
    assert found["soup"].scores == {}
    assert np.isnan(found["soup"].loss("nn"))
    assert all(
        "(soup): open surface with 960 boundary edges" in note
        for note in found["soup"].notes.values()
    )
    assert found["noise"].usable == 1


def test_a_damaged_mesh_is_mended_as_a_file_would_be(blob: Mesh) -> None:
    body = damaged("soup", 0, "auto", 0, blob)
    surface = as_trimesh(body)
    assert surface.is_watertight
    assert surface.volume == pytest.approx(blob.volume, rel=1e-6)
    assert len(body.vertices) == len(blob.vertices)
    assert body.name == "blob (soup)"
    more = damaged("soup", 0, "auto", 2 * len(blob.vertices), blob)
    assert len(more.vertices) >= 2 * len(blob.vertices)
    with pytest.raises(MeshError, match=r"blob \(soup\): open surface"):
        damaged("soup", 0, "never", 0, blob)


def test_the_seed_chooses_the_damage(blob: Mesh) -> None:
    one, again, other = (damaged("holes", seed, "auto", 0, blob).vertices for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert one.shape != other.shape or not np.array_equal(one, other)


def test_all_damages_are_the_default(dataset: SignatureDataset) -> None:
    found = study(dataset.subset([0, 5]), Root())["root"]
    assert list(found) == list(DAMAGES)
    # One mesh of each class: described, but there is nothing to find.
    assert all(result.usable == 1 for result in found.values())
    assert all(result.scores == result.clean == {} for result in found.values())


def test_wrong_arguments_are_named(dataset: SignatureDataset) -> None:
    with pytest.raises(ValueError, match=r"damages: expected some of holes, .*got 'rust'"):
        study(dataset, Root(), damages=["soup", "rust"])
    unlabelled = SignatureDataset(list(dataset.bodies.paths), CONFIG)
    with pytest.raises(ValueError, match="dataset: expected meshes with classes"):
        study(unlabelled, Root())


def test_the_dictionary_is_for_a_file() -> None:
    result = DamageResult(4, {"nn": 0.5}, {"nn": 0.75}, {"a.off": "why"})
    assert result.as_dict() == {
        "n_given": 4,
        "usable": 0.75,
        "scores": {"nn": 0.5},
        "clean": {"nn": 0.75},
        "notes": {"a.off": "why"},
    }
    assert result.loss("nn") == 0.25
