import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import GridSearchCV
from sklearn.neighbors import KNeighborsClassifier
from sklearn.pipeline import make_pipeline, make_union
from sklearn.utils import estimator_checks

from igps.data.dataset import SignatureDataset
from igps.descriptors.interior import interior
from igps.descriptors.literature.d2 import D2
from igps.mesh.loading import load_mesh
from igps.mesh.options import LoadOptions
from igps.nn.description import describe
from igps.signature.signature import SignatureConfig
from igps.sklearn import VolumetricFeatures
from label_files import write_nifti
from own_descriptors import changed

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=12, min_samples=0, n_surface_samples=20)
DISTANCES = changed(D2(), n_bins=8)


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    """Four balls and four rods."""
    root = tmp_path_factory.mktemp("shapes")
    for label, length in (("ball", 1.0), ("rod", 3.0)):
        (root / label).mkdir()
        for i in range(4):
            body = trimesh.creation.icosphere(subdivisions=3)
            body.vertices *= [1, 1 + 0.05 * i, length]
            body.export(root / label / f"{i}.off")
    return sorted(root.rglob("*.off"))


@pytest.fixture
def features(tmp_path):
    how = {"config": CONFIG, "cache_dir": tmp_path, "n_workers": 1}
    return VolumetricFeatures(interior(n_eigenpairs=20), **how)


def test_features_are_the_roots_of_the_histograms(paths, features, tmp_path):
    dataset = SignatureDataset(paths, CONFIG, tmp_path)
    histograms = describe(dataset, interior(n_eigenpairs=20)).flatten(1).numpy()
    assert_allclose(features.fit_transform(paths), np.sqrt(histograms), atol=1e-6)
    plain = clone(features).set_params(square_root=False)
    assert_allclose(plain.transform([str(path) for path in paths]), histograms, atol=1e-6)


def test_meshes_give_what_their_files_give(paths, features):
    meshes = [load_mesh(path) for path in paths[:2]]
    assert_allclose(features.transform(meshes), features.transform(paths[:2]), atol=1e-6)


def test_rich_features_bring_their_attributes(paths, tmp_path):
    rich = VolumetricFeatures("rich", cache_dir=tmp_path, n_workers=1).transform(paths[:1])
    assert rich.shape == (1, 27420)
    assert_allclose((rich**2).sum(), 1, rtol=1e-4)


def test_pipeline_classifies(paths, features):
    labels = [path.parent.name for path in paths]
    pipeline = make_pipeline(features, KNeighborsClassifier(1)).fit(
        paths[::2],
        labels[::2],
    )
    assert pipeline.score(paths[1::2], labels[1::2]) == 1


def test_other_input_is_refused(features):
    with pytest.raises(TypeError, match="X: expected paths of mesh files, or meshes, got int"):
        features.transform([1, 2])
    with pytest.raises(TypeError, match=r"expected a list of paths .*, got 'a\.off' alone"):
        features.transform("a.off")
    words = r"expected one column of paths or meshes, got an array of shape \(1, 2\)"
    with pytest.raises(ValueError, match=words):
        features.transform(np.array([["a.off", "b.off"]]))
    with pytest.raises(TypeError, match="got nothing"):
        features.fit([])
    with pytest.raises(ValueError, match="descriptor: expected one of interior"):
        VolumetricFeatures("unknown").fit(["a.off"])


def test_a_column_of_a_table_is_a_list(paths, features):
    """As ColumnTransformer hands it over; its one column was taken for a file."""
    pandas = pytest.importorskip("pandas")
    expected = features.transform(paths[:2])
    table = pandas.DataFrame({"file": list(map(str, paths[:2]))})
    for given in (table, table["file"], table.to_numpy()):
        assert_array_equal(features.transform(given), expected)


def test_a_file_of_several_bodies_is_no_row(tmp_path):
    labels = np.zeros((12, 12, 12), np.uint8)
    labels[1:6, 1:11, 1:11] = 1
    labels[7:11, 1:11, 1:11] = 2
    write_nifti(tmp_path / "a.nii.gz", labels)
    features = VolumetricFeatures("interior", cache_dir=tmp_path, n_workers=1)
    words = r"got several, such as .*a\.nii\.gz#1\. Name each as FILE#PART"
    with pytest.raises(ValueError, match=words):
        features.transform([tmp_path / "a.nii.gz"])


def test_a_name_is_a_descriptor_with_its_needs(paths, tmp_path):
    few = VolumetricFeatures("interior", config=CONFIG, cache_dir=tmp_path, n_workers=1)
    words = "this descriptor needs signatures of at least 250, got 20"
    for given in (paths[:1], [load_mesh(paths[0])]):
        with pytest.raises(ValueError, match=words):
            few.fit(given).transform(given)
    with pytest.raises(ValueError, match=r"mine\.nothing:Here"):
        VolumetricFeatures("mine.nothing:Here").fit(paths)


def test_descriptions_that_are_no_histograms_are_given_as_they_are(paths, tmp_path):
    features = VolumetricFeatures(D2(), config=CONFIG, cache_dir=tmp_path, n_workers=1)
    expected = describe(
        SignatureDataset(paths[:2], CONFIG, tmp_path),
        D2(),
        n_workers=1,
    )
    assert_allclose(features.transform(paths[:2]), expected, atol=1e-6)


def test_reading_is_passed_on(paths, tmp_path):
    """A surface with a hole is closed, unless nothing is to be mended."""
    path = tmp_path / "torn.off"
    whole = trimesh.load(paths[0], process=False)
    trimesh.Trimesh(whole.vertices, whole.faces[1:], process=False).export(path)
    how = {"config": CONFIG, "cache_dir": tmp_path / "cache", "n_workers": 1}
    features = VolumetricFeatures(D2(), reading=LoadOptions("never"), **how)
    with pytest.raises(ValueError, match="torn"):
        features.transform([path])
    mended = features.set_params(reading=None).transform([path])
    assert_allclose(mended, features.transform(paths[:1]), atol=0.05)


@pytest.mark.parametrize("descriptor", [DISTANCES, interior(n_eigenpairs=3)])
def test_columns_have_names_and_tables_have_them(paths, tmp_path, descriptor):
    features = VolumetricFeatures(descriptor, config=CONFIG, cache_dir=tmp_path, n_workers=1)
    with pytest.raises(NotFittedError):
        features.get_feature_names_out()
    values = features.fit(paths).transform(paths)
    names = features.get_feature_names_out()
    assert names.tolist() == [f"{descriptor.name}{i}" for i in range(values.shape[1])]
    pandas = pytest.importorskip("pandas")
    table = clone(features).set_output(transform="pandas").fit_transform(paths)
    assert isinstance(table, pandas.DataFrame)
    assert table.columns.tolist() == names.tolist()
    assert_array_equal(table.to_numpy(), values)
    # Names of each have the name of the step before them
    union = make_union(clone(features), clone(features)).fit(paths)
    assert len(set(union.get_feature_names_out())) == 2 * values.shape[1]


def test_parameters_are_searched(paths, features):
    labels = [path.parent.name for path in paths]
    pipeline = make_pipeline(features, KNeighborsClassifier(1))
    grid = {"volumetricfeatures__square_root": [True, False]}
    found = GridSearchCV(pipeline, grid, cv=2, error_score="raise").fit(paths, labels)
    assert found.best_score_ == 1


@pytest.mark.parametrize(
    "check",
    [
        estimator_checks.check_estimator_cloneable,
        estimator_checks.check_estimator_tags_renamed,
        estimator_checks.check_valid_tag_types,
        estimator_checks.check_estimator_repr,
        estimator_checks.check_no_attributes_set_in_init,
        estimator_checks.check_parameters_default_constructible,
        estimator_checks.check_get_params_invariance,
        estimator_checks.check_set_params,
        estimator_checks.check_mixin_order,
        estimator_checks.check_do_not_raise_errors_in_init_or_set_params,
    ],
)
def test_conventions_that_need_no_input(check):
    check("VolumetricFeatures", VolumetricFeatures())
