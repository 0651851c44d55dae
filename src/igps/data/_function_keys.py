"""Cache keys of functions that users write.

A key holds the name, the source code, and the default and global values of the function, and the same of the user's own
functions and classes that it uses, directly or through others. Functions of libraries are left out, as their code
changes only with the version of the library.
"""

import dis
import hashlib
import inspect
import logging
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePath
from types import FunctionType
from typing import Any

_PLAIN_TYPES = (
    bool,
    int,
    float,
    str,
    PurePath,
)  # keys can hold their values, which all processes represent equally
_REMEDY = "Pass a callable object with a method cache_tag(body), see igps.data.attributes.AttributeSource."


def function_key(function: Callable[..., Any]) -> str:
    """Return a key of a function; raise a ValueError if it uses values or code that a key cannot hold."""
    used = [function]
    for item in used:  # the list grows during the loop
        used += [
            helper for helper in dict.fromkeys(_global_references(item)[1]) if helper not in used
        ]
    return " ".join(map(_key_without_helpers, used))


def _key_without_helpers(item: Callable[..., Any]) -> str:
    name = getattr(item, "__qualname__", repr(item))
    defaults = getattr(item, "__defaults__", None) or ()
    keyword_defaults = getattr(item, "__kwdefaults__", None) or {}
    values = [*defaults, *keyword_defaults.values(), *_global_references(item)[0]]
    is_plain = all(value is None or isinstance(value, _PLAIN_TYPES) for value in values)
    if getattr(item, "__closure__", None) or inspect.ismethod(item) or not is_plain:
        raise ValueError(
            f"attributes: {name} uses variables that a cache key cannot hold. {_REMEDY}"
        )
    try:
        source = inspect.getsource(item)
    except (OSError, TypeError) as error:
        raise ValueError(
            f"attributes: the source code of {name} is not available ({error}). {_REMEDY}"
        ) from error
    if name.endswith("<lambda>"):  # its line may hold other lambdas, or end before the lambda does
        source += str(
            [
                (step.opname, step.argrepr)
                for step in _instructions(item)
                if not inspect.iscode(step.argval)
            ]
        )
    return f"{name} {hashlib.sha256(source.encode()).hexdigest()} {values}"


def _global_references(item: Callable[..., Any]) -> tuple[list[Any], list[Callable[..., Any]]]:
    """Return the constants, and the user's functions and classes, that the code of a function or class refers to."""
    constants, helpers = list[Any](), list[Callable[..., Any]]()
    if inspect.isclass(item):
        helpers += [base for base in item.__mro__[1:] if _is_own(base.__module__)]
    for value in (value for function in _functions(item) for value in _global_values(function)):
        if hasattr(value, "__name__"):  # modules, functions and classes, compiled or not
            helper = value if inspect.isfunction(value) else inspect.unwrap(value)
            if (inspect.isfunction(helper) or inspect.isclass(helper)) and _is_own(
                helper.__module__
            ):
                helpers.append(helper)
        elif value is not None and not isinstance(value, logging.Logger):
            constants.append(value)
    return constants, helpers


def _functions(item: Callable[..., Any]) -> Iterable[FunctionType]:
    """Return a function itself, or the methods and getters of a class."""
    members = vars(item).values() if inspect.isclass(item) else [item]
    functions = [getattr(member, "__func__", getattr(member, "fget", member)) for member in members]
    return filter(inspect.isfunction, functions)


def _global_values(function: FunctionType) -> list[Any]:
    """Return the values of the global names in a function, and of `MODULE.NAME` for the user's modules."""
    steps = list(_instructions(function))
    names = sorted({step.argval for step in steps if step.opname == "LOAD_GLOBAL"})
    attributes = sorted(
        {step.argval for step in steps if step.opname in ("LOAD_ATTR", "LOAD_METHOD")}
    )
    values = [function.__globals__[name] for name in names if name in function.__globals__]
    modules = [value for value in values if inspect.ismodule(value) and _is_own(value.__name__)]
    return values + [
        getattr(module, name) for module in modules for name in attributes if hasattr(module, name)
    ]


def _instructions(function: Callable[..., Any]) -> Iterator[dis.Instruction]:
    """Yield the byte code instructions of a function, and of the functions and comprehensions inside it."""
    codes = [function.__code__]
    for code in codes:  # the list grows during the loop
        codes += filter(inspect.iscode, code.co_consts)
        yield from dis.get_instructions(code)


def _is_own(module: str) -> bool:
    """Return whether a module belongs to the user, not to an installed package or the standard library."""
    package = module.partition(".")[0]
    if package == "igps" or package in sys.stdlib_module_names:
        return False
    file = getattr(sys.modules.get(module), "__file__", None)
    return file is None or not any(
        Path(file).is_relative_to(sysconfig.get_path(key)) for key in ("purelib", "platlib")
    )
