"""Properties of the residues of proteins and nucleic acids, by residue name."""

import math

VOLUMES = {
    "ALA": 88.6,
    "ARG": 173.4,
    "ASN": 114.1,
    "ASP": 111.1,
    "CYS": 108.5,
    "GLN": 143.8,
    "GLU": 138.4,
    "GLY": 60.1,
    "HIS": 153.2,
    "ILE": 166.7,
    "LEU": 166.7,
    "LYS": 168.6,
    "MET": 162.9,
    "PHE": 189.9,
    "PRO": 112.7,
    "SER": 89.0,
    "THR": 116.1,
    "TRP": 227.8,
    "TYR": 193.6,
    "VAL": 140.0,
}
"""Volumes of amino acid residues in proteins, Å³ (Zamyatnin 1972)."""

HYDROPATHY = {
    "ALA": 1.8,
    "ARG": -4.5,
    "ASN": -3.5,
    "ASP": -3.5,
    "CYS": 2.5,
    "GLN": -3.5,
    "GLU": -3.5,
    "GLY": -0.4,
    "HIS": -3.2,
    "ILE": 4.5,
    "LEU": 3.8,
    "LYS": -3.9,
    "MET": 1.9,
    "PHE": 2.8,
    "PRO": -1.6,
    "SER": -0.8,
    "THR": -0.7,
    "TRP": -0.9,
    "TYR": -1.3,
    "VAL": 4.2,
}
"""Hydropathy index, from -4.5 (hydrophilic) to 4.5 (hydrophobic) (Kyte and Doolittle 1982)."""

CHARGED_ATOMS: dict[str, dict[str, float]] = {
    "ASP": {"OD1": -0.5, "OD2": -0.5},
    "GLU": {"OE1": -0.5, "OE2": -0.5},
    "LYS": {"NZ": 1.0},
    "ARG": {"NH1": 0.5, "NH2": 0.5},
    "HIS": {"ND1": 0.05, "NE2": 0.05},
    "HIP": {"ND1": 0.5, "NE2": 0.5},
    "HSP": {"ND1": 0.5, "NE2": 0.5},
    "CYM": {"SG": -1.0},
    **{name: {} for name in ("ASH", "GLH", "HID", "HIE", "HSD", "HSE", "LYN")},
}
"""Charges of amino acid atoms at pH 7, in elementary charges, by the name of the residue in the file.

Names of Amber and CHARMM tell the state of protonation. HIS does not: its pKa is 6 to 7, so a tenth of a charge stands
for all of these residues together, of which about one in ten is charged.
"""

PHOSPHATES = {"OP1": -0.5, "OP2": -0.5, "O1P": -0.5, "O2P": -0.5}
"""Charges of nucleotide atoms, in elementary charges."""

DONORS = {"ARG": 3, "ASN": 1, "GLN": 1, "HIS": 1, "LYS": 1, "SER": 1, "THR": 1, "TRP": 1, "TYR": 1}
"""Number of side-chain atoms that donate hydrogen bonds; 0 for other amino acids."""

ACCEPTORS = {"ASN": 1, "ASP": 2, "GLN": 1, "GLU": 2, "HIS": 1, "SER": 1, "THR": 1, "TYR": 1}
"""Number of side-chain atoms that accept hydrogen bonds; 0 for other amino acids."""

STANDARD = {
    "ASH": "ASP",
    "CYM": "CYS",
    "CYX": "CYS",
    "GLH": "GLU",
    "HID": "HIS",
    "HIE": "HIS",
    "HIP": "HIS",
    "HSD": "HIS",
    "HSE": "HIS",
    "HSP": "HIS",
    "LYN": "LYS",
}
"""Standard names of residues that simulations name by their state of protonation."""

WATER = frozenset({"SOL", "SPC", "T3P", "T4P", "TIP", "TIP3", "TIP4", "TP3", "TP4", "TP5"})
"""Names of water in simulations, in addition to those of the Protein Data Bank."""

BACKBONE = frozenset(
    {"N", "CA", "C", "O", "OXT", "OT1", "OT2", "H", "HA", "HA2", "HA3", "H1", "H2", "H3"}
)
"""Names of backbone atoms, including those at the ends of chains."""

SIDE_CHAIN_ATOMS = {
    "ALA": 1,
    "ARG": 7,
    "ASN": 4,
    "ASP": 4,
    "CYS": 2,
    "GLN": 5,
    "GLU": 5,
    "GLY": 0,
    "HIS": 6,
    "ILE": 4,
    "LEU": 4,
    "LYS": 5,
    "MET": 4,
    "PHE": 7,
    "PRO": 3,
    "SER": 2,
    "THR": 3,
    "TRP": 10,
    "TYR": 8,
    "VAL": 3,
}
"""Number of atoms of side chains, without hydrogens."""

# No probe fits between the backbone and the ball of a whole side chain. With balls of the full volume, 18 chains cut to
# their backbones enclosed 5.7 ± 2.2 % more than whole; cut to Cβ, 1.4 ± 2.3 %.
_BARE_SHARE = 0.89

_MEAN_VOLUME = sum(VOLUMES.values()) / len(VOLUMES)


def residue_ball(name: str) -> float:
    """Return the radius, Å, of a ball with the volume of a residue, or with the mean volume for an unknown residue."""
    return math.cbrt(3 * VOLUMES.get(name, _MEAN_VOLUME) / (4 * math.pi))


def missing_share(name: str, n_atoms: int) -> float:
    """Return the share of a side chain that is missing if it has `n_atoms` atoms, hydrogens aside.

    The side chain of a residue that is not in `SIDE_CHAIN_ATOMS` is complete with any atom.
    """
    n_complete = SIDE_CHAIN_ATOMS.get(name, min(n_atoms, 1) or 1)
    return max(n_complete - n_atoms, 0) / max(n_complete, 1)


def side_chain_ball(name: str, share: float = 1.0) -> float:
    """Return the radius, Å, of a ball for a share of the volume of a residue minus that of glycine."""
    volume = share * (VOLUMES.get(name, _MEAN_VOLUME) - VOLUMES["GLY"])
    if share == 1:
        volume *= _BARE_SHARE
    return math.cbrt(3 * volume / (4 * math.pi))
