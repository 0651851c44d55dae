"""Parsers for the words of the command line, made from `Command` and `Option`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from igps.cli.commands import (
    COMMANDS,
    FORMER,
    Command,
    command_of,
    installed_commands,
    kinds_of,
    load_command,
)
from igps.cli.shared_options import COMMON, OPTIONS, SHARED, SIGNATURE, Option

SUMMARY = "Volumetric shape retrieval by interior Global Point Signatures."
_MORE = (
    "All options of reading and of signatures, for the command line or a file: igps help options"
)


def parse(words: Sequence[str], command: Command | None = None) -> tuple[Command, dict[str, Any]]:
    """Return the command that the words of a command line name, unless it is given, and its options as given.

    Prints the help and exits if the words ask for it; exits with status 2 if they are wrong.
    """
    if command is None:
        if words and words[0] in FORMER:
            now = FORMER[words[0]]
            print(f"igps: {words[0]} is a part of igps {now[0]} now.", file=sys.stderr)
            words = [*now, *words[1:]]
        name = command_of(words)
        if name is None:
            program_parser().parse_args(words)
            raise AssertionError("a parser that accepts a command of no name")
        command = load_command(name)
    n_words = len(command.name.split())
    return command, _given(command, words[n_words:])


def _given(command: Command, words: Sequence[str]) -> dict[str, Any]:
    """Return the options that the words give, by name; those of signatures as one `SignatureConfig`."""
    parser = command_parser(command)
    given = vars(parser.parse_args(words))
    file = given.pop(OPTIONS.name, None)
    if file is not None:
        # What is typed comes later, and wins
        words = [*words_of_file(file, command.shared_options()), *words]
        given = vars(parser.parse_args(words))
        del given[OPTIONS.name]
    return _with_signature(given)


def _with_signature(options: dict[str, Any]) -> dict[str, Any]:
    """Return options in which those of signatures are one `SignatureConfig`."""
    from igps.signature.config import SignatureConfig

    fields = {
        name.removeprefix(SIGNATURE): value
        for name, value in options.items()
        if name.startswith(SIGNATURE)
    }
    others = {name: value for name, value in options.items() if not name.startswith(SIGNATURE)}
    if fields:
        others[SIGNATURE.rstrip(".")] = SignatureConfig(**fields)
    return others


def command_parser(command: Command) -> argparse.ArgumentParser:
    """Return the parser of one command."""
    parser = argparse.ArgumentParser(**_settings(command))
    fill_parser(parser, command)
    return parser


def program_parser() -> argparse.ArgumentParser:
    """Return the parser of `igps` with all its commands, for its help, its errors, and completion."""
    parser = argparse.ArgumentParser(prog="igps", description=SUMMARY, allow_abbrev=False)
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    groups: dict[str, Any] = {}
    for name in COMMANDS:
        group, _, last = name.rpartition(" ")
        if group and group not in groups:
            members = [own for own in COMMANDS if own.startswith(f"{group} ")]
            listed = ", ".join(member.removeprefix(f"{group} ") for member in members)
            text = f"one of several commands: {listed}"
            parent = commands.add_parser(group, help=text, description=text.capitalize() + ".")
            groups[group] = parent.add_subparsers(metavar="COMMAND", required=True)
        command = load_command(name)
        add_to = groups[group] if group else commands
        subparser = add_to.add_parser(last, help=command.summary, **_settings(command))
        fill_parser(subparser, command)
    for name, place in installed_commands().items():
        commands.add_parser(name, help=f"from {place.partition(':')[0]}")
    return parser


def fill_parser(parser: argparse.ArgumentParser, command: Command) -> None:
    """Add the options of a command. Its help leaves out the rare ones that commands share."""
    positional = command.positional()
    for option, is_required in command.own_options():
        _add(parser, option, is_positional=option.name == positional, is_required=is_required)
    shared = command.shared_options()
    if shared:
        group = parser.add_argument_group("reading")
        for option in (*shared.values(), OPTIONS):
            _add(group, option, is_hidden=option.name not in (*COMMON, OPTIONS.name))
        parser.epilog = _MORE
    parser.usage = _usage(parser)


def shared_parser() -> argparse.ArgumentParser:
    """Return a parser of all shared options, for their help."""
    parser = argparse.ArgumentParser(
        prog="igps COMMAND",
        usage="igps COMMAND ... [options]",
        add_help=False,
        formatter_class=_HelpFormatter,
    )
    group = parser.add_argument_group("reading and signatures, for every command that reads bodies")
    for option in SHARED.values():
        _add(group, option)
    return parser


def words_of_file(path: Path, options: Iterable[str]) -> list[str]:
    """Return the options of a YAML file as words of a command line; those of signatures may be a mapping.

    Raises:
        ValueError: the file is not a mapping, or an option is not among `options`.
    """
    import yaml

    try:
        loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        problem = " ".join(str(error).split())
        raise ValueError(f"options: {path} is not YAML: {problem}.") from error
    if not isinstance(loaded, dict):
        raise ValueError(
            f"options: expected lines such as `mend: always` in {path}, got {loaded!r}."
        )
    values: dict[str, Any] = {}
    for name, value in loaded.items():
        if isinstance(value, dict):
            values |= {f"{name}.{key}": inner for key, inner in value.items()}
        else:
            values[str(name)] = value
    words = []
    for name, value in values.items():
        if name not in options:
            raise ValueError(
                f"options: {path} has {name!r}, which this command does not have. "
                "`igps help options` lists all names."
            )
        words += _words(name, value)
    return words


def _words(name: str, value: Any) -> list[str]:
    if value is None or value is False:
        return []
    if value is True:
        return [f"--{name}"]
    values = value if isinstance(value, list) else [value]
    return [f"--{name}={each}" for each in values]


def _settings(command: Command) -> dict[str, Any]:
    return {
        "prog": f"igps {command.name}",
        "description": command.description,
        "formatter_class": _HelpFormatter,
        "allow_abbrev": False,
    }


def _add(
    parser: argparse._ActionsContainer,
    option: Option,
    *,
    is_positional: bool = False,
    is_required: bool = False,
    is_hidden: bool = False,
) -> None:
    """Add an option. A value that is not given stays unset, so that the default of the function holds."""
    flag = option.name if is_positional else f"--{option.name}"
    text = argparse.SUPPRESS if is_hidden else _help_of(option)
    settings: dict[str, Any] = {"help": text, "default": argparse.SUPPRESS}
    if option.hint is bool:
        parser.add_argument(flag, action="store_true", **settings)
        return
    kinds, may_be_none = kinds_of(option.hint)
    kind = kinds[0]
    if get_origin(kind) in (list, tuple):
        kind = get_args(kind)[0]
        settings["nargs"] = "+"
        if not is_positional:
            settings["action"] = "extend"
    if get_origin(kind) is Literal:
        settings["choices"] = get_args(kind)
    elif may_be_none and kind in (int, float):
        settings["type"] = _number_or_none(kind)
    else:
        settings["type"] = kind
    if not is_positional:
        settings["required"] = is_required
        if "choices" not in settings:
            settings["metavar"] = option.name.rpartition(".")[2].upper()
    parser.add_argument(flag, **settings)


def _help_of(option: Option) -> str:
    text = option.help.replace("`", "").removesuffix(".").replace("%", "%%")
    default = option.default
    if isinstance(default, list | tuple):
        default = " ".join(default)
    if option.hint is bool or default in (None, ""):
        return text
    return f"{text} (default: {default})"


def _number_or_none(kind: type) -> Callable[[str], Any]:
    """Return a function that reads a number, or None from "none" or "null"."""

    def read(text: str) -> Any:
        return None if text.lower() in ("none", "null") else kind(text)

    read.__name__ = kind.__name__  # argparse names it in its errors
    return read


def _usage(parser: argparse.ArgumentParser) -> str:
    """Return a line with the arguments that a command requires."""
    words = [parser.prog]
    for action in parser._actions:
        if not action.option_strings:
            name = action.dest
            words.append(f"{name} [{name} ...]" if action.nargs == "+" else name)
        elif action.required:
            dots = " ..." if action.nargs == "+" else ""
            words.append(f"{action.option_strings[0]} {action.dest.upper()}{dots}")
    return " ".join([*words, "[options]"])


class _HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Help in two columns, with the paragraphs of the description as they are."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28)


class _Version(argparse.Action):
    """Print the version of igps and of its signatures."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        import importlib.metadata

        from igps.signature.config import SignatureConfig

        number = importlib.metadata.version("interior-gps")
        print(f"{parser.prog} {number}, signatures {SignatureConfig.ALGORITHM_VERSION}")
        parser.exit()
