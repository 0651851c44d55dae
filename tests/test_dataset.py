from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch.utils.data import DataLoader

import igps.data.dataset as dataset_module
from igps.data.dataset import LabelledSignature, SignatureBatch, SignatureDataset, collate
from igps.geometry.mesh import MeshError
from igps.geometry.signature import SignatureConfig
from igps.nn.descriptor import VolumetricDescriptor
from igps.nn.extraction import describe

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=50)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two classes of two small bodies each."""
    for label, ratio in (("ball", 1.0), ("egg", 1.7)):
        for i in (1, 2):
            body = trimesh.creation.icosphere(subdivisions=2)
            body.vertices *= [1.0, 1.0 + 0.05 * i, ratio]
            path = tmp_path / "meshes" / label / f"{i}.off"
            path.parent.mkdir(parents=True, exist_ok=True)
            body.export(path)
    return tmp_path / "meshes"


@pytest.fixture
def dataset(root: Path, tmp_path: Path) -> SignatureDataset:
    return SignatureDataset(root, CONFIG, tmp_path / "cache")


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the meshes whose signature is computed, not read."""
    names: list[str] = []
    compute = dataset_module.compute_signature

    def counting(mesh, config):  # type: ignore[no-untyped-def]
        names.append(mesh.name)
        return compute(mesh, config)

    monkeypatch.setattr(dataset_module, "compute_signature", counting)
    return names


def test_items_are_labelled_and_named(dataset: SignatureDataset) -> None:
    item = dataset[2]
    assert isinstance(item, LabelledSignature)
    assert (item.id, item.label, item.signature.name) == ("egg/1.off", 1, "egg/1.off")
    assert dataset.classes == ("ball", "egg")
    assert dataset.labels.tolist() == [0, 0, 1, 1]
    assert item.signature.config == CONFIG


def test_functions_of_position_become_attributes(root: Path, tmp_path: Path) -> None:
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache", attributes={"height": lambda points: points[:, 2]})
    for part in (dataset, dataset.subset([0, 3])):
        samples = part[1].signature.interior
        np.testing.assert_allclose(samples.attributes["height"], samples.points[:, 2], rtol=1e-6)
    assert SignatureDataset(root, CONFIG, tmp_path / "cache")[0].signature.interior.attributes == {}
    broken = SignatureDataset(root, CONFIG, tmp_path / "cache", attributes={"height": lambda points: points})
    with pytest.raises(ValueError, match=r"attributes: expected 'height' to give \d+ finite numbers.*ball/1.off"):
        broken[0]


def test_computed_once_then_read(dataset: SignatureDataset, counted: list[str]) -> None:
    first, second = dataset[0].signature, dataset[0].signature
    assert len(counted) == 1
    np.testing.assert_array_equal(first.interior.eigenfunctions, second.interior.eigenfunctions)


@pytest.mark.parametrize(
    "change",
    [{"n_eigenpairs": 21}, {"resolution": 11}, {"min_samples": 300}, {"n_surface_samples": 51}, {"backend": "robust"},
     {"max_vertices": 100}, {"accuracy": None}, {"attributes": ("depth",)}, {"seed": 1}],
)  # fmt: skip
def test_key_covers_every_parameter(root: Path, tmp_path: Path, counted: list[str], change: dict[str, object]) -> None:
    SignatureDataset(root, CONFIG, tmp_path / "cache")[0]
    SignatureDataset(root, replace(CONFIG, **change), tmp_path / "cache")[0]  # type: ignore[arg-type]
    assert len(counted) == 2


def test_parametrisation_above_is_complete() -> None:
    changed = {"n_eigenpairs", "resolution", "min_samples", "n_surface_samples", "backend", "max_vertices", "accuracy",
               "attributes", "seed"}  # fmt: skip
    assert set(CONFIG.as_dict()) == changed | {"algorithm_version"}


@pytest.mark.parametrize("option", [{"repair": True}, {"component": "largest"}, {"allow_open": True}])
def test_key_covers_how_the_file_is_read(
    root: Path, tmp_path: Path, counted: list[str], option: dict[str, object]
) -> None:
    SignatureDataset(root, CONFIG, tmp_path / "cache")[0]
    SignatureDataset(root, CONFIG, tmp_path / "cache", **option)[0]  # type: ignore[arg-type]
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
    assert "boundary edges" in failure.error
    assert len(list((tmp_path / "cache").rglob("*.safetensors"))) == 4
    usable = dataset.usable(failures)
    assert usable.files.names == ("ball/1.off", "ball/2.off", "egg/1.off", "egg/2.off")
    assert usable.labels.tolist() == [0, 0, 1, 1]


def test_precompute_resumes(dataset: SignatureDataset, counted: list[str]) -> None:
    dataset[1]
    assert dataset.precompute(n_workers=1, progress=False) == []
    assert len(counted) == 4
    assert dataset.precompute(n_workers=1, progress=False) == []
    assert len(counted) == 4


def test_precompute_leaves_the_environment_alone(dataset: SignatureDataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    dataset.precompute(n_workers=2, progress=False)
    assert os.environ["OMP_NUM_THREADS"] == "3"
    assert "MKL_NUM_THREADS" not in os.environ


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


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc to see whether a process lives")
def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(
        "import os, signal\n"
        "from igps.data.dataset import process_pool\n"
        "if __name__ == '__main__':\n"
        "    with process_pool(1) as pool:\n"
        "        print(pool.submit(os.getpid).result(), flush=True)\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
    for _ in range(100):
        if not Path(f"/proc/{worker}").exists():
            return
        time.sleep(0.1)
    os.kill(worker, signal.SIGKILL)
    pytest.fail("the worker outlived its parent")


def test_two_processes_on_one_cache(root: Path, tmp_path: Path) -> None:
    datasets = [SignatureDataset(root, CONFIG, tmp_path / "cache") for _ in range(2)]
    with ThreadPoolExecutor(2) as pool:
        results = list(pool.map(lambda d: d.precompute(n_workers=2, progress=False), datasets))
    assert results == [[], []]
    assert len(list((tmp_path / "cache").rglob("*"))) - len(list((tmp_path / "cache").iterdir())) == 4
    assert all(isinstance(datasets[0][i], LabelledSignature) for i in range(4))


def test_collate_pads_without_changing_any_descriptor(dataset: SignatureDataset, root: Path, tmp_path: Path) -> None:
    fewer = SignatureDataset(root, replace(CONFIG, n_eigenpairs=12), tmp_path / "cache")
    items = [dataset[0], dataset[2], fewer[3]]
    assert len({len(item.signature.interior) for item in items}) == 3
    batch = collate(items)
    assert isinstance(batch, SignatureBatch)
    assert batch.labels.tolist() == [0, 1, 1]
    assert batch.ids == ("ball/1.off", "egg/1.off", "egg/2.off")
    assert batch.eigenvalues.shape == (3, 20)
    for samples in ("interior", "surface"):
        descriptor = VolumetricDescriptor.paper(samples)  # type: ignore[arg-type]
        together = descriptor(batch)
        alone = torch.cat([descriptor(collate([item])) for item in items])
        assert together.shape == (3, 10, 64)
        torch.testing.assert_close(together, alone, atol=1e-7, rtol=0)
        torch.testing.assert_close(together.sum(dim=(1, 2)), torch.ones(3))


def test_batch_centres_points_far_from_the_origin(tmp_path: Path) -> None:
    body = trimesh.creation.icosphere(subdivisions=2)
    body.export(tmp_path / "near.ply")
    body.vertices += 1e4
    body.export(tmp_path / "far.ply", vertex_normal=False)
    dataset = SignatureDataset([tmp_path / "near.ply", tmp_path / "far.ply"], CONFIG, tmp_path / "cache")
    near, far = collate([dataset[0], dataset[1]]).interior.points
    torch.testing.assert_close(near, far, atol=1e-3, rtol=0)


def test_works_in_a_data_loader(dataset: SignatureDataset) -> None:
    batches = list(DataLoader(dataset, batch_size=3, collate_fn=collate))
    assert [len(batch) for batch in batches] == [3, 1]
    direct = describe(dataset, VolumetricDescriptor.paper(), batch_size=1)
    in_batches = torch.cat([VolumetricDescriptor.paper()(batch) for batch in batches])
    torch.testing.assert_close(direct, in_batches, atol=1e-7, rtol=0)


def test_collate_refuses_nothing_and_unlike_attributes(dataset: SignatureDataset) -> None:
    with pytest.raises(ValueError, match="at least one"):
        collate([])
    signature = dataset[0].signature
    interior = replace(signature.interior, attributes={"depth": np.zeros(len(signature.interior), dtype=np.float32)})
    with pytest.raises(ValueError, match="depth"):
        collate([signature, replace(signature, interior=interior)])
