"""Training a descriptor and a metric end to end, as a LightningModule."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import yaml
from jsonargparse import ArgumentParser
from pytorch_lightning import LightningModule
from pytorch_lightning.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn

from igps.data.datamodule import SignatureDataModule
from igps.data.dataset import SignatureBatch
from igps.nn.head import CorrectedDistance
from igps.retrieval import RetrievalScoresMetric


class RetrievalLearner(LightningModule):
    """Learns whatever has parameters in the descriptor and the distance, by a loss on the head's embeddings.

    A head that is fitted in closed form, such as a `WhitenedHead`, is fitted to the training shapes before training and
    again before each validation and checkpoint; what is trained then are bins and filters, through it.

    Validation and test log the retrieval scores of the whole distance, each shape against all others of its part. With
    a distance that has no head there is nothing to train, and `Trainer.test` gives the plain descriptor's scores.

    Args:
        descriptor: `SignatureBatch` to histograms (N, ...).
        distance: between histograms; its head is trained.
        loss: embeddings (N, D) and labels (N,) to a scalar; supervised contrastive (Khosla et al. 2020) if None, which
            needs `pytorch-metric-learning`.
        miner: embeddings and labels to the pairs or triplets that a loss of `pytorch-metric-learning` is to use; all of
            a batch if None.
        learning_rate: of the head; cosine decay over the epochs.
        bin_rate: learning rate of the descriptor's parameters.
        weight_decay: of the head alone.
    """

    def __init__(
        self,
        descriptor: nn.Module,
        distance: CorrectedDistance,
        loss: nn.Module | None = None,
        learning_rate: float = 1e-3,
        bin_rate: float = 1e-2,
        weight_decay: float = 1e-2,
        miner: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.descriptor = descriptor
        self.distance = distance
        self.loss = loss if loss is not None else _supervised_contrastive()
        self.miner = miner
        self.learning_rate = learning_rate
        self.bin_rate = bin_rate
        self.weight_decay = weight_decay
        # A method, not the module: the metric's state must not repeat its parameters in the checkpoint.
        self.scores = RetrievalScoresMetric(self.distances)

    def forward(self, batch: SignatureBatch) -> Tensor:
        """Histograms of a batch."""
        return self.descriptor(batch)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) distances between histograms (Q, ...) and (G, ...)."""
        return self.distance(queries, gallery)

    def setup(self, stage: str) -> None:
        """Refuse to train without a head, before the optimiser is made."""
        if stage == "fit" and self.distance.head is None:
            raise ValueError("distance: expected a head to train, got none. Use Trainer.test for a plain descriptor.")

    def on_fit_start(self) -> None:
        """Fit the head to the training shapes, or centre its inputs on them."""
        histograms, labels = self._training_histograms()
        if not self._fit_head(histograms, labels):
            self.distance.head.calibrate(histograms)  # type: ignore[union-attr, operator]

    def on_fit_end(self) -> None:
        """Put the plain and the learned distance on one scale, by the training shapes."""
        self._calibrate()

    def on_validation_epoch_start(self) -> None:
        """The scale changes with the head."""
        self._calibrate()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """The same for a checkpoint of an epoch that is not validated, or its distance would be on an older scale."""
        self._calibrate()
        checkpoint["state_dict"].update(self.state_dict())

    def training_step(self, batch: SignatureBatch, batch_index: int) -> Tensor:
        """Loss of one P×K batch."""
        embeddings = self.distance.head(self(batch))  # type: ignore[misc]
        chosen = () if self.miner is None else (self.miner(embeddings, batch.labels),)
        loss = self.loss(embeddings, batch.labels, *chosen)
        self.log("train_loss", loss, batch_size=len(batch), prog_bar=True)
        return loss

    def validation_step(self, batch: SignatureBatch, batch_index: int) -> None:
        """Collect the histograms of a batch."""
        self.scores.update(self(batch), batch.labels)

    def test_step(self, batch: SignatureBatch, batch_index: int) -> None:
        """Collect the histograms of a batch."""
        self.scores.update(self(batch), batch.labels)

    def on_validation_epoch_end(self) -> None:
        """Scores over the validation part."""
        self._log_scores("val")

    def on_test_epoch_end(self) -> None:
        """Scores over the test part."""
        self._log_scores("test")

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """AdamW: decay for the head, none for bins and filters, which have a meaning where they start."""
        groups = [
            {"params": list(self.distance.parameters()), "lr": self.learning_rate, "weight_decay": self.weight_decay},
            {"params": list(self.descriptor.parameters()), "lr": self.bin_rate, "weight_decay": 0.0},
        ]
        optimizer = torch.optim.AdamW([group for group in groups if group["params"]])
        epochs = max(self.trainer.max_epochs or 1, 1)
        return {"optimizer": optimizer, "lr_scheduler": torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)}

    def _log_scores(self, part: str) -> None:
        self.log_dict({f"{part}_{name}": value for name, value in self.scores.compute().items()})
        self.scores.reset()

    def _calibrate(self) -> None:
        training = self.training
        # A checkpoint is saved in training mode, where the head drops cells.
        self.eval()
        histograms, labels = self._training_histograms()
        self._fit_head(histograms, labels)
        self.distance.calibrate(histograms)
        self.train(training)

    def _fit_head(self, histograms: Tensor, labels: Tensor) -> bool:
        """Whether the head is one that is fitted in closed form."""
        fit: Any = getattr(self.distance.head, "fit", None)
        if fit is not None:
            fit(histograms, labels)
        return fit is not None

    @torch.no_grad()
    def _training_histograms(self) -> tuple[Tensor, Tensor]:
        loader = self.trainer.datamodule.training_in_order()  # type: ignore[attr-defined]
        training = self.training
        self.eval()
        parts = [(self(batch.to(self.device)), batch.labels) for batch in loader]
        self.train(training)
        histograms, labels = zip(*parts, strict=True)
        return torch.cat(histograms), torch.cat(labels)


def load_learner(checkpoint: str | Path) -> tuple[RetrievalLearner, SignatureDataModule]:
    """A trained learner in evaluation mode and its data, from a checkpoint of training/train.py.

    The configuration is read from config.yaml, two folders above the checkpoint, and the parameters without executing
    any code of the file. Paths in the configuration are taken as they were given to the training.

    Raises:
        FileNotFoundError: no such checkpoint, or no configuration.
    """
    checkpoint = Path(checkpoint)
    configuration = checkpoint.parent.parent / "config.yaml"
    for path in (checkpoint, configuration):
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file. Name a checkpoint in the folder that train.py wrote.")
    parser = ArgumentParser()
    parser.add_class_arguments(RetrievalLearner, "model")
    parser.add_class_arguments(SignatureDataModule, "data")
    stored = yaml.safe_load(configuration.read_text())
    made = parser.instantiate(parser.parse_object({name: stored[name] for name in ("model", "data")}))
    made.model.load_state_dict(torch.load(checkpoint, map_location="cpu", weights_only=True)["state_dict"])
    return made.model.eval(), made.data


def _supervised_contrastive() -> nn.Module:
    try:
        from pytorch_metric_learning.losses import SupConLoss
    except ImportError as error:
        raise ImportError('training needs pytorch-metric-learning: pip install "interior-gps[metric]".') from error
    return SupConLoss(temperature=0.1)
