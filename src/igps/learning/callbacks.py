"""What a training run does at each epoch: it draws numbers that a resumed run draws again, and writes its curve."""

import csv
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning import Callback, LightningModule, Trainer, seed_everything


class SeededEpochs(Callback):
    """Seed each epoch by the seed of the run and the epoch, so that a resumed run draws the same random numbers.

    Numbers are seeded before the shapes of an epoch are drawn, and again before its first step, because opening a
    loader draws numbers, too. The loader must be created for each epoch, as its sampler has a state. Loading processes
    (`n_loading_workers`) draw in advance: with them, a resumed run continues with other batches.
    """

    def __init__(self) -> None:
        self.state = {"seed": -1, "epoch": 0}

    def state_dict(self) -> dict[str, Any]:
        """Return the seed of the run and the next epoch."""
        return self.state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the seed and the epoch of the resumed run."""
        self.state = dict(state_dict)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Store the seed of a new run, and seed the first epoch."""
        if self.state["seed"] < 0:
            self.state["seed"] = torch.initial_seed() % 2**31
        self._seed()

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Seed the steps of an epoch."""
        if batch_idx == 0:
            self._seed()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Seed the shapes of the next epoch."""
        self.state = {**self.state, "epoch": trainer.current_epoch + 1}
        self._seed()

    def _seed(self) -> None:
        seed_everything(sum(self.state.values()), verbose=False)


class TrainingCurve(Callback):
    """Write mean loss and validation scores of each epoch to `curve.csv` in the folder of the run."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self._scores: dict[str, float] = {}

    def state_dict(self) -> dict[str, Any]:
        """Return the rows of the epochs so far."""
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the rows of a checkpoint."""
        self.rows = list(state_dict["rows"])

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Collect the validation scores."""
        self._scores = {}
        for name, value in trainer.callback_metrics.items():
            if name.startswith("val_"):
                self._scores[name] = float(value)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Add the row of the epoch, and write the file."""
        loss = float(trainer.callback_metrics["train_loss"])  # the mean of the epoch
        self.rows.append({"epoch": trainer.current_epoch, "train_loss": loss, **self._scores})
        self._scores = {}
        if trainer.is_global_zero:
            names = dict.fromkeys(name for row in self.rows for name in row)
            path = Path(trainer.default_root_dir) / "curve.csv"
            with path.open("w", newline="") as file:
                table = csv.DictWriter(file, list(names))
                table.writeheader()
                table.writerows(self.rows)
