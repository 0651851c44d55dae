"""Functions that Numba compiles when they are first called. Importing them does not import Numba.

A function that Python calls is cached on disk, with the compiled functions that it calls, so each machine compiles once
per version. Compiled code releases the global interpreter lock (GIL) and uses one thread; `igps._threads` sets how many
threads run side by side.
"""

import contextlib
import os
from collections.abc import Callable, Iterator
from functools import cache, update_wrapper
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Generic, ParamSpec, TypeVar

from filelock import FileLock

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# Values of `fastmath`
# Allows sums in any order, and thus vector instructions
REASSOCIATE = {
    "contract",
    "reassoc",
    "nsz",
}
# Allows fused multiply-add: a product and its sum are rounded once instead of twice
FUSE = {"contract"}
# Option of a function that makes arrays. The others count no references, which saves a sixth of the time to compile.
ALLOCATES = {"_nrt": True}


class Lazy:
    """Placeholder for a function that compiled code calls; `make` creates it when a caller is compiled."""

    def __init__(self, make: Callable[[], Callable[..., Any]]) -> None:
        self._make = make

    @property
    def dispatcher(self) -> Callable[..., Any]:
        """The Numba dispatcher; the same object for all threads."""
        made: dict[str, Callable[..., Any]] = vars(self)
        if "_dispatcher" not in made:
            made.setdefault("_dispatcher", self._make())
        return made["_dispatcher"]


class Compiled(Lazy, Generic[Arguments, Result]):
    """A function of arrays and numbers that is compiled when it is first called.

    The function may call other `Compiled` and `Lazy` functions of its module. These are compiled without a wrapper for
    Python, which saves a tenth of the time. Division by 0 gives the result of NumPy, without an error. The options are
    those of `numba.njit`. With `inline="always"`, the function is compiled as part of each caller, which saves time if
    it has only one caller.
    """

    def __init__(self, function: Callable[Arguments, Result], **options: Any) -> None:
        super().__init__(lambda: _compile(function, no_cpython_wrapper=True, **options))
        self._entry = Lazy(lambda: _compile(function, cache=True, **options))
        update_wrapper(self, function)

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        dispatcher: Any = self._entry.dispatcher
        if dispatcher.overloads:
            return dispatcher(*args, **kwargs)
        with _alone(dispatcher):
            try:
                return dispatcher(*args, **kwargs)
            except (AttributeError, ImportError):  # the cache names a class of an earlier version
                dispatcher._cache.flush()
                return dispatcher(*args, **kwargs)


def compiled(
    **options: Any,
) -> Callable[[Callable[Arguments, Result]], Compiled[Arguments, Result]]:
    """Return a decorator that makes a function `Compiled`, with options for `numba.njit`."""
    return lambda function: Compiled(function, **options)


def _compile(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Return the Numba dispatcher of a function, in whose globals dispatchers replace the `Lazy` objects."""
    assert isinstance(function, FunctionType)
    used = {name: function.__globals__.get(name) for name in function.__code__.co_names}
    dispatchers = {
        name: value.dispatcher for name, value in used.items() if isinstance(value, Lazy)
    }
    if dispatchers:
        names = {**function.__globals__, **dispatchers}
        function = FunctionType(function.__code__, names, function.__name__, function.__defaults__)
    defaults = {"nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy", "_nrt": False}
    return _numba().njit(**defaults | options)(function)


@contextlib.contextmanager
def _alone(dispatcher: Any) -> Iterator[None]:
    """Let other processes wait while this one calls a function for the first time.

    They then load what it compiled. Otherwise, each of several workers of a new installation would compile everything.
    """
    folder = Path(dispatcher.stats.cache_path)
    lock = FileLock(folder / f"{dispatcher.__name__}.lock")
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # such as a file system without locks: each compiles
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(lock)
        yield


@cache
def _numba() -> ModuleType:
    """Import Numba. A fork waits until no thread compiles, because a lock that is held stays locked in the child."""
    import numba
    from numba.core.compiler_lock import global_compiler_lock

    if hasattr(os, "register_at_fork"):
        os.register_at_fork(
            before=global_compiler_lock.acquire,
            after_in_parent=global_compiler_lock.release,
            after_in_child=global_compiler_lock.release,
        )
    return numba
