"""Structure files become molecules: small files written here, and what strangers' files hold."""

from __future__ import annotations

import gzip
import logging
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal

from commands import run
from igps.fields.molecules.bodies import molecule_of
from igps.fields.molecules.molecular_surface import molecular_surface
from igps.fields.molecules.residues import VOLUMES
from igps.fields.molecules.structures import is_structure, read_molecule
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef, each_body, list_bodies, load_mesh
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions

pytest.importorskip("gemmi")

COMPLETED = "{} residues were completed: balls stand for missing atoms of side chains"
ALANINE = [
    ("N", 0.0, 0.0),
    ("CA", 1.46, 0.0),
    ("C", 2.0, 1.4),
    ("O", 1.3, 2.4),
    ("CB", 2.0, -0.8),
]

SULFUR = [
    ("CG", 2.5, -1.5),
    ("CE", 3.5, -3.5),
    ("SD", 3.0, -2.0),
]


@dataclass(frozen=True)
class Atom:
    """An atom of a PDB file."""

    number: int
    name: str
    x: float
    y: float
    z: float
    residue: str = "ALA"
    chain: str = "A"
    place: str = "   1 "
    record: str = "ATOM"
    alternative: str = " "
    occupancy: float = 1.0
    b: float = 20.0
    element: str | None = None

    def line(self):
        element = self.name[0] if self.element is None else self.element
        return (
            f"{self.record:<6}{self.number:>5} {self.name:^4}{self.alternative}{self.residue:>3} "
            f"{self.chain}{self.place:>5}   {self.x:8.3f}{self.y:8.3f}{self.z:8.3f}"
            f"{self.occupancy:6.2f}{self.b:6.2f}          {element:>2}\n"
        )


def residue(number, name="ALA", atoms=ALANINE, **said):
    place = said.pop("place", f"{number:>4} ")
    return "".join(
        Atom(i, atom, x, y, 3.8 * number, residue=name, place=place, **said).line()
        for i, (atom, x, y) in enumerate(atoms, start=1)
    )


def written(folder, text, name="made.pdb"):
    path = folder / name
    path.write_text(text)
    return path


def backbone(atoms=4):
    return ALANINE[:atoms]


def test_atoms_have_the_radii_of_their_elements(tmp_path):
    text = residue(1) + residue(2, "MET", [*ALANINE, *SULFUR])
    (molecule,) = read_molecule(written(tmp_path, text))
    # Bondi 1964
    assert_allclose(molecule.radii[:5], [1.55, 1.70, 1.70, 1.52, 1.70], atol=1e-6)
    assert molecule.radii[-1] == pytest.approx(1.80)
    assert molecule.residue_names == ("ALA", "MET")
    assert molecule.residue_of.tolist() == [0] * 5 + [1] * 8
    assert_allclose(molecule.residue_positions, [[1.46, 0, 3.8], [1.46, 0, 7.6]])
    assert molecule.notes == ()


def test_pdb_and_mmcif_and_their_gzipped_files_are_one_molecule(tmp_path):
    import gemmi

    text = residue(1) + residue(2, "LYS") + "END\n"
    plain = written(tmp_path, text)
    structure = gemmi.read_structure(str(plain))
    structure.setup_entities()
    cif = written(tmp_path, structure.make_mmcif_document().as_string(), "made.cif")
    paths = [plain, cif]
    for path in (plain, cif):
        paths.append(path.with_name(path.name + ".gz"))
        paths[-1].write_bytes(gzip.compress(path.read_bytes()))
    one, *others = (read_molecule(path)[0] for path in paths)
    for path in paths:
        assert is_structure(path)
    for other in others:
        assert_allclose(other.positions, one.positions)
        assert_array_equal(other.radii, one.radii)
        assert_array_equal(other.charges, one.charges)
        assert other.residue_names == one.residue_names


def test_each_block_of_mmcif_with_atoms_gives_its_bodies(tmp_path):
    """As PyMOL writes several objects into one file; the first alone was read. Blocks of ligands have no atoms."""
    import gemmi

    blocks = []
    for name, n_residues in (("one", 1), ("chainless", 2)):
        text = "".join(residue(i) for i in range(1, n_residues + 1))
        structure = gemmi.read_pdb_string(text + "END\n")
        structure.name = name
        structure.setup_entities()
        blocks.append(structure.make_mmcif_document().as_string())
    path = written(tmp_path, "data_comp_LIG\n_chem_comp.id LIG\n" + "".join(blocks), "made.cif")
    found = read_molecule(path)
    assert [one.name for one in found] == [f"{path}#one chain A", f"{path}#chainless chain A"]
    assert [len(one.radii) for one in found] == [5, 10]
    models = read_molecule(path, "models")
    assert [one.name for one in models] == [f"{path}#one", f"{path}#chainless"]
    for part, n_residues in (("chainless chain A", 2), ("chainless", 2), ("one", 1)):
        assert len(molecule_of(BodyRef(path, part)).residue_names) == n_residues


def test_a_pqr_file_has_its_own_charges_and_radii(tmp_path):
    rows = "ATOM 1 N ALA A 1 0.0 0.0 0.0 -0.30 1.85\nATOM 2 HN ALA A 1 0.5 0.5 0.0 0.30 0.0\n"
    rows += "ATOM 3 CA HIE 2A 1.5 0.0 0.0 0.10 2.00\nHETATM 4 O WAT 3 9 9 9 -0.8 1.6\nTER\nEND\n"
    molecules = read_molecule(written(tmp_path, rows, "made.pqr"), "models")
    (molecule,) = molecules
    assert_allclose(molecule.charges, [-0.3, 0.3, 0.1], rtol=1e-6)
    assert_allclose(molecule.radii, [1.85, 0, 2], atol=1e-6)
    assert molecule.residue_names == ("ALA", "HIS")
    assert np.isnan(molecule.b_factors).all()
    assert molecule.notes == ("radii and charges are those of the PQR file",)


def test_long_numbers_of_a_pqr_file_leave_no_blank_before_them(tmp_path):
    rows = "ATOM   9999  N   ALA A1000       1.000   2.000   3.000  0.1000 1.8500\n"
    rows += "HETATM10000  O   HOH B1001       9.000   2.000   3.000 -0.8000 1.6000\n"
    rows += "HETATM10001  CA  ALA B1002A     12.000   2.000   3.000  0.2000 1.9000\n"
    one, other = read_molecule(written(tmp_path, rows, "made.pqr"))
    for molecule, chain, radius in ((one, "A", 1.85), (other, "B", 1.9)):
        assert molecule.name.endswith(f"chain {chain}")
        assert molecule.residue_names == ("ALA",)
        assert molecule.radii == pytest.approx([radius])
    fused = written(tmp_path, "ATOM 1 HG11VAL A 1 0.0 0.0 0.0 -0.30 1.85\n", "fused.pqr")
    words = r"fused\.pqr: line 1 is no atom .* Write it again, with blanks between fields"
    with pytest.raises(MeshError, match=words):
        read_molecule(fused)


def test_charges_are_those_of_residues_at_ph_7(tmp_path):
    names = {"ASP": "OD1 OD2", "GLU": "OE1 OE2", "LYS": "NZ", "ARG": "NH1 NH2"}
    names |= {"HIS": "ND1 NE2", "SER": "OG", "DA": "OP1"}
    text = ""
    for number, (name, atoms) in enumerate(names.items(), start=1):
        side = [(atom, 3.0 + i, -2.0) for i, atom in enumerate(atoms.split())]
        text += residue(number, name, [*ALANINE, *side])
    (molecule,) = read_molecule(written(tmp_path, text))
    sums = np.bincount(molecule.residue_of, molecule.charges)
    assert_allclose(sums, [-1, -1, 1, 1, 0.1, 0, -0.5])


def test_models_and_chains_are_bodies_of_their_own(tmp_path):
    model = f"{residue(1)}{residue(2)}TER\n{residue(1, chain='B')}ENDMDL\n"
    path = written(tmp_path, "".join(f"MODEL     {i:>4}\n{model}" for i in range(1, 21)))
    of_models = read_molecule(path, "models")
    assert [len(molecule.radii) for molecule in of_models] == [15] * 20
    assert of_models[19].name == f"{path}#model 20"
    of_chains = read_molecule(path)
    assert [len(molecule.radii) for molecule in of_chains] == [10, 5] * 20
    assert of_chains[1].name == f"{path}#model 1 chain B"


def test_an_assembly_is_built_by_its_operators(tmp_path):
    remark = (
        "REMARK 350 BIOMOLECULE: 1\n"
        "REMARK 350 APPLY THE FOLLOWING TO CHAINS: A\n"
        "REMARK 350   BIOMT1   1  1.000000  0.000000  0.000000        0.00000\n"
        "REMARK 350   BIOMT2   1  0.000000  1.000000  0.000000        0.00000\n"
        "REMARK 350   BIOMT3   1  0.000000  0.000000  1.000000        0.00000\n"
        "REMARK 350   BIOMT1   2 -1.000000  0.000000  0.000000        0.00000\n"
        "REMARK 350   BIOMT2   2  0.000000 -1.000000  0.000000        0.00000\n"
        "REMARK 350   BIOMT3   2  0.000000  0.000000  1.000000       50.00000\n"
    )
    (molecule,) = read_molecule(written(tmp_path, remark + residue(1)), "assembly")
    one = molecule.positions[:5]
    assert_allclose(molecule.positions[5:], one * [-1, -1, 1] + [0, 0, 50], atol=1e-4)
    (alone,) = read_molecule(written(tmp_path, residue(1)), "assembly")
    assert alone.notes == ("the file defines no assembly: the model was used",)


def test_an_assembly_of_a_chain_that_is_not_there_is_told_with_the_remedy(tmp_path):
    rows = "".join(
        f"REMARK 350   BIOMT{i}   1 {a:9.6f}{b:10.6f}{c:10.6f}        0.00000\n"
        for i, (a, b, c) in enumerate(np.eye(3), start=1)
    )
    text = f"REMARK 350 BIOMOLECULE: 1\nREMARK 350 APPLY THE FOLLOWING TO CHAINS: A, Q\n{rows}"
    path = written(tmp_path, text + residue(1))
    words = r"made\.pdb: assembly 1 cannot be made .*no chain Q.*bodies"
    with pytest.raises(MeshError, match=words):
        read_molecule(path, "assembly")


def test_water_is_left_out_and_ligands_as_said(tmp_path):
    water = Atom(9, "O", 9, 9, 9, residue="HOH", place=" 101 ", record="HETATM").line()
    ligand = Atom(10, "C1", 5, 5, 5, residue="XYZ", place=" 102 ", record="HETATM").line()
    changed = residue(2, "MSE", [*ALANINE, *SULFUR], record="HETATM")
    path = written(tmp_path, residue(1) + changed + water + ligand)
    (molecule,) = read_molecule(path)
    assert molecule.residue_names == ("ALA", "MET")
    assert molecule.notes == ("1 ligands were left out",)
    (more,) = read_molecule(path, ligands=True)
    assert more.residue_names == ("ALA", "MET", "XYZ")
    with pytest.raises(MeshError, match=r"water\.pdb: no atoms .* not of water alone"):
        read_molecule(written(tmp_path, water, "water.pdb"))


def test_what_the_file_says_is_of_a_polymer_is_none_of_its_ligands(tmp_path):
    """A nucleotide whose name gemmi does not know, by the sequence that the file lists; else TER may mean anything."""
    import gemmi

    names = ("P", "O5'", "C5'", "C1'", "N9")
    sugar = [(name, 1.5 * i, 0.0) for i, name in enumerate(names)]
    unknown = residue(2, "QQQ", sugar, record="HETATM")
    chain = residue(1, "A", sugar) + unknown + residue(3, "U", sugar) + "TER\n"
    ligands = residue(4, "QQX", sugar, record="HETATM")
    ligands += residue(5, "NH2", [("N", 9.0, 9.0)], record="HETATM")
    atoms = chain + ligands
    listed = written(tmp_path, "SEQRES   1 A    3    A QQQ   U\n" + atoms, "listed.pdb")
    structure = gemmi.read_structure(str(listed))
    structure.setup_entities()
    mmcif = written(tmp_path, structure.make_mmcif_document().as_string(), "listed.cif")
    for path in (listed, mmcif):
        assert read_molecule(path)[0].residue_names == ("A", "QQQ", "U")
    assert read_molecule(written(tmp_path, atoms))[0].residue_names == ("A", "U")


def test_water_and_ions_of_simulations_belong_to_no_polymer(tmp_path):
    water = [
        ("OW", 9.0, 9.0),
        ("HW1", 9.5, 9.0),
        ("HW2", 9.0, 9.5),
        ("MW", 9.1, 9.1),
    ]
    ion = residue(3, "SOD", [("NA", 9.0, 0.0)])
    text = residue(1) + residue(2, "SOL", water) + ion + residue(4, "QQQ")
    (molecule,) = read_molecule(written(tmp_path, text))
    assert molecule.residue_names == ("ALA", "QQQ")


def test_hydrogens_are_left_out(tmp_path):
    path = written(
        tmp_path,
        residue(1, atoms=[*ALANINE, ("H", 0.0, -1.0)]),
    )
    assert len(read_molecule(path)[0].radii) == 5


def test_a_backbone_gets_balls_of_its_side_chains(tmp_path):
    names = ("LEU", "GLY", "LYS")
    text = "".join(residue(i, name, backbone()) for i, name in enumerate(names, start=1))
    (molecule,) = read_molecule(written(tmp_path, text))
    assert molecule.notes == (COMPLETED.format(2),)
    assert np.bincount(molecule.residue_of).tolist() == [5, 4, 5]
    leucine = molecule.positions[0], molecule.radii[0]
    volume = 0.89 * (VOLUMES["LEU"] - VOLUMES["GLY"])
    found = 4 / 3 * np.pi * leucine[1] ** 3
    assert found == pytest.approx(volume)
    # It touches Cα, on the side of Cβ, which tetrahedral geometry has away from N and C.
    away = leucine[0] - [1.46, 0, 3.8]
    assert norm(away) == pytest.approx(leucine[1])
    for bonded in ([0.0, 0.0, 3.8], [2.0, 1.4, 3.8]):
        bond = np.array(bonded) - [1.46, 0, 3.8]
        cosine = away @ bond / norm(away) / norm(bond)
        found = np.degrees(np.arccos(cosine))
        expected = pytest.approx(109.5, abs=4)
        assert found == expected
    assert np.bincount(molecule.residue_of, molecule.charges).tolist() == [0, 0, 1]


def side_chain(*names):
    """Atoms in a line from Cα on, with Cβ as the first."""
    return [(name, 2.0 + 0.6 * i, -0.8 - 1.2 * i) for i, name in enumerate(("CB", *names))]


LYSINE = [*backbone(), *side_chain("CG", "CD", "CE", "NZ")]


@pytest.mark.parametrize("n_present", [1, 2, 4])
def test_a_cut_side_chain_gets_what_it_lacks_at_its_last_atom(n_present, tmp_path):
    (whole,) = read_molecule(written(tmp_path, residue(1, "LYS", LYSINE)))
    (cut,) = read_molecule(
        written(
            tmp_path,
            residue(1, "LYS", LYSINE[: 4 + n_present]),
        )
    )
    assert whole.notes == ()
    assert cut.notes == (COMPLETED.format(1),)
    assert cut.charges.sum() == whole.charges.sum() == 1
    ball = cut.positions[0]
    radius = cut.radii[0]
    share = (5 - n_present) / 5
    assert 4 / 3 * np.pi * radius**3 == pytest.approx(share * (VOLUMES["LYS"] - VOLUMES["GLY"]))
    alpha = np.array([1.46, 0, 3.8])
    last = np.array(
        [
            2.0 + 0.6 * (n_present - 1),
            -0.8 - 1.2 * (n_present - 1),
            3.8,
        ]
    )
    out = (last - alpha) / norm(last - alpha)
    assert_allclose(ball, last + radius * out, atol=1e-9)


def test_names_tell_the_state_of_protonation(tmp_path):
    charges = {"HIP": 1, "HSP": 1, "HSD": 0, "HSE": 0, "HID": 0, "HIE": 0, "HIS": 0.1}
    charges |= {"ASH": 0, "GLH": 0, "LYN": 0, "CYM": -1, "CYX": 0, "CYS": 0}
    for atoms in (backbone(), ALANINE):
        text = "".join(residue(i, name, atoms) for i, name in enumerate(charges, start=1))
        (molecule,) = read_molecule(written(tmp_path, text))
        sums = np.bincount(molecule.residue_of, molecule.charges)
        assert_allclose(sums, list(charges.values()), atol=1e-12)


def test_an_atom_that_is_given_twice_counts_once(tmp_path):
    """As programs that complete side chains leave them, without a letter for alternative locations."""
    twice = [*LYSINE, *LYSINE[-3:]]
    (once,) = read_molecule(written(tmp_path, residue(1, "LYS", LYSINE)))
    (molecule,) = read_molecule(written(tmp_path, residue(1, "LYS", twice)))
    assert_array_equal(molecule.positions, once.positions)
    assert molecule.charges.sum() == 1


def test_a_trace_has_balls_of_its_residues(tmp_path):
    text = "".join(residue(i, "ASP", ALANINE[1:2]) for i in range(1, 9))
    (molecule,) = read_molecule(written(tmp_path, text))
    assert molecule.notes == ("8 residues of Cα alone: a ball of the residue's volume was used",)
    assert_allclose(4 / 3 * np.pi * molecule.radii**3, VOLUMES["ASP"])
    assert molecule.charges.tolist() == [-1.0] * 8
    assert molecular_surface(molecule).volume > 6 * VOLUMES["ASP"]


def test_of_alternatives_the_most_occupied_is_taken(tmp_path):
    text = residue(1, atoms=backbone())
    text += Atom(5, "CB", 2, -0.8, 3.8, alternative="A", occupancy=0.4).line()
    text += Atom(6, "CB", 2, -0.9, 3.8, alternative="B", occupancy=0.6).line()
    text += residue(2, "GLY", backbone(), alternative="A", occupancy=0.3)
    text += residue(2, alternative="B", occupancy=0.7)
    (molecule,) = read_molecule(written(tmp_path, text))
    assert molecule.positions[4, 1] == pytest.approx(-0.9)
    assert molecule.residue_names == ("ALA", "ALA")
    assert molecule.notes == ("2 alternative locations: the one of the highest occupancy was used",)


def test_negative_inserted_and_repeated_numbers_lose_nothing(tmp_path):
    text = residue(1, place="  -5 ") + residue(2, place="  -5A")
    text += residue(3, "GLY", backbone()) + residue(4, place="   3 ")
    (molecule,) = read_molecule(written(tmp_path, text))
    assert molecule.residue_names == ("ALA", "ALA", "GLY", "ALA")
    assert len(molecule.radii) == 19
    assert molecule.notes == ("1 residues repeat a number: all were kept",)


def test_unknown_elements_and_residues_are_kept_with_a_note(tmp_path):
    odd = residue(
        2,
        atoms=[*ALANINE, ("X1", 3.0, -2.0), ("1HB", 3.0, -3.0)],
        element="Xx",
    )
    (molecule,) = read_molecule(written(tmp_path, residue(1, "QQQ") + odd))
    assert_allclose(molecule.radii[5:], [1.55, 1.70, 1.70, 1.52, 1.70, 1.70], atol=1e-6)
    assert molecule.residue_names == ("QQQ", "ALA")
    assert molecule.notes == (
        "5 atoms without an element: it was inferred from their names",
        "1 atoms of an unknown element: a radius of 1.7 Å was used",
        "1 residues of an unknown name",
    )


def test_atoms_without_a_position_are_left_out_not_put_at_the_origin(tmp_path):
    text = residue(1).replace("   1.300   2.400", "********   2.400")
    (molecule,) = read_molecule(written(tmp_path, text))
    assert len(molecule.radii) == 4
    assert "1 atoms without a position were left out" in molecule.notes


def test_a_chain_without_atoms_costs_no_other_chain(tmp_path, caplog):
    lost = Atom(1, "N", 0, 0, 0, chain="B").line()
    lost = lost.replace("   0.000   0.000   0.000", "     nan     nan     nan")
    path = written(tmp_path, residue(1) + lost)
    with caplog.at_level(logging.WARNING):
        (molecule,) = read_molecule(path)
    assert molecule.name == f"{path}#chain A"
    assert f"{path}#chain B: no atoms of a polymer, left out" in caplog.text


def test_a_surface_that_fails_in_any_way_costs_no_other_chain(tmp_path, monkeypatch):
    path = written(
        tmp_path,
        residue(1) + residue(1, chain="B") + residue(1, chain="C"),
    )

    def faulty(molecule):
        if "chain B" in molecule.name:
            raise ValueError("of any kind")
        return molecular_surface(molecule)

    monkeypatch.setattr("igps.fields.molecules.bodies.molecular_surface", faulty)
    found = {body.part: mesh for body, mesh in each_body(path)}
    assert isinstance(found["chain A"], Mesh)
    assert isinstance(found["chain C"], Mesh)
    told = f"{path}#chain B: not readable as a structure (ValueError: "
    assert str(found["chain B"]).startswith(told)


def test_b_factors_are_means_over_residues(tmp_path):
    text = Atom(1, "N", 0, 0, 0, b=10).line() + Atom(2, "CA", 1, 0, 0, b=30).line()
    text += residue(2, b=70.0)
    assert read_molecule(written(tmp_path, text))[0].b_factors.tolist() == [20.0, 70.0]


PQR_LINE = "ATOM 1 N ALA A 1 0.0 0.0 0.0 -0.30 1.85\n"


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("cut.pdb", residue(1) + "ATOM      6  N   ALA A   2      11.1", "cut short"),
        ("cut.cif", "data_x\nloop_\n_atom_site.id\n_atom_site.Cartn_x\n1 2\n3\n", "cut short"),
        ("cut.pqr", f"{PQR_LINE}ATOM 2 CA ALA A 1 0.0", "line 2 .*cut short"),
        ("negative.pqr", "ATOM 1 N ALA A 1 0.0 0.0 0.0 -0.30 -1.85\n", "radius of at least 0"),
        ("empty.pdb", "  \n", "the file is empty"),
        ("words.pdb", "no structure at all\n", "no atoms of a molecule"),
        ("words.cif", "no structure at all\n", "not readable as a structure"),
        ("other.xyz", "1\n", "expected a structure"),
    ],
)
def test_bad_files_are_named_with_the_remedy(tmp_path, name, text, said):
    with pytest.raises(MeshError, match=rf"{name}: .*{said}"):
        read_molecule(written(tmp_path, text, name))


def test_a_gzipped_file_that_is_cut_short_is_named(tmp_path):
    path = tmp_path / "cut.pdb.gz"
    path.write_bytes(gzip.compress((residue(1) * 50).encode())[:-20])
    with pytest.raises(MeshError, match=r"cut\.pdb\.gz: .*cut short.* Download it again"):
        read_molecule(path)
    path.write_bytes(b"no gzip")
    with pytest.raises(MeshError, match=r"cut\.pdb\.gz: .*damaged"):
        read_molecule(path)
    with pytest.raises(MeshError, match="no such file"):
        read_molecule(tmp_path / "absent.pdb")


def test_unknown_bodies_are_refused(tmp_path):
    with pytest.raises(ValueError, match="bodies: expected one of chains, models, assembly"):
        read_molecule(written(tmp_path, residue(1)), "residues")


def test_b_factors_that_a_file_lacks_are_unknown(tmp_path):
    whole = residue(1)
    cut = "".join(f"{row[:54]}\n" for row in whole.splitlines())
    blank = "".join(f"{row[:60]}      {row[66:]}\n" for row in whole.splitlines())
    columns = "group_PDB type_symbol label_atom_id label_alt_id label_comp_id label_asym_id"
    columns = f"{columns} label_seq_id id Cartn_x Cartn_y Cartn_z".split()
    row = "ATOM C CA . ALA A 1 1 0.0 0.0 0.0"
    loop = "data_made\nloop_\n" + "".join(f"_atom_site.{name}\n" for name in columns)
    pairs = "data_made\n"
    for name, value in zip(columns, row.split(), strict=True):
        pairs += f"_atom_site.{name} {value}\n"
    known = loop + "_atom_site.B_iso_or_equiv\n" + row
    texts = {"cut.pdb": cut, "blank.pdb": blank, "loop.cif": f"{loop}{row}\n", "pairs.cif": pairs}
    texts["asked.cif"] = f"{known} ?\n"
    for name, text in texts.items():
        (molecule,) = read_molecule(written(tmp_path, text, name))
        assert np.isnan(molecule.b_factors).all(), name
    (molecule,) = read_molecule(written(tmp_path, f"{known} 7\n", "known.cif"))
    assert molecule.b_factors.tolist() == [7]
    lacking = pairs.replace("_atom_site.label_alt_id .\n", "")
    with pytest.raises(MeshError, match="no label_alt_id"):
        read_molecule(written(tmp_path, lacking, "lacking.cif"))


def test_names_of_atoms_in_the_wrong_column_are_no_metals(tmp_path):
    names = ["N", "CA", "C", "O", "CB", "CG", "CD", "OE", "NE", "HG"]
    atoms = [(name, float(i), 0.0) for i, name in enumerate(names)]
    text = ""
    for row in residue(1, "GLN", atoms).splitlines():
        text += f"{row[:12]}{row[12:16].strip():<4}{row[16:66]}\n"
    (molecule,) = read_molecule(written(tmp_path, text))
    # Bondi 1964
    assert_allclose(molecule.radii, [1.55, 1.7, 1.7, 1.52, 1.7, 1.7, 1.7, 1.52, 1.55], atol=1e-6)
    # And calcium, which some write as an atom of the polymer, is no residue.
    ion = Atom(9, "CA", 5.0, 5.0, 5.0, residue="CA", place="  99 ", element="CA").line()
    (molecule,) = read_molecule(written(tmp_path, residue(1) + ion))
    assert molecule.residue_names == ("ALA",)
    assert molecule.notes == ("1 ligands were left out",)


def test_no_line_is_lost_to_marks_of_text_or_to_frames(tmp_path):
    text = residue(1) + residue(2)
    (usual,) = read_molecule(written(tmp_path, text))
    path = tmp_path / "other.pdb"
    for other in (f"\ufeff{text}", text.replace("\n", "\r"), text.replace("\n", "\r\n")):
        path.write_bytes(other.encode())
        assert_array_equal(read_molecule(path)[0].positions, usual.positions)
    frames = f"CRYST1\n{text}END\n{residue(1)}END\n"
    found = read_molecule(written(tmp_path, frames), "models")
    assert [len(molecule.radii) for molecule in found] == [10, 5]
    assert len(read_molecule(written(tmp_path, f"{text}TER\nEND\n"), "models")) == 1


def test_models_whose_number_repeats_are_all_read(tmp_path):
    model = f"MODEL        1\n{residue(1)}{residue(2)}ENDMDL\n"
    path = written(tmp_path, 3 * model + "END\n")
    molecules = read_molecule(path, bodies="models")
    assert [len(molecule.radii) for molecule in molecules] == [10, 10, 10]
    assert len({molecule.name for molecule in molecules}) == 3


def test_completed_residues_are_told_on_the_terminal(tmp_path, capsys):
    for name, n_residues in (("one", 9), ("two", 12)):
        text = "".join(residue(i, "LYS", backbone()) for i in range(1, n_residues + 1))
        written(tmp_path, text, f"{name}.pdb")
    arguments = ["extract", tmp_path, "--descriptor", "d2", "--out", tmp_path / "out.npz"]
    options = ["--signature.resolution", 8, "--signature.min_samples", 20, "--n_workers", 1]
    run(*arguments, *options, "--cache_dir", tmp_path)
    told = "21 residues were completed: balls stand for missing atoms of side chains (in 2 of 2"
    assert told in capsys.readouterr().out


def test_notes_of_the_whole_are_not_told_of_a_range(tmp_path):
    text = "".join(residue(i, "LYS", backbone()) for i in range(1, 10))
    molecule = molecule_of(BodyRef(written(tmp_path, text), "A:2-3"))
    completed = COMPLETED.format(9)
    assert molecule.notes == (f"of 9 residues: {completed}", "residues 2-3 alone: 2 of 9")


def test_ranges_of_residues_are_bodies(tmp_path):
    text = "".join(residue(i) for i in range(1, 9))
    text += "".join(residue(i, chain="B") for i in range(1, 4))
    path = written(tmp_path, text)
    for part in ("chain A:2-3,6-7", "A:2-3,6-7"):
        found = molecule_of(BodyRef(path, part))
        assert found.residue_labels == ("A 2", "A 3", "A 6", "A 7")
        assert found.positions[found.residue_of == 2, 2] == pytest.approx(np.full(5, 3.8 * 6))
        assert "residues 2-3,6-7 alone: 4 of 8" in found.notes
    mesh = load_mesh(path, part="A:2-3")
    assert mesh.vertices[:, 2].min() > 3.8 * 2 - 3
    assert mesh.vertices[:, 2].max() < 3.8 * 3 + 3
    with pytest.raises(MeshError, match=r"no residue is in 20-30; their numbers are 1 to 8"):
        load_mesh(path, part="A:20-30")


def test_coordinates_of_nine_characters_are_read(tmp_path):
    """Beyond ±1000 Å, lines of some programs grow by a character for each coordinate."""
    lines = [Atom(i, "CA", 0, 0, 0, place=f"{i:>4} ").line() for i in range(3)]
    wide = "-1234.567-2000.25012345.678"
    text = "".join(line[:30] + wide + line[54:] for line in lines)
    (molecule,) = read_molecule(written(tmp_path, text))
    assert_allclose(molecule.residue_positions, [[-1234.57, -2000.25, 12345.68]] * 3, atol=1e-9)
    assert molecule.b_factors.tolist() == [20.0] * 3


@pytest.mark.parametrize("kept", [4, 40, 60])
def test_a_pdb_file_that_is_cut_short_is_told(tmp_path, kept):
    whole = residue(1)
    last = whole.splitlines()[-1]
    path = written(tmp_path, whole + last[:kept])
    with pytest.raises(MeshError, match="cut short"):
        read_molecule(path)


def test_a_header_without_an_end_is_told(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        read_molecule(written(tmp_path, "HEADER    HYDROLASE\n" + residue(1) + "END\n"))
        assert not caplog.text
        read_molecule(written(tmp_path, "HEADER    HYDROLASE\n" + residue(1)))
    assert "no END, so it may be cut short" in caplog.text


def test_atoms_in_one_place_are_refused_and_one_atom_is_told(tmp_path):
    atoms = [(name, 0.0, 0.0) for name in ("N", "CA", "C")]
    path = written(tmp_path, residue(1, atoms=atoms))
    with pytest.raises(MeshError, match="all its atoms are in one place"):
        load_mesh(path, part="chain A")
    zinc = Atom(1, "ZN", 1, 2, 3, residue="ZN", record="HETATM", element="ZN").line()
    mesh = load_mesh(written(tmp_path, zinc), part="chain A")
    assert "a single atom: its surface is a ball" in mesh.notes


def test_lipids_among_the_atoms_of_polymers_are_told(tmp_path):
    tail = [(f"C{i}", 1.5 * i, 8.0) for i in range(1, 6)]
    (molecule,) = read_molecule(
        written(
            tmp_path,
            residue(1) + residue(2, "POP", tail),
        )
    )
    assert any("1 residues" in note and "lipids or detergents" in note for note in molecule.notes)


def test_the_first_model_alone_is_read_if_asked_for(tmp_path):
    models = [f"MODEL        {k}\n{residue(1)}{residue(2, chain='B')}ENDMDL\n" for k in (3, 4)]
    path = written(tmp_path, "".join(models))
    first = LoadOptions(first_model=True)
    parts = [body.part for body in list_bodies(path, first)]
    assert parts == ["model 3 chain A", "model 3 chain B"]
    assert len(list_bodies(path)) == 4
    models = replace(first, bodies="models")
    assert [body.part for body in list_bodies(path, models)] == ["model 3"]
    with pytest.raises(MeshError, match="expected chains or models as bodies with first_model"):
        load_mesh(path, replace(first, bodies="whole"))


def test_residues_of_low_plddt_are_left_out_of_the_body_and_its_attributes(tmp_path):
    text = "".join(residue(i, b=90.0 - 10 * i) for i in range(1, 6))
    path = written(tmp_path, text)
    options = LoadOptions(min_plddt=60)
    (body,) = list_bodies(path, options)
    assert body.part == "chain A:plddt60"
    assert molecule_of(body).residue_labels == ("A 1", "A 2", "A 3")
    mesh = load_mesh(path, options, part=body.part)
    assert "2 of 5 residues have a pLDDT below 60: left out" in mesh.notes
    assert mesh.volume < load_mesh(path).volume
    both = BodyRef(path, "A:2-9:plddt60.0")
    assert molecule_of(both).residue_labels == ("A 2", "A 3")
    with pytest.raises(MeshError, match="no residue has a pLDDT of 95; the largest is 80"):
        load_mesh(path, part="A:plddt95")


def test_b_factors_that_are_no_plddt_are_refused_as_such(tmp_path):
    path = written(tmp_path, residue(1, b=120.0) + residue(2))
    with pytest.raises(MeshError, match=r"expected a pLDDT .* got B-factors of 20 to 120"):
        load_mesh(path, LoadOptions(min_plddt=70))
