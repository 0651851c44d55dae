"""Measure what each learned part contributes: bins, spectral filter, dimensions and head, over seeded splits.

    python -m training.ablate DATA

Bins and filter are trained on the training part through a `WhitenedHead`. Then heads are fitted to the histograms of
that part, and the test part is scored once.
"""

from jsonargparse import auto_cli

from igps.cli import faults_in_a_sentence
from training.studies.ablation import ablate

if __name__ == "__main__":
    with faults_in_a_sentence():
        auto_cli(ablate)
