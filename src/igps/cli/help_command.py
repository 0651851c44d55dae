"""The command `igps help`."""

from __future__ import annotations

from typing import Literal

from igps.cli.parsing import program_parser, shared_parser


def show_help(topic: Literal["options", "descriptors", "bash", "zsh", "tcsh"]) -> None:
    """Show all options of reading and of signatures, the names of the descriptors, or a script for a shell.

    The script completes commands, options and their choices. To install it: igps help bash >
    /etc/bash_completion.d/igps, or write it to any file that your shell reads.

    Args:
        topic: options, descriptors, or the name of a shell.
    """
    if topic == "options":
        shared_parser().print_help()
        print("\nA file for --options holds the same names, such as:\n")
        print("mend: always\ncache_dir: cache\nsignature:\n  resolution: 64")
    elif topic == "descriptors":
        from igps.descriptors import NAMES
        from igps.descriptors.registry import FIELD_NAMES

        print("\n".join([*NAMES, *FIELD_NAMES]))
    else:
        try:
            import shtab
        except ImportError as error:
            raise ImportError(
                'Completion needs shtab: pip install "interior-gps[completion]".'
            ) from error
        print(shtab.complete(program_parser(), topic))
