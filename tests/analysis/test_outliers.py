"""Outliers: what is unlike its class comes first, with the reason; what is not, does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from conftest import as_mesh
from igps.analysis.groups import squared_distances
from igps.analysis.outliers import LIMIT, flat_share, measures_of, outliers
from igps.data.dataset import SignatureDataset

LABELS = ["a"] * 12 + ["b"] * 12


def usual(seed: int = 0) -> np.ndarray:
    """Vectors of two classes."""
    return np.random.default_rng(seed).normal(size=(24, 8)) + np.repeat([0, 6], 12)[:, None]


def found_of(vectors: np.ndarray, **given: object) -> list:
    return outliers(squared_distances(vectors) ** 0.5, LABELS, **given)  # type: ignore[arg-type]


def test_what_is_usual_is_no_outlier() -> None:
    found = [one for seed in range(20) for one in found_of(usual(seed))]
    assert np.mean([one.is_outlier for one in found]) < 0.02
    assert {one.lies_among for one in found} == {None}


def test_a_body_of_another_shape_comes_first() -> None:
    vectors = usual()
    vectors[3, 0] += 14
    first = found_of(vectors)[0]
    assert (first.body, first.reason) == (3, "its shape is unlike its class")
    assert first.score > LIMIT


def test_a_wrong_label_is_told() -> None:
    vectors = usual()
    vectors[20] = vectors[:12].mean(axis=0)
    first = found_of(vectors)[0]
    assert (first.body, first.lies_among) == (20, "a")
    assert first.reason.endswith("labelled b, lies among a")


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("volume", np.log(2), "its volume is 1.99 times"),
        ("spacing", np.log(2), "it is 1.99 times as coarse"),
        ("handles", 3.0, "it has 3 handles, where 0 are usual"),
        ("flat", 0.3, "30% of its surface lie in one plane"),
    ],
)
def test_each_measure_is_a_reason(name: str, value: float, told: str) -> None:
    values = 0.01 * np.random.default_rng(1).normal(size=24) if name in ("volume", "spacing") else np.zeros(24)
    values[5] = value
    first = found_of(usual(), measures={name: values})[0]
    assert first.body == 5
    assert told in first.reason


def test_a_repair_that_few_needed_is_a_reason() -> None:
    notes = [["smoothed 3 times"]] * 24
    notes[7] = ["smoothed 4 times", "dropped 1 piece apart of 40 voxels, 0.5% of the label"]
    first = found_of(usual(), notes=notes)[0]
    assert (first.body, "dropped 1 piece apart" in first.reason) == (7, True)


def test_classes_of_one_and_measures_that_are_missing_are_borne() -> None:
    labels = ["alone", *LABELS[1:]]
    volume = np.full(24, np.nan)
    found = outliers(squared_distances(usual()) ** 0.5, labels, {"volume": volume})
    assert len(found) == 24
    assert {one.score for one in found if one.label == "alone"} == {0.0}


def test_the_flat_share_is_that_of_the_flat_sides() -> None:
    box = trimesh.creation.box([1, 1, 2])
    for _ in range(4):
        box = box.subdivide()
    assert flat_share(as_mesh(box)) == pytest.approx(2 / 10, abs=0.01)
    ball = trimesh.creation.icosphere(subdivisions=4)
    assert flat_share(as_mesh(ball)) < 0.03


def test_measures_are_those_of_the_meshes(tmp_path: object) -> None:
    path = f"{tmp_path}/torus.off"
    torus = trimesh.creation.torus(2.0, 0.7, major_sections=48, minor_sections=24)
    torus.export(path)
    dataset = SignatureDataset([path, f"{tmp_path}/missing.off"], cache_dir=f"{tmp_path}/cache")
    measures = measures_of(dataset, n_workers=1)
    assert measures["handles"][0] == 1
    assert measures["volume"][0] == pytest.approx(np.log(torus.volume))
    assert measures["spacing"][0] == pytest.approx(np.log(torus.area / len(torus.faces)) / 2)
    assert not measures.pop("overlap").any()
    assert all(np.isnan(values[1]) for values in measures.values())


def test_the_spacing_of_a_label_is_the_side_of_its_voxels(tmp_path: Path) -> None:
    """Which its surface hides: a ball has as many faces on a grid that is twice as coarse."""
    nibabel = pytest.importorskip("nibabel", reason="nibabel is not installed")
    for name, side in (("fine", 1.0), ("coarse", 2.0)):
        places = (np.indices(3 * [int(40 / side)]) + 0.5) * side - 20
        mask = ((places**2).sum(axis=0) < 14**2).astype(np.uint8)
        nibabel.save(nibabel.Nifti1Image(mask, np.diag([side, side, side, 1])), tmp_path / f"{name}.nii.gz")
    dataset = SignatureDataset([tmp_path / "fine.nii.gz", tmp_path / "coarse.nii.gz"], cache_dir=tmp_path)
    spacing = measures_of(dataset, n_workers=1)["spacing"]
    assert np.exp(spacing) == pytest.approx([1, 2], rel=0.01)
