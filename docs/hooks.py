"""MkDocs hook: insert the help of every command into command-line.md."""

from __future__ import annotations

import argparse
import os
from typing import Any
from unittest import mock

from igps.cli.commands import COMMANDS, load_command
from igps.cli.parsing import command_parser, shared_parser

PLACEHOLDER = "<!-- commands -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the placeholder of a page by the help of every command, and of the options that they share."""
    if PLACEHOLDER not in markdown:
        return markdown
    sections = [_section(f"igps {name}", command_parser(load_command(name))) for name in COMMANDS]
    sections.append(_section("igps help options", shared_parser()))
    return markdown.replace(PLACEHOLDER, "\n".join(sections))


def _section(title: str, parser: argparse.ArgumentParser) -> str:
    with mock.patch.dict(os.environ, {"COLUMNS": "100"}):
        text = parser.format_help().strip()
    return f"## {title}\n\n```text\n{text}\n```\n"
