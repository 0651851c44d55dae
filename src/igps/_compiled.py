"""Loops that Numba compiles, where it is installed; whoever has one has another way for where it is not.

Compiled code is kept on disk by Numba, so that a process pays for compiling once per machine and version. It releases
the interpreter's lock and uses one thread: how many work side by side is for `igps._threads` to say.
"""

from __future__ import annotations

import importlib.util
import os
import threading
from collections.abc import Callable
from functools import cache, update_wrapper
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# For `fastmath`: sums may be taken in any order, so of several terms at once
SUMS = {"contract", "reassoc", "nsz"}

_compiling = threading.RLock()  # one that compiles what it calls


@cache
def is_available() -> bool:
    """Whether loops can be compiled: Numba (the extra ``[fast]``) is installed, and NUMBA_DISABLE_JIT is not set."""
    disabled = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
    return not disabled and importlib.util.find_spec("numba") is not None


@cache
def beats_blas() -> bool:
    """Whether compiled loops are faster than PyTorch's BLAS at products of a few long rows with many.

    On AMD's processors they take down to half of its time, on Intel's with AVX-512, for which MKL is made, up to twice.
    """
    if not is_available():
        return False
    import torch
    from llvmlite import binding

    wide = torch.backends.mkl.is_available() and binding.get_host_cpu_features().get("avx512f", False)
    return not wide or binding.get_host_cpu_name().startswith("znver")


class Compiled(Generic[Arguments, Result]):
    """A function of arrays and numbers that is compiled when it is first called; importing it costs nothing.

    Args:
        function: what `numba.njit` can compile; it may call other such functions of its module by their names.
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
    def plain(self) -> Callable[Arguments, Result]:
        """The function as it is written, which runs anywhere, slowly."""
        return self._function

    @property
    def dispatcher(self) -> Callable[..., Any]:
        """What Numba makes of the function, and of those that it calls.

        Raises:
            ImportError: Numba is not installed.
        """
        if self._compiled is None:
            with _compiling:
                if self._compiled is None:
                    import numba

                    self._compiled = numba.njit(cache=True, nogil=True, **self._options)(self._linked())
        return self._compiled

    def _linked(self) -> Callable[..., Any]:
        """The function, in whose globals the compiled functions that it calls are what Numba makes of them."""
        function = self._function
        if not isinstance(function, FunctionType):
            return function
        known = {name: function.__globals__.get(name) for name in function.__code__.co_names}
        called = {name: value.dispatcher for name, value in known.items() if isinstance(value, Compiled)}
        if not called:
            return function
        return FunctionType(
            function.__code__, {**function.__globals__, **called}, function.__name__, function.__defaults__
        )


def compiled(**options: Any) -> Callable[[Callable[Arguments, Result]], Compiled[Arguments, Result]]:
    """A decorator that makes a `Compiled` of a function."""

    def decorate(function: Callable[Arguments, Result]) -> Compiled[Arguments, Result]:
        return Compiled(function, **options)

    return decorate
