from dataclasses import replace
from pathlib import Path

import pytest
import torch
from pytorch_lightning import Callback, Trainer, seed_everything
from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_metric_learning.losses import TripletMarginLoss
from torch.testing import assert_close
from torch.utils.data import DataLoader

from igps.data.collation import collate
from igps.data.datamodule import Batches, SignatureDataModule
from igps.data.splits import Parts
from igps.nn.axes import InteriorDistance, Potential
from igps.nn.description import describe
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.heads.closed_form import KernelHead, WhitenedHead
from igps.nn.heads.learned import BlendedDistance, ProjectionHead
from igps.nn.histograms.pairs import PairHistogram
from igps.nn.learner import RetrievalLearner
from igps.retrieval import chi_square, retrieval_scores
from igps.shapes import ArticulatedShapes
from igps.signature.signature import SignatureConfig

PROJECT = Path(__file__).parents[2]
CONFIG = SignatureConfig(n_eigenpairs=20, resolution=12, min_samples=0, n_surface_samples=20)


@pytest.fixture(scope="module")
def shapes(tmp_path_factory):
    root = tmp_path_factory.mktemp("shapes")
    ArticulatedShapes(n_classes=3, n_per_class=6, n_vertices=700).write(root / "meshes")
    return root


def data(shapes):
    return SignatureDataModule(
        shapes / "meshes",
        Parts(n_train=4, n_validation=2),
        Batches(n_classes=3, n_per_class=3),
        CONFIG,
        cache_dir=shapes / "cache",
        n_workers=1,
    )


@pytest.fixture(scope="module")
def items(shapes):
    """The training shapes, in memory."""
    module = data(shapes)
    module.prepare_data()
    part = module.dataset.subset(module.split.train)
    return [part[i] for i in range(len(part))]


def loader(items):
    """Of no datamodule."""
    return DataLoader(items, batch_size=6, collate_fn=collate)


def bins():
    axes = [Potential(2, learnable=True), InteriorDistance(16, learnable=True)]
    return HistogramDescriptor(PairHistogram(axes, SpectralEmbedding(n_knots=5)))


def two_parts():
    return HistogramDescriptor([bins().histograms[0], PairHistogram([InteriorDistance(9)])])


def learner(head=None):
    seed_everything(3, verbose=False)
    return RetrievalLearner(bins(), BlendedDistance(head or ProjectionHead(width=8, n_hidden=16)))


def state_of(model):
    return {name: value.clone() for name, value in model.state_dict().items()}


def assert_same(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert torch.equal(value, other[name]), name


def trainer(epochs, root):
    return Trainer(
        max_epochs=epochs,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=root,
        num_sanity_val_steps=0,
    )


def test_training_moves_bins_filter_and_head_and_is_reproducible(shapes, tmp_path):
    states = []
    for _ in range(2):
        model = learner()
        before = state_of(model)
        run = trainer(3, tmp_path)
        run.fit(model, data(shapes))
        states.append(model.state_dict())
        assert {"val_ft", "val_nn", "val_dcg", "train_loss"} <= set(run.callback_metrics)
    moved = {name for name, value in states[0].items() if not torch.equal(value, before[name])}
    for part in (
        "log_gain",
        "axes.0.centres",
        "axes.1.centres",
        "head.layers",
        "plain_unit",
        "learned_unit",
    ):
        assert any(part in name for name in moved), part
    for name, value in states[0].items():
        assert_close(states[1][name], value, atol=0, rtol=0)
    for name in states[0]:
        assert not name.startswith("scores")


def test_a_checkpoint_has_the_scale_of_its_own_epoch(shapes, tmp_path):
    module = data(shapes)
    model = learner()
    run = trainer(1, tmp_path)
    run.limit_val_batches = 0
    # Saved at the end of an epoch that is not validated, and before the end of the fit.
    run.callbacks.append(
        ModelCheckpoint(tmp_path, filename="last", every_n_epochs=1, save_on_train_epoch_end=True)
    )
    run.fit(model, module)
    state = torch.load(tmp_path / "last.ckpt", weights_only=True)["state_dict"]
    fresh = learner()
    fresh.load_state_dict(state)
    fresh.eval()
    histograms = describe(module.dataset.subset(module.split.train), fresh.descriptor)
    fresh.distance.calibrate(histograms)
    for name in ("plain_unit", "learned_unit"):
        assert_close(state[f"distance.{name}"], getattr(fresh.distance, name))
        assert state[f"distance.{name}"] != 1


def test_the_loss_uses_what_the_miner_chose(shapes, tmp_path):
    seen = []

    class First(torch.nn.Module):
        """One triplet."""

        def forward(self, embeddings, labels):
            anchor, positive = (labels == labels[0]).nonzero().flatten()[:2]
            negative = (labels != labels[0]).nonzero().flatten()[0]
            return anchor.reshape(1), positive.reshape(1), negative.reshape(1)

    class Loss(TripletMarginLoss):
        def forward(self, embeddings, labels, chosen):
            seen.append([len(indices) for indices in chosen])
            return super().forward(embeddings, labels, chosen)

    plain = learner()
    model = RetrievalLearner(plain.descriptor, plain.distance, Loss(), miner=First())
    trainer(1, tmp_path).fit(model, data(shapes))
    assert seen
    for lengths in seen:
        assert lengths == [1, 1, 1]


@pytest.mark.parametrize("validated", [True, False])
def test_a_head_in_closed_form_follows_the_bins(shapes, tmp_path, validated):
    seed_everything(3, verbose=False)
    model = RetrievalLearner(two_parts(), BlendedDistance(WhitenedHead(4), share=1.0))
    module = data(shapes)
    run = trainer(2, tmp_path)
    run.limit_val_batches = 1.0 if validated else 0
    run.fit(model, module)
    for parameter in model.parameters():
        assert (parameter != 0).any()
    part = module.dataset.subset(module.split.train)
    cells = model.descriptor.part_cells
    assert cells == (3 * 16, 9)
    expected = WhitenedHead(4).fit(describe(part, model.descriptor), part.labels, cells)
    for name, value in expected.state_dict().items():
        assert_close(
            model.distance.head.state_dict()[name].abs(),
            value.abs(),
            atol=1e-4,
            rtol=0,
        )


@pytest.mark.parametrize("make", [ProjectionHead, WhitenedHead, KernelHead])
def test_any_loader_of_labelled_batches_trains(items, tmp_path, make):
    """Without a datamodule and without validation data, and the default checkpoint of an epoch holds a fitted head."""
    model = learner(make())
    before = state_of(model.descriptor)
    run = Trainer(
        max_epochs=2,
        accelerator="cpu",
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=tmp_path,
        callbacks=[ModelCheckpoint(save_on_train_epoch_end=True)],
    )
    run.fit(model, loader(items))
    assert any(
        not torch.equal(value, before[name])
        for name, value in model.descriptor.state_dict().items()
    )
    (checkpoint,) = tmp_path.rglob("*.ckpt")
    loaded = RetrievalLearner.load_from_checkpoint(
        checkpoint, descriptor=bins(), distance=BlendedDistance(make())
    ).eval()
    assert_same(loaded.state_dict(), model.state_dict())
    with torch.no_grad():
        descriptions = loaded(collate(items))
        found = loaded.distances(descriptions, descriptions)
        model.eval()
        assert_close(found, model.distances(descriptions, descriptions), atol=1e-5, rtol=1e-4)
        assert_close(model(collate(items)), descriptions, atol=1e-6, rtol=0)
    head = loaded.distance.head
    fitted = head.whitened if isinstance(head, KernelHead) else head
    if make is ProjectionHead:
        assert len(fitted.mean) == 48
        assert (fitted.mean > 0).any()
    else:
        assert_close(
            fitted.mean,
            descriptions.flatten(1).sqrt().mean(dim=0),
            atol=1e-6,
            rtol=1e-4,
        )
    # Both parts of the distance on the scale of the training shapes.
    pairs = torch.triu_indices(len(items), len(items), 1).unbind()
    plain = chi_square(descriptions, descriptions)[pairs].median()
    assert_close(loaded.distance.plain_unit, plain, atol=1e-6, rtol=1e-4)
    assert found[pairs].median() == pytest.approx(1, abs=0.5)


def test_saving_a_checkpoint_changes_nothing(items, tmp_path):
    model = learner(WhitenedHead())
    run = trainer(1, tmp_path)
    seen = []

    class Save(Callback):
        """In the midst of an epoch, in training mode."""

        def on_train_batch_end(self, trainer, module, *_):
            before = state_of(module)
            modes = [one.training for one in module.modules()]
            generator = torch.get_rng_state()
            trainer.save_checkpoint(tmp_path / "now.ckpt")
            assert_same(state_of(module), before)
            assert_same(torch.load(tmp_path / "now.ckpt", weights_only=True)["state_dict"], before)
            assert [one.training for one in module.modules()] == modes
            assert torch.equal(torch.get_rng_state(), generator)
            seen.append(module.training)

    run.callbacks.append(Save())
    run.fit(model, loader(items))
    assert seen == [True]
    before = state_of(model)
    run.save_checkpoint(tmp_path / "after.ckpt")
    assert_same(state_of(model), before)


def test_the_mode_of_each_module_outlives_a_fit(items, tmp_path):
    """A module that the caller froze in evaluation mode stays there, whenever the head is fitted."""
    modes = []
    frozen = learner()
    frozen.descriptor.eval()

    class Look(Callback):
        def on_train_batch_start(self, trainer, module, *_):
            modes.append([module.training, module.descriptor.training, module.distance.training])

    run = trainer(2, tmp_path)
    run.callbacks.append(Look())
    run.fit(frozen, loader(items))
    assert modes == [[True, False, True]] * 2


@pytest.mark.parametrize("precision", ["64-true", "bf16-true"])
def test_a_precision_that_would_write_into_batches_is_refused_with_the_remedy(
    items, tmp_path, precision
):
    run = Trainer(precision=precision, accelerator="cpu", logger=False, default_root_dir=tmp_path)
    with pytest.raises(
        ValueError, match=f"precision: expected one of .*bf16-mixed, got {precision}"
    ):
        run.fit(learner(), loader(items))


def test_a_checkpoint_that_names_a_foreign_class_is_refused(items, tmp_path):
    model = learner()
    run = trainer(1, tmp_path)
    run.fit(model, loader(items))
    run.save_checkpoint(tmp_path / "own.ckpt")
    made = {"descriptor": bins(), "distance": BlendedDistance(ProjectionHead(width=8, n_hidden=16))}
    loaded = RetrievalLearner.load_from_checkpoint(tmp_path / "own.ckpt", **made)
    assert loaded.hparams["learning_rate"] == 1e-3
    stored = torch.load(tmp_path / "own.ckpt", weights_only=True)
    foreign = tmp_path / "foreign.ckpt"
    for miner in (
        {"class_path": "elsewhere.miners.Harmless"},
        {
            "class_path": "torch.nn.Identity",
            "init_args": {"inner": [{"class_path": "elsewhere.Harmless"}]},
        },
        {"_class_path": "elsewhere.Harmless"},
    ):
        torch.save(
            {**stored, "hyper_parameters": {**stored["hyper_parameters"], "miner": miner}}, foreign
        )
        with pytest.raises(
            ValueError, match=r"foreign.ckpt: names the class elsewhere\..*pass trusted=\[...\]"
        ):
            RetrievalLearner.load_from_checkpoint(foreign, **made)
        with (
            foreign.open("rb") as stream,
            pytest.raises(ValueError, match=r"names the class elsewhere\."),
        ):
            RetrievalLearner.load_from_checkpoint(stream, **made)
        RetrievalLearner.load_from_checkpoint(foreign, **made, miner=None, trusted=["elsewhere"])
    with foreign.open("wb") as stream:
        torch.save(stored, stream)
    with foreign.open("rb") as stream:
        assert_same(
            RetrievalLearner.load_from_checkpoint(stream, **made).state_dict(), model.state_dict()
        )


def test_a_lazy_head_has_its_size_before_the_optimiser_is_made():
    model = RetrievalLearner(two_parts(), BlendedDistance(ProjectionHead(width=4)))
    for one in model.parameters():
        assert not isinstance(one, torch.nn.UninitializedParameter)
    assert model.distance.head.layers[1].in_features == 3 * 16 + 9
    assert model.distance.head.training


def test_any_module_describes(items, tmp_path):
    class Plain(torch.nn.Module):
        """Cells that are learned, whatever the shape."""

        def __init__(self):
            super().__init__()
            self.cells = torch.nn.Parameter(torch.zeros(5))

        def forward(self, batch):
            means = batch.interior.points.abs().mean(dim=1)
            return (self.cells + means[:, [0, 1, 2, 0, 1]]).softmax(dim=1)

    seed_everything(3, verbose=False)
    model = RetrievalLearner(Plain(), BlendedDistance(WhitenedHead(2)))
    trainer(1, tmp_path).fit(model, loader(items))
    assert model.distance.head.part_cells.tolist() == [5]
    assert (model.descriptor.cells != 0).any()


def test_bodies_of_unknown_classes_are_refused(items, tmp_path):
    """As −1 all would be of one class, and every score the best."""
    unknown = [replace(item, label=-1) for item in items]
    with pytest.raises(ValueError, match="labels: expected the class of each body, got −1"):
        trainer(1, tmp_path).fit(
            learner(),
            loader([*items[:-1], unknown[-1]]),
        )
    with pytest.raises(ValueError, match="query_labels: expected known classes, got −1"):
        trainer(1, tmp_path).test(learner(), loader(unknown), verbose=False)


def test_several_training_loaders_are_refused(items, tmp_path):
    with pytest.raises(ValueError, match="train_dataloaders: expected one DataLoader, got list"):
        trainer(1, tmp_path).fit(
            learner(),
            [loader(items), loader(items)],
        )


def test_without_head_the_test_scores_are_the_plain_ones(shapes, tmp_path):
    module = data(shapes)
    module.prepare_data()
    model = RetrievalLearner(HistogramDescriptor(PairHistogram()), BlendedDistance())
    (logged,) = trainer(1, tmp_path).test(model, module, verbose=False)
    part = module.dataset.subset(module.split.test)
    histograms = describe(part, HistogramDescriptor(PairHistogram()))
    expected = retrieval_scores(chi_square(histograms, histograms), part.labels).mean()
    assert {name.removeprefix("test_"): value for name, value in logged.items()} == pytest.approx(
        expected, abs=1e-6
    )
    with pytest.raises(ValueError, match="expected a head to train"):
        trainer(1, tmp_path).fit(model, module)
