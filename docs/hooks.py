"""MkDocs hook: insert the help of every command into command-line.md."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from typing import Any
from unittest import mock

from igps.cli import COMMANDS, Commands, main

PLACEHOLDER = "<!-- commands -->"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the placeholder of a page by the help of every command."""
    return (
        markdown.replace(PLACEHOLDER, "\n".join(_sections(COMMANDS)))
        if PLACEHOLDER in markdown
        else markdown
    )


def _sections(commands: Commands, *group: str) -> list[str]:
    sections = []
    for name, command in commands.items():
        words = (*group, name)
        if callable(command):
            sections.append(f"## igps {' '.join(words)}\n\n```text\n{_help(words)}\n```\n")
        else:
            sections += _sections(command, *words)
    return sections


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
