"""Outliers: what is unlike its class comes first, with the reason; what is not, does not."""

import numpy as np
import pytest
import trimesh
from numpy.random import default_rng

from conftest import as_mesh
from igps.analysis.groups import squared_distances
from igps.analysis.outliers import LIMIT, flat_share, measure_bodies, outliers
from igps.data.dataset import SignatureDataset
from igps.data.sources import find_bodies
from label_files import write_nifti

LABELS = ["a"] * 12 + ["b"] * 12


def usual(seed=0):
    """Vectors of two classes."""
    return default_rng(seed).normal(size=(24, 8)) + np.repeat([0, 6], 12)[:, None]


def found_of(vectors, **given):
    return outliers(squared_distances(vectors) ** 0.5, LABELS, **given)


def test_what_is_usual_is_no_outlier():
    found = [one for seed in range(20) for one in found_of(usual(seed))]
    assert np.mean([one.is_outlier for one in found]) < 0.02
    assert {one.nearer_class for one in found} == {None}


def test_a_body_alone_in_its_class_is_told_not_to_be_judged():
    found = outliers(
        squared_distances(usual()) ** 0.5,
        ["alone", *LABELS[1:]],
    )
    reason = "shape not assessed: the only body of its class"
    assert [one.label for one in found if one.reason == reason] == ["alone"]


def test_bodies_that_the_scan_cut_are_compared_with_their_like():
    """Five of twelve are half as large, and far away in shape, because the image ends there; one at another side."""
    vectors = usual()
    vectors[:5] += 20 * np.eye(8)[0]
    vectors[5] += 20 * np.eye(8)[1]
    volume = 0.01 * default_rng(0).normal(size=24)
    volume[:6] -= np.log(2)
    sides = ["S"] * 5 + ["LI"] + [""] * 18
    measures = {"volume": volume}
    apart = found_of(vectors, measures=measures, cut=sides)
    for one in apart:
        assert not one.is_outlier
    assert {one.nearer_class for one in apart} == {None}
    told = {one.body: one.reason for one in apart}
    assert told[5].endswith("the only body of its class cut at LI by the border of the image")
    assert {told[i] for i in range(5)} == {"nothing unusual"}
    whole_is_small = np.where(
        np.arange(24) == 9,
        -np.log(2),
        volume,
    )
    first = found_of(vectors, measures={"volume": whole_is_small}, cut=sides)[0]
    assert first.body == 9
    assert first.is_outlier is True


def test_a_body_of_another_shape_comes_first():
    vectors = usual()
    vectors[3, 0] += 14
    first = found_of(vectors)[0]
    assert first.body == 3
    assert first.reason == "its shape is unusual for its class"
    assert first.score > LIMIT


@pytest.mark.parametrize(
    ("n", "n_odd"),
    [(10, 1), (12, 1), (40, 2)],
)
def test_bodies_far_off_are_found_whatever_the_size_of_the_class(n, n_odd):
    """Thirty standard deviations off: an odd body is left out of what is taken to be a tail."""
    random = default_rng(n)
    points = random.normal(size=(n, 4))
    volumes = 0.1 * random.normal(size=n)
    volumes[:n_odd] += 3
    found = outliers(
        squared_distances(points) ** 0.5,
        ["a"] * n,
        {"volume": volumes},
    )
    assert {one.body for one in found if one.is_outlier} == set(range(n_odd))


@pytest.mark.parametrize(
    ("n_subjects", "n_organs"),
    [(14, 5), (10, 20)],
)
def test_a_subject_with_a_wrong_unit_is_found_by_all_its_organs(n_subjects, n_organs):
    """All lengths of one subject are doubled; the bodies of one subject must not be taken for a tail."""
    random = default_rng(n_subjects)
    n = n_subjects * n_organs
    labels = [f"organ {i % n_organs}" for i in range(n)]
    subjects = np.repeat(np.arange(n_subjects), n_organs)
    organs = 10 * random.normal(size=(n_organs, 6))
    points = random.normal(size=(n, 6)) + np.tile(organs, (n_subjects, 1))
    spacing = 0.1 * np.repeat(random.normal(size=n_subjects), n_organs)
    volume = 0.2 * random.normal(size=n)
    volume[subjects == 3] += np.log(8)
    spacing[subjects == 3] += np.log(2)
    measures = {"volume": volume, "spacing": spacing}
    found = outliers(
        squared_distances(points) ** 0.5,
        labels,
        measures,
        subjects=subjects.tolist(),
    )
    odd = [one.body for one in found if one.is_outlier]
    assert set(np.flatnonzero(subjects == 3)) <= set(odd)
    assert len(odd) <= n_organs + 0.05 * n


def test_a_wrong_label_is_told():
    vectors = usual()
    vectors[20] = vectors[:12].mean(axis=0)
    first = found_of(vectors)[0]
    assert first.body == 20
    assert first.nearer_class == "a"
    assert first.reason.endswith("labelled b, but nearer to a")


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("volume", np.log(2), "its volume is 1.99 times"),
        ("spacing", np.log(2), "its resolution is 1.99 times as coarse"),
        ("handles", 3.0, "it has 3 handles (0 usual)"),
        ("flat", 0.3, "30% of its surface lies in one plane"),
        ("stray", 0.2, "4.0% of its voxels are detached"),
        ("cavity", 0.2, "its cavities have 4.0% of its volume"),
        ("hole", 0.1, "holes in its slices have 1.0% of its volume (0.0% usual)"),
        ("gap", 0.3, "its gaps have 9% of its volume (0% usual)"),
        ("cut", 9.0, "its last slice is as large as those before it"),
    ],
)
def test_each_measure_is_a_reason(name, value, told):
    values = np.zeros(24)
    if name in ("volume", "spacing"):
        values = 0.01 * default_rng(1).normal(size=24)
    values[5] = value
    first = found_of(usual(), measures={name: values})[0]
    assert first.body == 5
    assert told in first.reason


def test_a_leak_lies_in_another_class():
    overlap = np.zeros((24, 24))
    overlap[2, 20] = 0.08
    first, second = found_of(usual(), measures={"overlap": overlap})[:2]
    assert first.body == 2
    assert first.reason == "8% of its voxels lie in a body of another class"
    assert second.scores["overlap"] == 0


def test_of_a_pair_the_odd_one_is_found():
    labels = ["left and right"] * 2 + [f"pair {i // 2}" for i in range(22)]
    handles = np.zeros(24)
    handles[1] = 2
    found = outliers(squared_distances(usual()) ** 0.5, labels, {"handles": handles})
    scores = {one.body: one.scores["handles"] for one in found}
    assert scores[0] < 0
    assert scores[1] == max(scores.values()) > LIMIT


def test_a_coarse_single_body_is_found_beside_a_class_of_finer_ones():
    """A third of all bodies is finer; a class of one that is coarse is odd all the same."""
    labels = ["fine"] * 8 + [f"single {i}" for i in range(16)]
    spacing = np.log(np.repeat([1.0, 3.0], [8, 16]))
    spacing[20] = np.log(6)
    found = outliers(squared_distances(usual()) ** 0.5, labels, {"spacing": spacing})[0].body
    assert found == 20


def test_a_repair_that_few_needed_is_a_reason():
    notes = [["smoothed 3 times"]] * 24
    notes[7] = ["smoothed 4 times", "dropped 1 piece apart of 40 voxels, 0.5% of the label"]
    first = found_of(usual(), notes=notes)[0]
    assert first.body == 7
    assert "dropped 1 piece apart" in first.reason


def test_what_is_repaired_in_labels_is_measured_in_their_voxels():
    notes = [["smoothed 3 times"]] * 24
    notes[7] = ["dropped 1 small piece apart of 9 voxels, 0.1% of the label"]
    stray = np.where(
        np.arange(24) == 7,
        0.001**0.5,
        0.0,
    )
    found = found_of(usual(), measures={"stray": stray}, notes=notes)
    scores = {one.body: one.scores for one in found}
    assert scores[7]["repairs"] == 0 < scores[7]["stray"]


def test_classes_of_one_and_measures_that_are_missing_are_borne():
    labels = ["alone", *LABELS[1:]]
    volume = np.full(24, np.nan)
    found = outliers(squared_distances(usual()) ** 0.5, labels, {"volume": volume})
    assert len(found) == 24
    assert {one.score for one in found if one.label == "alone"} == {0.0}


def test_the_flat_share_is_that_of_the_flat_sides():
    box = trimesh.creation.box([1, 1, 2])
    for _ in range(4):
        box = box.subdivide()
    expected = pytest.approx(2 / 10, abs=0.01)
    assert flat_share(as_mesh(box)) == expected
    ball = trimesh.creation.icosphere(subdivisions=4)
    assert flat_share(as_mesh(ball)) < 0.03


def test_measures_are_those_of_the_meshes(tmp_path):
    path = f"{tmp_path}/torus.off"
    torus = trimesh.creation.torus(2.0, 0.7, major_sections=48, minor_sections=24)
    torus.export(path)
    torus.copy().apply_scale(1e-3).export(f"{tmp_path}/metres.glb")
    paths = [path, f"{tmp_path}/missing.off", f"{tmp_path}/metres.glb"]
    dataset = SignatureDataset(paths, cache_dir=f"{tmp_path}/cache")
    measures = measure_bodies(dataset, n_workers=1)
    assert measures["handles"][0] == 1
    expected = pytest.approx(np.log(torus.volume))
    assert measures["volume"][0] == expected
    expected = pytest.approx(np.log(torus.area / len(torus.faces)) / 2)
    assert measures["spacing"][0] == expected
    for name in ("volume", "spacing"):
        expected = pytest.approx(measures[name][0], abs=1e-4)
        assert measures[name][2] == expected
    assert not measures.pop("overlap").any()
    for values in measures.values():
        assert np.isnan(values[1])


def test_the_spacing_of_a_label_is_the_side_of_its_voxels(tmp_path):
    """Which its surface hides: a ball has as many faces on a grid that is twice as coarse."""
    for name, side in (("fine", 1.0), ("coarse", 2.0)):
        places = (np.indices(3 * [int(40 / side)]) + 0.5) * side - 20
        mask = ((places**2).sum(axis=0) < 14**2).astype(np.uint8)
        write_nifti(tmp_path / f"{name}.nii.gz", mask, np.diag([side, side, side, 1]))
    files = [tmp_path / "fine.nii.gz", tmp_path / "coarse.nii.gz"]
    dataset = SignatureDataset(files, cache_dir=tmp_path)
    spacing = measure_bodies(dataset, n_workers=1)["spacing"]
    expected = pytest.approx([1, 2], rel=0.01)
    assert np.exp(spacing) == expected


def test_labels_are_measured_in_their_grid(tmp_path):
    """Two balls that share a cap, one cut by a plane, one by the border of the volume, one with an island."""
    x, y, z = np.indices((60, 40, 40))

    def ball(at, radius=10, height=20):
        return (x - at) ** 2 + (y - 20) ** 2 + (z - height) ** 2 <= radius**2

    island = ball(40) | ball(56, 2)
    masks = {
        "a": ball(20),
        "b": ball(36),
        "cut": ball(20) & (z < 24),
        "border": ball(20, 10, 35),
        "island": island,
    }
    for name, mask in masks.items():
        write_nifti(tmp_path / f"{name}.nii.gz", mask.astype(np.uint8))
    files = [tmp_path / f"{name}.nii.gz" for name in masks]
    dataset = SignatureDataset(files, cache_dir=tmp_path, labels=["a", "b", "a", "c", "d"])
    found = measure_bodies(dataset, n_workers=1)
    for place, name in ((1, "b"), (3, "border")):
        shared = (masks["a"] & masks[name]).sum() / masks["a"].sum()
        assert found["overlap"][0, place] == pytest.approx(shared)
    assert found["overlap"][0, 2] == 0  # of one class, which may be another subject
    expected = pytest.approx(
        [
            0,
            0,
            0,
            0,
            ball(56, 2).sum() / island.sum(),
        ]
    )
    assert found["stray"] ** 2 == expected
    assert found["cut"][2] > 3 * max(found["cut"][[0, 1, 3]])


def test_labels_of_other_subjects_in_the_same_standard_space_do_not_overlap(tmp_path):
    """A file for each subject, all on the grid of an atlas: the ball of one lies in the block of the other."""
    x, y, z = np.indices((40, 24, 24))
    for name, at in (("s1", 12), ("s2", 20)):
        labels = np.where(
            (x - at) ** 2 + (y - 12) ** 2 + (z - 12) ** 2 <= 64,
            1,
            0,
        )
        labels[at + 9 :, 4:20, 4:20] = 2
        write_nifti(tmp_path / f"{name}.nii.gz", labels.astype(np.uint8))
    bodies = find_bodies(tmp_path, classes="body")
    assert bodies.labels == ("1", "2", "1", "2")
    found = measure_bodies(SignatureDataset(bodies, cache_dir=tmp_path), n_workers=1)
    assert not found["overlap"].any()
