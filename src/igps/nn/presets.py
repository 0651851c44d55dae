"""Descriptors by name: what each is made of, what it needs of the signatures, and how its results are compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

from torch import Tensor, nn

from igps.geometry.attributes import AttributeName
from igps.geometry.signature import SignatureConfig
from igps.nn.descriptor import CombinedDescriptor, VolumetricDescriptor
from igps.retrieval import chi_square, cosine

HistogramName = Literal["interior", "gps", "multiscale", "rich"]
DescriptorName = Literal[HistogramName, "pretrained"]


@dataclass(frozen=True)
class Preset:
    """A descriptor with all that goes with it.

    Args:
        make: the module, `SignatureBatch` to (N, ...).
        distance: (Q, ...) and (G, ...) to (Q, G).
        attributes: that the interior samples must carry.
        n_eigenpairs: that the signatures must have at least.
    """

    make: Callable[[], nn.Module]
    distance: Callable[[Tensor, Tensor], Tensor] = chi_square
    attributes: tuple[AttributeName, ...] = ()
    n_eigenpairs: int = 1

    def completed(self, config: SignatureConfig) -> SignatureConfig:
        """The configuration with the attributes that the descriptor needs.

        Raises:
            ValueError: too few eigenpairs, with which the descriptor would be another one.
        """
        if config.n_eigenpairs < self.n_eigenpairs:
            raise ValueError(
                f"n_eigenpairs: this descriptor needs signatures of at least {self.n_eigenpairs}, "
                f"got {config.n_eigenpairs}. Raise it, or choose another descriptor."
            )
        return replace(config, attributes=tuple(dict.fromkeys((*config.attributes, *self.attributes))))


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
        "multiscale": Preset(CombinedDescriptor.multiscale, n_eigenpairs=250),
        "rich": Preset(CombinedDescriptor.rich, attributes=attributes, n_eigenpairs=50),
        "pretrained": Preset(VolumetricDescriptor.pretrained, cosine, attributes, n_eigenpairs=50),
    }
    if name not in presets:
        raise ValueError(f"descriptor: expected one of {', '.join(presets)}, got {name!r}.")
    return presets[name]
