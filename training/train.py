"""Train a descriptor and a metric on a folder of labelled meshes.

    python -m training.train --config configs/train.yaml
    python -m training.train --config configs/train.yaml --resume true

configs/train.yaml holds every value, and each can also be given on the command line, such as `--data.root MESHES`. The
folder of the run, `trainer.default_root_dir`, then contains

- `checkpoints/best.ckpt`, by FT of the validation part, and `checkpoints/last.ckpt`;
- `curve.csv` and `curve.svg`: loss and validation scores of each epoch;
- `config.yaml`: the values of this run.

A checkpoint also holds the configuration: `RetrievalLearner.load_from_checkpoint` and
`SignatureDataModule.load_from_checkpoint` read it.
"""

from __future__ import annotations

from pathlib import Path

from pytorch_lightning.cli import LightningArgumentParser, LightningCLI

from igps.cli import errors_as_messages
from igps.data.datamodule import SignatureDataModule
from igps.nn.learner import RetrievalLearner

CONFIG = Path(__file__).parents[1] / "configs" / "train.yaml"


class Configuration(LightningCLI):
    """Makes learner, data and trainer from the file and the command line."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the option to resume."""
        parser.add_argument(
            "--resume", type=bool, default=False, help="continue from checkpoints/last.ckpt"
        )

    @property
    def last_checkpoint(self) -> Path:
        """Where the run keeps its last checkpoint."""
        return Path(self.config.trainer.default_root_dir) / "checkpoints" / "last.ckpt"

    def before_instantiate_classes(self) -> None:
        """Raise an error rather than overwrite an earlier run, or resume one that does not exist."""
        last = self.last_checkpoint
        if self.config.resume and not last.exists():
            raise FileNotFoundError(f"resume: expected {last}, which does not exist.")
        if last.exists() and not self.config.resume:
            raise FileExistsError(
                f"trainer.default_root_dir: {last} exists, of an earlier run. Give --resume true, or another folder."
            )


def train() -> None:
    """Read the configuration, fit the learner, and write the folder of the run."""
    run = Configuration(
        RetrievalLearner,
        SignatureDataModule,
        run=False,
        save_config_kwargs={"overwrite": True},
        parser_kwargs={"default_config_files": [str(CONFIG)]},
    )
    checkpoint = str(run.last_checkpoint) if run.config.resume else None
    run.trainer.fit(run.model, run.datamodule, ckpt_path=checkpoint)


if __name__ == "__main__":
    with errors_as_messages():
        train()
