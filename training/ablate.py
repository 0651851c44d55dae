"""What each learned part gives: bins, spectral filter, dimensions and head, over several seeded splits.

    python -m training.ablate DATA

Bins and filter are trained on the training part through a `WhitenedHead`; then heads are fitted to its histograms, and
the test part is scored once.
"""

from jsonargparse import auto_cli

from igps.cli import faults_in_a_sentence
from training.studies.ablation import ablate

if __name__ == "__main__":
    with faults_in_a_sentence():
        auto_cli(ablate)
