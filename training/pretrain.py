"""Fit the metric of the descriptor `pretrained` to generated shapes, and score it on held-out shapes.

    python -m training.pretrain --config configs/pretrain.yaml
    python -m training.pretrain --config configs/pretrain.yaml --data DATA

The first command makes the file that the package ships. It scores the metric on held-out families of generated classes
and individuals, beside the plain descriptors. The second command also scores it on a labelled collection, alone and
with a few labels of the collection.
"""

from jsonargparse import auto_cli

from igps.cli import errors_as_messages
from training.studies.pretraining import pretrain

if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(pretrain)
