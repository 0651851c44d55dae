"""Loops that Numba compiles when they are first called: importing them imports no compiler.

Numba keeps what Python calls on disk, with all that it calls itself, so that a process pays for compiling once per
machine and version. Compiled code releases the interpreter's lock and uses one thread; `igps._threads` decides how many
run side by side.
"""

import gc
import os
from collections.abc import Callable
from functools import cache, update_wrapper
from types import FunctionType, ModuleType
from typing import Any, Generic, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# For `fastmath`: sums may be taken in any order, so of several terms at once
SUMS = {"contract", "reassoc", "nsz"}
# A product and its sum may be rounded once, not twice
CONTRACTED = {"contract"}


class Lazy:
    """Something that compiled functions may call by its name; it needs Numba only when one of them is compiled."""

    def __init__(self, make: Callable[[], Callable[..., Any]]) -> None:
        self._make = make

    @property
    def dispatcher(self) -> Callable[..., Any]:
        """What Numba knows it as; the same object for all threads."""
        found = self.__dict__.get("_made")
        return self.__dict__.setdefault("_made", self._make()) if found is None else found


class Compiled(Lazy, Generic[Arguments, Result]):
    """A function of arrays and numbers that is compiled when it is first called.

    It may call other such functions, and `Lazy` ones, of its module: in a form that Python cannot call, which takes a
    tenth less time to compile. The options are those of `numba.njit`. With `inline="always"` it becomes a part of what
    calls it, which takes less time to compile where that is one place: LLVM works on a function anew in each caller.
    Division by 0 gives what NumPy gives, without an error.
    """

    def __init__(self, function: Callable[Arguments, Result], **options: Any) -> None:
        super().__init__(lambda: _compile(function, no_cpython_wrapper=True, **options))
        self._entry = Lazy(lambda: _compile(function, cache=True, **options))
        update_wrapper(self, function)

    def __call__(self, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        dispatcher: Any = self._entry.dispatcher
        try:
            return dispatcher(*args, **kwargs)
        except AttributeError:  # what an earlier version has left on disk names a class that is gone; loops raise none
            dispatcher._cache.flush()
            return dispatcher(*args, **kwargs)


def compiled(**options: Any) -> Callable[[Callable[Arguments, Result]], Compiled[Arguments, Result]]:
    """A decorator that makes a `Compiled` of a function; the options are those of `numba.njit`."""
    return lambda function: Compiled(function, **options)


def _compile(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """The function as Numba compiles it, and so what it calls: Numba looks names up in the globals of a function."""
    assert isinstance(function, FunctionType)
    names = {name: function.__globals__.get(name) for name in function.__code__.co_names}
    called = {name: value.dispatcher for name, value in names.items() if isinstance(value, Lazy)}
    if called:
        defaults, linked = function.__defaults__, {**function.__globals__, **called}
        function = FunctionType(function.__code__, linked, function.__name__, defaults)
    return _numba().njit(nogil=True, no_cfunc_wrapper=True, error_model="numpy", **options)(function)


@cache
def _numba() -> ModuleType:
    """Numba. A fork waits until no thread compiles, as a child would inherit the compiler's lock, closed."""
    import numba
    from numba.core import event
    from numba.core.compiler_lock import global_compiler_lock as lock

    outer: list[bool] = []  # whether garbage was collected before each function that is being compiled

    class Uncollected(event.Listener):
        """Compiling makes so many objects that to look for garbage among them takes a tenth of the time."""

        def on_start(self, event: object) -> None:
            outer.append(gc.isenabled())
            gc.disable()

        def on_end(self, event: object) -> None:
            if outer.pop():
                gc.enable()

    event.register("numba:compile", Uncollected())
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=lock.acquire, after_in_parent=lock.release, after_in_child=lock.release)
    return numba
