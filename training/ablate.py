"""Measure what each learned part contributes: bins, spectral filter, dimensions and head, over seeded splits.

    python -m training.ablate DATA

Bins and filter are trained on the training part through a `WhitenedHead`. Then heads are fitted to the histograms of
that part, and the test part is scored once.
"""

from jsonargparse import auto_cli

from igps.cli import errors_as_messages
from training.studies.ablation import ablate

if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(ablate)
