"""Attributes of samples that come from elsewhere: an image, a field, a function of position."""

import dis
import hashlib
import inspect
from collections.abc import Callable, Iterable, Mapping
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

    A ValueError where its source code is not known, or does not tell what it does.
    """

    function: Callable[[BodyRef, Floats], NDArray[np.floating[Any]]]

    def __post_init__(self) -> None:
        self.cache_tag(None)

    def cache_tag(self, body: BodyRef | None) -> str:
        """The function, and the body, whose name it is given."""
        name = getattr(self.function, "__qualname__", repr(self.function))
        remedy = "Give an object with this call and a method cache_tag(body), see igps.data.attributes.AttributeSource."
        kept = getattr(self.function, "__defaults__", None), getattr(self.function, "__kwdefaults__", None)
        used = [*(kept[0] or ()), *(kept[1] or {}).values(), *_constants(self.function)]
        is_told = all(one is None or isinstance(one, _Keyable) for one in used)
        if getattr(self.function, "__closure__", None) or inspect.ismethod(self.function) or not is_told:
            raise ValueError(f"attributes: {name} uses variables of what is around it, which no key tells. {remedy}")
        try:
            source = inspect.getsource(self.function)
        except (OSError, TypeError) as error:
            raise ValueError(f"attributes: the source code of {name} is not known ({error}). {remedy}") from error
        return f"function {name} {hashlib.sha256(source.encode()).hexdigest()} {used} {body}"

    def __call__(self, body: BodyRef, points: Floats) -> NDArray[np.floating[Any]]:
        """Its values."""
        return self.function(body, points)


def _constants(function: Callable[..., Any]) -> list[Any]:
    """The numbers, texts, arrays and the like that a function uses from its module."""
    if not inspect.isfunction(function):
        return []
    names = sorted({one.argval for one in dis.get_instructions(function) if one.opname == "LOAD_GLOBAL"})
    found = [function.__globals__[name] for name in names if name in function.__globals__]
    return [one for one in found if isinstance(one, _Keyable | list | tuple | dict | set | np.ndarray)]


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
