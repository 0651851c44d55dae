"""Measure retrieval scores over several seeded splits, or of a trained checkpoint.

    python -m training.evaluate splits DATA --descriptor rich --protocol unseen
    python -m training.evaluate fitted DATA --first_seed 200
    python -m training.evaluate checkpoint build/training/checkpoints/last.ckpt

No parameter is tuned: heads with fixed parameters are fitted to the training part, and the test part is scored once.
If a descriptor has a metric, as `pretrained` has, the metric is the prior of the heads.
"""

from jsonargparse import auto_cli

from igps.cli import errors_as_messages
from training.studies.learning import checkpoint, fitted, splits

if __name__ == "__main__":
    with errors_as_messages():
        auto_cli([splits, fitted, checkpoint])
