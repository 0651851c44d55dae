"""Training a descriptor and a head end to end, as a LightningModule."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from pickle import UnpicklingError
from typing import IO, Any, Self

import torch
from pytorch_lightning import LightningModule
from pytorch_lightning.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.nn.parameter import is_lazy
from torch.utils.data import DataLoader

from igps._threads import one_thread
from igps.data.batch import SignatureBatch
from igps.data.datamodule import has_configuration
from igps.nn.description import evaluation_mode
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.heads.base import Head
from igps.nn.heads.learned import BlendedDistance
from igps.retrieval.metric import RetrievalScoresMetric

# Precisions with which Lightning leaves batches as they are.
_PRECISIONS = ("32-true", "16-mixed", "bf16-mixed")
# Packages whose classes a checkpoint may name by default.
_TRUSTED = ("igps", "torch", "pytorch_lightning", "pytorch_metric_learning")


class RetrievalLearner(LightningModule):
    """Trains the parameters of a descriptor and a distance, by a loss on the head's embeddings.

    Any DataLoader of `SignatureBatch`es with labels can be used. The head is fitted to the descriptions of the training
    shapes before the first step. A head in closed form, such as a `WhitenedHead`, is fitted again before each
    validation and after each epoch, and passes the gradients on to bins and filters.

    Validation and test log retrieval scores, with each shape as a query against all other shapes of the split. A
    distance without a head cannot be trained, but `Trainer.test` gives the scores of the plain descriptor.

    Example:
        >>> import tempfile
        >>> from pytorch_lightning import Trainer
        >>> from igps import ArticulatedShapes, HistogramDescriptor, PairHistogram, SignatureConfig
        >>> from igps.data.datamodule import SignatureDataModule
        >>> from igps.data.splits import Parts
        >>> from igps.nn.heads.learned import BlendedDistance, ProjectionHead
        >>> learner = RetrievalLearner(HistogramDescriptor(PairHistogram()), BlendedDistance(ProjectionHead()))
        >>> trainer = Trainer(
        ...     max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        ...     enable_model_summary=False,
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ArticulatedShapes(2, 4, n_vertices=600).write(f"{folder}/shapes")
        ...     data = SignatureDataModule(
        ...         f"{folder}/shapes", Parts(n_train=2, n_validation=0), config=SignatureConfig(n_eigenpairs=50),
        ...         cache_dir=f"{folder}/cache",
        ...     )
        ...     trainer.fit(learner, data)
        ...     scores = trainer.test(learner, data, verbose=False)[0]
        >>> sorted(scores)
        ['test_adr', 'test_adr_self', 'test_dcg', 'test_e', 'test_ft', 'test_map', 'test_nn', 'test_st']

    Args:
        descriptor: a `Descriptor`, or any module from `SignatureBatch` to histograms (N, ...).
        distance: between descriptions, with the head to train.
        loss: maps embeddings (N, D) and labels (N,) to a scalar; supervised contrastive (Khosla et al. 2020) if None,
            which needs `pytorch-metric-learning`.
        learning_rate: initial learning rate of the head; decays along a cosine over the epochs.
        bin_rate: the same for the descriptor's parameters.
        weight_decay: of the head only.
        miner: of `pytorch-metric-learning`; selects the pairs or triplets for the loss, which uses all if None.

    Raises:
        ValueError: the descriptor has entries other than histograms, such as `molecular` with size.
    """

    def __init__(
        self,
        descriptor: nn.Module,
        distance: BlendedDistance,
        loss: nn.Module | None = None,
        learning_rate: float = 1e-3,
        bin_rate: float = 1e-2,
        weight_decay: float = 1e-2,
        miner: nn.Module | None = None,
    ) -> None:
        super().__init__()
        # Without a configuration, modules are passed to load_from_checkpoint; the state contains their parameters.
        self.save_hyperparameters(
            ignore=() if has_configuration() else ("descriptor", "distance", "loss", "miner")
        )
        self.descriptor = descriptor
        self.distance = distance
        self.miner = miner
        self.loss = _supervised_contrastive() if loss is None else loss
        self.learning_rate = learning_rate
        self.bin_rate = bin_rate
        self.weight_decay = weight_decay
        self.part_cells = (
            descriptor.part_cells if isinstance(descriptor, HistogramDescriptor) else None
        )
        if (
            distance.head is not None
            and self.part_cells is not None
            and any(map(is_lazy, distance.parameters()))
        ):
            # A first call sets the sizes of lazy parameters, which the optimiser needs.
            with torch.no_grad():
                distance.head.eval()(torch.ones(1, sum(self.part_cells)))
            distance.head.train()
        # A method, as with the module the checkpoint would contain its parameters twice.
        self.scores = RetrievalScoresMetric(self.distances)
        self._fitted_step = -1

    @classmethod
    def load_from_checkpoint(
        cls,
        checkpoint_path: str | Path | IO[bytes],
        *arguments: Any,
        trusted: Sequence[str] = (),
        **options: Any,
    ) -> Self:
        """Load a learner as `LightningModule.load_from_checkpoint` does, on the CPU by default.

        A checkpoint of a run by Lightning's command line contains its configuration; for another one, pass
        `descriptor=` and `distance=`. No code of the file runs: its configuration may only name classes of this
        library, torch, Lightning, pytorch-metric-learning and the packages in `trusted`.

        Raises:
            ValueError: the file is not a checkpoint, is damaged, or names a class of another package.
        """
        options.setdefault("map_location", "cpu")
        options.setdefault("weights_only", True)
        try:
            stored = torch.load(checkpoint_path, map_location="cpu", weights_only=True)
        except (UnpicklingError, EOFError, RuntimeError) as error:
            raise ValueError(
                f"{checkpoint_path}: expected a checkpoint, got another or a damaged file."
            ) from error
        allowed = (*_TRUSTED, *trusted)
        for path in _class_paths(stored.get("hyper_parameters", {})):
            if path.partition(".")[0] not in allowed:
                raise ValueError(
                    f"{checkpoint_path}: names the class {path}, whose package is not one of {', '.join(allowed)}. "
                    "If you trust the file, pass trusted=[...] with that package."
                )
        if hasattr(checkpoint_path, "seek"):
            checkpoint_path.seek(0)
        return super().load_from_checkpoint(checkpoint_path, *arguments, **options)

    def forward(self, batch: SignatureBatch) -> Tensor:
        """Return the descriptions (N, ...) of a batch."""
        return self.descriptor(batch)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """Return distances (Q, G) between descriptions (Q, ...) and (G, ...)."""
        return self.distance(queries, gallery)

    @property
    def _head(self) -> Head:
        if self.distance.head is None:
            raise ValueError(
                "distance: expected a head to train, got none. Use Trainer.test for a plain descriptor."
            )
        return self.distance.head

    def setup(self, stage: str) -> None:
        """Raise a ValueError if there is no head to train, or if the precision of the trainer cannot be used."""
        if stage == "fit":
            _ = self._head
        if self.trainer.precision not in _PRECISIONS:
            raise ValueError(
                f"precision: expected one of {', '.join(_PRECISIONS)}, got {self.trainer.precision}. "
                "Others make Lightning write into batches, which are fixed."
            )

    def on_train_start(self) -> None:
        """Fit the head to the training shapes, or centre its inputs on them; skipped in a resumed run."""
        if self.global_step == 0:
            self._fit(calibrate=False)

    def on_train_epoch_end(self) -> None:
        """Fit the head to the current bins and calibrate the distance, so that the checkpoint holds both."""
        self._fit()

    def on_validation_epoch_start(self) -> None:
        """Fit the head and calibrate the distance, as the bins changed in training."""
        if not self.trainer.sanity_checking and self.trainer.state.fn == "fit":
            self._fit()

    @one_thread()
    def training_step(self, batch: SignatureBatch, batch_index: int) -> Tensor:
        """Return the loss of one P×K batch."""
        embeddings = self._head(self(batch))
        labels = _known_labels(batch)
        mined = () if self.miner is None else (self.miner(embeddings, labels),)
        loss: Tensor = self.loss(embeddings, labels, *mined)
        self.log(
            "train_loss",
            loss,
            prog_bar=True,
            on_step=True,
            on_epoch=True,
            sync_dist=True,
            batch_size=len(batch),
        )
        return loss

    @one_thread()
    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Compute the gradients of the loss on one thread, like the loss itself."""
        super().backward(loss, *args, **kwargs)

    @one_thread()
    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Make a step on one thread; Lightning computes the loss and its gradients within it."""
        super().optimizer_step(*args, **kwargs)

    @one_thread()
    def validation_step(self, batch: SignatureBatch, batch_index: int) -> None:
        """Collect the descriptions of a batch."""
        self.scores.update(self(batch), batch.labels, batch.ids)

    test_step = validation_step

    def on_validation_epoch_end(self) -> None:
        """Log the scores of the validation split."""
        self._log_scores("val")

    def on_test_epoch_end(self) -> None:
        """Log the scores of the test split."""
        self._log_scores("test")

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Return AdamW with weight decay for the head, but not for bins and filters, whose initial values matter."""
        groups = [
            {
                "params": list(self.distance.parameters()),
                "lr": self.learning_rate,
                "weight_decay": self.weight_decay,
            },
            {
                "params": list(self.descriptor.parameters()),
                "lr": self.bin_rate,
                "weight_decay": 0.0,
            },
        ]
        optimizer = torch.optim.AdamW([group for group in groups if group["params"]])
        epochs = max(self.trainer.max_epochs or 1, 1)
        return {
            "optimizer": optimizer,
            "lr_scheduler": torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs),
        }

    @one_thread()
    def _log_scores(self, split: str) -> None:
        if not self.trainer.sanity_checking:
            for name, value in self.scores.compute().items():
                self.log(f"{split}_{name}", value, prog_bar=name == "ft")
        self.scores.reset()

    @one_thread()
    def _fit(self, calibrate: bool = True) -> None:
        """Fit the head to the current descriptions of the training shapes and calibrate the distance.

        A head that is trained by gradients is fitted only once, before training, which centres its inputs.
        """
        if self._fitted_step == self.global_step:
            return
        head = self._head
        with evaluation_mode(self):
            descriptions, labels = self._training_descriptions()
            if not (calibrate and any(True for _ in head.parameters())):
                head.fit(descriptions, labels, self.part_cells)
            if calibrate:
                self.distance.calibrate(descriptions)
                self._fitted_step = self.global_step

    @torch.no_grad()
    def _training_descriptions(self) -> tuple[Tensor, Tensor]:
        """Describe all shapes of the training loader's dataset, each once."""
        loader = self.trainer.train_dataloader
        if not isinstance(loader, DataLoader):
            raise ValueError(
                f"train_dataloaders: expected one DataLoader, got {type(loader).__name__}."
            )
        ordered = DataLoader(loader.dataset, batch_size=16, collate_fn=loader.collate_fn)
        descriptions = []
        labels = []
        for batch in ordered:
            descriptions.append(self(batch.to(self.device)))
            labels.append(_known_labels(batch))
        return torch.cat(descriptions), torch.cat(labels)


def _known_labels(batch: SignatureBatch) -> Tensor:
    """Return the labels (N,) of a batch; raise a ValueError for −1, which would count as a class."""
    if bool((batch.labels < 0).any()):
        raise ValueError(
            "labels: expected the class of each body, got −1 (unknown). Give folders of classes, a labels.csv, or "
            "SignatureDataset(labels=...)."
        )
    return batch.labels


def _class_paths(configuration: Any) -> Iterator[str]:
    """Yield the import paths of all classes that a configuration names."""
    if isinstance(configuration, Mapping):
        for key, value in configuration.items():
            if key in ("class_path", "_class_path", "_instantiator") and isinstance(value, str):
                yield value
            else:
                yield from _class_paths(value)
    elif isinstance(configuration, Sequence) and not isinstance(configuration, str):
        for value in configuration:
            yield from _class_paths(value)


def _supervised_contrastive() -> nn.Module:
    try:
        from pytorch_metric_learning.losses import SupConLoss
    except ImportError as error:
        raise ImportError(
            'training needs pytorch-metric-learning: pip install "interior-gps[metric]".'
        ) from error
    return SupConLoss(temperature=0.1)
