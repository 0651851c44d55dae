"""Retrieval scores over several seeded splits, and of a trained checkpoint.

    python -m training.evaluate splits DATA --descriptor rich --protocol unseen
    python -m training.evaluate fitted DATA --first_seed 200
    python -m training.evaluate checkpoint build/training/checkpoints/last.ckpt

Nothing is chosen here: the heads are fitted to the training part with fixed parameters, the test part is scored once.
Of a descriptor with a metric, such as `pretrained`, that is the heads' prior.
"""

from jsonargparse import auto_cli

from igps.cli import faults_in_a_sentence
from training.studies.learning import checkpoint, fitted, splits

if __name__ == "__main__":
    with faults_in_a_sentence():
        auto_cli([splits, fitted, checkpoint])
