"""Additional attributes of samples: values of an image or a field, or of a function of position."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igps._arrays import Floats
from igps.mesh.loading import BodyRef
from igps.signature.attributes import AttributeName
from igps.signature.signature import SAMPLE_KINDS, SampleKind, Signature

Values = NDArray[np.floating[Any]]
PointFunction = Callable[[BodyRef, Floats], Values]
"""A function of a body and points (P, 3), in coordinates of its file, to values (P,) or (P, C)."""


@runtime_checkable
class AttributeSource(Protocol):
    """Picklable source of an attribute that is cached, such as the values of an image."""

    def cache_tag(self, body: BodyRef) -> str:
        """Return all that the values depend on besides the points, such as a checksum of the image."""

    def __call__(self, body: BodyRef, points: Floats) -> Values:
        """Return values (P,) or (P, C) at points (P, 3) in the coordinates of the body's file."""


@runtime_checkable
class FileSource(Protocol):
    """An attribute source that reads files, which may lie in the folder of the bodies."""

    def files(self, paths: Iterable[Path]) -> set[Path]:
        """Return the files that are read for the bodies in `paths`, without `paths` themselves."""


@dataclass(frozen=True)
class FunctionAttribute:
    """A function as an attribute source, with a text that identifies the function."""

    function: PointFunction
    tag: str

    def cache_tag(self, body: BodyRef) -> str:
        """Return the text, and the body, whose path and part the function may use."""
        return f"function {self.tag} {body}"

    def __call__(self, body: BodyRef, points: Floats) -> Values:
        return self.function(body, points)


def split_attributes(
    attributes: Mapping[str, AttributeSource | PointFunction],
) -> tuple[dict[str, AttributeSource], dict[str, PointFunction]]:
    """Split attributes into sources, whose values are cached, and functions, which are called at each access.

    A function is a source if its attribute `cache_tag` holds a text.
    """
    sources: dict[str, AttributeSource] = {}
    functions: dict[str, PointFunction] = {}
    for name, value in attributes.items():
        if not callable(value) or name in get_args(AttributeName):
            raise ValueError(
                f"attributes: expected functions or sources by names other than "
                f"{', '.join(get_args(AttributeName))}, got {name}={value!r}. These attributes of the "
                "library are set by SignatureConfig(attributes=...)."
            )
        tag = getattr(value, "cache_tag", None)
        given: Any = value
        if callable(tag):
            sources[name] = given
            continue
        if tag is None:
            functions[name] = given
        elif isinstance(tag, str) and tag:
            sources[name] = FunctionAttribute(given, tag)
        else:
            raise ValueError(
                f"attributes: expected a text, or a method, as cache_tag of {name}, got {tag!r}. "
                "Change it whenever the function gives other values."
            )
    return sources, functions


def with_attribute(
    signature: Signature, name: str, values: Mapping[SampleKind, ArrayLike]
) -> Signature:
    """Return a Signature with an additional attribute; raise a ValueError if a sample lacks a finite row of values."""
    changed = {}
    try:
        for kind in SAMPLE_KINDS:
            changed[kind] = getattr(signature, kind).with_attributes({name: values[kind]})
    except ValueError as error:
        raise ValueError(f"{signature.name}: attributes: {error}") from error
    return replace(signature, **changed)
