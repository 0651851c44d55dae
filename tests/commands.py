"""Run the command line of igps in the process of the test."""

import sys

import pytest

from igps.cli import main


def run(*arguments):
    """Run `igps` with arguments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["igps", *map(str, arguments)])
        main()


def error_of(capsys, *arguments):
    """Return the line of the error with which `igps` ends for these arguments."""
    with pytest.raises(SystemExit, match="1"):
        run(*arguments)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("igps: ")]
    return line
