"""Bodies in memory are those of files that hold the same."""

from concurrent.futures import ThreadPoolExecutor

import nibabel
import numpy as np
import pytest
import trimesh

from igps import MeshError, SignatureConfig, SignatureDataset

CONFIG = SignatureConfig(n_eigenpairs=10)
BALL = trimesh.creation.icosphere(subdivisions=2)
AFFINE = np.diag([-1.0, 1, 2, 1])


def two_balls_and_a_speck():
    index = np.indices((24, 24, 24))
    labels = np.zeros((24, 24, 24), dtype=np.uint8)
    labels[((index - 8) ** 2).sum(axis=0) < 40] = 2
    labels[((index - 17) ** 2).sum(axis=0) < 30] = 5
    labels[0, 0, :3] = 9
    return labels


def test_they_have_the_signatures_of_their_files(tmp_path):
    image = nibabel.Nifti1Image(two_balls_and_a_speck(), AFFINE)
    nibabel.save(image, tmp_path / "a.nii")
    BALL.export(tmp_path / "b.stl")
    of_files = SignatureDataset(
        [tmp_path / "a.nii", tmp_path / "b.stl"], CONFIG, tmp_path / "files"
    )
    given = {
        "a": image,
        "b": trimesh.load(tmp_path / "b.stl"),
        "c": np.full((4, 4, 4), np.nan),
    }
    in_memory = SignatureDataset(given, CONFIG, tmp_path / "memory", labels=["x", "y", "z"])
    assert in_memory.bodies.names == ("a#2", "a#5", "a#9", "b", "c")
    assert in_memory.bodies.labels == ("x", "x", "x", "y", "z")
    errors = [failure.error for failure in in_memory.precompute(n_workers=1, progress=False)]
    assert errors[0].startswith("a#9: expected at least 8 voxels, got 3,")
    assert errors[1].startswith("c: 64 voxels are NaN")
    assert len(errors) == 2
    usable = in_memory.usable(in_memory.precompute(n_workers=1, progress=False))
    of_files = of_files.usable(of_files.precompute(n_workers=1, progress=False))
    for one, other in zip(usable.signatures(), of_files.signatures(), strict=True):
        np.testing.assert_array_equal(one.eigenvalues, other.eigenvalues)
        np.testing.assert_array_equal(one.interior.points, other.interior.points)
        assert one.unit == other.unit
    assert usable.mesh(2).volume == pytest.approx(BALL.volume)
    with pytest.raises(MeshError, match="a#9: expected at least 8 voxels, got 3"):
        in_memory.mesh(2)


def test_arrays_have_their_spacing_and_are_cached_by_what_they_hold(tmp_path):
    labels = two_balls_and_a_speck()
    volumes = []
    for spacing in ((1, 1, 2), (1, 1, 1)):  # under one name
        dataset = SignatureDataset({"a": (labels == 2, spacing)}, CONFIG, tmp_path)
        assert dataset.precompute(n_workers=1, progress=False) == []
        volumes.append(dataset[0].signature.volume)
        assert dataset.bodies.names == ("a",)
        again = SignatureDataset({"b": (labels == 2, spacing)}, CONFIG, tmp_path)
        assert again.cached_keys() == dataset.cached_keys()
    expected = pytest.approx(
        [2 * (labels == 2).sum(), (labels == 2).sum()],
        rel=1e-3,
    )
    assert volumes == expected


def test_each_has_a_label():
    with pytest.raises(ValueError, match=r"labels: expected one for each of 1 bodies, got 2"):
        SignatureDataset({"a": BALL}, CONFIG, labels=["x", "y"])
    with pytest.raises(ValueError, match=r"bodies: expected at least one"):
        SignatureDataset({}, CONFIG)


def test_an_executor_gets_them_too(tmp_path):
    dataset = SignatureDataset(
        {"a": BALL, "b": BALL.copy().apply_scale(2)},
        CONFIG,
        tmp_path,
    )
    with ThreadPoolExecutor(2) as executor:
        assert dataset.precompute(executor, progress=False) == []
    assert dataset[1].signature.volume == pytest.approx(8 * BALL.volume)
