"""The command line: every subcommand of `igps` is a function, whose signature and docstring define its options."""

import argparse
import contextlib
import inspect
import json
import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from docstring_parser import parse
from jsonargparse import ArgumentParser, Namespace

from igps._failures import MachineError, is_machine_error, machine_error_text
from igps._parameters import check_at_least
from igps._threads import one_thread
from igps.cli import gallery
from igps.cli.answers import explain, groups, outliers
from igps.cli.clusters import clusters, map_bodies
from igps.cli.compare import compare
from igps.cli.demo import demo
from igps.cli.doctor import doctor
from igps.cli.duplicates import distance, duplicates
from igps.cli.feature_table import SUFFIXES
from igps.cli.fit import classify, fit
from igps.cli.help import HelpFormatter, usage_of
from igps.cli.precompute import cache_export, precompute
from igps.cli.reading import FLAGS, LISTS, MEANINGS, Verdict
from igps.cli.report import report
from igps.cli.retrieval import extract, query, retrieve
from igps.data.pipeline import version
from igps.descriptors.registry import attributes_suffix
from igps.report.page_data import finite

Command = Callable[..., Any]
Commands = Mapping[str, "Command | Commands"]
JSON = "json"


def completion(shell: Literal["bash", "zsh", "tcsh"]) -> None:
    """Print a shell script that completes commands, options and their choices.

    To install it: igps completion bash > /etc/bash_completion.d/igps, or write it to any file that your shell reads.

    Args:
        shell: bash, zsh or tcsh.
    """
    try:
        import shtab  # noqa: F401
    except ImportError as error:
        raise ImportError(
            'igps completion needs shtab: pip install "interior-gps[completion]".'
        ) from error
    print(command_parser().get_completion_script(f"shtab-{shell}"))


def _by_name(*commands: Command) -> dict[str, Command]:
    return {command.__name__: command for command in commands}


COMMANDS: Commands = {
    **_by_name(retrieve, extract, query, fit, classify, precompute),
    "cache": {"export": cache_export},
    "gallery": _by_name(
        gallery.build,
        gallery.add,
        gallery.sync,
        gallery.remove,
        gallery.update,
        gallery.merge,
        query,
        gallery.info,
        gallery.versions,
        gallery.restore,
    ),
    **_by_name(duplicates, distance, demo, compare, doctor, groups, explain, outliers, clusters),
    "figure": {"map": map_bodies, **_by_name(clusters, groups, explain, outliers)},
    **_by_name(report, completion),
}
"""The commands by name: a function, or a mapping for a group of commands.

A command that prints a table returns the same data, for `--json`. Commands of `figure` write to `figures` by default.
"""

ENDINGS: Mapping[Command, Sequence[str]] = {
    extract: (*SUFFIXES, ".npz"),
    fit: (".safetensors", ""),
    cache_export: (".igps",),
    classify: (".csv",),
    duplicates: (".csv",),
    doctor: (),
    report: (),
}
"""Suffixes that `out` of a command may have: () allows any file, and "" a folder. Elsewhere `out` is a folder."""


@contextlib.contextmanager
def errors_as_messages() -> Iterator[None]:
    """Print an expected error as one sentence without its traceback, and exit with the status described in `main`."""
    try:
        yield
    except MemoryError as error:
        print(
            f"igps: out of memory ({error}). Reduce the input, or set a memory limit for each body.",
            file=sys.stderr,
        )
        sys.exit(2)
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        is_system = isinstance(error, OSError) and is_machine_error(error)
        print(f"igps: {machine_error_text(error) if is_system else error}", file=sys.stderr)  # type: ignore[arg-type]
        sys.exit(2 if is_system or isinstance(error, MachineError) else 1)
    except KeyboardInterrupt:
        print(
            "igps: interrupted. Run again to continue: finished results are kept.", file=sys.stderr
        )
        sys.exit(130)  # the convention of shells: 128 + SIGINT


def main(
    commands: Commands | None = None,
    program: str = "igps",
    endings: Mapping[Command, Sequence[str]] = ENDINGS,
) -> None:
    """Run the command of the command line; exit with status 1 for wrong input, or 2 for a fault of the system.

    Args:
        commands: commands by name; those of `igps` if None.
        program: name of the program, for its help.
        endings: suffixes that `out` of a command may have, see `ENDINGS`.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    commands = COMMANDS if commands is None else commands
    with errors_as_messages():
        parser = command_parser(commands, program)
        parsed = parser.instantiate(parser.parse_args())
        command, options = _selected(parsed, commands)
        as_json = options.pop(JSON, False)
        if parsed.subcommand == "figure" and options.get("out", ...) is None:
            options["out"] = Path("figures")
        if suffix := attributes_suffix(options.pop("with", None) or ()):
            if "descriptors" in options:
                options["descriptors"] = [name + suffix for name in options["descriptors"]]
            else:
                options["descriptor"] = (options["descriptor"] or "pretrained") + suffix
        check_at_least(1, n_workers=options.get("n_workers"))
        check_place("out", options.get("out"), endings.get(command))
        check_place("failures", options.get("failures"), ())
        # With --json, standard output holds the JSON alone
        with (
            one_thread(),
            contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext(),
        ):
            result = command(**options)
    verdict = result if isinstance(result, Verdict) else Verdict(result, True)
    if as_json:
        print(json.dumps(finite(verdict.result), indent=2))
    if not verdict.is_good:
        sys.exit(1)


def check_place(name: str, place: Path | None, endings: Sequence[str] | None) -> None:
    """Raise a ValueError if a file with one of `endings`, see `ENDINGS`, cannot be written; if None, a folder."""
    if place is None:
        return
    if endings and place.suffix.lower() not in endings:
        allowed = ", ".join(filter(None, endings)) + ", or a folder" * ("" in endings)
        raise ValueError(f"{name}: expected a file ending in {allowed}, got {place}.")
    is_file = endings is not None and (place.suffix != "" or "" not in endings)
    place = place.absolute()
    existing = next(path for path in (place, *place.parents) if path.exists())
    if existing.is_dir() == (existing == place and is_file):
        kind, other = ("file", "folder") if existing.is_dir() else ("folder", "file")
        raise ValueError(
            f"{name}: expected a {kind}, {existing} is a {other}. Choose another path."
        )
    if not os.access(existing, os.W_OK):
        raise ValueError(
            f"{name}: no permission to write to {existing}. Choose another path, or grant the permission."
        )


def command_parser(commands: Commands | None = None, program: str = "igps") -> ArgumentParser:
    """Return the parser of all commands; for the arguments see `main`."""
    summary = "Volumetric shape retrieval by interior Global Point Signatures."
    parser = ArgumentParser(prog=program, description=summary, formatter_class=HelpFormatter)
    text = f"%(prog)s {version()}"
    parser.add_argument(
        "--version", action="version", version=text, help="show the version and exit"
    )
    _add_commands(parser, COMMANDS if commands is None else commands, program)
    return parser


def _selected(arguments: Namespace, commands: Commands) -> tuple[Command, dict[str, Any]]:
    """Return the command that the parsed arguments name, with its options."""
    name: str = arguments.subcommand
    command, options = commands[name], arguments[name]
    return (command, options.as_dict()) if callable(command) else _selected(options, command)


def _add_commands(parser: ArgumentParser, commands: Commands, program: str) -> None:
    subcommands = parser.add_subcommands(required=True)
    for name, command in commands.items():
        if callable(command):
            summary, _, details = (inspect.getdoc(command) or "").partition("\n")
            description = summary + "\n" + details.partition("Args:")[0]
            subparser = ArgumentParser(description=description, formatter_class=HelpFormatter)
            _add_options(subparser, command)
            subparser.usage = usage_of(subparser, f"{program} {name}")
            subcommands.add_subcommand(name, subparser, help=summary)
        else:
            listed = f"commands: {', '.join(command)}"
            group = ArgumentParser(
                description=f"One of several {listed}.", formatter_class=HelpFormatter
            )
            subcommands.add_subcommand(name, group, help=listed)
            # jsonargparse accepts subcommands of a group only after adding the group
            _add_commands(group, command, f"{program} {name}")


def _add_options(parser: ArgumentParser, command: Command) -> None:
    """Add the options of a command, from its signature and docstring.

    A first parameter without default is positional. A list takes several values, and a boolean is a switch.
    """
    types = get_type_hints(command)
    documented = {
        parameter.arg_name: parameter.description
        for parameter in parse(command.__doc__ or "").params
    }
    meanings = {**MEANINGS, **documented}
    parameters = inspect.signature(command).parameters
    switches = {name: meanings.get(name) for name in parameters if types[name] is bool}
    lists: dict[str, str | None] = {}
    if "reading" in parameters:
        switches = {**FLAGS, **switches}
        has_descriptor = {"descriptor", "descriptors"} & set(parameters)
        lists = {
            name: meaning for name, meaning in LISTS.items() if name != "with" or has_descriptor
        }
    if types["return"] is not type(None):
        switches[JSON] = "print the table as JSON, and everything else to standard error"
    custom: set[str | int] = {*switches, *LISTS}  # their syntax differs from jsonargparse's
    for position, (name, parameter) in enumerate(parameters.items()):
        is_positional = position == 0 and parameter.default is parameter.empty
        item = _list_item(types[name])
        if is_positional or item is not None:
            option, settings = (name if is_positional else f"--{name}"), dict[str, Any]()
            if parameter.default is not parameter.empty:
                settings["default"] = parameter.default
            if not is_positional:
                settings |= {"action": _Collect, "required": not settings}
            parser.add_argument(
                option,
                nargs=item and "+",
                type=item or types[name],
                help=meanings[name],
                **settings,
            )
            custom.add(name)
    parser.add_function_arguments(command, as_group=False, skip=custom)
    for action in parser._actions:
        action.help = action.help or meanings.get(action.dest)
    for name, meaning in lists.items():
        parser.add_argument(f"--{name}", nargs="+", action=_Collect, help=meaning)
    for name, meaning in switches.items():
        parser.add_argument(f"--{name}", action="store_true", help=meaning)


class _Collect(argparse.Action):
    """Collect the values of a repeated option in place of its default."""

    _collected: Any = None  # the last value that this action set, which is never the default

    def __call__(
        self, parser: Any, namespace: Any, values: Any, option_string: str | None = None
    ) -> None:
        given = getattr(namespace, self.dest, None)
        self._collected = [*given, *values] if given is self._collected and given else values
        setattr(namespace, self.dest, self._collected)


def _list_item(hint: Any) -> Any:
    """Return the item type of a list or of an optional list; None for every other type."""
    lists = [kind for kind in (hint, *get_args(hint)) if get_origin(kind) is list]
    return get_args(lists[0])[0] if lists else None
