"""The command `igps completion`."""

from __future__ import annotations

from typing import Literal

from igps.cli.parsing import program_parser


def completion(shell: Literal["bash", "zsh", "tcsh"]) -> None:
    """Print a shell script that completes commands, options and their choices.

    To install it: igps completion bash > /etc/bash_completion.d/igps, or write it to any file that your shell reads.

    Args:
        shell: bash, zsh or tcsh.
    """
    try:
        import shtab
    except ImportError as error:
        raise ImportError(
            'igps completion needs shtab: pip install "interior-gps[completion]".'
        ) from error
    print(shtab.complete(program_parser(), shell))
