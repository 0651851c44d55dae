"""Lightning data module of a labelled collection."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from pytorch_lightning import LightningDataModule
from pytorch_lightning.core.mixins.hparams_mixin import _given_hyperparameters
from torch.utils.data import DataLoader, Sampler

from igps._parameters import check_at_least
from igps.data.batch import LabelledSignature, SignatureBatch
from igps.data.cache import default_cache_dir
from igps.data.collation import collate
from igps.data.dataset import SignatureDataset
from igps.data.sources import find_bodies
from igps.data.splits import Parts
from igps.data.transforms import FewerSamples
from igps.mesh.options import LoadOptions
from igps.signature.signature import SignatureConfig

_N_EVALUATED = 16  # shapes in a batch of validation and test


def has_configuration() -> bool:
    """Return whether Lightning's command line creates an object from a configuration, which checkpoints can store."""
    # Arguments that are passed in Python would have to be pickled, and loading a pickle can run code
    return _given_hyperparameters.get() is not None


@dataclass(frozen=True)
class Batches:
    """What the batches of a data module hold.

    Args:
        n_classes, n_per_class: P and K of a training batch, in each process.
        n_samples: size of the fixed random subsets of interior and surface samples of each training shape that are kept
            in memory. If None, whole signatures are read from the cache at each step.
    """

    n_classes: int = 10
    n_per_class: int = 4
    n_samples: int | None = 1000

    def __post_init__(self) -> None:
        check_at_least(2, n_samples=self.n_samples)


class SignatureDataModule(LightningDataModule):
    """Training, validation and test loaders over a folder of labelled meshes.

    A training batch holds K shapes of each of P classes (P×K sampling), so that every shape has others of its class.
    This needs `pytorch-metric-learning`.

    Checkpoints store the arguments for `load_from_checkpoint` if the module was created from a configuration.

    Example:
        >>> import tempfile
        >>> from igps import ArticulatedShapes
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ArticulatedShapes(3, 6, n_vertices=600).write(folder)
        ...     data = SignatureDataModule(folder, Parts(n_train=4, n_validation=2))
        >>> len(data.split.train), len(data.split.validation), len(data.split.test)
        (6, 6, 6)

    Args:
        root: folder with classes, see `find_bodies`.
        parts: how the shapes are divided.
        batches: what a batch holds.
        config, reading: see `SignatureDataset`.
        cache_dir: directory of the signatures; the user's cache directory if None.
        n_workers: number of processes that compute missing signatures; the number of cores if None.
        n_loading_workers: number of processes that read signatures for batches; 0 reads in the main process.
    """

    def __init__(
        self,
        root: Path,
        parts: Parts | None = None,
        batches: Batches | None = None,
        config: SignatureConfig | None = None,
        reading: LoadOptions | None = None,
        cache_dir: Path | None = None,
        n_workers: int | None = None,
        n_loading_workers: int = 0,
    ) -> None:
        super().__init__()
        self.batches = batches or Batches()
        if has_configuration():
            self.save_hyperparameters()
        directory = Path(cache_dir or default_cache_dir())
        bodies = find_bodies(root, reading, labelled=True, cache_dir=directory)
        self.dataset = SignatureDataset(bodies, config, directory, reading=reading)
        self.n_workers = n_workers
        self.n_loading_workers = n_loading_workers
        self._in_memory: SignatureDataset | None = None
        self.split = (parts or Parts()).split(self.dataset.labels)

    def prepare_data(self) -> None:
        """Fill the cache. A mesh that cannot be used stops training, because the split must be complete."""
        self.dataset.precompute(n_workers=self.n_workers, strict=True)

    def train_dataloader(self) -> DataLoader[LabelledSignature]:
        """Return a loader of random P×K batches, as many as cover the training part once."""
        try:
            from pytorch_metric_learning.samplers import MPerClassSampler
        except ImportError as error:
            raise ImportError(
                'training needs pytorch-metric-learning: pip install "interior-gps[metric]".'
            ) from error
        part = self.dataset.subset(self.split.train)
        n_per_class = self.batches.n_per_class
        n_batch = min(self.batches.n_classes, len(part.labels.unique())) * n_per_class
        # Lightning distributes the drawn shapes to its processes in turn, and each gets `n_per_class` of a class
        n_processes = self.trainer.world_size if self.trainer is not None else 1
        sampler = MPerClassSampler(
            part.labels,
            n_per_class * n_processes,
            batch_size=n_batch * n_processes,
            length_before_new_iter=max(len(part), n_batch * n_processes),
        )
        n = self.batches.n_samples
        if n is None:
            return self._loader(part, n_batch, sampler, self.n_loading_workers)
        if self._in_memory is None:
            self._in_memory = part.to_memory(FewerSamples(n_interior=n, n_surface=n, seed=0))
        # No workers, because there is nothing to read
        return self._loader(self._in_memory, n_batch, sampler, 0)

    def val_dataloader(self) -> DataLoader[LabelledSignature] | list[DataLoader[LabelledSignature]]:
        """Return a loader of the validation part in order; an empty list if the part is empty."""
        return self._evaluation_loader(self.split.validation) if self.split.validation else []

    def test_dataloader(self) -> DataLoader[LabelledSignature]:
        """Return a loader of the test part in order."""
        return self._evaluation_loader(self.split.test)

    def transfer_batch_to_device(
        self, batch: SignatureBatch, device: torch.device, dataloader_index: int
    ) -> SignatureBatch:
        """Move a batch; by default, Lightning moves only tensors and containers of tensors."""
        return batch.to(device, non_blocking=True)

    def _evaluation_loader(self, indices: Sequence[int]) -> DataLoader[LabelledSignature]:
        part = self.dataset.subset(indices)
        return self._loader(part, _N_EVALUATED, None, self.n_loading_workers)

    def _loader(
        self, part: SignatureDataset, batch_size: int, sampler: Sampler[int] | None, n_workers: int
    ) -> DataLoader[LabelledSignature]:
        return DataLoader(
            part,
            batch_size=batch_size,
            sampler=sampler,
            num_workers=n_workers,
            persistent_workers=n_workers > 0,
            pin_memory=torch.cuda.is_available(),
            collate_fn=collate,
        )
