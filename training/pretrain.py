"""Fit the metric of the descriptor `pretrained` to generated shapes, and measure it where it was not fitted.

    python -m training.pretrain --config configs/pretrain.yaml
    python -m training.pretrain --config configs/pretrain.yaml --data DATA

The first makes the file that the package ships; its only check is on held-out families of generated classes, beside the
plain descriptors. The second scores that metric on a labelled collection too, alone and with a few labels of it.
"""

from jsonargparse import auto_cli

from igps.cli import faults_in_a_sentence
from training.studies.pretraining import pretrain

if __name__ == "__main__":
    with faults_in_a_sentence():
        auto_cli(pretrain)
