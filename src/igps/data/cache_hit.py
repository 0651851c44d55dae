"""The cache entry of a body."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from igps.data.keys import derived_key


@dataclass(frozen=True)
class CacheHit:
    """The cache entry of a body: the keys to read it by, and what the header of its file tells."""

    key: str  # of the Signature
    attributes: Mapping[str, str] = field(default_factory=dict)  # keys of added attributes, by name
    notes: tuple[str, ...] = ()  # on how the mesh was changed
    unit: str | None = None  # of length
    measures: Mapping[str, float] = field(default_factory=dict)  # plain numbers by name

    @property
    def whole_key(self) -> str:
        """Key of the Signature with its attributes."""
        if not self.attributes:
            return self.key
        return derived_key("with attributes", self.key, sorted(self.attributes.items()))

    def with_header(self, texts: Mapping[str, str]) -> "CacheHit":
        """Return the entry with notes and unit from the texts of the Signature's file."""
        return replace(
            self,
            notes=tuple(json.loads(texts["notes"])),
            unit=json.loads(texts["unit"]),
        )
