"""A callback of the tests' own."""

from pytorch_lightning import Callback


class PowerFailure(Callback):
    """Fails in the middle of the third epoch."""

    def on_train_batch_end(self, trainer, *arguments):
        if trainer.current_epoch == 2:
            raise RuntimeError("the power fails")
