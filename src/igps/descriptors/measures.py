"""The plain numbers of a body as a descriptor."""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from igps.data.batch import SignatureBatch
from igps.data.requirements import Requirements
from igps.mesh.mesh import millimetres
from igps.nn.descriptor import Descriptor
from igps.retrieval import euclidean
from igps.signature.measures import POWERS

COLUMNS = {
    "area": 0.06,
    "major_axis_length": 0.33,
    "minor_axis_length": 0.29,
    "least_axis_length": 0.40,
    "largest_diameter": 0.25,
    "mean_thickness": 0.31,
    "greatest_thickness": 0.34,
    "total_curvature": 0.43,
    "extent": 0.54,
    "convexity": 0.46,
    "n_pieces": 0.70,
    "euler_number": 0.53,
    "volume": 0.18,
}
"""The measures that are compared, and the spread of each column among generated bodies. Others follow from these."""

_MIN_SPREAD = 1e-3  # smaller ones are those of discretisation
_SIGNED = ("total_curvature", "euler_number")


class Measures(Descriptor):
    """Logarithms of plain numbers, see `igps.measures`, each over its spread; compared by the Euclidean distance.

    The spread of each column is its standard deviation in a collection, see `igps.nn.fit_centres`, and among generated
    bodies before it is fitted.

    A measure with a unit enters as the logarithm of a length: √area, ∛volume. Without size, lengths are over ∛volume.
    Total curvature and the Euler number, which may be negative, enter as asinh(x); all others as log(x).

    Args:
        size: whether size is compared: lengths are then in millimetres if the unit is known.
    """

    source = "Zwanenburg et al. 2020 (IBSI); Hildebrand and Rüegsegger 1997"
    requirements = Requirements(eigenpairs=False, samples=(), measures=True)
    spread: Tensor
    fitted: Tensor

    def __init__(self, *, size: bool = False) -> None:
        super().__init__()
        self.size = size
        self.name = "measures+size" if size else "measures"
        self.invariant_to = ("motion",) if size else ("motion", "scale")
        self.columns = tuple(COLUMNS) if size else tuple(COLUMNS)[:-1]
        spread = [COLUMNS[name] for name in self.columns]
        self.register_buffer("spread", torch.tensor(spread, dtype=torch.float64))
        self.register_buffer("fitted", torch.tensor(False))

    def describe(self, batch: SignatureBatch) -> Tensor:
        """(N, D) logarithms over their spread; a ValueError if the bodies have no measures."""
        if batch.measures is None:
            raise ValueError(
                "measures: expected bodies with plain numbers, got Signatures without them. Give "
                "SignatureDataset(descriptor=...) this descriptor, or SignatureConfig(measures=True)."
            )
        units = batch.units or (None,) * len(batch)
        return (self.logarithms(batch.measures, units) / self.spread).float()

    def logarithms(self, rows: Tensor, units: Sequence[str | None]) -> Tensor:
        """Return the columns (N, D) of measures (N, M) in the order of `POWERS`, of bodies with these units."""
        names = list(POWERS)
        factors = rows[:, names.index("volume")].pow(-1 / 3)
        if self.size:
            factors = factors.new_tensor([millimetres(unit) for unit in units])
        columns = []
        for name in self.columns:
            values = rows[:, names.index(name)] * factors ** POWERS[name]
            columns.append(_logarithm(name, values))
        return torch.stack(columns, dim=1)

    def fit_collection(
        self, measures: Sequence[Mapping[str, float]], units: Sequence[str | None]
    ) -> bool:
        """Set the spread of each column to that of N bodies, unless it was set before; return whether it was set now.

        A column that is the same in all bodies keeps its spread.
        """
        if bool(self.fitted) or len(measures) < 2 or not all(measures):
            return False
        rows = [[row.get(name, math.nan) for name in POWERS] for row in measures]
        columns = self.logarithms(torch.tensor(rows, dtype=torch.float64), units)
        spread = columns.std(dim=0)
        self.spread.copy_(torch.where(spread > _MIN_SPREAD, spread, self.spread))
        self.fitted.fill_(True)
        return True

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        """(Q, G) Euclidean distances."""
        return euclidean(queries, gallery)

    def column_names(self, width: int) -> list[str]:
        """Return the names of the measures, after `log`."""
        return [f"log.{name}" for name in self.columns]

    def with_size(self) -> "Measures":
        """Return the descriptor that compares size, too."""
        return Measures(size=True)


def _logarithm(name: str, values: Tensor) -> Tensor:
    if name in _SIGNED:
        return torch.asinh(values)
    return values.log() / max(POWERS[name], 1)
