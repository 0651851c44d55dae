"""`igps fit` and a learned layout beside networks and plain numbers. The program behind the page.

    python -m docs.benchmarks.peers families FOLDER METHODS
    python -m docs.benchmarks.peers collection ROOT CACHE METHODS
    python -m docs.benchmarks.peers adrenals FOLDER CACHE METHODS
    python -m docs.benchmarks.peers held_out ROOT CACHE METHODS

METHODS is a list such as [numbers,fit]. `--runs.seeds [200]` and the like choose fewer runs. All get the same bodies to
train on, and the same to be tested on. Networks have one size, one rate and one number of steps, set before the first
run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, reduce
from itertools import pairwise
from operator import or_
from pathlib import Path
from statistics import mean, stdev

import numpy as np
import torch
from docs.benchmarks.layout import families
from jsonargparse import auto_cli
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import KFold, StratifiedKFold
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler
from torch import Tensor, nn

import igps
from igps.cli import errors_as_messages
from igps.data.splits import split_seen
from igps.descriptors.with_numbers import Numbers
from igps.learning.fitting import classification_scores, classify
from igps.nn import Classifier
from igps.signature.voxels import grid_axes, inside_grid

N_POINTS, N_NEIGHBOURS = 1024, 10
N_EIGENPAIRS, N_CHANNELS, N_TIMES = 60, 64, 16
N_GRID = 28
N_BATCH, N_STEPS, RATE = 8, 100, 5e-3
SEEDS = (200, 201, 202, 203, 204)
N_LABELS = (1, 3, 5, 10)


@dataclass(frozen=True)
class Task:
    """Bodies, of which some train a method that is then asked for the probabilities of the others."""

    dataset: igps.SignatureDataset
    train: list[int]
    test: list[int]
    n_steps: int = N_STEPS

    @property
    def n_classes(self) -> int:
        """The number of classes."""
        return len(self.dataset.classes)

    @property
    def bodies(self) -> igps.SignatureDataset:
        """The bodies to train on, and after them those to test on."""
        return self.dataset[self.train + self.test]


def numbers(task: Task) -> Tensor:
    """Logistic regression on 12 plain numbers and size."""
    model = LogisticRegression(class_weight="balanced", max_iter=2000)
    return _of_table(task, make_pipeline(StandardScaler(), model))


def boosted(task: Task) -> Tensor:
    """Boosted trees on the same numbers."""
    model = HistGradientBoostingClassifier(class_weight="balanced", min_samples_leaf=3)
    return _of_table(task, make_pipeline(model))


def _of_table(task: Task, model: Pipeline) -> Tensor:
    rows = igps.describe(task.bodies, Numbers(), n_workers=1).numpy()
    n_train = len(task.train)
    model.fit(rows[:n_train], task.bodies.labels[:n_train].numpy())
    return torch.from_numpy(model.predict_proba(rows[n_train:]))


def fit(task: Task) -> Tensor:
    """`igps.fit` on `pretrained`, see `_fitted`."""
    return _fitted(task, "pretrained")


def fit_interior(task: Task) -> Tensor:
    """`igps.fit` on `interior`, which has no metric from other shapes, see `_fitted`."""
    return _fitted(task, "interior")


def _fitted(task: Task, name: str) -> Tensor:
    """Fit to a descriptor; with one body of each class, of which none can be held out, compare by its distance."""
    train = task.dataset[task.train]
    if len(train) > task.n_classes:
        model = igps.fit(train, name, n_workers=1)
        return classify(task.dataset[task.test], model, n_workers=1).probabilities
    descriptor = igps.descriptor(name)
    rows = igps.describe(task.bodies, descriptor, n_workers=1)
    distances = descriptor.distances(rows[len(train) :], rows[: len(train)])
    return (-distances[:, train.labels.argsort()]).softmax(dim=1)


def layout(task: Task) -> Tensor:
    """Bins, classes and filter of `interior` with a linear classifier, by gradients."""
    descriptor = igps.descriptor("interior", learnable=True, n_training_samples=400)
    model = Classifier(descriptor, task.n_classes)
    dataset = task.bodies.to_memory()
    return _trained(task, model, lambda indices: model(dataset.batch(indices)))


class DGCNN(nn.Module):
    """Three convolutions over edges to nearest neighbours, and their maximum (Wang et al. 2019).

    The neighbours are those of the points; they are not found anew in each layer.
    """

    def __init__(self, n_classes: int) -> None:
        from torch_geometric.nn import EdgeConv

        super().__init__()
        widths = (3, N_CHANNELS, N_CHANNELS, 2 * N_CHANNELS)
        self.layers = nn.ModuleList()
        for n_in, n_out in pairwise(widths):
            layer = nn.Sequential(nn.Linear(2 * n_in, n_out), nn.BatchNorm1d(n_out), nn.ReLU())
            self.layers.append(EdgeConv(layer, aggr="max"))
        self.last = nn.Linear(sum(widths[1:]), n_classes)

    def forward(self, points: Tensor) -> Tensor:
        """(N, P, 3) to (N, n_classes)."""
        n, n_points, _ = points.shape
        nearest = torch.cdist(points, points).topk(N_NEIGHBOURS + 1, largest=False).indices
        first = n_points * torch.arange(n)[:, None, None]
        sources = (first + nearest[:, :, 1:]).flatten()
        targets = torch.arange(n * n_points).repeat_interleave(N_NEIGHBOURS)
        edges = torch.stack([sources, targets])
        x = points.flatten(0, 1)
        found = []
        for layer in self.layers:
            x = layer(x, edges)
            found.append(x)
        together = torch.cat(found, dim=1).unflatten(0, (n, n_points)).amax(dim=1)
        logits: Tensor = self.last(together)
        return logits


def dgcnn(task: Task) -> Tensor:
    """`DGCNN` on 1,024 surface samples."""
    points = _surface(task)[0]
    model = DGCNN(task.n_classes)
    return _trained(task, model, lambda indices: model(points[indices]))


class DiffusionBlock(nn.Module):
    """A block of DiffusionNet (Sharp, Attaiki, Crane and Ovsjanikov 2022), without gradient features."""

    def __init__(self) -> None:
        super().__init__()
        self.log_time = nn.Parameter(torch.full((N_CHANNELS,), -3.0))
        self.mix = nn.Sequential(
            nn.Linear(2 * N_CHANNELS, N_CHANNELS), nn.ReLU(), nn.Linear(N_CHANNELS, N_CHANNELS)
        )

    def forward(self, x: Tensor, values: Tensor, functions: Tensor) -> Tensor:
        """(N, P, D) to the same; eigenvalues (N, K) and eigenfunctions (N, P, K) of bodies of area 1."""
        average = x.mean(dim=1, keepdim=True)
        spectral = functions.mT @ (x - average) / x.shape[1]
        decay = (-values[:, :, None] * self.log_time.exp()).exp()
        diffused = average + functions @ (decay * spectral)
        mixed: Tensor = self.mix(torch.cat([x, diffused], dim=2))
        return x + mixed


class DiffusionNet(nn.Module):
    """Four blocks on heat kernel signatures at 16 times, averaged over the surface."""

    def __init__(self, n_classes: int) -> None:
        super().__init__()
        self.first = nn.Linear(N_TIMES, N_CHANNELS)
        self.blocks = nn.ModuleList(DiffusionBlock() for _ in range(4))
        self.last = nn.Linear(N_CHANNELS, n_classes)

    def forward(self, values: Tensor, functions: Tensor) -> Tensor:
        """Eigenvalues (N, K) and eigenfunctions (N, P, K) of bodies of area 1 to (N, n_classes)."""
        times = torch.logspace(-2.5, 0, N_TIMES)
        decay = (-values[:, :, None] * times).exp()
        x = self.first((functions.square() @ decay).clamp_min(1e-6).log())
        for block in self.blocks:
            x = block(x, values, functions)
        logits: Tensor = self.last(x.mean(dim=1))
        return logits


def diffusionnet(task: Task) -> Tensor:
    """`DiffusionNet` on 1,024 surface samples with our eigenpairs."""
    _, values, functions = _surface(task)
    model = DiffusionNet(task.n_classes)
    return _trained(task, model, lambda indices: model(values[indices], functions[indices]))


def _surface(task: Task) -> tuple[Tensor, Tensor, Tensor]:
    """Return 1,024 points (N, P, 3) of all bodies in one unit, eigenvalues (N, K) and eigenfunctions for area 1."""
    points = []
    values = []
    functions = []
    for item in task.bodies:
        signature = item.signature
        order = np.random.default_rng(0).permutation(len(signature.surface))[:N_POINTS]
        place = signature.surface.points[order]
        points.append(torch.from_numpy(place - place.mean(axis=0)).float())
        values.append(torch.from_numpy(signature.eigenvalues[:N_EIGENPAIRS] * signature.area))
        chosen = signature.surface.eigenfunctions[order, :N_EIGENPAIRS]
        functions.append(torch.from_numpy(chosen * np.sqrt(signature.area)))
    together = torch.stack(points)
    return together / together.std(), torch.stack(values).float(), torch.stack(functions).float()


def resnet(task: Task) -> Tensor:
    """ResNet-18 with 3D kernels on a grid of 28³."""
    from monai.networks.nets import resnet18

    grids = torch.stack([_grid(task.dataset, i) for i in task.train + task.test])
    model = resnet18(
        spatial_dims=3,
        n_input_channels=1,
        num_classes=task.n_classes,
        conv1_t_size=3,
        conv1_t_stride=2,
    )
    return _trained(task, model, lambda indices: model(grids[indices]))


@cache
def _grid(dataset: igps.SignatureDataset, index: int) -> Tensor:
    """Return whether each of 28³ grid points around a body is inside: (1, 28, 28, 28) of 0 and 1."""
    mesh = dataset.mesh(index)
    inside = torch.from_numpy(inside_grid(mesh, grid_axes(mesh, N_GRID)))
    x, y, z = ((N_GRID - n) // 2 for n in inside.shape)
    n_x, n_y, n_z = inside.shape
    grid = torch.zeros(1, N_GRID, N_GRID, N_GRID)
    grid[0, x : x + n_x, y : y + n_y, z : z + n_z] = inside
    return grid


def _trained(task: Task, model: nn.Module, logits: Callable[[list[int]], Tensor]) -> Tensor:
    """Train a network with Adam and weights of the classes, and return probabilities (N, n_classes) of the others."""
    n_train = len(task.train)
    labels = task.bodies.labels[:n_train]
    weights = n_train / (task.n_classes * torch.bincount(labels, minlength=task.n_classes))
    optimizer = torch.optim.Adam(model.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=task.n_steps)
    model.train()
    for _ in range(task.n_steps):
        chosen = torch.randperm(n_train)[:N_BATCH].tolist()
        loss = nn.functional.cross_entropy(logits(chosen), labels[chosen], weights)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    model.eval()
    with torch.no_grad():
        parts = [logits([n_train + i]).softmax(dim=1) for i in range(len(task.test))]
    return torch.cat(parts)


METHODS: dict[str, Callable[[Task], Tensor]] = {
    "numbers": numbers,
    "boosted": boosted,
    "fit": fit,
    "fit_interior": fit_interior,
    "layout": layout,
    "diffusionnet": diffusionnet,
    "dgcnn": dgcnn,
    "resnet": resnet,
}


def ask(name: str, task: Task, seed: int) -> tuple[Tensor, float]:
    """Return the answers (N, n_classes) of a method, and the core-seconds that it took."""
    torch.manual_seed(seed)
    start = time.process_time()
    found = METHODS[name](task)
    return found, time.process_time() - start


def scores(found: Tensor, task: Task) -> dict[str, float]:
    """Return accuracy, balanced accuracy and area under the curve of answers, in percent."""
    labels = task.dataset.labels[task.test]
    of_all = classification_scores(found, labels, torch.arange(task.n_classes))
    return {name: 100 * of_all[name] for name in ("accuracy", "balanced_accuracy", "auc")}


def report(title: str, rows: list[dict[str, float]]) -> None:
    """Print mean and standard deviation of each score over the runs."""
    texts = []
    for name in rows[0]:
        values = [row[name] for row in rows]
        spread = f" ± {stdev(values):.1f}" if len(values) > 1 else ""
        texts.append(f"{name} {mean(values):.1f}{spread}")
    print(f"{title}, {len(rows)} runs: {', '.join(texts)}", flush=True)


@dataclass(frozen=True)
class Runs:
    """How often each method is trained: by seed and, where it varies, by number of labels of each class."""

    seeds: tuple[int, ...] = SEEDS
    labels: tuple[int, ...] = N_LABELS
    n_steps: int = N_STEPS


ALL_RUNS = Runs()


def run_adrenals(root: Path, cache_dir: Path, methods: list[str], runs: Runs = ALL_RUNS) -> None:
    """Train on `train`, and print scores on `val`."""
    torch.set_num_threads(1)
    paths = sorted(root.glob("*/*/*.nii.gz"))
    labels = [path.parts[-2] for path in paths]
    dataset = _dataset(paths, cache_dir, methods, labels)
    train = [i for i, path in enumerate(paths) if path.parts[-3] == "train"]
    test = [i for i, path in enumerate(paths) if path.parts[-3] == "val"]
    task = Task(dataset, train, test, runs.n_steps)
    for name in methods:
        rows = []
        for seed in runs.seeds:
            found, seconds = ask(name, task, seed)
            rows.append(scores(found, task) | {"seconds": seconds})
            report(f"adrenals, {name}, {runs.n_steps} steps", rows)


def run_held_out(
    root: Path,
    cache_dir: Path,
    methods: list[str],
    runs: Runs = ALL_RUNS,
    n_folds: int | None = None,
) -> None:
    """Ask for each body of a folder after training on other folds, by default on all others, and print scores."""
    torch.set_num_threads(1)
    dataset = _dataset(root, cache_dir, methods)
    labels = dataset.labels.numpy()
    everyone = Task(dataset, [], list(range(len(dataset))))
    for name in methods:
        rows = []
        for seed in runs.seeds:
            folds = KFold(len(dataset))
            if n_folds is not None:
                folds = StratifiedKFold(n_folds, shuffle=True, random_state=seed)
            answers = torch.zeros(len(dataset), len(dataset.classes))
            costs = []
            for train, test in folds.split(labels, labels):
                task = Task(dataset, train.tolist(), test.tolist(), runs.n_steps)
                found, seconds = ask(name, task, seed)
                answers[test] = found.float()
                costs.append(seconds)
            rows.append(scores(answers, everyone) | {"seconds of a fit": mean(costs)})
            report(f"{name}, {n_folds or len(dataset)} folds, {runs.n_steps} steps", rows)


def run_families(folder: Path, methods: list[str], runs: Runs = ALL_RUNS) -> None:
    """Train on a few bodies of each family, and print how many of two other bodies in two poses are recognised."""
    torch.set_num_threads(1)
    dataset = families(folder, *_described())
    _few_labels(dataset, split_families, methods, runs)


def run_collection(root: Path, cache_dir: Path, methods: list[str], runs: Runs = ALL_RUNS) -> None:
    """Train on a few bodies of each class, and print how many of those beyond ten of a class are recognised."""
    torch.set_num_threads(1)
    dataset = _dataset(root, cache_dir, methods)
    _few_labels(dataset, split_classes, methods, runs)


def _few_labels(
    dataset: igps.SignatureDataset,
    split: Callable[[igps.SignatureDataset, int, int], tuple[list[int], list[int]]],
    methods: list[str],
    runs: Runs,
) -> None:
    for name in methods:
        for n_labels in runs.labels:
            rows = []
            for seed in runs.seeds:
                task = Task(dataset, *split(dataset, n_labels, seed), runs.n_steps)
                found, seconds = ask(name, task, seed)
                rows.append(scores(found, task) | {"seconds": seconds})
            report(f"{name}, {n_labels} labels, {runs.n_steps} steps", rows)


def split_families(
    dataset: igps.SignatureDataset, n_labels: int, seed: int
) -> tuple[list[int], list[int]]:
    """Return the shapes to train on, and all poses of the two bodies of each class that are tested."""
    generator = np.random.default_rng(seed)
    owners = np.array(["/".join(name.split("/")[:2]) for name in dataset.bodies.names])
    labels = np.array(dataset.bodies.labels)
    train: list[int] = []
    test: list[int] = []
    for label in np.unique(labels):
        is_own = labels == label
        tested = generator.permutation(np.unique(owners[is_own]))[:2]
        is_tested = is_own & np.isin(owners, tested)
        test += np.flatnonzero(is_tested).tolist()
        others = np.flatnonzero(is_own & ~is_tested)
        train += generator.permutation(others)[:n_labels].tolist()
    return train, test


def split_classes(
    dataset: igps.SignatureDataset, n_labels: int, seed: int
) -> tuple[list[int], list[int]]:
    """Return some of the ten bodies of each class that `docs.benchmarks.learning` trains on, and those it tests."""
    split = split_seen(dataset.labels, max(N_LABELS), seed=seed)
    generator = np.random.default_rng(seed)
    candidates = generator.permutation(split.train)
    labels = dataset.labels.numpy()[candidates]
    train: list[int] = []
    for label in np.unique(labels):
        train += candidates[labels == label][:n_labels].tolist()
    return train, list(split.test)


def _described() -> list[igps.Descriptor]:
    """Return the descriptors whose data the methods need."""
    return [igps.descriptor("interior"), igps.descriptor("pretrained"), Numbers()]


def _dataset(
    root: Path | list[Path], cache_dir: Path, methods: list[str], labels: list[str] | None = None
) -> igps.SignatureDataset:
    """Return a collection with all that the methods need, after its signatures are computed."""
    requirements = [descriptor.requirements for descriptor in _described()]
    needed = reduce(or_, requirements)
    dataset = igps.SignatureDataset(root, descriptor=needed, cache_dir=cache_dir, labels=labels)
    if methods != ["resnet"]:  # which reads meshes alone
        dataset.precompute(strict=True, n_workers=1)
    return dataset


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(
            {
                "adrenals": run_adrenals,
                "collection": run_collection,
                "families": run_families,
                "held_out": run_held_out,
            }
        )
