"""What the residues of a molecule around a point are like: charge, hydropathy, kinds, ..., as attributes of samples.

Each is a mean over the residues by a Gaussian of their distance, so that it is known everywhere inside, and changes
little when atoms do.
"""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial.distance import cdist

from igps._arrays import Floats
from igps.mesh.formats.molecules import Molecule
from igps.mesh.residues import ACCEPTORS, AROMATIC, DONORS, HYDROPATHY, VOLUMES

RESIDUE_KINDS = (*sorted(VOLUMES), "A", "C", "G", "U", "other")
"""Amino acids, the bases of nucleotides (U is T, too), and all else."""

WIDTH = 4.0
"""Standard deviation of the Gaussian, Å."""

BJERRUM_LENGTH = 7.14
"""Distance at which two elementary charges in water have the energy kT, Å, at 25 °C."""

DEBYE_LENGTH = 7.85
"""Distance over which salt water screens a charge, Å, at 0.15 mol/l."""

# Numbers of a block of points by residues.
_BLOCK = 2**22


def screened_potential(molecule: Molecule, points: Floats) -> Floats:
    """(P,) potential at points (P, 3) of all charges in salt water, kT/e (Debye and Hückel 1923).

    The sum of l·q/d·exp(−d/D) over the charges q at distances d, with l the Bjerrum length and D the Debye length. In
    its own ball a charge counts as on the ball's surface.
    """
    charged = np.nonzero(molecule.charges)[0]
    at, radii = molecule.positions[charged], np.maximum(molecule.radii[charged], 1.0)
    strength = BJERRUM_LENGTH * molecule.charges[charged]
    potential = np.zeros(len(points))
    for block in _blocks(len(points), len(charged)):
        distance = np.maximum(cdist(points[block], at), radii)
        potential[block] = (np.exp(-distance / DEBYE_LENGTH) / distance) @ strength
    return potential


def residue_means(molecule: Molecule, points: Floats, values: Floats) -> Floats:
    """(P, D) means of the residues' values (R, D) at points (P, 3), Å, by a Gaussian of the distance.

    A value that is not known, NaN, does not count; the mean is NaN where none is known near a point.
    """
    known = np.isfinite(values)
    filled = np.where(known, values, 0)
    means = np.empty((len(points), values.shape[1]))
    for block in _blocks(len(points), len(values)):
        squares = cdist(points[block], molecule.residue_positions, "sqeuclidean")
        # Relative to the nearest, so that far outside it counts alone, rather than nothing.
        weights = np.exp((squares.min(axis=1, keepdims=True) - squares) / (2 * WIDTH**2))
        total = weights @ known.astype(float)
        means[block] = np.where(total > 0, weights @ filled / np.where(total > 0, total, 1), np.nan)
    return means


def residue_attribute(molecule: Molecule, points: Floats, name: str) -> Floats:
    """A named attribute of points (P, 3), Å: (P,), of "residue_shares" (P, 25); a ValueError of an unknown name."""
    if name == "screened_potential":
        return screened_potential(molecule, points)
    if name not in _COLUMNS:
        raise ValueError(f"attributes: expected some of {', '.join(RESIDUE_ATTRIBUTES)}, got {name!r}.")
    means = residue_means(molecule, points, _COLUMNS[name](molecule))
    return means[:, 0] if means.shape[1] == 1 else means


def _by_name(table: Mapping[str, float], default: float = np.nan) -> Callable[[Molecule], Floats]:
    """Values (R, 1) of the residues by their names; those of amino acids that the table does not name are `default`."""

    def column(molecule: Molecule) -> Floats:
        values = [table.get(name, default if name in VOLUMES else np.nan) for name in molecule.residue_names]
        return np.array(values, dtype=float)[:, None]

    return column


def _charges(molecule: Molecule) -> Floats:
    sums = np.bincount(molecule.residue_of, molecule.charges, len(molecule.residue_names))
    return sums[:, None].astype(np.float64)


def _kinds(molecule: Molecule) -> Floats:
    """(R, 25), 1 for the kind of each residue."""
    number = {name: i for i, name in enumerate(RESIDUE_KINDS)}
    number |= {f"D{base}": number[base] for base in "ACG"} | {"DT": number["U"], "T": number["U"]}
    return np.eye(len(RESIDUE_KINDS))[[number.get(name, number["other"]) for name in molecule.residue_names]]


_COLUMNS: Mapping[str, Callable[[Molecule], Floats]] = {
    "charge": _charges,  # elementary charges
    "hydropathy": _by_name(HYDROPATHY),  # Kyte and Doolittle 1982
    "b_factor": lambda molecule: molecule.b_factors[:, None],  # Å², or pLDDT
    "donors": _by_name(DONORS, 0.0),  # of hydrogen bonds in side chains
    "acceptors": _by_name(ACCEPTORS, 0.0),
    "aromaticity": _by_name(dict.fromkeys(AROMATIC, 1.0), 0.0),  # share of amino acids with a ring
    "residue_volume": _by_name(VOLUMES),  # Å³, Zamyatnin 1972
    "residue_shares": _kinds,  # of `RESIDUE_KINDS`, of sum 1
}

RESIDUE_ATTRIBUTES: tuple[str, ...] = (*_COLUMNS, "screened_potential")
"""Names of the attributes, see `residue_attribute`."""


def _blocks(n_points: int, n_others: int) -> list[slice]:
    step = max(_BLOCK // max(n_others, 1), 1)
    return [slice(start, start + step) for start in range(0, n_points, step)]
