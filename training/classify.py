"""Measure classification accuracy over several seeded splits, on fixed or on trained histograms.

    python -m training.classify DATA --descriptor rich
    python -m training.classify DATA --checkpoint build/training/checkpoints/last.ckpt

With a checkpoint, the features are the histograms of its learned bins and filter, and the split is that of the
checkpoint.
"""

from jsonargparse import auto_cli

from igps.cli import errors_as_messages
from training.studies.classification import classify

if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(classify)
