from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
import trimesh

from igps.data.datamodule import SignatureDataModule, Split, split_seen, split_unseen
from igps.geometry.mesh import MeshError
from igps.geometry.signature import SignatureConfig

LABELS = torch.arange(8).repeat_interleave(6)[torch.randperm(48, generator=torch.Generator().manual_seed(1))]
CONFIG = SignatureConfig(n_eigenpairs=12, resolution=8, min_samples=0, n_surface_samples=20)


def classes(indices: tuple[int, ...]) -> list[int]:
    return sorted(LABELS[list(indices)].tolist())


def disjoint(split: Split) -> bool:
    parts = [set(part) for part in (split.train, split.validation, split.test)]
    return sum(map(len, parts)) == len(set.union(*parts))


def test_seen_split_takes_the_same_number_of_every_class() -> None:
    split = split_seen(LABELS, 4, n_validation=1, seed=3)
    assert disjoint(split)
    assert classes(split.train) == sorted([*range(8)] * 3)
    assert classes(split.validation) == [*range(8)]
    assert classes(split.test) == sorted([*range(8)] * 2)


def test_unseen_split_shares_no_class() -> None:
    split = split_unseen(LABELS, 5, n_validation=2, seed=3)
    assert disjoint(split)
    parts = [set(classes(part)) for part in (split.train, split.validation, split.test)]
    assert [len(part) for part in parts] == [3, 2, 3]
    assert len(set.union(*parts)) == 8
    assert len(split.train) == 3 * 6


def test_fewer_training_classes_keep_the_test_classes() -> None:
    many, few = (split_unseen(LABELS, n, n_test=2, seed=5) for n in (6, 3))
    assert many.test == few.test
    assert set(few.train) < set(many.train)


def test_validation_is_taken_from_the_training_part_alone() -> None:
    for split in (split_seen, split_unseen):
        assert split(LABELS, 4, seed=2).test == split(LABELS, 4, n_validation=2, seed=2).test


def test_splits_depend_on_the_seed_alone() -> None:
    for split in (split_seen, split_unseen):
        torch.manual_seed(0)
        first = split(LABELS, 4, seed=1)
        torch.manual_seed(1)
        assert split(LABELS, 4, seed=1) == first
        assert split(LABELS, 4, seed=2) != first


@pytest.mark.parametrize(
    ("split", "arguments", "name"),
    [
        (split_seen, {"n_train": 6}, "n_train"),
        (split_seen, {"n_train": 3, "n_validation": 3}, "n_validation"),
        (split_unseen, {"n_train": 8}, "n_train"),
        (split_unseen, {"n_train": 6, "n_test": 3}, "n_test"),
        (split_unseen, {"n_train": 3, "n_validation": 3}, "n_validation"),
    ],
)
def test_impossible_splits_are_refused(split, arguments: dict[str, int], name: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=name):
        split(LABELS, **arguments)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for label in range(3):
        for i in range(4):
            body = trimesh.creation.icosphere(subdivisions=2)
            body.vertices *= [1.0, 1.0 + 0.1 * i, 1.0 + label]
            path = tmp_path / "meshes" / f"class{label}" / f"{i}.off"
            path.parent.mkdir(parents=True, exist_ok=True)
            body.export(path)
    return tmp_path / "meshes"


def test_loaders_give_the_parts_and_balanced_batches(root: Path, tmp_path: Path) -> None:
    module = SignatureDataModule(
        root, "seen", n_train=3, n_validation=1, classes_per_batch=3, shapes_per_class=2, config=CONFIG,
        cache_dir=tmp_path / "cache", n_workers=1,
    )  # fmt: skip
    module.prepare_data()
    names = module.dataset.files.names
    (batch,) = module.train_dataloader()
    assert sorted(batch.labels.tolist()) == [0, 0, 1, 1, 2, 2]
    assert set(batch.ids) <= {names[i] for i in module.split.train}
    for loader, part in (
        (module.val_dataloader(), module.split.validation),
        (module.test_dataloader(), module.split.test),
    ):
        ids = [name for batch in loader for name in batch.ids]  # type: ignore[union-attr]
        assert ids == [names[i] for i in part]


@pytest.mark.parametrize("n_samples", [20, None])
def test_training_shapes_are_kept_in_memory_thinned(root: Path, tmp_path: Path, n_samples: int | None) -> None:
    module = SignatureDataModule(
        root, n_train=3, n_validation=1, classes_per_batch=3, shapes_per_class=2, config=CONFIG,
        cache_dir=tmp_path / "cache", n_workers=1, n_samples_in_memory=n_samples,
    )  # fmt: skip
    module.prepare_data()
    whole = {item.id: item.signature.interior for item in (module.dataset[i] for i in module.split.train)}
    (batch,) = module.train_dataloader()
    shutil.rmtree(tmp_path / "cache")
    for i, name in enumerate(batch.ids):
        kept = batch.interior.eigenfunctions[i, batch.interior.mask[i]]
        assert len(kept) == (n_samples or len(whole[name]))
        among = (kept[:, None] == torch.from_numpy(whole[name].eigenfunctions)).all(dim=2)
        assert among.any(dim=1).all()
    if n_samples is not None:
        assert len(list(module.train_dataloader())) == 1  # without the cache
        shutil.rmtree(root)
        assert len(list(module.train_dataloader())) == 1


def test_a_single_sample_in_memory_is_refused(root: Path) -> None:
    with pytest.raises(ValueError, match="n_samples_in_memory: expected None or at least 2, got -3"):
        SignatureDataModule(root, n_samples_in_memory=-3)


def test_a_bad_mesh_stops_training(root: Path, tmp_path: Path) -> None:
    (root / "class1" / "9.off").write_text("nothing")
    module = SignatureDataModule(root, n_train=2, n_validation=0, config=CONFIG, cache_dir=tmp_path, n_workers=1)
    with pytest.raises(MeshError, match=r"9\.off"):
        module.prepare_data()


def test_needs_classes(root: Path) -> None:
    with pytest.raises(ValueError, match="no classes found"):
        SignatureDataModule(root / "class0")
