"""Seeded splits of a labelled collection into training, validation and test parts, and their data loaders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from pytorch_lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader

from igps.data.dataset import LabelledSignature, SignatureBatch, SignatureDataset, collate
from igps.geometry.signature import Samples, SignatureConfig

Protocol = Literal["seen", "unseen"]


@dataclass(frozen=True)
class Split:
    """Indices of the shapes of each part; no shape is in two of them.

    Args:
        train: to fit parameters to.
        validation: taken from the training part, to choose between models; may be empty.
        test: to be looked at once.
    """

    train: tuple[int, ...]
    validation: tuple[int, ...]
    test: tuple[int, ...]


def split_seen(labels: Tensor, n_train: int, *, n_validation: int = 0, seed: int = 0) -> Split:
    """Every class in every part: `n_train` shapes of each train, the others test.

    Args:
        labels: (N,) integer classes.
        n_train: shapes of each class in training and validation together.
        n_validation: how many of those validate.
        seed: of the draw.

    Raises:
        ValueError: a class has no more than `n_train` shapes, or `n_validation` leaves none to train on.
    """
    if not 0 <= n_validation < n_train:
        raise ValueError(f"n_validation: expected 0 to n_train - 1 = {n_train - 1}, got {n_validation}.")
    generator = torch.Generator().manual_seed(seed)
    parts: tuple[list[int], list[int], list[int]] = ([], [], [])
    for label in labels.unique().tolist():
        members = torch.nonzero(labels == label).flatten()
        if len(members) <= n_train:
            raise ValueError(f"n_train: expected fewer than the {len(members)} shapes of class {label}, got {n_train}.")
        drawn = members[torch.randperm(len(members), generator=generator)].tolist()
        for part, chosen in zip(
            parts, (drawn[n_validation:n_train], drawn[:n_validation], drawn[n_train:]), strict=True
        ):
            part.extend(chosen)
    train, validation, test = (tuple(sorted(part)) for part in parts)
    return Split(train, validation, test)


def split_unseen(
    labels: Tensor, n_train: int, *, n_validation: int = 0, n_test: int | None = None, seed: int = 0
) -> Split:
    """No class in two parts: `n_train` classes train, others test.

    With the same seed and `n_test` the test classes stay the same whatever `n_train`, and the training classes of a
    smaller `n_train` are among those of a larger.

    Args:
        labels: (N,) integer classes.
        n_train: classes in training and validation together.
        n_validation: how many of those validate.
        n_test: classes to test; all others if None.
        seed: of the draw.

    Raises:
        ValueError: not so many classes, or `n_validation` leaves none to train on.
    """
    classes = labels.unique()
    n_test = len(classes) - n_train if n_test is None else n_test
    if not 0 <= n_validation < n_train:
        raise ValueError(f"n_validation: expected 0 to n_train - 1 = {n_train - 1}, got {n_validation}.")
    if n_test < 1 or n_train + n_test > len(classes):
        raise ValueError(f"n_train, n_test: expected at most {len(classes)} classes together, got {n_train}, {n_test}.")
    drawn = classes[torch.randperm(len(classes), generator=torch.Generator().manual_seed(seed))]

    def members(chosen: Tensor) -> tuple[int, ...]:
        return tuple(torch.nonzero(torch.isin(labels, chosen)).flatten().tolist())

    fit = drawn[:n_train]
    return Split(members(fit[n_validation:]), members(fit[:n_validation]), members(drawn[len(drawn) - n_test :]))


class SignatureDataModule(LightningDataModule):
    """Training, validation and test loaders over a folder of labelled meshes.

    Training batches hold the same number of shapes of each of several classes (P×K sampling), so that every shape has
    company of its class. They need `pytorch-metric-learning`.

    Args:
        root: a folder that tells classes, see `find_meshes`.
        protocol: "seen" splits each class, "unseen" splits the classes.
        n_train: shapes of each class ("seen") or classes ("unseen") in training and validation together.
        n_validation: how many of those validate.
        n_test: classes to test ("unseen" only); all others if None.
        split_seed: of the split.
        classes_per_batch, shapes_per_class: P and K of a training batch.
        n_samples_in_memory: interior and surface samples of each training shape, a fixed random subset, that are kept
            in memory from step to step; None reads whole signatures from the cache at each step.
        config: of the signatures.
        cache_dir: of the signatures; the user's cache directory if None.
        n_workers: processes that compute missing signatures; all cores if None.
    """

    def __init__(
        self,
        root: Path,
        protocol: Protocol = "seen",
        n_train: int = 10,
        n_validation: int = 2,
        n_test: int | None = None,
        split_seed: int = 0,
        classes_per_batch: int = 10,
        shapes_per_class: int = 4,
        n_samples_in_memory: int | None = 1000,
        config: SignatureConfig | None = None,
        cache_dir: Path | None = None,
        n_workers: int | None = None,
    ) -> None:
        super().__init__()
        if protocol not in ("seen", "unseen"):
            raise ValueError(f"protocol: expected 'seen' or 'unseen', got {protocol!r}.")
        if protocol == "seen" and n_test is not None:
            raise ValueError("n_test: expected None with protocol 'seen', which tests all shapes not trained on.")
        if n_samples_in_memory is not None and n_samples_in_memory < 2:
            raise ValueError(f"n_samples_in_memory: expected None or at least 2, got {n_samples_in_memory}.")
        self.dataset = SignatureDataset(root, config, cache_dir)
        if self.dataset.files.labels is None:
            raise ValueError(f"{root}: no classes found. Expected one folder per class, or a labels.csv (file,label).")
        self.classes_per_batch = classes_per_batch
        self.shapes_per_class = shapes_per_class
        self.n_samples_in_memory = n_samples_in_memory
        self._in_memory: list[LabelledSignature] = []
        self.n_workers = n_workers
        labels = self.dataset.labels
        if protocol == "seen":
            self.split = split_seen(labels, n_train, n_validation=n_validation, seed=split_seed)
        else:
            self.split = split_unseen(labels, n_train, n_validation=n_validation, n_test=n_test, seed=split_seed)

    def prepare_data(self) -> None:
        """Fill the cache. A mesh that cannot be used stops training: a split with holes is not the split."""
        self.dataset.precompute(n_workers=self.n_workers, strict=True)

    def train_dataloader(self) -> DataLoader[LabelledSignature]:
        """Endless variety of P×K batches, as many an epoch as cover the training part once."""
        try:
            from pytorch_metric_learning.samplers import MPerClassSampler
        except ImportError as error:
            raise ImportError('training needs pytorch-metric-learning: pip install "interior-gps[metric]".') from error
        part = self.dataset.subset(self.split.train)
        n_batch = min(self.classes_per_batch, len(part.labels.unique())) * self.shapes_per_class
        sampler = MPerClassSampler(
            part.labels, self.shapes_per_class, batch_size=n_batch, length_before_new_iter=max(len(part), n_batch)
        )
        if self.n_samples_in_memory is None:
            return DataLoader(part, batch_size=n_batch, sampler=sampler, collate_fn=collate)
        if not self._in_memory:
            self._in_memory = [_thinned(part[i], self.n_samples_in_memory) for i in range(len(part))]
        # A list is a map-style dataset to a DataLoader.
        return DataLoader(self._in_memory, batch_size=n_batch, sampler=sampler, collate_fn=collate)  # type: ignore[arg-type]

    def training_in_order(self) -> DataLoader[LabelledSignature]:
        """The training part, each shape once: for what is measured on it, such as a distance's median."""
        return self._in_order(self.split.train)

    def val_dataloader(self) -> DataLoader[LabelledSignature] | list[DataLoader[LabelledSignature]]:
        """The validation part in order; nothing if it is empty."""
        return self._in_order(self.split.validation) if self.split.validation else []

    def test_dataloader(self) -> DataLoader[LabelledSignature]:
        """The test part in order."""
        return self._in_order(self.split.test)

    def transfer_batch_to_device(
        self, batch: SignatureBatch, device: torch.device, dataloader_index: int
    ) -> SignatureBatch:
        """Lightning moves tensors and their containers, not batches of ours."""
        return batch.to(device)

    def _in_order(self, indices: Sequence[int]) -> DataLoader[LabelledSignature]:
        return DataLoader(self.dataset.subset(indices), batch_size=16, collate_fn=collate)


def _thinned(item: LabelledSignature, n_samples: int) -> LabelledSignature:
    generator = np.random.default_rng(0)

    def subset(samples: Samples) -> Samples:
        chosen = np.sort(generator.permutation(len(samples))[:n_samples])
        attributes = {name: values[chosen] for name, values in samples.attributes.items()}
        return Samples(samples.points[chosen], samples.eigenfunctions[chosen], attributes)

    signature = item.signature
    thinned = replace(signature, interior=subset(signature.interior), surface=subset(signature.surface))
    return replace(item, signature=thinned)
