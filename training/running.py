"""A run of training: a few values in one YAML, a curve, an early end, and going on after an interruption."""

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
_SHORT = {"root": ("data", "root"), "out": ("trainer", "default_root_dir"), "epochs": ("trainer", "max_epochs")}


class Run(LightningCLI):
    """The command line of training/train.py: what a file leaves out is that of configs/default.yaml.

    In the folder of the run are `checkpoints/last.ckpt` and `best.ckpt` (by the validation's FT), `curve.csv`,
    `curve.svg`, and `config.yaml`. A run that was interrupted and resumed ends with the weights of one that was not.
    """

    def __init__(self) -> None:
        often = ModelCheckpoint(filename="last", save_on_train_epoch_end=True, enable_version_counter=False)
        best = ModelCheckpoint(
            filename="best", monitor="val_ft", mode="max", save_on_train_epoch_end=False, enable_version_counter=False
        )
        files = {"default_config_files": [str(DEFAULTS)]}
        super().__init__(
            RetrievalLearner,
            SignatureDataModule,
            seed_everything_default=0,
            save_config_kwargs={"overwrite": True},
            parser_kwargs=dict.fromkeys(("fit", "validate", "test", "predict"), files),
            trainer_defaults={"callbacks": [SeededEpochs(), TrainingCurve(), often, best]},
        )

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Short names of what every run sets, resuming, and when to stop."""
        parser.add_argument("--root", type=str | None, help="for data.root: the folder of labelled meshes")
        parser.add_argument("--out", type=str | None, help="for trainer.default_root_dir: the folder of the run")
        parser.add_argument("--epochs", type=int | None, help="for trainer.max_epochs")
        parser.add_argument("--resume", type=str | None, help="a checkpoint to go on from, or 'last'")
        parser.add_lightning_class_args(EarlyStopping, "early_stopping")
        parser.set_defaults(
            {f"early_stopping.{key}": value for key, value in
             {"monitor": "val_ft", "mode": "max", "patience": 5, "strict": False}.items()}
        )  # fmt: skip

    def before_instantiate_classes(self) -> None:
        """Put the short names where they belong."""
        config = self.config[self.subcommand]
        for name, (group, key) in _SHORT.items():
            if config[name] is not None:
                config[group][key] = config[name]
        last = Path(config.trainer.default_root_dir or ".") / "checkpoints" / "last.ckpt"
        if self.subcommand == "fit" and config.resume is not None:
            config.ckpt_path = str(last) if config.resume == "last" else config.resume
        elif self.subcommand == "fit" and config.ckpt_path is None and last.exists():
            raise FileExistsError(f"out: {last} is of another run. Give --resume last, or another folder.")
        if config.ckpt_path not in (None, "best", "last", "hpc") and not Path(config.ckpt_path).exists():
            raise FileNotFoundError(f"resume, ckpt_path: expected a checkpoint, there is no {config.ckpt_path}.")

    def before_fit(self) -> None:
        """Checkpoints lie in the folder of the run, whatever the logger."""
        for callback in self.trainer.checkpoint_callbacks:
            if isinstance(callback, ModelCheckpoint) and callback.dirpath is None:
                callback.dirpath = str(Path(self.trainer.default_root_dir) / "checkpoints")


class SeededEpochs(Callback):
    """Random numbers of each epoch begin anew, from the run's seed and the epoch: those of a resumed run are the same.

    Once before its shapes are drawn, and once before its first step, as opening a loader draws numbers too. The loader
    is to be made anew for each epoch, or its sampler would remember. Processes that load (`n_loading_workers`) draw
    ahead: with them a resumed run goes on with other batches.
    """

    def __init__(self) -> None:
        self.state = {"seed": -1, "epoch": 0}

    def state_dict(self) -> dict[str, Any]:
        """The run's seed, and the epoch that comes next."""
        return self.state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Those of the run that goes on."""
        self.state = dict(state_dict)

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take over the seed of the run."""
        if self.state["seed"] < 0:
            self.state["seed"] = torch.initial_seed() % 2**31
        self._begin()

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """For what is drawn in the steps."""
        if batch_idx == 0:
            self._begin()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """For the shapes of the next."""
        self.state = {**self.state, "epoch": trainer.current_epoch + 1}
        self._begin()

    def _begin(self) -> None:
        seed_everything(sum(self.state.values()), verbose=False)


class TrainingCurve(Callback):
    """Mean loss of each epoch and the scores of its validation, as `curve.csv` and `curve.svg` in the run's folder."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self._losses: list[float] = []
        self._scores: dict[str, float] = {}

    def state_dict(self) -> dict[str, Any]:
        """The rows so far."""
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from those of a checkpoint."""
        self.rows = list(state_dict["rows"])

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """An interrupted epoch begins anew."""
        self._losses, self._scores = [], {}

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Collect the loss."""
        self._losses.append(float(outputs["loss"]))

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Collect the scores."""
        found = trainer.callback_metrics.items()
        self._scores = {name: float(value) for name, value in found if name.startswith("val_")}

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """A row, and the picture."""
        self.rows.append({"epoch": trainer.current_epoch, "train_loss": mean(self._losses), **self._scores})
        if trainer.is_global_zero:
            self.write(Path(trainer.default_root_dir))

    def write(self, folder: Path) -> None:
        """Write both files."""
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "curve.csv").open("w", newline="") as file:
            names = {name: None for row in self.rows for name in row}
            table = csv.DictWriter(file, list(names))
            table.writeheader()
            table.writerows(self.rows)
        figure = Figure(figsize=(6, 3.5), layout="constrained")
        loss = figure.subplots()
        loss.plot([row["epoch"] for row in self.rows], [row["train_loss"] for row in self.rows], "C0", label="loss")
        loss.set(xlabel="epoch", ylabel="loss of the training part")
        scored = [row for row in self.rows if "val_ft" in row]
        if scored:
            score = loss.twinx()
            score.plot([row["epoch"] for row in scored], [row["val_ft"] for row in scored], "C1o-")
            score.set(ylabel="FT of the validation part", ylim=(0, 1))
        figure.savefig(folder / "curve.svg")
