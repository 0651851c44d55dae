"""The command line: every command of `igps` is a function, whose signature and docstring define its options.

Help, versions and wrong options are answered without importing torch: see `igps.cli.commands`.
"""

import contextlib
import inspect
import io
import json
import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from igps._parameters import check_at_least
from igps.cli.commands import COMMANDS, ENDINGS, Command
from igps.cli.parsing import parse
from igps.cli.shared_options import JSON, WITH, Verdict


@contextlib.contextmanager
def errors_as_messages() -> Iterator[None]:
    """Print an expected error as one sentence without its traceback, and exit with the status described in `main`."""
    try:
        yield
    except KeyboardInterrupt:
        print(
            "igps: interrupted. Run again to continue: finished results are kept.", file=sys.stderr
        )
        sys.exit(130)  # the convention of shells: 128 + SIGINT
    except BrokenPipeError:
        _forget_output()
        sys.exit(141)  # the convention of shells: 128 + SIGPIPE
    except MemoryError as error:
        print(
            f"igps: out of memory ({error}). Reduce the input, or set a memory limit for each body.",
            file=sys.stderr,
        )
        sys.exit(2)
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        from igps.failures import MachineError, machine_error

        shown = machine_error(error) or error
        print(f"igps: {shown}", file=sys.stderr)
        sys.exit(2 if isinstance(shown, MachineError) else 1)


def main() -> None:
    """Run the command of the command line; exit with status 1 for wrong input, or 2 for a fault of the system.

    The status is 130 after Ctrl-C, and 141 if nobody reads the output any more, as behind `| head`.
    """
    _start_in_utf8()
    with errors_as_messages():
        logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
        command, options = parse(sys.argv[1:])
        as_json = options.pop(JSON.name, False)
        attributes = options.pop(WITH.name, None)
        if attributes:
            options |= _with_attributes(attributes, command, options)
        check_at_least(1, n_workers=options.get("n_workers"))
        if command.name in COMMANDS:
            check_place("out", options.get("out"), ENDINGS.get(command.name))
            check_place("failures", options.get("failures"), ())
        from tqdm.contrib.logging import logging_redirect_tqdm  # a warning clears the bar first

        from igps._progress import Progress, number_bars

        # With --json, standard output holds the JSON alone
        place = contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext()
        with place, logging_redirect_tqdm(tqdm_class=Progress), _threads_of(command):
            result = command.function(**options)
            number_bars(None)
        verdict = result if isinstance(result, Verdict) else Verdict(result, True)
        if as_json:
            from igps.report.page_data import finite

            print(json.dumps(finite(verdict.result), indent=2))
        sys.stdout.flush()  # a closed pipe shows here, not when Python ends
    if not verdict.is_good:
        sys.exit(1)


def _start_in_utf8() -> None:
    """Start Python again if it takes names of files for ASCII, as in the C locale.

    Letters that the terminal does not have are printed as escapes.
    """
    if sys.getfilesystemencoding() != "utf-8":
        os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _with_attributes(
    attributes: Sequence[str], command: Command, options: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the option for the descriptor, or descriptors, with attributes behind each name."""
    from igps.descriptors import NAMES

    suffix = "".join(f"+{attribute}" for attribute in attributes)
    parameters = inspect.signature(command.function).parameters
    if "descriptors" in parameters:
        names = options.get("descriptors") or parameters["descriptors"].default or NAMES
        return {"descriptors": [name + suffix for name in names]}
    name = options.get("descriptor") or parameters["descriptor"].default or "pretrained"
    return {"descriptor": name + suffix}


def check_place(name: str, place: Path | None, endings: Sequence[str] | None) -> None:
    """Raise a ValueError if a file with one of `endings`, see `ENDINGS`, cannot be written; if None, a folder."""
    if place is None:
        return
    if endings and place.suffix.lower() not in endings:
        allowed = ", ".join(ending for ending in endings if ending)
        if "" in endings:
            allowed += ", or a folder"
        raise ValueError(f"{name}: expected a file ending in {allowed}, got {place}.")
    is_file = endings is not None and (place.suffix != "" or "" not in endings)
    place = place.absolute()
    existing = next(path for path in (place, *place.parents) if path.exists())
    if existing == place and is_file and existing.is_dir():
        raise ValueError(f"{name}: expected a file, {existing} is a folder. Choose another path.")
    if not existing.is_dir() and not (existing == place and is_file):
        raise ValueError(f"{name}: expected a folder, {existing} is a file. Choose another path.")
    if not os.access(existing, os.W_OK):
        raise ValueError(
            f"{name}: no permission to write to {existing}. Choose another path, or grant the permission."
        )


def _threads_of(command: Command) -> AbstractContextManager[object]:
    """Return the context in which a command runs: its numerical libraries take one thread in each process."""
    if command.name == "help":
        return contextlib.nullcontext()
    from igps._threads import one_thread

    return one_thread()


def _forget_output() -> None:
    """Send what is still to be printed nowhere, so that Python does not fail to print it at its end."""
    with contextlib.suppress(io.UnsupportedOperation):  # an output that is no file of the system
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
