"""Attributes of samples that come from elsewhere: an image, a field, a function of position."""

import dis
import hashlib
import inspect
import logging
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igps._arrays import Floats
from igps.mesh.loading import BodyRef
from igps.signature.attributes import AttributeName
from igps.signature.signature import SAMPLE_KINDS, SampleKind, Signature

# Values that a key of the cache can hold
_Keyable = bool | int | float | str | PurePath

PointFunction = Callable[..., NDArray[np.floating[Any]]]


@runtime_checkable
class AttributeSource(Protocol):
    """What gives the samples of a body an attribute that is kept in the cache, such as an image; picklable."""

    def cache_tag(self, body: BodyRef) -> str:
        """All that the values depend on beside the points, such as a checksum of the image."""

    def __call__(self, body: BodyRef, points: Floats) -> NDArray[np.floating[Any]]:
        """Values (P,) or (P, C) at points (P, 3) in the coordinates of the body's file."""


@runtime_checkable
class FromFiles(Protocol):
    """A source that reads files, which may lie among those of bodies."""

    def files(self, paths: Iterable[Path]) -> set[Path]:
        """The files that it reads for the bodies in these files, without the latter."""


@dataclass(frozen=True)
class FunctionAttribute:
    """A function `(body, points)` as a source; name, code, defaults and constants stand for it in keys of the cache.

    With it stand the functions and classes that it uses, but for those of libraries, which are taken not to change.

    A ValueError where its source code is not known, or does not tell what it does.
    """

    function: Callable[[BodyRef, Floats], NDArray[np.floating[Any]]]

    def __post_init__(self) -> None:
        self.cache_tag(None)

    def cache_tag(self, body: BodyRef | None) -> str:
        """The function with all of its own that it calls, and the body, whose name it is given."""
        return f"function {' '.join(map(_told, [self.function, *_helpers(self.function)]))} {body}"

    def __call__(self, body: BodyRef, points: Floats) -> NDArray[np.floating[Any]]:
        """Its values."""
        return self.function(body, points)


def _told(function: Callable[..., Any]) -> str:
    """Name, source code, defaults and constants of a function or class; a ValueError if they do not tell all."""
    name = getattr(function, "__qualname__", repr(function))
    remedy = "Give an object with this call and a method cache_tag(body), see igps.data.attributes.AttributeSource."
    kept = getattr(function, "__defaults__", None), getattr(function, "__kwdefaults__", None)
    used = [*(kept[0] or ()), *(kept[1] or {}).values(), *_used(function)[0]]
    is_told = all(one is None or isinstance(one, _Keyable) for one in used)
    if getattr(function, "__closure__", None) or inspect.ismethod(function) or not is_told:
        raise ValueError(f"attributes: {name} uses variables of what is around it, which no key tells. {remedy}")
    try:
        source = inspect.getsource(function)
    except (OSError, TypeError) as error:
        raise ValueError(f"attributes: the source code of {name} is not known ({error}). {remedy}") from error
    if name.endswith("<lambda>"):  # its source is that of one line, in which others may stand, and which it may leave
        source += str([(step.opname, step.argrepr) for step in _steps(function) if not inspect.iscode(step.argval)])
    return f"{name} {hashlib.sha256(source.encode()).hexdigest()} {used}"


def _helpers(function: Callable[..., Any]) -> list[Callable[..., Any]]:
    """The functions and classes, of no library, that a function uses, and those that they use."""
    found, waiting = list[Callable[..., Any]](), _used(function)[1]
    for one in waiting:  # which grows
        if one is not function and one not in found:
            found.append(one)
            waiting += _used(one)[1]
    return found


def _used(given: Callable[..., Any]) -> tuple[list[Any], list[Callable[..., Any]]]:
    """What a function, or a class and its methods, use of their modules: values; functions and classes of no library.

    What these modules import of other modules of the user is among them.
    """
    constants, helpers, functions = list[Any](), list[Any](), [given]
    if inspect.isclass(given):
        helpers += [one for one in given.__mro__[1:] if _is_own(one.__module__)]
        functions = [getattr(one, "__func__", getattr(one, "fget", one)) for one in vars(given).values()]
    for function in filter(inspect.isfunction, functions):
        steps = list(_steps(function))
        names = sorted({step.argval for step in steps if step.opname == "LOAD_GLOBAL"})
        found = [function.__globals__[name] for name in names if name in function.__globals__]
        inside = sorted({step.argval for step in steps if step.opname in ("LOAD_ATTR", "LOAD_METHOD")})
        for module in [one for one in found if inspect.ismodule(one) and _is_own(one.__name__)]:
            found += [getattr(module, name) for name in inside if hasattr(module, name)]
        for one in found:
            if not hasattr(one, "__name__"):  # as modules, functions and classes have, compiled or not
                constants += [] if one is None or isinstance(one, logging.Logger) else [one]
                continue
            code = one if inspect.isfunction(one) else inspect.unwrap(one)
            if (inspect.isfunction(code) or inspect.isclass(code)) and _is_own(code.__module__):
                helpers.append(code)
    return constants, helpers


def _steps(function: Callable[..., Any]) -> Iterator[dis.Instruction]:
    """The code of a function, and of what is defined in it, such as comprehensions."""
    codes = [function.__code__]
    for code in codes:  # which grow
        codes += filter(inspect.iscode, code.co_consts)
        yield from dis.get_instructions(code)


def _is_own(module: str) -> bool:
    """Whether a module is of the user: its code may change from run to run, that of libraries only with a version."""
    package = module.partition(".")[0]
    if package == "igps" or package in sys.stdlib_module_names:
        return False
    file = getattr(sys.modules.get(module), "__file__", None)
    return file is None or not any(Path(file).is_relative_to(sysconfig.get_path(one)) for one in ("purelib", "platlib"))


def _takes_body(function: Callable[..., Any]) -> bool:
    """Whether a function has to be given two things, a body and points."""
    try:
        given = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return False
    by_place = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    return sum(one.kind in by_place and one.default is one.empty for one in given) == 2


def split_attributes(
    given: Mapping[str, AttributeSource | PointFunction],
) -> tuple[dict[str, AttributeSource], dict[str, PointFunction]]:
    """Attributes that are kept in the cache, and functions of points, which are called at each reading."""
    sources: dict[str, AttributeSource] = {}
    functions: dict[str, PointFunction] = {}
    for name, one in given.items():
        if not callable(one) or name in get_args(AttributeName):  # it would take the place of the library's own
            own = f"the library's, {', '.join(get_args(AttributeName))}, are named in SignatureConfig(attributes=...)"
            raise ValueError(f"attributes: expected functions or sources by other names, got {name}={one!r}: {own}.")
        if isinstance(one, AttributeSource):
            sources[name] = one
        elif _takes_body(one):
            sources[name] = FunctionAttribute(one)
        else:
            functions[name] = one
    return sources, functions


def with_attribute(signature: Signature, name: str, values: Mapping[SampleKind, ArrayLike]) -> Signature:
    """The Signature with an attribute of its samples, by kind; a ValueError without one finite row for each."""
    try:
        interior, surface = (getattr(signature, kind).with_attributes({name: values[kind]}) for kind in SAMPLE_KINDS)
    except ValueError as error:
        raise ValueError(f"{signature.name}: attributes: {error}") from error
    return replace(signature, interior=interior, surface=surface)
