"""A bar on standard error that tells how far a long computation is."""

import sys
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from itertools import count
from typing import Any

from tqdm import tqdm

_SECONDS = 60  # between the lines in a file
_NUMBERS: ContextVar[Iterator[str] | None] = ContextVar("numbers of bars", default=None)


def number_bars(total: int | None) -> None:
    """Number the bars that follow, as in "2/3 descriptions", by the number of steps of a command; None ends it."""
    _NUMBERS.set(None if total is None else (f"{i}/{total} " for i in count(1)))


class Progress(tqdm):
    """One bar at a time: it makes way for the next when it ends. In a file, it is a line a minute and one at its end.

    Of a bar that is updated by hand, the estimate leaves out the first result. Until then, worker processes start, and
    a new installation compiles its loops, which says nothing about the results that follow.
    """

    def __init__(self, iterable: Any = None, **options: Any) -> None:
        numbers = _NUMBERS.get()
        if numbers is not None and not options.get("disable"):
            options["desc"] = next(numbers) + options["desc"]
        self._is_in_file = not (options.get("file") or sys.stderr).isatty()
        if self._is_in_file:
            options |= {"delay": _SECONDS, "mininterval": _SECONDS, "maxinterval": _SECONDS}
            options["bar_format"] = "{desc}: {n_fmt}/{total_fmt} [{elapsed}<{remaining}]"
        super().__init__(iterable, leave=False, **options)
        self._is_first = iterable is None and not self.disable
        if self._is_first and self.n < (self.total or 0):
            self.set_postfix_str(
                "the first takes longer: loops are compiled once", not self._is_in_file
            )

    @staticmethod
    def status_printer(file: Any) -> Callable[[str], None]:
        """Return a function that writes a state over the last one, or on a line of its own in a file."""
        if file.isatty():
            printer: Callable[[str], None] = tqdm.status_printer(file)
            return printer

        def write_line(text: str) -> None:
            file.write(text + "\n")
            file.flush()

        return write_line

    @classmethod
    def write(cls, s: str, file: Any = None, end: str = "\n", nolock: bool = False) -> None:
        """Write a line above the bars of a terminal; in a file, the last line of a bar stays as it is."""
        stream = file or sys.stdout
        if stream.isatty():
            super().write(s, stream, end, nolock)
            return
        stream.write(s + end)
        stream.flush()

    def update(self, n: float | None = 1) -> bool | None:
        """Add n results; the clock of the estimate starts at the first."""
        if not self._is_first:
            return super().update(n)
        self._is_first = False
        self.n += n or 0
        self.last_print_n = self.n
        self.unpause()
        self.set_postfix_str("", not self._is_in_file)
        return True

    def moveto(self, n: int) -> None:
        """Move the cursor to the bar n lines below the first; the lines of a file have one order."""
        if not self._is_in_file:
            super().moveto(n)

    def close(self) -> None:
        """Take the bar away, or write the last line."""
        if self._is_in_file and not self.disable:
            self.display()
            self.sp = None  # nothing is left to clear
        super().close()
