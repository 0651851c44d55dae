"""Loops that Numba compiles, where it is installed; whoever has one has another way for where it is not.

Compiled code is kept on disk by Numba, so that a process pays for compiling once per machine and version. It releases
the interpreter's lock and uses one thread: how many work side by side is for `igps.parallel` to say.
"""

from __future__ import annotations

import importlib.util
import os
import threading
from collections.abc import Callable
from functools import cache, update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

_compiling = threading.Lock()


@cache
def is_available() -> bool:
    """Whether loops can be compiled: Numba (the extra ``[fast]``) is installed, and NUMBA_DISABLE_JIT is not set."""
    disabled = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
    return not disabled and importlib.util.find_spec("numba") is not None


class Compiled(Generic[Arguments, Result]):
    """A function of arrays and numbers that is compiled when it is first called; importing it costs nothing.

    Args:
        function: what `numba.njit` can compile.
        **options: of `numba.njit`.
    """

    def __init__(self, function: Callable[Arguments, Result], **options: Any) -> None:
        update_wrapper(self, function)
        self._function = function
        self._options = options
        self._compiled: Callable[..., Any] | None = None

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        return self.dispatcher(*args, **kwargs)

    @property
    def dispatcher(self) -> Callable[..., Any]:
        """What Numba makes of the function; other compiled functions may call this one.

        Raises:
            ImportError: Numba is not installed.
        """
        if self._compiled is None:
            with _compiling:
                if self._compiled is None:
                    import numba

                    self._compiled = numba.njit(cache=True, nogil=True, **self._options)(self._function)
        return self._compiled


def compiled(**options: Any) -> Callable[[Callable[Arguments, Result]], Compiled[Arguments, Result]]:
    """A decorator that makes a `Compiled` of a function."""

    def decorate(function: Callable[Arguments, Result]) -> Compiled[Arguments, Result]:
        return Compiled(function, **options)

    return decorate
