"""Attributes of samples that come from elsewhere: an image, a field, a function of position."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igps.mesh.loading import BodyRef
from igps.signature.signature import Signature

ROOMS = ("interior", "surface")


@runtime_checkable
class AttributeSource(Protocol):
    """What gives the samples of a body an attribute that is kept in the cache, such as an image; picklable."""

    def cache_tag(self, body: BodyRef) -> str:
        """All that the values depend on beside the points, such as a checksum of the image."""

    def __call__(self, body: BodyRef, points: NDArray[np.float64]) -> NDArray[np.floating[Any]]:
        """Values (P,) or (P, C) at points (P, 3) in the coordinates of the body's file."""


def with_attribute(signature: Signature, name: str, values: Mapping[str, ArrayLike]) -> Signature:
    """The Signature with an attribute of its samples, by room.

    Raises:
        ValueError: not one finite row for each sample.
    """
    try:
        interior, surface = (getattr(signature, room).with_attributes({name: values[room]}) for room in ROOMS)
    except ValueError as error:
        raise ValueError(f"{signature.name}: attributes: {error}") from error
    return replace(signature, interior=interior, surface=surface)
