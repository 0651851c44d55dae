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
}
"""Charges of amino acid atoms at pH 7, in elementary charges; a tenth of all histidines is charged (pKa 6)."""

PHOSPHATES = {"OP1": -0.5, "OP2": -0.5, "O1P": -0.5, "O2P": -0.5}
"""Charges of nucleotide atoms, in elementary charges."""

DONORS = {"ARG": 3, "ASN": 1, "GLN": 1, "HIS": 1, "LYS": 1, "SER": 1, "THR": 1, "TRP": 1, "TYR": 1}
"""Number of side-chain atoms that donate hydrogen bonds; 0 for other amino acids."""

ACCEPTORS = {"ASN": 1, "ASP": 2, "GLN": 1, "GLU": 2, "HIS": 1, "SER": 1, "THR": 1, "TYR": 1}
"""Number of side-chain atoms that accept hydrogen bonds; 0 for other amino acids."""

AROMATIC = frozenset({"HIS", "PHE", "TRP", "TYR"})
"""Residues with an aromatic ring."""

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

_MEAN_VOLUME = sum(VOLUMES.values()) / len(VOLUMES)


def residue_ball(name: str) -> float:
    """Return the radius, Å, of a ball with the volume of a residue, or with the mean volume for an unknown residue."""
    return math.cbrt(3 * VOLUMES.get(name, _MEAN_VOLUME) / (4 * math.pi))


def side_chain_ball(name: str) -> float:
    """Return the radius, Å, of a ball with the volume of a residue minus that of glycine."""
    return math.cbrt(3 * (VOLUMES.get(name, _MEAN_VOLUME) - VOLUMES["GLY"]) / (4 * math.pi))
