from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest
import torch
import yaml
from pytorch_lightning import Trainer, seed_everything
from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_metric_learning.losses import TripletMarginLoss

from igps.data.datamodule import SignatureDataModule
from igps.geometry.signature import SignatureConfig
from igps.nn.descriptor import VolumetricDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.extraction import describe
from igps.nn.fitted import WhitenedHead
from igps.nn.head import CorrectedDistance, MetricHead
from igps.nn.histogram import PairHistogram
from igps.nn.learner import RetrievalLearner
from igps.retrieval import chi_square, retrieval_scores
from igps.shapes import ArticulatedShapes

PROJECT = Path(__file__).parents[1]
CONFIG = SignatureConfig(n_eigenpairs=20, resolution=12, min_samples=0, n_surface_samples=20)


@pytest.fixture(scope="module")
def shapes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("shapes")
    ArticulatedShapes(n_classes=3, n_per_class=6, n_vertices=700).write(root / "meshes")
    return root


def data(shapes: Path) -> SignatureDataModule:
    return SignatureDataModule(
        shapes / "meshes", n_train=4, n_validation=2, classes_per_batch=3, shapes_per_class=3, config=CONFIG,
        cache_dir=shapes / "cache", n_workers=1,
    )  # fmt: skip


def learner() -> RetrievalLearner:
    seed_everything(3, verbose=False)
    descriptor = VolumetricDescriptor(SpectralEmbedding(n_knots=5), PairHistogram(2, 16, learnable=True))
    return RetrievalLearner(descriptor, CorrectedDistance(MetricHead(3 * 16, width=8, n_hidden=16)))


def trainer(epochs: int, root: Path) -> Trainer:
    return Trainer(
        max_epochs=epochs, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, default_root_dir=root, num_sanity_val_steps=0,
    )  # fmt: skip


def test_training_moves_bins_filter_and_head_and_is_reproducible(shapes: Path, tmp_path: Path) -> None:
    states = []
    for _ in range(2):
        model = learner()
        before = {name: value.clone() for name, value in model.state_dict().items()}
        run = trainer(3, tmp_path)
        run.fit(model, data(shapes))
        states.append(model.state_dict())
        assert {"val_ft", "val_nn", "val_dcg", "train_loss"} <= set(run.callback_metrics)
    moved = {name for name, value in states[0].items() if not torch.equal(value, before[name])}
    for part in ("log_gain", "distance_centres", "potential_centres", "head.layers", "plain_unit", "learned_unit"):
        assert any(part in name for name in moved), part
    for name, value in states[0].items():
        torch.testing.assert_close(states[1][name], value, atol=0, rtol=0)
    assert not any(name.startswith("scores") for name in states[0])


def test_a_checkpoint_has_the_scale_of_its_own_epoch(shapes: Path, tmp_path: Path) -> None:
    module, model = data(shapes), learner()
    run = trainer(1, tmp_path)
    run.limit_val_batches = 0
    # Saved at the end of an epoch that is not validated, and before the end of the fit.
    run.callbacks.append(ModelCheckpoint(tmp_path, filename="last", every_n_epochs=1, save_on_train_epoch_end=True))  # type: ignore[attr-defined]
    run.fit(model, module)
    state = torch.load(tmp_path / "last.ckpt", weights_only=True)["state_dict"]
    fresh = learner()
    fresh.load_state_dict(state)
    fresh.eval()
    histograms = describe(module.dataset.subset(module.split.train), fresh.descriptor)
    fresh.distance.calibrate(histograms)
    for name in ("plain_unit", "learned_unit"):
        torch.testing.assert_close(state[f"distance.{name}"], getattr(fresh.distance, name))
        assert state[f"distance.{name}"] != 1


def test_the_loss_uses_what_the_miner_chose(shapes: Path, tmp_path: Path) -> None:
    seen = []

    class First(torch.nn.Module):
        """One triplet."""

        def forward(self, embeddings: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, ...]:
            anchor, positive = (labels == labels[0]).nonzero().flatten()[:2]
            return tuple(i.reshape(1) for i in (anchor, positive, (labels != labels[0]).nonzero().flatten()[0]))

    class Loss(TripletMarginLoss):
        def forward(self, embeddings: torch.Tensor, labels: torch.Tensor, chosen: tuple) -> torch.Tensor:  # type: ignore[override]
            seen.append([len(indices) for indices in chosen])
            return super().forward(embeddings, labels, chosen)

    plain = learner()
    model = RetrievalLearner(plain.descriptor, plain.distance, Loss(), miner=First())
    trainer(1, tmp_path).fit(model, data(shapes))
    assert seen
    assert all(lengths == [1, 1, 1] for lengths in seen)


def test_a_head_in_closed_form_follows_the_bins(shapes: Path, tmp_path: Path) -> None:
    seed_everything(3, verbose=False)
    descriptor = VolumetricDescriptor(SpectralEmbedding(n_knots=5), PairHistogram(2, 16, learnable=True))
    model = RetrievalLearner(descriptor, CorrectedDistance(WhitenedHead(3 * 16, 4), share=1.0))
    module = data(shapes)
    trainer(2, tmp_path).fit(model, module)
    assert all((parameter != 0).any() for parameter in model.parameters())
    part = module.dataset.subset(module.split.train)
    expected = WhitenedHead(3 * 16, 4).fit(describe(part, model.eval().descriptor), part.labels)
    for name, value in expected.state_dict().items():
        torch.testing.assert_close(model.distance.head.state_dict()[name].abs(), value.abs(), atol=1e-4, rtol=0)


def test_without_head_the_test_scores_are_the_plain_ones(shapes: Path, tmp_path: Path) -> None:
    module = data(shapes)
    module.prepare_data()
    model = RetrievalLearner(VolumetricDescriptor.paper(), CorrectedDistance())
    (logged,) = trainer(1, tmp_path).test(model, module, verbose=False)
    part = module.dataset.subset(module.split.test)
    histograms = describe(part, VolumetricDescriptor.paper())
    expected = retrieval_scores(chi_square(histograms, histograms), part.labels).mean()
    assert {name.removeprefix("test_"): value for name, value in logged.items()} == pytest.approx(expected, abs=1e-6)
    with pytest.raises(ValueError, match="expected a head to train"):
        trainer(1, tmp_path).fit(model, module)


def test_smoke_configuration_trains_and_its_checkpoint_loads_without_running_code(
    shapes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ["fit", "--config", PROJECT / "configs/default.yaml", "--config", PROJECT / "configs/smoke.yaml"]
    arguments += ["--data.root", shapes / "meshes", "--data.cache_dir", shapes / "cache", "--data.n_train", "4"]
    arguments += [
        "--data.config.n_eigenpairs",
        "20",
        "--data.config.resolution",
        "12",
        "--data.config.min_samples",
        "0",
    ]
    arguments += ["--data.config.n_surface_samples", "20", "--data.n_workers", "1"]
    arguments += ["--trainer.default_root_dir", tmp_path]
    monkeypatch.setattr(sys, "argv", ["train.py", *map(str, arguments)])
    runpy.run_path(str(PROJECT / "training/train.py"), run_name="__main__")
    (checkpoint,) = tmp_path.rglob("*.ckpt")
    state = torch.load(checkpoint, weights_only=True)["state_dict"]
    assert state["descriptor.embedding.log_gain"].shape == (12,)
    (stored,) = tmp_path.rglob("config.yaml")
    configuration = yaml.safe_load(stored.read_text())
    assert configuration["data"]["split_seed"] == 0
    assert configuration["model"]["descriptor"]["init_args"]["histogram"]["init_args"]["n_bins"] == 64
