import shutil

import numpy as np
import pytest
import torch
import trimesh

from bodies_on_disk import write_body
from igps.data.datamodule import Batches, SignatureDataModule
from igps.data.splits import Parts
from igps.mesh.errors import MeshError
from igps.mesh.options import LoadOptions
from igps.signature.signature import SignatureConfig

CONFIG = SignatureConfig(n_eigenpairs=12, resolution=8, min_samples=0, n_surface_samples=20)
FEW = Parts(n_train=2, n_validation=0)


@pytest.fixture
def root(tmp_path):
    for label in range(3):
        for i in range(5):
            path = tmp_path / "meshes" / f"class{label}" / f"{i}.off"
            write_body(path, 1.0 + 0.1 * i, 1.0 + label)
    return tmp_path / "meshes"


def test_loaders_give_the_parts_and_balanced_batches(root, tmp_path):
    module = SignatureDataModule(
        root,
        Parts("seen", n_train=4, n_validation=2),
        Batches(n_classes=3, n_per_class=2),
        CONFIG,
        cache_dir=tmp_path / "cache",
        n_workers=1,
    )
    module.prepare_data()
    names = module.dataset.bodies.names
    (batch,) = module.train_dataloader()
    assert sorted(batch.labels.tolist()) == [0, 0, 1, 1, 2, 2]
    assert set(batch.ids) <= {names[i] for i in module.split.train}
    for loader, part in (
        (module.val_dataloader(), module.split.validation),
        (module.test_dataloader(), module.split.test),
    ):
        ids = [name for batch in loader for name in batch.ids]
        assert ids == [names[i] for i in part]


@pytest.mark.parametrize("n_samples", [20, None])
def test_training_shapes_are_kept_in_memory_thinned(root, tmp_path, n_samples):
    module = SignatureDataModule(
        root,
        FEW,
        Batches(n_classes=3, n_per_class=2, n_samples=n_samples),
        CONFIG,
        cache_dir=tmp_path / "cache",
        n_workers=1,
    )
    module.prepare_data()
    items = [module.dataset[i] for i in module.split.train]
    whole = {item.id: item.signature.interior for item in items}
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


def test_batches_of_nothing_are_refused():
    with pytest.raises(ValueError, match="n_samples: expected at least 2, got -3"):
        Batches(n_samples=-3)


def test_a_bad_mesh_stops_training(root, tmp_path):
    (root / "class1" / "9.off").write_text("nothing")
    module = SignatureDataModule(root, FEW, config=CONFIG, cache_dir=tmp_path, n_workers=1)
    with pytest.raises(MeshError, match=r"9\.off"):
        module.prepare_data()


def test_needs_classes(root):
    with pytest.raises(ValueError, match="no classes found"):
        SignatureDataModule(root / "class0")


def test_impossible_protocols_are_refused(root):
    with pytest.raises(ValueError, match="protocol: expected one of seen, unseen, got 'some'"):
        SignatureDataModule(root, Parts("some"))


def test_meshes_are_read_as_asked(root, tmp_path):
    """A mesh with a hole stops training, unless holes are allowed."""
    mesh = trimesh.load(root / "class1" / "2.off", process=False)
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    mesh.export(root / "class1" / "2.off")

    def module(**options):
        return SignatureDataModule(
            root,
            FEW,
            config=CONFIG,
            cache_dir=tmp_path / "cache",
            n_workers=1,
            **options,
        )

    with pytest.raises(MeshError, match=r"2\.off.*boundary edges"):
        module(reading=LoadOptions("never")).prepare_data()
    module(reading=LoadOptions("never", allow_open=True)).prepare_data()


def test_nothing_to_validate_on_is_no_loader(root, tmp_path):
    module = SignatureDataModule(root, FEW, config=CONFIG, cache_dir=tmp_path, n_workers=1)
    assert module.val_dataloader() == []


def test_without_a_configuration_a_checkpoint_keeps_nothing_of_the_data(root):
    """Paths and configurations could be read only by running code."""
    assert SignatureDataModule(root, FEW, config=CONFIG).hparams == {}


def test_a_validation_part_without_pairs_is_refused_where_it_is_given(root):
    with pytest.raises(ValueError, match="n_validation: expected at least 2 bodies of a class"):
        SignatureDataModule(root, Parts(n_train=3, n_validation=1), config=CONFIG)
