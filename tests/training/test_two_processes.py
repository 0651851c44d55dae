"""Lightning on two processes finds the scores that it finds on one."""

import pytest
import torch
from pytorch_lightning import Trainer, seed_everything

from igps.data.datamodule import Batches, SignatureDataModule
from igps.data.splits import Parts
from igps.nn.axes import InteriorDistance, Potential
from igps.nn.description import describe
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.heads.learned import BlendedDistance, ProjectionHead
from igps.nn.histograms.pairs import PairHistogram
from igps.nn.learner import RetrievalLearner
from igps.retrieval import retrieval_scores
from igps.shapes import ArticulatedShapes
from igps.signature.signature import SignatureConfig

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=12, min_samples=0, n_surface_samples=20)

pytestmark = pytest.mark.skipif(
    not (torch.distributed.is_available() and torch.distributed.is_gloo_available()),
    reason="this build of torch has no gloo, by which two processes could speak to each other",
)


@pytest.fixture(scope="module")
def module(tmp_path_factory):
    """Nine shapes to validate: on two processes one is dealt out twice."""
    root = tmp_path_factory.mktemp("two_processes")
    ArticulatedShapes(n_classes=3, n_per_class=8, n_vertices=500).write(root / "meshes")
    data = SignatureDataModule(
        root / "meshes",
        Parts(n_train=5, n_validation=3),
        Batches(n_classes=3, n_per_class=2),
        CONFIG,
        cache_dir=root / "cache",
        n_workers=1,
    )
    data.prepare_data()
    return data


def trainer(n_processes, root):
    # Processes of their own for two: those of the tests have no script that could be started again.
    return Trainer(
        max_epochs=1,
        accelerator="cpu",
        devices=n_processes,
        strategy="ddp_spawn" if n_processes > 1 else "auto",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=root,
        num_sanity_val_steps=0,
    )


def in_two_processes(work):
    """The result of what starts two processes; the test is skipped where no process can be started."""
    try:
        return work()
    except (OSError, torch.multiprocessing.ProcessExitedException) as error:
        pytest.skip(f"no two processes here: {error}")


def test_scores_on_two_processes_are_those_on_one(module, tmp_path):
    seed_everything(3, verbose=False)
    axes = [
        Potential(2, learnable=True),
        InteriorDistance(16, learnable=True),
    ]
    descriptor = HistogramDescriptor(PairHistogram(axes, SpectralEmbedding()))
    distance = BlendedDistance(ProjectionHead(width=8, n_hidden=16))
    model = RetrievalLearner(descriptor, distance)
    before = {name: value.clone() for name, value in model.state_dict().items()}

    two = trainer(2, tmp_path)
    in_two_processes(lambda: two.fit(model, module))
    trained = {name: float(value) for name, value in two.callback_metrics.items()}
    after = model.state_dict()
    moved = [name for name in after if not torch.equal(after[name], before[name])]
    assert any("head.layers" in name for name in moved)
    # Bins move by gradients alone, of which there are none where a process has one shape of each class.
    assert any("centres" in name for name in moved)
    assert trained["train_loss"] > 0

    one = trainer(1, tmp_path)
    (validated,) = one.validate(model, module, verbose=False)
    assert {name: trained[name] for name in validated} == pytest.approx(validated, abs=1e-6)

    # The same without Lightning, over the nine shapes.
    part = module.dataset.subset(module.split.validation)
    model.eval()
    with torch.inference_mode():
        found = describe(part, model.descriptor)
        distances = model.distances(found, found)
    assert len(part) == 9
    expected = retrieval_scores(distances, part.labels).mean()
    for name, value in expected.items():
        assert validated[f"val_{name}"] == pytest.approx(value, abs=1e-6)
    # A shape that counted twice would have been told by the scores.
    dealt = [*range(9), 0]
    twice = retrieval_scores(distances[dealt][:, dealt], part.labels[dealt]).mean()
    assert max(abs(twice[name] - expected[name]) for name in expected) > 1e-3
