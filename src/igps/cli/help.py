"""The help of commands, in the words that a person types."""

import argparse
import re
from typing import Any, get_args

from jsonargparse import ArgumentParser, DefaultHelpFormatter

# References to Python names, such as ", see `laplacian`" or " (see `Requirements.apply_to`)"
_REFERENCE = re.compile(r" \(see `[^)]*\)|,? see `[^`]+`(?: and `[^`]+`)*")


class HelpFormatter(DefaultHelpFormatter):
    """Help that shows the choices of an option in place of its Python type, and its default if it has one."""

    def _get_help_string(self, action: argparse.Action) -> str:
        if isinstance(action, argparse._HelpAction):
            return action.help or ""
        text = as_typed(action.help or "").removesuffix(".")
        if isinstance(action.default, list):
            return f"{text} (default: {' '.join(action.default)})"
        is_unset = (
            any(action.default is unset for unset in (None, False, ()))
            or action.default == argparse.SUPPRESS
        )
        has_default = action.option_strings and not is_unset
        return f"{text} (default: %(default)s)" if has_default else text

    def _get_default_metavar_for_optional(self, action: argparse.Action) -> str:
        choices = _choices(getattr(action, "_typehint", None))
        return (
            f"{{{','.join(choices)}}}"
            if choices
            else super()._get_default_metavar_for_optional(action)
        )


def as_typed(text: str) -> str:
    """Return a description of a parameter as help of an option: `null` for None, and no references to Python names."""
    return re.sub(r"\bNone\b", "null", _REFERENCE.sub("", " ".join(text.split()))).replace("`", "")


def usage_of(parser: ArgumentParser, command: str) -> str:
    """Return a line with the arguments that a command requires; the positional one is first, where no list takes it."""
    required = ["[options]"]
    for action in parser._actions:
        name = action.option_strings[0] if action.option_strings else action.dest
        if not action.option_strings:
            required.insert(0, f"{name} [{name} ...]" if action.nargs == "+" else name)
        elif action.required:
            required.insert(-1, f"{name} {action.dest.upper()}" + " ..." * (action.nargs == "+"))
    return f"{command} {' '.join(required)}"


def _choices(hint: Any) -> tuple[str, ...]:
    """Return the strings that an optional choice allows."""
    return tuple(
        choice for kind in get_args(hint) for choice in get_args(kind) if isinstance(choice, str)
    )
