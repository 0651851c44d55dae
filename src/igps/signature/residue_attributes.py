"""What the residues of a molecule around a point are like: charge, hydropathy, kinds, ..., as attributes of samples.

Each is a mean over the residues by a Gaussian of their distance, so that it is known everywhere inside, and changes
little when atoms do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from igps.mesh.formats.molecules import Molecule
from igps.mesh.residues import ACCEPTORS, AROMATIC, DONORS, HYDROPATHY, VOLUMES
from igps.signature.signature import Samples, Signature

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


def charge(molecule: Molecule, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) mean charge of the residues around points (P, 3), elementary charges."""
    return _mean("charge", molecule, points)


def hydropathy(molecule: Molecule, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) mean hydropathy of the amino acids around points (P, 3) (Kyte and Doolittle 1982)."""
    return _mean("hydropathy", molecule, points)


def b_factor(molecule: Molecule, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) mean B-factor, Å², or pLDDT of the residues around points (P, 3)."""
    return _mean("b_factor", molecule, points)


def donors(molecule: Molecule, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) mean number of hydrogen-bond donors in the side chains around points (P, 3)."""
    return _mean("donors", molecule, points)


def acceptors(molecule: Molecule, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) mean number of hydrogen-bond acceptors in the side chains around points (P, 3)."""
    return _mean("acceptors", molecule, points)


def aromaticity(molecule: Molecule, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) share of amino acids with an aromatic ring around points (P, 3)."""
    return _mean("aromaticity", molecule, points)


def residue_volume(molecule: Molecule, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) mean volume of the amino acids around points (P, 3), Å³ (Zamyatnin 1972)."""
    return _mean("residue_volume", molecule, points)


def residue_shares(molecule: Molecule, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, 25) shares of `RESIDUE_KINDS` in the residues around points (P, 3); rows of sum 1."""
    return residue_means(molecule, points, _kinds(molecule))


def screened_potential(molecule: Molecule, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P,) potential at points (P, 3) of all charges in salt water, kT/e (Debye and Hückel 1923).

    The sum of l·q/d·exp(−d/D) over the charges q at distances d, with l the Bjerrum length and D the Debye length. In
    its own ball a charge counts as on the ball's surface.
    """
    charged = np.nonzero(molecule.charges)[0]
    at, radii = molecule.positions[charged], np.maximum(molecule.radii[charged], 1.0)
    strength = BJERRUM_LENGTH * molecule.charges[charged]
    potential = np.zeros(len(points))
    for block in _blocks(len(points), len(charged)):
        distance = np.maximum(np.sqrt(_squared_distances(points[block], at)), radii)
        potential[block] = (np.exp(-distance / DEBYE_LENGTH) / distance) @ strength
    return potential


def residue_means(
    molecule: Molecule, points: NDArray[np.float64], values: NDArray[np.float64], width: float = WIDTH
) -> NDArray[np.float64]:
    """Means of the residues' values at points, by a Gaussian of the distance.

    Args:
        molecule: R residues.
        points: (P, 3), Å.
        values: (R, D); NaN where a residue's is not known, which then does not count.
        width: standard deviation of the Gaussian, Å.

    Returns:
        (P, D); NaN where none is known near a point.
    """
    known = np.isfinite(values)
    filled = np.where(known, values, 0)
    means = np.empty((len(points), values.shape[1]))
    for block in _blocks(len(points), len(values)):
        squares = _squared_distances(points[block], molecule.residue_positions)
        # Relative to the nearest, so that far outside it counts alone, rather than nothing.
        weights = np.exp((squares.min(axis=1, keepdims=True) - squares) / (2 * width**2))
        total = weights @ known.astype(float)
        means[block] = np.where(total > 0, weights @ filled / np.where(total > 0, total, 1), np.nan)
    return means


def residue_attributes(
    molecule: Molecule, points: NDArray[np.float64], names: Sequence[str]
) -> Mapping[str, NDArray[np.float32]]:
    """Named attributes of points, each (P,) or (P, 25), see `RESIDUE_ATTRIBUTES`; several cost hardly more than one.

    Raises:
        ValueError: an unknown name.
    """
    if unknown := [name for name in names if name not in RESIDUE_ATTRIBUTES]:
        raise ValueError(f"attributes: expected some of {', '.join(RESIDUE_ATTRIBUTES)}, got {unknown[0]!r}.")
    of_residues = {name: _COLUMNS[name](molecule) for name in names if name in _COLUMNS}
    found = {}
    if of_residues:
        means = residue_means(molecule, points, np.concatenate(list(of_residues.values()), axis=1))
        ends = np.cumsum([column.shape[1] for column in of_residues.values()])
        parts = np.split(means, ends[:-1], axis=1)
        found = dict(zip(of_residues, (part[:, 0] if part.shape[1] == 1 else part for part in parts), strict=True))
    if "screened_potential" in names:
        found["screened_potential"] = screened_potential(molecule, points)
    return {name: found[name].astype(np.float32) for name in names}


def with_residue_attributes(signature: Signature, molecule: Molecule, names: Sequence[str]) -> Signature:
    """A Signature of the molecule's surface whose samples have the named attributes, too."""

    def added(samples: Samples) -> Samples:
        new = residue_attributes(molecule, samples.points, names)
        return replace(samples, attributes={**samples.attributes, **new})

    return replace(signature, interior=added(signature.interior), surface=added(signature.surface))


def _by_name(table: Mapping[str, float], default: float = np.nan) -> Callable[[Molecule], NDArray[np.float64]]:
    """Values (R, 1) of the residues by their names; those of amino acids that the table does not name are `default`."""

    def column(molecule: Molecule) -> NDArray[np.float64]:
        return np.array(
            [[table.get(name, default if name in VOLUMES else np.nan)] for name in molecule.residue_names], dtype=float
        ).reshape(-1, 1)

    return column


def _charges(molecule: Molecule) -> NDArray[np.float64]:
    sums = np.bincount(molecule.residue_of, molecule.charges, len(molecule.residue_names))
    return sums[:, None].astype(np.float64)


def _kinds(molecule: Molecule) -> NDArray[np.float64]:
    """(R, 25), 1 for the kind of each residue."""
    number = {name: i for i, name in enumerate(RESIDUE_KINDS)}
    number |= {f"D{base}": number[base] for base in "ACG"} | {"DT": number["U"], "T": number["U"]}
    return np.eye(len(RESIDUE_KINDS))[[number.get(name, number["other"]) for name in molecule.residue_names]]


_COLUMNS: Mapping[str, Callable[[Molecule], NDArray[np.float64]]] = {
    "charge": _charges,
    "hydropathy": _by_name(HYDROPATHY),
    "b_factor": lambda molecule: molecule.b_factors[:, None],
    "donors": _by_name(DONORS, 0.0),
    "acceptors": _by_name(ACCEPTORS, 0.0),
    "aromaticity": _by_name(dict.fromkeys(AROMATIC, 1.0), 0.0),
    "residue_volume": _by_name(VOLUMES),
    "residue_shares": _kinds,
}

RESIDUE_ATTRIBUTES: tuple[str, ...] = (*_COLUMNS, "screened_potential")
"""Names of the attributes; each is a function of this module, of a molecule and points."""


def _mean(name: str, molecule: Molecule, points: NDArray[np.float64]) -> NDArray[np.float64]:
    return residue_means(molecule, points, _COLUMNS[name](molecule))[:, 0]


def _blocks(n_points: int, n_others: int) -> list[slice]:
    step = max(_BLOCK // max(n_others, 1), 1)
    return [slice(start, start + step) for start in range(0, n_points, step)]


def _squared_distances(points: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, R), by columns: no array of three dimensions."""
    squares = np.zeros((len(points), len(others)))
    for axis in range(3):
        squares += np.square(points[:, axis, None] - others[:, axis])
    return squares
