"""What `make docs` writes into pages: the help of every command, where command-line.md says so."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from typing import Any
from unittest import mock

from igps.cli import COMMANDS, Commands, main

PLACE = "<!-- commands -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page with the help of every command."""
    return markdown.replace(PLACE, "\n".join(_sections(COMMANDS))) if PLACE in markdown else markdown


def _sections(commands: Commands, *group: str) -> list[str]:
    found = []
    for name, command in commands.items():
        words = (*group, name)
        if callable(command):
            found.append(f"## igps {' '.join(words)}\n\n```text\n{_help(words)}\n```\n")
        else:
            found += _sections(command, *words)
    return found


def _help(words: tuple[str, ...]) -> str:
    text = io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["igps", *words, "--help"]),
        mock.patch.dict(os.environ, {"COLUMNS": "100"}),
        contextlib.redirect_stdout(text),
        contextlib.suppress(SystemExit),
    ):
        main()
    return text.getvalue().strip()
