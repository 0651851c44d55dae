"""Where inside a signal lies, from the objects of other libraries: each gives the same numbers."""

import pickle

import numpy as np
import pytest

import igps
from igps.analysis.inside import column_names
from igps.data.grids import grid_of
from igps.mesh.errors import MeshError
from igps.monai import InteriorFeaturesd
from igps.sklearn import VolumetricFeatures

SHAPE = (16, 18, 12)
SPACING = (1.0, 0.8, 1.5)
# Turned about the third axis, and moved
TURN = np.array(
    [
        [0.8, -0.6, 0.0],
        [0.6, 0.8, 0.0],
        [0.0, 0.0, 1.0],
    ]
)
AFFINE = np.eye(4)
AFFINE[:3, :3] = TURN * SPACING
AFFINE[:3, 3] = [-30.0, 12.0, 5.0]


def world(affine=AFFINE, shape=SHAPE):
    """The centres of all voxels."""
    indices = np.indices(shape).reshape(3, -1).T
    return (indices @ affine[:3, :3].T + affine[:3, 3]).reshape(
        *shape,
        3,
    )


CENTRE = world().reshape(-1, 3).mean(axis=0)
LABELS = (np.linalg.norm((world() - CENTRE) / [5, 5, 6], axis=-1) < 1).astype(np.uint8)
IMAGE = np.exp(-np.linalg.norm(world() - CENTRE - [2, 0, 1], axis=-1) / 4).astype(np.float32)


@pytest.fixture(scope="module")
def expected():
    (row,) = igps.inside(IMAGE, LABELS, SPACING)
    expected = pytest.approx(
        LABELS.sum() * np.prod(SPACING),
        rel=0.01,
    )
    assert row["volume"] == expected
    return row


def check(rows, expected):
    assert len(rows) == 1
    for name in column_names(["image"]):
        assert rows[0][name] == pytest.approx(expected[name], abs=2e-3), name


def in_nibabel(values, affine=AFFINE):
    return pytest.importorskip("nibabel").Nifti1Image(values, affine)


def test_images_of_nibabel_and_simpleitk_give_the_numbers_of_arrays(expected):
    check(igps.inside(in_nibabel(IMAGE), in_nibabel(LABELS)), expected)
    simpleitk = pytest.importorskip("SimpleITK")
    converted = []
    for values in (IMAGE, LABELS):
        image = simpleitk.GetImageFromArray(np.ascontiguousarray(values.T))
        image.SetSpacing(SPACING)
        image.SetDirection((np.diag([-1, -1, 1]) @ TURN).ravel().tolist())  # LPS
        image.SetOrigin((AFFINE[:3, 3] * [-1, -1, 1]).tolist())
        np.testing.assert_allclose(grid_of(image).affine, AFFINE, atol=1e-6)
        converted.append(image)
    check(igps.inside(*converted), expected)
    check(igps.inside(in_nibabel(IMAGE), converted[1]), expected)


def test_an_image_on_another_grid_is_read_by_its_place():
    affine = np.diag([0.9, 1.1, 1.3, 1.0])
    affine[:3, 3] = CENTRE - np.array([13.5, 16.5, 19.5])
    slope = np.array([0.7, -1.3, 2.1])
    image = in_nibabel(
        world(affine, (31, 31, 31)) @ slope,
        affine,
    )
    (row,) = igps.inside(
        {"image": image, "same": in_nibabel(world() @ slope)},
        in_nibabel(LABELS),
    )
    assert row["image.mean"] == pytest.approx(row["same.mean"], rel=1e-5)
    assert row["image.ends.q90"] == pytest.approx(row["same.ends.q90"], rel=1e-5)
    assert row["image_and_same.correlation"] == pytest.approx(1, abs=1e-6)


def test_each_label_has_a_row_and_one_that_is_too_small_a_sentence():
    labels = LABELS.copy()
    labels[LABELS > 0] = 1 + (world() @ np.array([0, 0, 1]) > CENTRE[2])[LABELS > 0]
    labels[0, 0, :3] = 7
    rows = {row["label"]: row for row in igps.inside(IMAGE, labels, SPACING)}
    assert set(rows) == {"1", "2", "7"}
    assert rows["1"]["note"] == ""
    assert "expected at least 8 voxels, got 3" in rows["7"]["note"]
    assert np.isnan(rows["7"]["image.mean"])


def test_what_cannot_be_compared_is_refused_with_a_sentence():
    three = np.zeros(SHAPE, np.uint8)
    three[5, 5, 3:6] = 1
    with pytest.raises(MeshError, match="expected at least 8 voxels, got 3"):
        igps.inside(IMAGE, three, SPACING)
    holes = np.where(
        np.indices(SHAPE)[0] < 8,
        np.nan,
        IMAGE,
    )
    with pytest.raises(MeshError, match="has no value at"):
        igps.inside(holes, LABELS, SPACING)
    elsewhere = AFFINE.copy()
    elsewhere[0, 3] += 100
    with pytest.raises(MeshError, match="has no value at"):
        igps.inside(in_nibabel(IMAGE, elsewhere), in_nibabel(LABELS))
    with pytest.raises(ValueError, match="expected the shape of the labels"):
        igps.inside(IMAGE[:-1], LABELS, SPACING)
    with pytest.raises(ValueError, match="Choose one channel"):
        igps.inside(np.stack([IMAGE, IMAGE]), LABELS, SPACING)
    with pytest.raises(TypeError, match="expected an array"):
        igps.inside("image.nii.gz", LABELS)
    sheared = AFFINE.copy()
    sheared[0, 1] += 0.3
    with pytest.raises(ValueError, match="without shear"):
        igps.inside(in_nibabel(IMAGE, sheared), in_nibabel(LABELS, sheared))
    constant = np.full(SHAPE, 3.0)
    (row,) = igps.inside(constant, LABELS, SPACING)
    assert row["image.core.mean"] == pytest.approx(3)
    assert np.isnan(row["image.moran"])


def test_rows_are_a_table_of_pandas(expected):
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame(
        igps.inside(
            {"ct": IMAGE, "pet": IMAGE**2},
            LABELS,
            SPACING,
        )
    )
    assert table["ct.rim.mean"][0] == pytest.approx(expected["image.rim.mean"])
    of_both = [name.removeprefix("ct_and_pet.") for name in table.filter(like="_and_")]
    assert of_both == ["correlation", "rank_correlation", "overlap", "information"]


def test_a_subject_of_torchio_brings_its_metadata(expected):
    torchio = pytest.importorskip("torchio", reason="torchio is not installed")
    subject = torchio.Subject(
        image=torchio.ScalarImage(tensor=IMAGE[None], affine=AFFINE),
        organ=torchio.LabelMap(tensor=LABELS[None], affine=AFFINE),
        age=63,
        centre="A",
    )
    rows = igps.inside(subject, "organ")
    check(rows, expected)
    assert rows[0]["age"] == 63
    assert rows[0]["centre"] == "A"
    assert rows[0]["label"] == "1"


def test_a_transform_of_monai_is_pickled_and_kept_by_its_caching_dataset(expected):
    data = pytest.importorskip("monai.data", reason="monai is not installed")
    from monai.transforms import Compose, EnsureChannelFirstd, ToTensord

    transform = InteriorFeaturesd(keys="label", image_key="image", labels=(1, 2))
    assert transform.feature_names == column_names(["image"])
    channel = EnsureChannelFirstd(["image", "label"], channel_dim="no_channel")
    chain = Compose(
        [
            channel,
            pickle.loads(pickle.dumps(transform)),
            ToTensord("label_inside"),
        ]
    )
    items = [
        {
            "image": data.MetaTensor(IMAGE, AFFINE),
            "label": data.MetaTensor(LABELS, AFFINE),
        },
        {"image": IMAGE, "label": LABELS},  # in voxels of side 1
    ]
    cached = data.CacheDataset(items, chain, progress=False)
    assert "label_inside" in cached._cache[0]
    assert "label_inside" not in items[0]
    first = cached[0]["label_inside"]
    assert first.shape == (2, len(transform.feature_names))
    row = dict(
        zip(
            transform.feature_names,
            first[0].tolist(),
            strict=True,
        )
    )
    check([row], expected)
    assert first[1].isnan().all()  # there is no label 2
    assert (cached[1]["label_inside"][0] != first[0]).any()
    np.testing.assert_array_equal(cached[0]["label_inside"], first)


def test_without_monai_the_transform_tells_how_to_get_it(monkeypatch):
    monkeypatch.setattr("igps.monai._MISSING", ImportError("no module"))
    with pytest.raises(ImportError, match=r"interior-gps\[monai\]"):
        InteriorFeaturesd(keys="label", image_key="image")


def test_features_of_scikit_learn_hold_the_numbers(expected, tmp_path):
    nibabel = pytest.importorskip("nibabel")
    straight = np.diag([*SPACING, 1.0])  # the grid of samples is along the axes of the world
    nibabel.save(in_nibabel(LABELS, straight), tmp_path / "a.nii.gz")
    nibabel.save(in_nibabel(IMAGE, straight), tmp_path / "a_image.nii.gz")
    inside = ["image={stem}_image.nii.gz"]
    features = VolumetricFeatures("shape_dna", inside=inside, cache_dir=tmp_path / "cache")
    table = features.fit_transform([tmp_path / "a.nii.gz"])
    names = features.get_feature_names_out().tolist()
    assert table.shape == (1, len(names))
    assert names[-57:] == column_names(["image"])
    check(
        [dict(zip(names, table[0].tolist(), strict=True))],
        expected,
    )
    with pytest.raises(TypeError, match="expected a list of attributes"):
        VolumetricFeatures(inside="ct").fit([tmp_path / "a.nii.gz"])
    surface = igps.as_mesh(LABELS > 0)
    with pytest.raises(ValueError, match="expected mesh files"):
        features.transform([surface])
