"""Additional attributes of samples: values of an image or a field, or of a function of position."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igps._arrays import Floats
from igps.data._function_keys import function_key
from igps.mesh.loading import BodyRef
from igps.signature.attributes import AttributeName
from igps.signature.signature import SAMPLE_KINDS, SampleKind, Signature

PointFunction = Callable[..., NDArray[np.floating[Any]]]


@runtime_checkable
class AttributeSource(Protocol):
    """Picklable source of an attribute that is cached, such as the values of an image."""

    def cache_tag(self, body: BodyRef) -> str:
        """Return all that the values depend on besides the points, such as a checksum of the image."""

    def __call__(self, body: BodyRef, points: Floats) -> NDArray[np.floating[Any]]:
        """Return values (P,) or (P, C) at points (P, 3) in the coordinates of the body's file."""


@runtime_checkable
class FileSource(Protocol):
    """An attribute source that reads files, which may lie in the folder of the bodies."""

    def files(self, paths: Iterable[Path]) -> set[Path]:
        """Return the files that are read for the bodies in `paths`, without `paths` themselves."""


@dataclass(frozen=True)
class FunctionAttribute:
    """A function `(body, points)` as an attribute source.

    The cache key contains the function and the user's functions and classes that it uses. A ValueError is raised if
    they use variables that a key cannot hold, or if their source code is not available.
    """

    function: Callable[[BodyRef, Floats], NDArray[np.floating[Any]]]

    def __post_init__(self) -> None:
        self.cache_tag(None)

    def cache_tag(self, body: BodyRef | None) -> str:
        """Return a key of the function, and the body, whose path and part the function may use."""
        return f"function {function_key(self.function)} {body}"

    def __call__(self, body: BodyRef, points: Floats) -> NDArray[np.floating[Any]]:
        return self.function(body, points)


def _takes_body(function: Callable[..., Any]) -> bool:
    """Return whether a function has two required positional arguments, body and points."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return False
    positional = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    return sum(p.kind in positional and p.default is p.empty for p in parameters) == 2


def split_attributes(
    attributes: Mapping[str, AttributeSource | PointFunction],
) -> tuple[dict[str, AttributeSource], dict[str, PointFunction]]:
    """Split attributes into sources, whose values are cached, and functions of points, called at each access."""
    sources: dict[str, AttributeSource] = {}
    functions: dict[str, PointFunction] = {}
    for name, value in attributes.items():
        if not callable(value) or name in get_args(AttributeName):
            raise ValueError(
                f"attributes: expected functions or sources by names other than {', '.join(get_args(AttributeName))}, "
                f"got {name}={value!r}. These attributes of the library are set by SignatureConfig(attributes=...)."
            )
        if isinstance(value, AttributeSource):
            sources[name] = value
        elif _takes_body(value):
            sources[name] = FunctionAttribute(value)
        else:
            functions[name] = value
    return sources, functions


def with_attribute(
    signature: Signature, name: str, values: Mapping[SampleKind, ArrayLike]
) -> Signature:
    """Return a Signature with an additional attribute; raise a ValueError if a sample lacks a finite row of values."""
    try:
        interior, surface = (
            getattr(signature, kind).with_attributes({name: values[kind]}) for kind in SAMPLE_KINDS
        )
    except ValueError as error:
        raise ValueError(f"{signature.name}: attributes: {error}") from error
    return replace(signature, interior=interior, surface=surface)
