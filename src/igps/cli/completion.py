"""`igps completion`."""

from __future__ import annotations

from typing import Literal

from jsonargparse import ArgumentParser

Shell = Literal["bash", "zsh", "tcsh"]


def completion(shell: Shell) -> None:
    """Print a script by which a shell completes commands, options and their choices.

    Where to keep it: igps completion bash > /etc/bash_completion.d/igps, or any file that your shell reads.

    Args:
        shell: bash, zsh or tcsh.
    """
    # Here, as the parser has this command too
    from igps.cli import command_parser

    print(completion_script(command_parser(), shell))


def completion_script(parser: ArgumentParser, shell: Shell) -> str:
    """The script for a shell.

    Raises:
        ImportError: shtab is missing.
    """
    try:
        import shtab  # noqa: F401
    except ImportError as error:
        raise ImportError('igps completion needs shtab: pip install "interior-gps[completion]".') from error
    return str(parser.get_completion_script(f"shtab-{shell}"))
