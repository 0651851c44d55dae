"""Attributes of samples from the residues of a molecule around them: charge, hydropathy, kinds, ...

All but the screened potential are means over the residues, weighted by a Gaussian of the distance. They are therefore
defined everywhere inside, and change little when atoms move.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from igps._arrays import Floats, Integers
from igps._parameters import check_one_of
from igps.data.attribute_sources import fill_missing
from igps.fields.molecules.bodies import molecule_of
from igps.fields.molecules.molecule import Molecule
from igps.fields.molecules.residues import ACCEPTORS, DONORS, HYDROPATHY, VOLUMES
from igps.fields.molecules.structures import is_structure
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef

RESIDUE_KINDS = (*sorted(VOLUMES), "A", "C", "G", "U", "other")
"""Amino acids, bases of nucleotides (U includes T), and all other residues."""

WIDTH = 4.0
"""Standard deviation of the Gaussian, Å."""

BJERRUM_LENGTH = 7.14
"""Distance at which two elementary charges in water have the energy kT, Å, at 25 °C."""

DEBYE_LENGTH = 7.85
"""Distance over which salt water screens a charge, Å, at 0.15 mol/l."""

# Residues between the ends of a direction of the chain and its middle. Neighbours alone would turn with each residue of
# a helix; so many give the direction of the helix or strand.
_REACH = 3
_SHORT_REACH = 2  # of the rise, which tells helices from strands

# Largest number of entries of a matrix of points by residues
_BLOCK_SIZE = 2**22


def screened_potential(molecule: Molecule, points: Floats) -> Floats:
    """Return the potential (P,) of all charges in salt water at points (P, 3), kT/e (Debye and Hückel 1923).

    It is the sum of l·q/d·exp(−d/D) over charges q at distances d, with l the Bjerrum length and D the Debye length.
    Inside the ball of an atom, d is the radius of the ball.
    """
    charged = np.nonzero(molecule.charges)[0]
    positions = molecule.positions[charged]
    radii = np.maximum(molecule.radii[charged], 1.0)
    strength = BJERRUM_LENGTH * molecule.charges[charged]
    potential = np.zeros(len(points))
    for block in _blocks(len(points), len(charged)):
        distance = np.maximum(cdist(points[block], positions), radii)
        potential[block] = (np.exp(-distance / DEBYE_LENGTH) / distance) @ strength
    return potential


def residue_means(molecule: Molecule, points: Floats, values: Floats) -> Floats:
    """Return means (P, D) of the residues' values (R, D) at points (P, 3), Å, weighted by a Gaussian of the distance.

    Unknown values (NaN) are left out; the mean is NaN if no value is known near a point.
    """
    is_known = np.isfinite(values)
    filled = np.where(is_known, values, 0)
    means = np.empty((len(points), values.shape[1]))
    for block in _blocks(len(points), len(values)):
        squares = cdist(points[block], molecule.residue_positions, "sqeuclidean")
        nearest = squares.min(axis=1, keepdims=True)
        # Relative to the weight of the nearest residue, so that not all weights vanish far outside.
        weights = np.exp((nearest - squares) / (2 * WIDTH**2))
        total = weights @ is_known.astype(float)
        total[total == 0] = np.nan
        means[block] = weights @ filled / total
    return means


def trace(molecule: Molecule, points: Floats) -> Floats:
    """Return the nearest residue of a polymer to points (P, 3): position, direction of the chain, rise, place (P, 8).

    Positions, Å, are relative to the mean of the residues, as attributes have single precision. Directions, of length
    1, point from the third residue before to the third after; 0 for one alone. The rise is the distance from the second
    residue before to the second after, Å for each residue. Both end where a gap begins.
    """
    is_linked = np.isfinite(molecule.places)
    if not is_linked.any():
        return np.full((len(points), 8), np.nan)
    positions = molecule.residue_positions[is_linked]
    places = molecule.places[is_linked]
    run = np.cumsum(np.diff(places, prepend=places[0]) != 1)
    directions = _advances(positions, run, _REACH)
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    directions /= np.maximum(lengths, 1e-9)
    rises = np.linalg.norm(_advances(positions, run, _SHORT_REACH), axis=1)
    rows = np.column_stack([positions - positions.mean(axis=0), directions, rises, places])
    _, nearest = cKDTree(positions).query(points)
    return rows[nearest]


def _advances(positions: Floats, run: Integers, reach: int) -> Floats:
    """Return how far the chain advances with each residue (R, 3), from so many before to so many after in its run."""
    order = np.arange(len(run))
    before = np.maximum(order - reach, np.searchsorted(run, run))
    after = np.minimum(order + reach, np.searchsorted(run, run, side="right") - 1)
    n_steps = np.maximum(after - before, 1)
    return (positions[after] - positions[before]) / n_steps[:, None]


def composition(molecule: Molecule, points: Floats) -> Floats:
    """Return the shares of `RESIDUE_KINDS` and the logarithm of the number of residues, the same at all points."""
    kinds = _kinds(molecule)
    row = np.append(kinds.mean(axis=0), np.log(len(kinds)))
    return np.tile(row, (len(points), 1))


def residue_attribute(molecule: Molecule, points: Floats, name: str) -> Floats:
    """Return a named attribute of points (P, 3), Å: (P,), or (P, C) of several numbers; a ValueError for others.

    "residue_shares" has 25 numbers, "composition" 26, "trace" 8.
    """
    if name in _AT_POINTS:
        return _AT_POINTS[name](molecule, points)
    if name not in _COLUMNS:
        raise ValueError(
            f"attributes: expected names among {', '.join(RESIDUE_ATTRIBUTES)}, got {name!r}."
        )
    means = residue_means(molecule, points, _COLUMNS[name](molecule))
    return means[:, 0] if means.shape[1] == 1 else means


def _by_name(table: Mapping[str, float], default: float = np.nan) -> Callable[[Molecule], Floats]:
    """Return a function for values (R, 1) by residue name: the default for amino acids not in the table, else NaN."""
    complete = {**dict.fromkeys(VOLUMES, default), **table}

    def column(molecule: Molecule) -> Floats:
        values = [complete.get(name, np.nan) for name in molecule.residue_names]
        return np.array(values, dtype=float)[:, None]

    return column


def _charges(molecule: Molecule) -> Floats:
    sums = np.bincount(molecule.residue_of, molecule.charges, len(molecule.residue_names))
    return sums[:, None].astype(np.float64)


def _kinds(molecule: Molecule) -> Floats:
    """Return the kind of each residue as a one-hot row (R, 25)."""
    index = {name: i for i, name in enumerate(RESIDUE_KINDS)}
    index |= {f"D{base}": index[base] for base in "ACG"}
    index |= dict.fromkeys(("DT", "T"), index["U"])
    kinds = [index.get(name, index["other"]) for name in molecule.residue_names]
    return np.eye(len(RESIDUE_KINDS))[kinds]


_COLUMNS: Mapping[str, Callable[[Molecule], Floats]] = {
    "charge": _charges,  # elementary charges
    "hydropathy": _by_name(HYDROPATHY),  # Kyte and Doolittle 1982
    "b_factor": lambda molecule: molecule.b_factors[:, None],  # Å², or pLDDT
    "donors": _by_name(DONORS, 0.0),  # numbers of hydrogen bond donors of the side chain
    "acceptors": _by_name(ACCEPTORS, 0.0),
    "residue_shares": _kinds,  # shares of `RESIDUE_KINDS`, which sum to 1
}

_AT_POINTS: Mapping[str, Callable[[Molecule, Floats], Floats]] = {
    "screened_potential": screened_potential,  # kT/e
    "trace": trace,
    "composition": composition,
}

RESIDUE_ATTRIBUTES: tuple[str, ...] = (*_COLUMNS, *_AT_POINTS)
"""Names of the attributes, see `residue_attribute`."""


def _blocks(n_points: int, n_others: int) -> list[slice]:
    step = max(_BLOCK_SIZE // max(n_others, 1), 1)
    return [slice(start, start + step) for start in range(0, n_points, step)]


@dataclass(frozen=True)
class ResidueAttribute:
    """An attribute of the residues of a molecule, one of `RESIDUE_ATTRIBUTES`."""

    name: str

    def __post_init__(self) -> None:
        check_one_of(RESIDUE_ATTRIBUTES, attribute=self.name)

    def cache_tag(self, body: BodyRef) -> str:
        """Return the name. The molecule is the body's own file, which is part of the key of its Signature."""
        return f"residues 5 {self.name}"

    def __call__(self, body: BodyRef, points: Floats) -> Floats:
        """Return values (P,) or (P, C) at points (P, 3), Å; raise a MeshError if the body has no such values."""
        if not is_structure(body.path):
            raise MeshError(
                f"{body}: expected a PDB, mmCIF, BinaryCIF or PQR file for {self.name!r}. Choose another descriptor."
            )
        values = residue_attribute(molecule_of(body), points, self.name)
        if np.isnan(values).all():
            raise MeshError(
                f"{body}: {self.name!r} is defined for none of its residues. Choose another descriptor."
            )
        return fill_missing(values, points, f"{body}: {self.name}")
