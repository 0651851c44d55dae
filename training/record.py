"""Write results into a table of the documentation: `python -m training.record NAME KIND RESULTS "COMMAND"`."""

from jsonargparse import auto_cli

from igps.cli import errors_as_messages
from training.studies.pages import record

if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(record)
