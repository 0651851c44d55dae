"""What every system of the comparison answers: how it describes a shape, and how far two descriptions are apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from igps.geometry.mesh import Mesh
from igps.geometry.signature import Signature


@dataclass(frozen=True, eq=False)
class Body:
    """A shape as the systems see it.

    Args:
        signature: with its eigenpairs and samples, from the cache.
        read: reads the mesh, for systems that need more than the signature.
    """

    signature: Signature
    read: Callable[[], Mesh]

    @cached_property
    def mesh(self) -> Mesh:
        """The mesh, read on first use."""
        return self.read()


class System(Protocol):
    """A retrieval system: its parameters are its fields, its methods are pure, and it can be pickled.

    Args:
        name: by which it is asked for and listed.
        source: author, year.
        invariant_to: which of "motion" (rotation, translation, reflection), "scale" and "pose" (isometric bending)
            leave its descriptions as they are, but for discretisation.
    """

    @property
    def name(self) -> str: ...

    @property
    def source(self) -> str: ...

    @property
    def invariant_to(self) -> tuple[str, ...]: ...

    def describe(self, body: Body) -> NDArray[np.float32]:
        """A fixed-size array of finite numbers; raises ValueError for a body that the system cannot describe."""
        ...

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, ...) and (G, ...) descriptions to (Q, G) non-negative distances."""
        ...
