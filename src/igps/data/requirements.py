"""What a descriptor needs of a body."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from torch import nn

from igps.data.attributes import AttributeSource
from igps.data.batch import SignatureBatch
from igps.signature.attributes import AttributeName
from igps.signature.signature import SignatureConfig


@dataclass(frozen=True)
class Requirements:
    """What a descriptor needs of a body, beside its samples, area and volume."""

    n_eigenpairs: int = 0  # at least so many; with fewer it would be another descriptor
    attributes: tuple[AttributeName, ...] = ()  # of the samples, see `SignatureConfig`
    mesh: bool = False  # whether the surface itself
    whole_spectrum: bool = False  # whether all eigenpairs that there are: with more it would be another descriptor
    # Of further attributes of the samples, by name; those that a Dataset is given itself come first
    sources: Mapping[str, AttributeSource] = field(default_factory=dict, hash=False)

    def __or__(self, other: Requirements) -> Requirements:
        """What both need."""
        return Requirements(
            max(self.n_eigenpairs, other.n_eigenpairs),
            tuple(dict.fromkeys((*self.attributes, *other.attributes))),
            self.mesh or other.mesh,
            self.whole_spectrum or other.whole_spectrum,
            {**self.sources, **other.sources},
        )

    def apply_to(self, config: SignatureConfig) -> SignatureConfig:
        """The configuration with the attributes that are needed, and as many eigenpairs if it names no number.

        A descriptor of the whole spectrum gets the usual number, if that is enough; a ValueError of too few eigenpairs.
        """
        usual = SignatureConfig.DEFAULT_EIGENPAIRS if self.whole_spectrum else 0
        config = config.with_eigenpairs(max(usual, self.n_eigenpairs))
        self._check_eigenpairs(config.n_kept)
        return replace(config, attributes=tuple(dict.fromkeys((*config.attributes, *self.attributes))))

    def check_config(self, config: SignatureConfig) -> None:
        """Raise a ValueError that names what Signatures of this configuration lack, if they lack anything."""
        self._check_eigenpairs(config.n_kept)
        self._check_attributes((*config.attributes, *self.sources))

    def check(self, batch: SignatureBatch) -> None:
        """Raise a ValueError that names what the batch lacks, if it lacks anything."""
        if not batch.area.shape[0]:
            raise ValueError("batch: expected at least one shape, got none.")
        if self.n_eigenpairs and not torch.compiler.is_compiling():  # what is traced cannot look at numbers
            self._check_eigenpairs(int(torch.isfinite(batch.eigenvalues).sum(dim=1).min()))
        self._check_attributes({*batch.interior.attributes, *batch.surface.attributes})
        if self.mesh and batch.meshes is None:
            raise ValueError(
                "meshes: this descriptor needs the surfaces too. Make the batch by SignatureDataset.batch(..., "
                "meshes=True), or by collate(signatures, meshes)."
            )

    def _check_attributes(self, found: Collection[str]) -> None:
        if missing := [name for name in (*self.attributes, *self.sources) if name not in found]:
            raise ValueError(
                f"attributes: this descriptor needs signatures with {', '.join(missing)}, got {sorted(found)}. Compute "
                "them with SignatureDataset(..., descriptor=...), or with SignatureConfig(attributes=...)."
            )

    def _check_eigenpairs(self, found: int) -> None:
        if found < self.n_eigenpairs:
            raise ValueError(
                f"n_eigenpairs: this descriptor needs signatures of at least {self.n_eigenpairs}, got {found}. "
                "Raise SignatureConfig(n_eigenpairs=...), or choose another descriptor."
            )


def embedding_requirements(embedding: nn.Module) -> Requirements:
    """What an embedding needs: the eigenpairs that it says it uses, or all."""
    n_eigenpairs = getattr(embedding, "n_eigenpairs", None)
    return Requirements(n_eigenpairs) if isinstance(n_eigenpairs, int) else Requirements(whole_spectrum=True)


class Requiring(Protocol):
    """What a Dataset has to know of a descriptor."""

    @property
    def requirements(self) -> Requirements:
        """What it needs of a body."""


AnyDescriptor = str | Requiring | Requirements
"""A descriptor's name, itself, or its requirements."""

_by_name: list[Callable[[str], Requiring]] = []


def register_descriptors(by_name: Callable[[str], Requiring]) -> None:
    """Set how a descriptor is found by its name: this room may not import those above it, so the package tells it."""
    _by_name[:] = [by_name]


def requirements_of(descriptor: AnyDescriptor) -> Requirements:
    """What a descriptor needs of a body."""
    if isinstance(descriptor, Requirements):
        return descriptor
    return (_by_name[0](descriptor) if isinstance(descriptor, str) else descriptor).requirements
