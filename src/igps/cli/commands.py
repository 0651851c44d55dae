"""The commands of `igps`: a table of names, and how the options of a function become those of a command."""

from __future__ import annotations

import importlib
import inspect
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, Union, get_args, get_origin, get_type_hints

from igps.cli.shared_options import GROUPS, JSON, MEANINGS, SHARED, SIGNATURE, WITH, Option

COMMANDS: Mapping[str, str] = {
    "retrieve": "igps.cli.retrieval_commands:retrieve",
    "query": "igps.cli.retrieval_commands:query",
    "extract": "igps.cli.retrieval_commands:extract",
    "compare": "igps.cli.compare_command:compare",
    "fit": "igps.cli.fit_commands:fit",
    "classify": "igps.cli.fit_commands:classify",
    "train": "igps.cli.train_command:train",
    "inside": "igps.cli.inside_command:inside",
    "groups": "igps.cli.groups_command:groups",
    "explain": "igps.cli.explain_command:explain",
    "outliers": "igps.cli.outliers_command:outliers",
    "asymmetry": "igps.cli.asymmetry_command:asymmetry",
    "clusters": "igps.cli.clusters_command:clusters",
    "trajectory": "igps.cli.trajectory_command:trajectory",
    "duplicates": "igps.cli.duplicates_command:duplicates",
    "doctor": "igps.cli.doctor_command:doctor",
    "report": "igps.cli.report_command:report",
    "gallery build": "igps.cli.gallery_commands:build",
    "gallery sync": "igps.cli.gallery_commands:sync",
    "gallery remove": "igps.cli.gallery_commands:remove",
    "gallery info": "igps.cli.gallery_commands:info",
    "precompute": "igps.cli.precompute_command:precompute",
    "demo": "igps.cli.demo_command:demo",
    "help": "igps.cli.help_command:show_help",
}
"""Where the function of each command is. Its module imports other packages inside its functions, see `Command`."""

FORMER: Mapping[str, Sequence[str]] = {"map": ("clusters", "--colour", "class")}
"""Words that stand for a command that is part of another now."""

ENTRY_POINTS = "igps.commands"
"""The group of entry points by which other packages add commands."""

ENDINGS: Mapping[str, Sequence[str]] = {
    "extract": (".csv", ".parquet", ".npz"),
    "inside": (".csv", ".parquet"),
    "fit": (".safetensors", ""),
    "classify": (".csv",),
    "duplicates": (".csv",),
    "doctor": (),
    "report": (),
}
"""Suffixes that `out` of a command may have: () allows any file, and "" a folder. Elsewhere `out` is a folder."""


@dataclass(frozen=True)
class Command:
    """A function as a command: its signature gives the options, and its docstring their help.

    The first parameter, if it has no default, is positional. A list takes several values, and a boolean is a switch.
    `**reading` stands for the shared options of that name, see `GROUPS`; so does a parameter that is not documented and
    has the name of a shared option. A function that returns something has the option `--json`, which prints it.
    """

    name: str
    function: Callable[..., Any]

    @property
    def summary(self) -> str:
        """First line of the docstring."""
        return inspect.cleandoc(self.function.__doc__ or "").partition("\n")[0]

    @property
    def description(self) -> str:
        """Docstring without its arguments."""
        return inspect.cleandoc(self.function.__doc__ or "").partition("\nArgs:")[0].strip()

    def own_options(self) -> list[tuple[Option, bool]]:
        """Return the options that only this command has, and whether each is required."""
        documented = documented_parameters(self.function.__doc__ or "")
        hints = get_type_hints(self.function)
        options = []
        for name, parameter in self._named_parameters().items():
            is_shared = name in SHARED or name == SIGNATURE.rstrip(".")
            if is_shared and name not in documented:
                continue
            is_required = parameter.default is parameter.empty
            text = documented.get(name) or MEANINGS.get(name, "")
            default = None if is_required else parameter.default
            options.append((Option(name, hints[name], text, default), is_required))
        if hints.get("return") not in (None, type(None)):
            options.append((JSON, False))
        if {"descriptor", "descriptors"} & set(hints) and self.shared_options():
            options.append((WITH, False))
        return options

    def shared_options(self) -> dict[str, Option]:
        """Return the shared options that this command has, by name."""
        documented = documented_parameters(self.function.__doc__ or "")
        found: dict[str, Option] = {}
        for name, parameter in inspect.signature(self.function).parameters.items():
            if parameter.kind is parameter.VAR_KEYWORD:
                found |= GROUPS[name]
            elif name == SIGNATURE.rstrip("."):
                found |= {key: SHARED[key] for key in SHARED if key.startswith(SIGNATURE)}
            elif name in SHARED:
                found[name] = SHARED[name]
        # In the order of `SHARED`, and without those that the command explains itself
        return {name: SHARED[name] for name in SHARED if name in found and name not in documented}

    def positional(self) -> str | None:
        """Return the name of the positional parameter; None if there is none."""
        for name, parameter in self._named_parameters().items():
            return name if parameter.default is parameter.empty else None
        return None

    def _named_parameters(self) -> dict[str, inspect.Parameter]:
        parameters = inspect.signature(self.function).parameters
        return {name: p for name, p in parameters.items() if p.kind is not p.VAR_KEYWORD}


def load_command(name: str) -> Command:
    """Import the module of a command and return the command."""
    place = COMMANDS.get(name) or installed_commands()[name]
    module, _, function = place.partition(":")
    return Command(name, getattr(importlib.import_module(module), function))


def installed_commands() -> dict[str, str]:
    """Return the commands that other packages add: where they are, by name."""
    return {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}


def command_of(words: Sequence[str]) -> str | None:
    """Return the name of the command that words begin with, in one or two words; None if there is none."""
    for n_words in (2, 1):
        name = " ".join(words[:n_words])
        if name in COMMANDS:
            return name
    is_name = bool(words) and not words[0].startswith("-")
    if is_name and words[0] in installed_commands():
        return words[0]
    return None


def documented_parameters(docstring: str) -> dict[str, str]:
    """Return the descriptions of parameters by name, from the section "Args:" of a docstring."""
    section = inspect.cleandoc(docstring).partition("\nArgs:\n")[2]
    section = re.split(r"\n(?=\S)", section)[0]
    entries = re.split(r"^ {4}(\w+): ", section, flags=re.MULTILINE)[1:]
    texts = [" ".join(text.split()) for text in entries[1::2]]
    return dict(zip(entries[::2], texts, strict=True))


def kinds_of(hint: Any) -> tuple[list[Any], bool]:
    """Return the types that a value may have, without None, and whether None is among them."""
    is_union = get_origin(hint) in (Union, types.UnionType)
    kinds = list(get_args(hint)) if is_union else [hint]
    without_none = [kind for kind in kinds if kind is not type(None)]
    return without_none, len(without_none) < len(kinds)
