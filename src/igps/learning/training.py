"""Training of a layout and a head by gradients, from a file of values."""

from __future__ import annotations

import logging
from argparse import ArgumentError
from pathlib import Path
from typing import Any

import torch
from pytorch_lightning.cli import LightningArgumentParser, LightningCLI

from igps.data.datamodule import SignatureDataModule
from igps.nn.descriptor import Descriptor
from igps.nn.learner import RetrievalLearner

logger = logging.getLogger(__name__)

DEFAULTS = Path(__file__).with_name("train.yaml")
"""Every value, with its meaning."""


class _Run(LightningCLI):
    """Makes learner, data and trainer from the file of values."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_argument("--resume", type=bool, default=False)

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Read the file; the words of the command line are those of `igps`."""
        self.config = parser.parse_args(args)

    @property
    def checkpoints(self) -> Path:
        return Path(self.config.trainer.default_root_dir) / "checkpoints"

    def before_instantiate_classes(self) -> None:
        """Raise an error rather than overwrite an earlier run, or resume one that does not exist."""
        last = self.checkpoints / "last.ckpt"
        if self.config.resume and not last.exists():
            raise FileNotFoundError(f"resume: expected {last}, which does not exist.")
        if last.exists() and not self.config.resume:
            raise FileExistsError(
                f"trainer.default_root_dir: {last} exists, of an earlier run. Give --resume, or another folder."
            )


def train(config: Path, *, resume: bool = False) -> Path:
    """Train a layout and a head, and write the folder of the run, `trainer.default_root_dir`:

    - `checkpoints/best.ckpt`, by FT of the validation part, and `checkpoints/last.ckpt`, which
      `RetrievalLearner.load_from_checkpoint` and `SignatureDataModule.load_from_checkpoint` read;
    - `layout.safetensors`: the descriptor with the best layout, without the head, for `igps.load`;
    - `curve.csv`: loss and validation scores of each epoch;
    - `config.yaml`: the values of this run.

    Args:
        config: a YAML file; values that it leaves out are those of `DEFAULTS`.
        resume: continue an interrupted run, to the same weights as without the interruption.

    Returns:
        The path of the layout, which is not written if its modules belong to other packages.

    Raises:
        FileNotFoundError: no such file, or nothing to resume.
        FileExistsError: the folder has an earlier run.
        ValueError: an unknown value.
    """
    if not config.is_file():
        raise FileNotFoundError(f"config: expected a YAML file, {config} does not exist.")
    try:
        run = _Run(
            RetrievalLearner,
            SignatureDataModule,
            run=False,
            args=["--config", str(config), *(["--resume", "true"] if resume else [])],
            save_config_kwargs={"overwrite": True},
            parser_kwargs={"default_config_files": [str(DEFAULTS)], "exit_on_error": False},
        )
    except ArgumentError as error:
        raise ValueError(f"{config}: {error}. {DEFAULTS} lists every value.") from error
    last = run.checkpoints / "last.ckpt"
    run.trainer.fit(run.model, run.datamodule, ckpt_path=last if resume else None)
    learner = run.model
    assert isinstance(learner, RetrievalLearner)
    best = run.checkpoints / "best.ckpt"
    stored = torch.load(best if best.exists() else last, map_location="cpu", weights_only=True)
    learner.load_state_dict(stored["state_dict"])
    path = run.checkpoints.with_name("layout.safetensors")
    if isinstance(learner.descriptor, Descriptor):
        _save(learner.descriptor, path)
    return path


def _save(descriptor: Descriptor, path: Path) -> None:
    """Write a descriptor; only warn about modules of other packages, whose code no file can name."""
    try:
        descriptor.save(path)
    except ValueError as error:
        logger.warning("%s is not written: %s", path, error)
