"""The command line: what follows `igps` is a function by name."""

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

from igps._parallel import MachineError, is_machine_error, machine_error_text
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
from igps.cli.precompute import cache_export, precompute
from igps.cli.reading import FLAGS, LISTS, MEANINGS, Verdict
from igps.cli.report import report
from igps.cli.retrieval import extract, query, retrieve
from igps.data.pipeline import version
from igps.report.page_data import finite

Command = Callable[..., Any]
Commands = Mapping[str, "Command | Commands"]
JSON = "json"


def completion(shell: Literal["bash", "zsh", "tcsh"]) -> None:
    """Print a script by which a shell completes commands, options and their choices.

    Where to keep it: igps completion bash > /etc/bash_completion.d/igps, or any file that your shell reads.

    Args:
        shell: bash, zsh or tcsh.
    """
    try:
        import shtab  # noqa: F401
    except ImportError as error:
        raise ImportError('igps completion needs shtab: pip install "interior-gps[completion]".') from error
    print(command_parser().get_completion_script(f"shtab-{shell}"))


def _named(*commands: Command) -> dict[str, Command]:
    return {command.__name__: command for command in commands}


COMMANDS: Commands = {
    **_named(retrieve, extract, query, fit, classify, precompute),
    "cache": {"export": cache_export},
    "gallery": _named(
        gallery.build, gallery.add, gallery.sync, gallery.remove, gallery.update, gallery.merge, query, gallery.info,
        gallery.versions, gallery.restore,
    ),
    **_named(duplicates, distance, demo, compare, doctor, groups, explain, outliers, clusters),
    "figure": {"map": map_bodies, **_named(clusters, groups, explain, outliers)},
    **_named(report, completion),
}  # fmt: skip
"""What follows `igps`: a function, or the commands of a group by name.

A command that prints a table returns what it tells, for `--json`. Those of `figure` write to `figures` if not told.
"""


ENDINGS: Mapping[Command, Sequence[str]] = {
    extract: (*SUFFIXES, ".npz"), fit: (".safetensors", ""), cache_export: (".igps",), classify: (".csv",),
    duplicates: (".csv",), doctor: (), report: (),
}  # fmt: skip
"""Of the files that commands write as `out`, none where any will do; "" is a folder, as `out` of the others."""


@contextlib.contextmanager
def faults_in_a_sentence() -> Iterator[None]:
    """Say what is expected of bad input without a traceback, which would bury it, and exit as `main` does."""
    try:
        yield
    except MemoryError as error:
        print(f"igps: out of memory ({error}). Ask for less, or set a memory limit for each body.", file=sys.stderr)
        sys.exit(2)
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        full = isinstance(error, OSError) and is_machine_error(error)
        print(f"igps: {machine_error_text(error) if full else error}", file=sys.stderr)  # type: ignore[arg-type]
        sys.exit(2 if full or isinstance(error, MachineError) else 1)
    except KeyboardInterrupt:
        print("igps: interrupted. Run again to go on: what is done is kept.", file=sys.stderr)
        sys.exit(130)  # as shells say it


def main(
    commands: Commands | None = None, program: str = "igps", endings: Mapping[Command, Sequence[str]] = ENDINGS
) -> None:
    """Run the command that the words of the command line name: status 1 if the input is at fault, 2 if the machine is.

    Args:
        commands: by name; those of `igps` if not given.
        program: what the commands follow on the command line.
        endings: see `ENDINGS`.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    commands = COMMANDS if commands is None else commands
    with faults_in_a_sentence():
        parser = command_parser(commands, program)
        parsed = parser.instantiate(parser.parse_args())
        command, options = _chosen(parsed, commands)
        as_json = options.pop(JSON, False)
        if parsed.subcommand == "figure" and options.get("out", ...) is None:
            options["out"] = Path("figures")
        if taken_in := "".join(f"+{word}" for word in options.pop("with", None) or ()):
            if "descriptors" in options:
                options["descriptors"] = [one + taken_in for one in options["descriptors"]]
            else:
                options["descriptor"] = (options["descriptor"] or "pretrained") + taken_in
        check_at_least(1, n_workers=options.get("n_workers"))
        check_place("out", options.get("out"), endings.get(command))
        check_place("failures", options.get("failures"), ())
        # With --json, text for readers goes to standard error
        with one_thread(), contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
            found = command(**options)
    verdict = found if isinstance(found, Verdict) else Verdict(found, True)
    if as_json:
        print(json.dumps(finite(verdict.result), indent=2))
    if not verdict.is_good:
        sys.exit(1)


def check_place(name: str, place: Path | None, endings: Sequence[str] | None) -> None:
    """Raise a ValueError where a file of these endings, or a folder if None, could not be written."""
    if place is None:
        return
    if endings and place.suffix.lower() not in endings:
        told = ", ".join(filter(None, endings)) + ", or a folder" * ("" in endings)
        raise ValueError(f"{name}: expected a file ending in {told}, got {place}.")
    is_file = endings is not None and (place.suffix != "" or "" not in endings)
    place = place.absolute()
    there = next(one for one in (place, *place.parents) if one.exists())
    if there.is_dir() == (there == place and is_file):
        kind, other = ("file", "folder") if there.is_dir() else ("folder", "file")
        raise ValueError(f"{name}: expected a {kind}, {there} is a {other}. Name another place.")
    if not os.access(there, os.W_OK):
        raise ValueError(f"{name}: {there} may not be written to. Name another place, or ask for the right.")


def command_parser(commands: Commands | None = None, program: str = "igps") -> ArgumentParser:
    """The parser of all commands; for the arguments see `main`."""
    parser = ArgumentParser(prog=program, description="Volumetric shape retrieval by interior Global Point Signatures.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {version()}", help="show it and exit")
    _add_commands(parser, COMMANDS if commands is None else commands)
    return parser


def _chosen(arguments: Namespace, commands: Commands) -> tuple[Command, dict[str, Any]]:
    name: str = arguments.subcommand
    command, options = commands[name], arguments[name]
    return (command, options.as_dict()) if callable(command) else _chosen(options, command)


def _add_commands(parser: ArgumentParser, commands: Commands) -> None:
    added = parser.add_subcommands(required=True)
    for name, command in commands.items():
        if callable(command):
            summary, _, rest = (inspect.getdoc(command) or "").partition("\n")
            one = ArgumentParser(description=summary + "\n" + rest.partition("Args:")[0])
            _add_options(one, command)
            added.add_subcommand(name, one, help=summary)
        else:
            group = ArgumentParser(description=f"One of {', '.join(command)}.")
            added.add_subcommand(name, group, help=", ".join(command))
            _add_commands(group, command)  # a group takes commands only after it was added itself


def _add_options(parser: ArgumentParser, command: Command) -> None:
    """Options from the signature and docstring of a command, written as a shell user expects them.

    A first parameter without default is positional. A list takes several words, and a truth value is a switch.
    """
    kinds = get_type_hints(command)
    documented = {parameter.arg_name: parameter.description for parameter in parse(command.__doc__ or "").params}
    meanings = {**MEANINGS, **documented}
    parameters = inspect.signature(command).parameters
    switches = {name: meanings.get(name) for name in parameters if kinds[name] is bool}
    if "reading" in parameters:
        switches = {**FLAGS, **switches}
        for several, told in LISTS.items():
            if several != "with" or {"descriptor", "descriptors"} & set(parameters):
                parser.add_argument(f"--{several}", nargs="+", action="extend", help=told)
    if kinds["return"] is not type(None):
        switches[JSON] = "print the table as JSON, and everything else to standard error"
    by_hand: set[str | int] = {*switches, *LISTS}
    for place, (name, parameter) in enumerate(parameters.items()):
        positional = place == 0 and parameter.default is parameter.empty
        item = _list_item(kinds[name])
        if positional or item is not None:
            option, how = (name, {}) if positional else (f"--{name}", {"default": parameter.default})
            if not positional and parameter.default is parameter.empty:
                how = {"required": True}
            if item is not None and how.get("default") is None:
                how["action"] = "extend"  # what is named again comes beside the first
            parser.add_argument(option, nargs=item and "+", type=item or kinds[name], help=meanings[name], **how)
            by_hand.add(name)
    parser.add_function_arguments(command, skip=by_hand)
    for action in parser._actions:
        action.help = action.help or meanings.get(action.dest)
    for name, meaning in switches.items():
        parser.add_argument(f"--{name}", action="store_true", help=meaning)


def _list_item(kind: Any) -> Any:
    """What a list, or an optional list, is of; None for everything else."""
    lists = [one for one in (kind, *get_args(kind)) if get_origin(one) is list]
    return get_args(lists[0])[0] if lists else None
