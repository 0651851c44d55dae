"""Requirements of descriptors."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from torch import nn

from igps.data.added_attributes import AttributeSource
from igps.data.batch import SignatureBatch
from igps.signature.attributes import AttributeName
from igps.signature.signature import SAMPLE_KINDS, SampleKind, SignatureConfig


@dataclass(frozen=True)
class Requirements:
    """Requirements of a descriptor for a body, besides samples, area and volume."""

    n_eigenpairs: int = 0  # minimum number; fewer would give another descriptor
    attributes: tuple[AttributeName, ...] = ()  # of the samples, see `SignatureConfig`
    mesh: bool = False  # whether the mesh is needed
    eigenpairs: bool = True  # whether any are needed, and not plain numbers or samples alone
    samples: tuple[SampleKind, ...] = SAMPLE_KINDS  # kinds of samples that are read
    measures: bool = False  # whether plain numbers are needed, see `igps.measures`
    # Whether all eigenpairs are used, so that more would give another descriptor
    whole_spectrum: bool = False
    # Sources of additional attributes by name, which the `attributes` of a SignatureDataset override
    sources: Mapping[str, AttributeSource] = field(default_factory=dict, hash=False)

    def __or__(self, other: Requirements) -> Requirements:
        """Return requirements that meet those of both."""
        return Requirements(
            n_eigenpairs=max(self.n_eigenpairs, other.n_eigenpairs),
            attributes=tuple(dict.fromkeys((*self.attributes, *other.attributes))),
            mesh=self.mesh or other.mesh,
            eigenpairs=self.eigenpairs or other.eigenpairs,
            samples=tuple(k for k in SAMPLE_KINDS if k in (*self.samples, *other.samples)),
            measures=self.measures or other.measures,
            whole_spectrum=self.whole_spectrum or other.whole_spectrum,
            sources={**self.sources, **other.sources},
        )

    def apply_to(self, config: SignatureConfig) -> SignatureConfig:
        """Return the configuration with the required attributes and plain numbers.

        If it has no number of eigenpairs, it gets the required one, for a whole spectrum at least the default. A
        ValueError is raised if the configuration has fewer.
        """
        default = SignatureConfig.DEFAULT_EIGENPAIRS if self.whole_spectrum else 0
        if config.n_eigenpairs is None and not self.eigenpairs:
            config = replace(config, n_eigenpairs=0)
        config = config.with_eigenpairs(max(default, self.n_eigenpairs))
        self._check_eigenpairs(config.n_kept)
        attributes = dict.fromkeys((*config.attributes, *self.attributes))
        measures = config.measures or self.measures
        return replace(config, attributes=tuple(attributes), measures=measures)

    def check_config(self, config: SignatureConfig) -> None:
        """Raise a ValueError if Signatures of a configuration do not meet the requirements."""
        self._check_eigenpairs(config.n_kept)
        self._check_attributes((*config.attributes, *self.sources))

    def check(self, batch: SignatureBatch) -> None:
        """Raise a ValueError if a batch does not meet the requirements."""
        if not batch.area.shape[0]:
            raise ValueError("batch: expected at least one shape, got none.")
        for kind in self.samples:
            if getattr(batch, kind).mask.shape[1] == 0:
                raise ValueError(
                    f"batch: expected {kind} samples, got none: its dataset was made for a descriptor that does not "
                    "read them. Give SignatureDataset(descriptor=...) this one, or igps.collate([item.signature])."
                )
        # Neither in tracing nor on the device "meta" are there values to read
        has_values = not torch.compiler.is_compiling() and batch.device.type != "meta"
        if self.n_eigenpairs and has_values:
            n_present = torch.isfinite(batch.eigenvalues).sum(dim=1)
            self._check_eigenpairs(int(n_present.min()))
        self._check_attributes({*batch.interior.attributes, *batch.surface.attributes})
        if self.mesh and batch.meshes is None:
            raise ValueError(
                "meshes: this descriptor needs the surfaces too. Make the batch by SignatureDataset.batch(..., "
                "meshes=True), or by collate(signatures, meshes)."
            )

    def _check_attributes(self, names: Collection[str]) -> None:
        missing = [name for name in (*self.attributes, *self.sources) if name not in names]
        if missing:
            raise ValueError(
                f"attributes: this descriptor needs signatures with {', '.join(missing)}, got {sorted(names)}. Compute "
                "them with SignatureDataset(..., descriptor=...), or with SignatureConfig(attributes=...)."
            )

    def _check_eigenpairs(self, n: int) -> None:
        if n < self.n_eigenpairs:
            raise ValueError(
                f"n_eigenpairs: this descriptor needs signatures of at least {self.n_eigenpairs}, got {n}. "
                "Raise SignatureConfig(n_eigenpairs=...), or choose another descriptor."
            )


SURFACE_DIRECTION = Requirements(attributes=("surface_direction",))
"""That each sample has its direction to the surface, or out of it."""


def embedding_requirements(embedding: nn.Module) -> Requirements:
    """Return the requirements of an embedding: its `n_eigenpairs`, or the whole spectrum if it has none."""
    n_eigenpairs = getattr(embedding, "n_eigenpairs", None)
    if isinstance(n_eigenpairs, int):
        return Requirements(n_eigenpairs)
    return Requirements(whole_spectrum=True)


class HasRequirements(Protocol):
    """The part of a descriptor that a Dataset uses."""

    @property
    def requirements(self) -> Requirements:
        """Requirements of the descriptor."""


AnyDescriptor = HasRequirements | Requirements
"""A descriptor, or its requirements."""


def requirements_of(descriptor: AnyDescriptor) -> Requirements:
    """Return the requirements of a descriptor; raise a TypeError for a name."""
    if isinstance(descriptor, str):
        raise TypeError(
            f"descriptor: expected a descriptor, got its name. Give igps.descriptor({descriptor!r})."
        )
    return descriptor if isinstance(descriptor, Requirements) else descriptor.requirements
