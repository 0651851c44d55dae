"""Training runs: configuration by YAML, learning curve, early stopping, and resumption."""

import csv
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from matplotlib.figure import Figure
from pytorch_lightning import Callback, LightningModule, Trainer, seed_everything
from pytorch_lightning.callbacks import EarlyStopping, ModelCheckpoint
from pytorch_lightning.cli import LightningArgumentParser, LightningCLI

from igps.data.datamodule import SignatureDataModule
from igps.nn.learner import RetrievalLearner

DEFAULTS = Path(__file__).parents[1] / "configs" / "default.yaml"
_SHORT_NAMES = {
    "root": ("data", "root"),
    "out": ("trainer", "default_root_dir"),
    "epochs": ("trainer", "max_epochs"),
}


class Run(LightningCLI):
    """The command line of training/train.py; configs/default.yaml holds the defaults of all options.

    The folder of the run contains `checkpoints/last.ckpt`, `checkpoints/best.ckpt` (by FT of the validation part),
    `curve.csv`, `curve.svg` and `config.yaml`. An interrupted and resumed run ends with the same weights as an
    uninterrupted one.
    """

    def __init__(self) -> None:
        last = ModelCheckpoint(
            filename="last", save_on_train_epoch_end=True, enable_version_counter=False
        )
        best = ModelCheckpoint(
            filename="best",
            monitor="val_ft",
            mode="max",
            save_on_train_epoch_end=False,
            enable_version_counter=False,
        )
        files = {"default_config_files": [str(DEFAULTS)]}
        super().__init__(
            RetrievalLearner,
            SignatureDataModule,
            seed_everything_default=0,
            save_config_kwargs={"overwrite": True},
            parser_kwargs=dict.fromkeys(("fit", "validate", "test", "predict"), files),
            trainer_defaults={"callbacks": [SeededEpochs(), TrainingCurve(), last, best]},
        )

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add short names of frequent options, resumption and early stopping."""
        parser.add_argument(
            "--root", type=str | None, help="short for data.root: the folder of labelled meshes"
        )
        parser.add_argument(
            "--out",
            type=str | None,
            help="short for trainer.default_root_dir: the folder of the run",
        )
        parser.add_argument("--epochs", type=int | None, help="short for trainer.max_epochs")
        parser.add_argument(
            "--resume", type=str | None, help="checkpoint to resume from, or 'last'"
        )
        parser.add_lightning_class_args(EarlyStopping, "early_stopping")
        parser.set_defaults(
            {
                f"early_stopping.{key}": value
                for key, value in {
                    "monitor": "val_ft",
                    "mode": "max",
                    "patience": 5,
                    "strict": False,
                }.items()
            }
        )

    def before_instantiate_classes(self) -> None:
        """Copy the values of short names to the options they stand for."""
        config = self.config[self.subcommand]
        for name, (group, key) in _SHORT_NAMES.items():
            if config[name] is not None:
                config[group][key] = config[name]
        last = Path(config.trainer.default_root_dir or ".") / "checkpoints" / "last.ckpt"
        if self.subcommand == "fit" and config.resume is not None:
            config.ckpt_path = str(last) if config.resume == "last" else config.resume
        elif self.subcommand == "fit" and config.ckpt_path is None and last.exists():
            raise FileExistsError(
                f"out: {last} exists, of an earlier run. Give --resume last, or another folder."
            )
        if (
            config.ckpt_path not in (None, "best", "last", "hpc")
            and not Path(config.ckpt_path).exists()
        ):
            raise FileNotFoundError(
                f"resume, ckpt_path: expected a checkpoint, got {config.ckpt_path}, which does not exist."
            )

    def before_fit(self) -> None:
        """Put checkpoints into the folder of the run, whatever the logger."""
        for callback in self.trainer.checkpoint_callbacks:
            if isinstance(callback, ModelCheckpoint) and callback.dirpath is None:
                callback.dirpath = str(Path(self.trainer.default_root_dir) / "checkpoints")


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
    """Write mean loss and validation scores of each epoch to `curve.csv` and `curve.svg` in the folder of the run."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self._losses: list[float] = []
        self._scores: dict[str, float] = {}

    def state_dict(self) -> dict[str, Any]:
        """Return the rows of the epochs so far."""
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the rows of a checkpoint."""
        self.rows = list(state_dict["rows"])

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Discard the values of an interrupted epoch."""
        self._losses, self._scores = [], {}

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Collect the loss of a step."""
        self._losses.append(float(outputs["loss"]))

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Collect the validation scores."""
        metrics = trainer.callback_metrics.items()
        self._scores = {name: float(value) for name, value in metrics if name.startswith("val_")}

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Add the row of the epoch, and write the files."""
        self.rows.append(
            {"epoch": trainer.current_epoch, "train_loss": mean(self._losses), **self._scores}
        )
        if trainer.is_global_zero:
            self.write(Path(trainer.default_root_dir))

    def write(self, folder: Path) -> None:
        """Write the table and the plot."""
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "curve.csv").open("w", newline="") as file:
            names = {name: None for row in self.rows for name in row}
            table = csv.DictWriter(file, list(names))
            table.writeheader()
            table.writerows(self.rows)
        figure = Figure(figsize=(6, 3.5), layout="constrained")
        loss = figure.subplots()
        loss.plot(
            [row["epoch"] for row in self.rows],
            [row["train_loss"] for row in self.rows],
            "C0",
            label="loss",
        )
        loss.set(xlabel="epoch", ylabel="loss of the training part")
        scored = [row for row in self.rows if "val_ft" in row]
        if scored:
            score = loss.twinx()
            score.plot([row["epoch"] for row in scored], [row["val_ft"] for row in scored], "C1o-")
            score.set(ylabel="FT of the validation part", ylim=(0, 1))
        figure.savefig(folder / "curve.svg")
