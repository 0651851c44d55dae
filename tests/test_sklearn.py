from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from sklearn.base import clone
from sklearn.neighbors import KNeighborsClassifier
from sklearn.pipeline import make_pipeline
from sklearn.utils.estimator_checks import check_estimator

from igps.data.dataset import SignatureDataset
from igps.geometry.reading import load_mesh
from igps.geometry.signature import SignatureConfig
from igps.nn.descriptor import VolumetricDescriptor
from igps.nn.extraction import describe
from igps.sklearn import VolumetricFeatures

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=12, min_samples=0, n_surface_samples=20)


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
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
def features(tmp_path: Path) -> VolumetricFeatures:
    return VolumetricFeatures("interior", config=CONFIG, cache_dir=tmp_path, n_workers=1)


def test_features_are_the_roots_of_the_histograms(
    paths: list[Path], features: VolumetricFeatures, tmp_path: Path
) -> None:
    histograms = describe(SignatureDataset(paths, CONFIG, tmp_path), VolumetricDescriptor.paper()).flatten(1).numpy()
    np.testing.assert_allclose(features.fit_transform(paths), np.sqrt(histograms), atol=1e-6)
    plain = clone(features).set_params(square_root=False)
    np.testing.assert_allclose(plain.transform([str(path) for path in paths]), histograms, atol=1e-6)


def test_meshes_give_what_their_files_give(paths: list[Path], features: VolumetricFeatures) -> None:
    meshes = [load_mesh(path) for path in paths[:2]]
    np.testing.assert_allclose(features.transform(meshes), features.transform(paths[:2]), atol=1e-6)


def test_rich_features_bring_their_attributes(paths: list[Path], tmp_path: Path) -> None:
    rich = VolumetricFeatures("rich", cache_dir=tmp_path, n_workers=1).transform(paths[:1])
    assert rich.shape == (1, 27420)
    np.testing.assert_allclose((rich**2).sum(), 1, rtol=1e-4)


def test_pipeline_classifies(paths: list[Path], features: VolumetricFeatures) -> None:
    labels = [path.parent.name for path in paths]
    pipeline = make_pipeline(features, KNeighborsClassifier(1)).fit(paths[::2], labels[::2])
    assert pipeline.score(paths[1::2], labels[1::2]) == 1


def test_other_input_is_refused(features: VolumetricFeatures) -> None:
    with pytest.raises(TypeError, match="X: expected paths of mesh files, or meshes, got int"):
        features.transform([1, 2])
    with pytest.raises(TypeError, match="got nothing"):
        features.fit([])
    with pytest.raises(ValueError, match="descriptor: expected one of interior"):
        VolumetricFeatures("unknown").fit(["a.off"])  # type: ignore[arg-type]


def test_conventions_of_scikit_learn(features: VolumetricFeatures) -> None:
    results = check_estimator(VolumetricFeatures(), on_fail=None)
    failed = {result["check_name"] for result in results if result["status"] == "failed"}
    assert failed == set()
    assert any(result["status"] == "passed" for result in results)
