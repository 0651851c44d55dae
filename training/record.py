"""Write results into a table of the documentation: `python -m training.record NAME KIND RESULTS "COMMAND"`."""

from jsonargparse import auto_cli

from igps.cli import faults_in_a_sentence
from training.studies.pages import record

if __name__ == "__main__":
    with faults_in_a_sentence():
        auto_cli(record)
