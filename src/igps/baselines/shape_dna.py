"""Shape-DNA: the first eigenvalues of the surface (Reuter, Wolter and Peinecke 2005)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from igps.baselines.system import Body
from igps.retrieval.distances import euclidean

Normalisation = Literal["area", "slope"]


@dataclass(frozen=True)
class ShapeDNA:
    """The first eigenvalues of the Laplace–Beltrami operator, made free of scale, without the zero.

    "area" multiplies them by the area of the surface. "slope" divides them by the slope c of the line λₖ = c·k that
    fits them best; for many eigenvalues that is Weyl's law, c = 4π / area.

    Source: Reuter, Wolter and Peinecke 2005 and 2006 (normalisations, Euclidean distance); 12 eigenvalues over the
    area as in Reuter's run at SHREC'11 (Lian et al. 2011).

    Args:
        n_eigenvalues: eigenvalues compared.
        normalisation: "area" or "slope".

    Raises:
        ValueError: a parameter out of range.
    """

    name: ClassVar[str] = "shape_dna"
    source: ClassVar[str] = "Reuter, Wolter and Peinecke 2005"
    invariant_to: ClassVar[tuple[str, ...]] = ("motion", "scale", "pose")

    n_eigenvalues: int = 12
    normalisation: Normalisation = "area"

    def __post_init__(self) -> None:
        if self.n_eigenvalues < 1:
            raise ValueError(f"n_eigenvalues: expected at least 1, got {self.n_eigenvalues}.")
        if self.normalisation not in get_args(Normalisation):
            raise ValueError(f"normalisation: expected one of {get_args(Normalisation)}, got {self.normalisation!r}.")

    def describe(self, body: Body) -> NDArray[np.float32]:
        """(n_eigenvalues,) normalised eigenvalues, ascending, without unit.

        Raises:
            ValueError: the signature has fewer eigenvalues.
        """
        eigenvalues = body.signature.eigenvalues[: self.n_eigenvalues]
        if len(eigenvalues) < self.n_eigenvalues:
            raise ValueError(
                f"n_eigenvalues: expected at most the {len(eigenvalues)} of the signature, got {self.n_eigenvalues}. "
                "Raise n_eigenpairs of the signatures, or compare fewer eigenvalues."
            )
        if self.normalisation == "area":
            return (eigenvalues * body.signature.area).astype(np.float32)
        k = np.arange(1, self.n_eigenvalues + 1)
        return (eigenvalues * (k @ k) / (k @ eigenvalues)).astype(np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) Euclidean distances."""
        return euclidean(queries, gallery)
