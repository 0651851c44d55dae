"""Frames of a simulation as PQR files without hydrogens, which keep charges, residues and chains."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from igps._arrays import Floats
from igps._files import atomic_write
from igps._progress import Progress
from igps.fields.molecules._gemmi import gemmi_module
from igps.fields.molecules.residues import CHARGED_ATOMS, PHOSPHATES
from igps.mesh.errors import MeshError

if TYPE_CHECKING:
    from MDAnalysis import AtomGroup

_HEAVIEST = 92  # atomic number of the last element that is looked up
_MASS_ERROR = 0.3  # of an atom, in units of atomic mass; united atoms are heavier by 1 or more


def write_frames(
    topology: Path, frames: list[Path], folder: Path, select: str, step: int
) -> list[tuple[Path, int, float]]:
    """Write every so many frames of a trajectory as PQR files, with a progress bar.

    Charges are those of the topology, or else those of residues at pH 7; radii are van der Waals radii of the elements.

    Args:
        topology, frames: files that MDAnalysis reads, such as PSF and DCD, or PDB and XTC.
        folder: where to write.
        select: atoms, in MDAnalysis' language, such as "protein and not name H*".
        step: from one frame to the next.

    Returns:
        File, number and time (ps) of each frame.

    Raises:
        ImportError: MDAnalysis is not installed.
        MeshError: the files cannot be read, or no atom is selected.
    """
    try:
        import MDAnalysis
    except ImportError as error:
        raise ImportError(
            'Trajectories need MDAnalysis: pip install "interior-gps[molecules,trajectories]".'
        ) from error
    try:
        universe = MDAnalysis.Universe(str(topology), *map(str, frames))
        atoms = universe.select_atoms(select)
    except Exception as error:  # its readers raise whatever they like
        words = " ".join(str(error).split())[:300]
        raise MeshError(
            f"{topology}: not readable with {', '.join(map(str, frames))} and {select!r} ({words}). "
            "Check that both are of the same atoms."
        ) from error
    if not len(atoms):
        raise MeshError(
            f"{topology}: no atom is selected by {select!r}. Choose others by --select."
        )
    folder.mkdir(parents=True, exist_ok=True)
    starts, ends, atoms = _columns(atoms)
    written = []
    n_digits = len(str(len(universe.trajectory)))
    for frame in Progress(universe.trajectory[::step], desc="frames"):
        path = folder / f"frame_{frame.frame:0{n_digits}}.pqr"
        lines = [
            f"{start} {x:.3f} {y:.3f} {z:.3f} {end}\n"
            for start, (x, y, z), end in zip(starts, atoms.positions.tolist(), ends, strict=True)
        ]
        with atomic_write(path) as file:
            file.write("".join(lines).encode())
        written.append((path, int(frame.frame), float(frame.time)))
    return written


def _columns(atoms: AtomGroup) -> tuple[list[str], list[str], AtomGroup]:
    """Return what stands before and after the coordinates of each heavy atom in a PQR file, and the heavy atoms.

    A heavy atom has the charges of the hydrogens that are nearest to it.
    """
    elements = _elements(atoms)
    is_heavy = np.array([element.atomic_number != 1 for element in elements])
    all_charges = _charges(atoms)
    heavy = atoms[is_heavy]
    _, nearest = cKDTree(heavy.positions).query(atoms.positions)
    charges = np.bincount(nearest, all_charges, len(heavy))
    radii = [element.vdw_r for element in elements if element.atomic_number != 1]
    atoms = heavy
    chains = [str(name).replace(" ", "") for name in atoms.segids]
    starts = []
    columns = (atoms.names, atoms.resnames, chains, atoms.resids)
    for number, (name, residue, chain, place) in enumerate(zip(*columns, strict=True), 1):
        starts.append(f"ATOM {number} {name[:4]} {residue} {chain} {place}")
    ends = [f"{q:.4f} {r:.4f}" for q, r in zip(charges, radii, strict=True)]
    return starts, ends, atoms


def _elements(atoms: AtomGroup) -> list[Any]:
    """Return the element of each atom: of the topology, or else by its mass, or by the first letter of its name."""
    gemmi = gemmi_module()
    known = [gemmi.Element(number) for number in range(1, _HEAVIEST + 1)]
    weights = np.array([element.weight for element in known])
    masses = getattr(atoms, "masses", np.zeros(len(atoms)))
    told = getattr(atoms, "elements", [""] * len(atoms))
    elements = []
    for name, symbol, mass in zip(atoms.names, told, masses, strict=True):
        nearest = int(np.abs(weights - mass).argmin())
        if symbol:
            elements.append(gemmi.Element(symbol))
        elif abs(weights[nearest] - mass) < _MASS_ERROR:
            elements.append(known[nearest])
        else:
            elements.append(gemmi.Element(name.lstrip("0123456789")[:1]))
    return elements


def _charges(atoms: AtomGroup) -> Floats:
    """Return the charge of each atom: of the topology, or else those of residues at pH 7."""
    if hasattr(atoms, "charges"):
        return np.asarray(atoms.charges, dtype=np.float64)
    named = zip(atoms.resnames, atoms.names, strict=True)
    return np.array(
        [CHARGED_ATOMS.get(residue, PHOSPHATES).get(name, 0.0) for residue, name in named]
    )
