"""Train a descriptor and a metric, or test one: `python training/train.py {fit,test} --config configs/default.yaml`.

Every option of the learner, the data and the trainer can be set in the file or on the command line; the whole
configuration is stored beside the checkpoint.
"""

from __future__ import annotations

from pytorch_lightning.cli import LightningCLI

from igps.data.datamodule import SignatureDataModule
from igps.nn.learner import RetrievalLearner


def main() -> None:
    """Entry point."""
    LightningCLI(
        RetrievalLearner, SignatureDataModule, seed_everything_default=0, save_config_kwargs={"overwrite": True}
    )


if __name__ == "__main__":
    main()
