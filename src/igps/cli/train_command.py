"""The command `igps train`."""

from __future__ import annotations

from pathlib import Path


def train(config: Path, resume: bool = False) -> None:
    """Train the layout of a descriptor and a head by gradients, as a YAML file says.

    For most folders igps fit reaches as much, in seconds. Training needs data.root, the folder with one subfolder per
    class, trainer.default_root_dir, the folder of the run, and trainer.max_epochs. It stops when validation no longer
    improves, and writes layout.safetensors for --descriptor, checkpoints with the head, and the curve of loss and
    validation.

    Args:
        config: YAML file; igps/learning/train.yaml lists every value, its meaning and its default.
        resume: continue an interrupted run.
    """
    from igps.learning.training import train as train_by_gradients

    print(f"written to {train_by_gradients(config, resume=resume)}")
