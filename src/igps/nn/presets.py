"""Descriptors by name: what each is made of, what it needs of the signatures, and how its results are compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

from torch import Tensor, nn

from igps.geometry.attributes import AttributeName
from igps.nn.descriptor import CombinedDescriptor, VolumetricDescriptor
from igps.retrieval import chi_square, cosine

DescriptorName = Literal["interior", "gps", "multiscale", "rich", "pretrained"]


@dataclass(frozen=True)
class Preset:
    """A descriptor with all that goes with it.

    Args:
        make: the module, `SignatureBatch` to (N, ...).
        distance: (Q, ...) and (G, ...) to (Q, G).
        attributes: that the interior samples must carry.
    """

    make: Callable[[], nn.Module]
    distance: Callable[[Tensor, Tensor], Tensor] = chi_square
    attributes: tuple[AttributeName, ...] = ()


def preset(name: DescriptorName) -> Preset:
    """The descriptor of a name.

    "interior" and "gps" are `VolumetricDescriptor.paper` on interior and surface samples, "multiscale" and "rich" those
    of `CombinedDescriptor`, "pretrained" is `VolumetricDescriptor.pretrained`.

    Raises:
        ValueError: unknown name.
    """
    attributes = get_args(AttributeName)
    presets = {
        "interior": Preset(VolumetricDescriptor.paper),
        "gps": Preset(lambda: VolumetricDescriptor.paper("surface")),
        "multiscale": Preset(CombinedDescriptor.multiscale),
        "rich": Preset(CombinedDescriptor.rich, attributes=attributes),
        "pretrained": Preset(VolumetricDescriptor.pretrained, cosine, attributes),
    }
    if name not in presets:
        raise ValueError(f"descriptor: expected one of {', '.join(presets)}, got {name!r}.")
    return presets[name]
