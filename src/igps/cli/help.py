"""The command `igps help`."""

from __future__ import annotations

from typing import Literal

from igps.cli.parsing import shared_parser


def show_help(topic: Literal["options", "descriptors"]) -> None:
    """Show all options of reading and of signatures, or the names of the descriptors.

    Args:
        topic: options or descriptors.
    """
    if topic == "options":
        shared_parser().print_help()
        print("\nA file for --options holds the same names, such as:\n")
        print("mend: always\ncache_dir: cache\nsignature:\n  resolution: 64")
    else:
        from igps.descriptors import NAMES
        from igps.descriptors.registry import FIELD_NAMES

        print("\n".join([*NAMES, *FIELD_NAMES]))
