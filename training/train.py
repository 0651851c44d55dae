"""Train a descriptor and a metric, or test one: `python -m training.train {fit,test} --config configs/default.yaml`.

Every option of the learner, the data and the trainer can be set in the file or on the command line. A checkpoint holds
the configuration too: `RetrievalLearner.load_from_checkpoint` and `SignatureDataModule.load_from_checkpoint` read it.
"""

from __future__ import annotations

from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.cli import LightningCLI

from igps.data.datamodule import SignatureDataModule
from igps.nn.learner import RetrievalLearner


def main() -> None:
    """Entry point."""
    LightningCLI(
        RetrievalLearner,
        SignatureDataModule,
        seed_everything_default=0,
        save_config_kwargs={"overwrite": True},
        # After every epoch, validated or not.
        trainer_defaults={"callbacks": [ModelCheckpoint(save_on_train_epoch_end=True)]},
    )


if __name__ == "__main__":
    main()
