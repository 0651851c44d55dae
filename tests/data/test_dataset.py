from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from bodies_on_disk import write_body
from torch.utils.data import DataLoader

import igps.data.pipeline as pipeline_module
from igps._parallel import Failed, Limits
from igps.data.batch import LabelledSignature, SignatureBatch, collate
from igps.data.dataset import Failure, SignatureDataset
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions
from igps.signature.signature import SignatureConfig

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=50)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two classes of two small bodies each."""
    for label, ratio in (("ball", 1.0), ("egg", 1.7)):
        for i in (1, 2):
            write_body(tmp_path / "meshes" / label / f"{i}.off", 1.0 + 0.05 * i, ratio)
    return tmp_path / "meshes"


@pytest.fixture
def dataset(root: Path, tmp_path: Path) -> SignatureDataset:
    return SignatureDataset(root, CONFIG, tmp_path / "cache")


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the meshes whose signature is computed, not read."""
    names: list[str] = []
    compute = pipeline_module.compute_signature

    def counting(mesh, config):  # type: ignore[no-untyped-def]
        names.append(mesh.name)
        return compute(mesh, config)

    monkeypatch.setattr(pipeline_module, "compute_signature", counting)
    return names


def test_items_are_labelled_and_named(dataset: SignatureDataset) -> None:
    item = dataset[2]
    assert isinstance(item, LabelledSignature)
    assert (item.id, item.label, item.signature.name) == ("egg/1.off", 1, "egg/1.off")
    assert dataset.classes == ("ball", "egg")
    assert dataset.labels.tolist() == [0, 0, 1, 1]
    assert item.signature.config == CONFIG


def test_functions_of_position_become_attributes(root: Path, tmp_path: Path) -> None:
    dataset = SignatureDataset(
        root, CONFIG, tmp_path / "cache", point_functions={"height": lambda points: points[:, 2]}
    )
    for part in (dataset, dataset.subset([0, 3])):
        samples = part[1].signature.interior
        np.testing.assert_allclose(samples.attributes["height"], samples.points[:, 2], rtol=1e-6)
    assert SignatureDataset(root, CONFIG, tmp_path / "cache")[0].signature.interior.attributes == {}
    wrong = {"height": lambda points: points}
    broken = SignatureDataset(root, CONFIG, tmp_path / "cache", point_functions=wrong)
    with pytest.raises(ValueError, match=r"point_functions: expected 'height' to give \d+ finite numbers.*ball/1.off"):
        broken[0]


def test_computed_once_then_read(dataset: SignatureDataset, counted: list[str]) -> None:
    first, second = dataset[0].signature, dataset[0].signature
    assert len(counted) == 1
    np.testing.assert_array_equal(first.interior.eigenfunctions, second.interior.eigenfunctions)


@pytest.mark.parametrize(
    "change",
    [{"n_eigenpairs": 21}, {"resolution": 11}, {"min_samples": 300}, {"n_surface_samples": 51}, {"backend": "robust"},
     {"max_vertices": 100}, {"accuracy": None}, {"attributes": ("depth",)}, {"seed": 1}, {"least_vertices": 200}],
)  # fmt: skip
def test_key_covers_every_parameter(root: Path, tmp_path: Path, counted: list[str], change: dict[str, object]) -> None:
    SignatureDataset(root, CONFIG, tmp_path / "cache")[0]
    SignatureDataset(root, replace(CONFIG, **change), tmp_path / "cache")[0]  # type: ignore[arg-type]
    assert len(counted) == 2


def test_parametrisation_above_is_complete() -> None:
    changed = {"n_eigenpairs", "resolution", "min_samples", "n_surface_samples", "backend", "max_vertices", "accuracy",
               "attributes", "seed"}  # fmt: skip
    assert set(CONFIG.as_dict()) == changed | {"algorithm_version"}
    assert {field.name for field in fields(CONFIG)} == changed | {"least_vertices"}


@pytest.mark.parametrize("option", [{"mend": "always"}, {"component": "largest"}, {"allow_open": True}])
def test_key_covers_how_the_file_is_read(
    root: Path, tmp_path: Path, counted: list[str], option: dict[str, object]
) -> None:
    SignatureDataset(root, CONFIG, tmp_path / "cache")[0]
    SignatureDataset(root, CONFIG, tmp_path / "cache", reading=LoadOptions(**option))[0]  # type: ignore[arg-type]
    assert len(counted) == 2


def test_key_covers_content_and_version_but_not_the_path(
    root: Path, tmp_path: Path, counted: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    dataset[0]
    (root / "ball" / "1.off").rename(root / "egg" / "9.off")
    moved = SignatureDataset(root, CONFIG, tmp_path / "cache")
    assert moved[3].id == moved[3].signature.name == "egg/9.off"
    assert len(counted) == 1
    (root / "egg" / "9.off").write_text((root / "egg" / "1.off").read_text())
    moved[3]
    assert len(counted) == 2
    monkeypatch.setattr(SignatureConfig, "ALGORITHM_VERSION", SignatureConfig.ALGORITHM_VERSION + 1)
    moved[3]
    assert len(counted) == 3


def test_truncated_file_is_reported_and_computed_again(
    dataset: SignatureDataset, counted: list[str], caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    before = dataset[0].signature
    (file,) = (tmp_path / "cache").rglob("*.safetensors")
    file.write_bytes(file.read_bytes()[:100])
    with caplog.at_level(logging.WARNING):
        after = dataset[0].signature
    assert str(file) in caplog.text
    assert len(counted) == 2
    np.testing.assert_array_equal(after.interior.eigenfunctions, before.interior.eigenfunctions)


@pytest.mark.parametrize("how", ["processes", "inline", "threads"])
def test_precompute_fills_the_cache_and_lists_bad_meshes(root: Path, tmp_path: Path, how: str) -> None:
    (root / "egg" / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    if how == "threads":
        with ThreadPoolExecutor(2) as pool:
            failures = dataset.precompute(pool, progress=False)
    else:
        failures = dataset.precompute(n_workers=2 if how == "processes" else 1, progress=False)
    (failure,) = failures
    assert failure.id == "egg/bad.off"
    assert "a single triangle" in failure.error
    assert len(list((tmp_path / "cache").rglob("*.safetensors"))) == 4
    usable = dataset.usable(failures)
    assert usable.bodies.names == ("ball/1.off", "ball/2.off", "egg/1.off", "egg/2.off")
    assert usable.labels.tolist() == [0, 0, 1, 1]


def test_precompute_resumes(dataset: SignatureDataset, counted: list[str]) -> None:
    dataset[1]
    assert dataset.precompute(n_workers=1, progress=False) == []
    assert len(counted) == 4
    assert dataset.precompute(n_workers=1, progress=False) == []
    assert len(counted) == 4


def test_strict_stops_at_a_bad_mesh(root: Path, tmp_path: Path) -> None:
    (root / "egg" / "bad.off").write_text("nothing")
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    with pytest.raises(MeshError, match=r"bad\.off"):
        dataset.precompute(n_workers=1, strict=True, progress=False)


def test_a_missing_file_is_a_failure_like_any_other(root: Path, tmp_path: Path) -> None:
    dataset = SignatureDataset([root / "ball" / "1.off", root / "gone.off"], CONFIG, tmp_path / "cache")
    (failure,) = dataset.precompute(n_workers=1, progress=False)
    assert "gone.off" in failure.error
    with pytest.raises(MeshError, match=r"gone\.off"):
        dataset[1]


def test_two_processes_on_one_cache(root: Path, tmp_path: Path) -> None:
    datasets = [SignatureDataset(root, CONFIG, tmp_path / "cache") for _ in range(2)]
    with ThreadPoolExecutor(2) as pool:
        results = list(pool.map(lambda d: d.precompute(n_workers=2, progress=False), datasets))
    assert results == [[], []]
    assert len(list((tmp_path / "cache").rglob("*"))) - len(list((tmp_path / "cache").iterdir())) == 4
    assert all(isinstance(datasets[0][i], LabelledSignature) for i in range(4))


def test_works_in_a_data_loader(dataset: SignatureDataset) -> None:
    batches = list(DataLoader(dataset, batch_size=3, collate_fn=collate))
    assert [batch.ids for batch in batches] == [("ball/1.off", "ball/2.off", "egg/1.off"), ("egg/2.off",)]
    for batch, first in zip(batches, (0, 3), strict=True):
        direct = collate([dataset[first + i] for i in range(len(batch))])
        assert torch.equal(batch.interior.eigenfunctions, direct.interior.eigenfunctions)
        assert torch.equal(batch.labels, direct.labels)


def test_batch_has_the_meshes_on_demand(dataset: SignatureDataset) -> None:
    assert dataset.batch([3, 1]).meshes is None
    batch = dataset.batch([3, 1], meshes=True)
    assert isinstance(batch, SignatureBatch)
    assert batch.ids == ("egg/2.off", "ball/2.off")
    assert batch.labels.tolist() == [1, 0]
    for mesh, body, i in zip(batch.meshes or (), batch.bodies(), (3, 1), strict=True):
        np.testing.assert_array_equal(mesh.vertices, dataset.mesh(i).vertices)
        assert mesh.area == pytest.approx(body.area)


def test_slow_meshes_are_listed(dataset: SignatureDataset, tmp_path: Path) -> None:
    (failure,) = dataset.subset([2]).precompute(n_workers=1, progress=False, limits=Limits(seconds=1e-6))
    assert failure.id == "egg/1.off"
    assert failure.error.startswith(f"{failure.path}: it took longer than the time_limit")
    assert not list((tmp_path / "cache").rglob("*.safetensors"))


def test_a_failure_names_its_file_once(dataset: SignatureDataset) -> None:
    path = dataset.bodies.paths[2]
    expected = Failure("egg/1.off", path, f"{path}: bad")
    assert dataset.failure(2, Failed("bad")) == dataset.failure(2, Failed(f"{path}: bad")) == expected
