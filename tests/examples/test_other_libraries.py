"""Examples to copy: descriptions and heads in PyTorch Geometric and pytorch-metric-learning."""

import sys

import numpy as np
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

import igps
from igps.data.geometric import to_pyg
from igps.nn.axes import InteriorDistance, Potential
from igps.nn.embedding import SpectralEmbedding
from igps.nn.heads import ProjectionHead
from own_descriptors import small_interior, write_egg

CONFIG = igps.SignatureConfig(n_eigenpairs=20, resolution=9, min_samples=0, n_surface_samples=80)

pytest.importorskip("torch_geometric", reason="the extra geometric is not installed")
distances = pytest.importorskip(
    "pytorch_metric_learning.distances", reason="the extra metric is not installed"
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Eight eggs of two classes."""
    root = tmp_path_factory.mktemp("examples")
    for label, height in (("flat", 0.5), ("long", 2.0)):
        for i in range(4):
            write_egg(
                root / "eggs" / label / f"{i}.off",
                height * (1 + 0.05 * i),
                subdivisions=2,
            )
    found = igps.SignatureDataset(root / "eggs", CONFIG, root / "cache")
    found.precompute(n_workers=1, progress=False)
    return found.to_memory()


def test_pytorch_geometric_batches_samples_with_their_eigenfunctions(dataset):
    from torch_geometric.loader import DataLoader as GeometricLoader
    from torch_geometric.nn import global_add_pool

    changed = to_pyg(dataset[0].signature)
    for values in changed.to_dict().values():  # as transforms of theirs do in place
        values.zero_()
    bodies = [to_pyg(item.signature, "surface", item.label) for item in dataset]
    assert bodies[0].eigenfunctions.any()
    batch = next(iter(GeometricLoader(bodies, batch_size=8)))
    assert batch.pos.shape == (640, 3)
    assert batch.eigenfunctions.shape == (640, 20)
    assert batch.eigenvalues.shape == (8, 20)
    assert batch.y.tolist() == dataset.labels.tolist()
    # A heat kernel signature (Sun, Ovsjanikov and Guibas 2009) of each sample, pooled over each body: the heat trace.
    weights = (-0.05 * batch.eigenvalues * batch.area[:, None]).exp()[batch.batch]
    heat = (batch.mass[:, None] * weights * batch.eigenfunctions**2).sum(dim=1)
    traces = global_add_pool(heat, batch.batch)
    for trace, item in zip(traces.tolist(), dataset, strict=True):
        expected = np.exp(-0.05 * item.signature.eigenvalues * item.signature.area).sum()
        assert trace == pytest.approx(expected, rel=0.5)  # samples of 80 points


class AsTheirs(distances.BaseDistance):
    """A head's or a descriptor's distance for pytorch-metric-learning; its own are passed on by `compute_mat`."""

    def __init__(self, distances):
        super().__init__(normalize_embeddings=False)
        self.distances = distances

    def compute_mat(self, query, reference):
        return self.distances(query, reference)

    def pairwise_distance(self, query, reference):
        return self.distances(query, reference).diagonal()


def test_heads_and_descriptors_are_distances_of_pytorch_metric_learning_and_back(dataset):
    from pytorch_metric_learning.distances import LpDistance
    from pytorch_metric_learning.losses import TripletMarginLoss
    from pytorch_metric_learning.miners import BatchHardMiner
    from pytorch_metric_learning.samplers import MPerClassSampler
    from pytorch_metric_learning.testers import GlobalEmbeddingSpaceTester
    from pytorch_metric_learning.trainers import MetricLossOnly
    from pytorch_metric_learning.utils.accuracy_calculator import AccuracyCalculator
    from pytorch_metric_learning.utils.inference import CustomKNN

    torch.manual_seed(0)
    axes = [
        Potential(3, learnable=True),
        InteriorDistance(12, learnable=True),
    ]
    histogram = igps.PairHistogram(axes, SpectralEmbedding(n_eigenpairs=20))
    descriptor = igps.HistogramDescriptor(histogram)
    head = ProjectionHead(width=8, n_hidden=0, cell_dropout=0)
    head.fit(
        igps.describe(dataset, descriptor).flatten(1),
        dataset.labels,
    )
    distance = AsTheirs(head.distances)
    miner = BatchHardMiner(distance=distance)
    loss = TripletMarginLoss(margin=0.2, distance=distance)
    head(torch.ones(1, descriptor.n_features))
    optimizer = torch.optim.Adam(
        [*descriptor.parameters(), *head.parameters()],
        lr=0.01,
    )
    sampler = MPerClassSampler(dataset.labels, m=4, batch_size=8, length_before_new_iter=160)
    losses = []
    for batch in DataLoader(
        dataset,
        batch_size=8,
        sampler=sampler,
        collate_fn=igps.collate,
    ):
        embeddings = head(descriptor(batch).flatten(1))
        value = loss(embeddings, batch.labels, miner(embeddings, batch.labels))
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        losses.append(float(value.detach()))
    assert losses[-1] <= losses[0]

    plain = small_interior()
    cells = igps.describe(dataset, plain).flatten(1)
    nearest = CustomKNN(AsTheirs(plain.distances))
    calculator = AccuracyCalculator(include=("precision_at_1",), k=1, knn_func=nearest)
    found = calculator.get_accuracy(cells, dataset.labels)["precision_at_1"]
    ours = igps.retrieval_scores(plain.distances(cells, cells), dataset.labels).mean()["nn"]
    assert found == pytest.approx(ours)

    how = {
        "dataloader_num_workers": 0,
        "data_and_label_getter": lambda batch: (batch, batch.labels),
    }
    trunk = nn.Sequential(plain, nn.Flatten())
    as_it_is = {"normalize_embeddings": False, "accuracy_calculator": calculator}
    tester = GlobalEmbeddingSpaceTester(batch_size=3, **as_it_is, **how)
    tested = tester.test({"eggs": dataset}, 0, trunk, collate_fn=igps.collate)["eggs"]
    assert tested["precision_at_1_level0"] == pytest.approx(ours)

    layer = nn.Linear(plain.n_features, 4)
    before = layer.weight.detach().clone()
    models = {"trunk": trunk, "embedder": layer}
    optimizers = {
        "embedder_optimizer": torch.optim.Adam(
            layer.parameters(),
            lr=0.01,
        )
    }
    losses = {"metric_loss": TripletMarginLoss()}
    how |= {"dataset": dataset, "collate_fn": igps.collate}
    MetricLossOnly(models, optimizers, 8, losses, **how).train()
    assert not torch.equal(layer.weight, before)

    theirs = LpDistance(normalize_embeddings=False)  # and back: any of theirs is a distance here
    scores = igps.retrieval_scores(theirs(cells, cells), dataset.labels).mean()
    assert scores == igps.retrieval_scores(torch.cdist(cells, cells), dataset.labels).mean()


def test_missing_extras_are_named(monkeypatch, dataset):
    monkeypatch.setitem(sys.modules, "torch_geometric.data", None)
    with pytest.raises(ImportError, match=r"interior-gps\[geometric\]"):
        to_pyg(dataset[0].signature)
