"""BinaryCIF: the encodings of its specification, the same molecule as mmCIF, and files of strangers."""

from __future__ import annotations

import gzip
import tracemalloc

import numpy as np
import pytest

from igps.fields.molecules._binary_cif import MAX_BYTES, read_binary_cif
from igps.fields.molecules.structures import read_molecule
from igps.mesh.errors import MeshError

gemmi = pytest.importorskip("gemmi")
msgpack = pytest.importorskip("msgpack")

INT8 = {"kind": "ByteArray", "type": 1}
INT32 = {"kind": "ByteArray", "type": 3}
PACKED = {"kind": "IntegerPacking", "byteCount": 1, "isUnsigned": False}


def packed(values, *encoding):
    dtype = {1: "i1", 3: "<i4"}[encoding[-1]["type"]]
    return {
        "data": np.array(values, dtype).tobytes(),
        "encoding": list(encoding),
    }


def strings(values):
    known = sorted(set(values))
    ends = np.cumsum([0, *map(len, known)])
    whole = {
        "kind": "StringArray",
        "stringData": "".join(known),
        "dataEncoding": [INT32],
        "offsets": np.array(ends, "<i4").tobytes(),
        "offsetEncoding": [INT32],
    }
    indices = [known.index(value) for value in values]
    return {"data": packed(indices, INT32)["data"], "encoding": [whole]}


def column(name, data, mask=None):
    return {"name": name, "data": data, "mask": mask}


def file_of(n_rows, *columns, name="_atom_site"):
    table = {"name": name, "rowCount": n_rows, "columns": list(columns)}
    return {"dataBlocks": [{"header": "made", "categories": [table]}]}


# The examples of the specification (Sehnal et al. 2020)
@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (packed([1, 2, -3, 127, 1], PACKED, INT8), [1, 2, -3, 128]),
        (packed([1, -128, -2, 127, 0], PACKED, INT8), [1, -130, 127]),
        (
            packed(
                [0, 3, 2, 1],
                {"kind": "Delta", "origin": 1000},
                INT8,
            ),
            [1000, 1003, 1005, 1006],
        ),
        (
            packed(
                [1, 3, 2, 1, 3, 2],
                {"kind": "RunLength"},
                INT32,
            ),
            [1, 1, 1, 2, 3, 3],
        ),
        (
            packed(
                [120, 123, 12],
                {"kind": "FixedPoint", "factor": 100},
                INT32,
            ),
            [1.2, 1.23, 0.12],
        ),
        (
            packed(
                [0, 0, 1, 2, 2, 1],
                {"kind": "IntervalQuantization", "min": 1, "max": 2, "numSteps": 3},
                INT8,
            ),
            [1, 1, 1.5, 2, 2, 1.5],
        ),
        (strings(["a", "AB", "a"]), ["a", "AB", "a"]),
    ],
)
def test_each_encoding_is_undone(data, expected):
    content = msgpack.packb(file_of(len(expected), column("x", data)))
    assert list(read_binary_cif(content)) == [("made", {"_atom_site": {"x": expected}})]


def helix():
    """Return the mmCIF of a short chain, with its assembly, as gemmi writes it."""
    structure = gemmi.Structure()
    model = gemmi.Model(1)
    chain = gemmi.Chain("A")
    for number in range(1, 9):
        residue = gemmi.Residue()
        residue.name = "ALA" if number % 3 else "LYS"
        residue.seqid = gemmi.SeqId(number, " ")
        for i, name in enumerate(("N", "CA", "C", "O", "CB")):
            atom = gemmi.Atom()
            atom.name = name
            atom.element = gemmi.Element(name[0])
            turn = np.radians(100 * number + 25 * i)
            position = (-40 + np.cos(turn), np.sin(turn), 1.5 * number + 0.4 * i)
            atom.pos = gemmi.Position(*np.round(position, 3))
            residue.add_atom(atom)
        chain.add_residue(residue)
    model.add_chain(chain)
    structure.add_model(model)
    structure.setup_entities()
    return structure.make_mmcif_document()


def packed_column(name, values):
    """Coordinates as differences in bytes, and all else as text, "?" and "." by a mask."""
    mask = [".?".find(value) + 1 for value in values]
    masked = packed(mask, INT8) if any(mask) else None
    if not name.startswith("Cartn"):
        return column(name, strings(values), masked)
    thousandths = [round(float(value) * 1000) for value in values]
    small = []
    for step in np.diff(thousandths, prepend=0).tolist():
        limit = 127 if step >= 0 else -128
        n_limits, rest = divmod(abs(step), abs(limit))
        small += [limit] * n_limits + [rest if step >= 0 else -rest]
    point = {"kind": "FixedPoint", "factor": 1000}
    return column(
        name,
        packed(small, point, {"kind": "Delta", "origin": 0}, PACKED, INT8),
    )


@pytest.mark.parametrize("suffix", [".bcif", ".BCIF.gz"])
def test_it_is_the_molecule_of_the_same_mmcif(suffix, tmp_path):
    document = helix()
    plain = tmp_path / "made.cif"
    document.write_file(str(plain))
    block = document.sole_block()
    tables = []
    for name in block.get_mmcif_category_names():
        table = block.find_mmcif_category(name)
        columns = []
        for tag, *values in zip(table.tags, *table, strict=True):
            plain_values = [gemmi.cif.as_string(value) or value for value in values]
            columns.append(packed_column(tag.removeprefix(name), plain_values))
        tables.append(
            {
                "name": name.rstrip("."),
                "rowCount": len(table),
                "columns": columns,
            }
        )
    content = msgpack.packb({"dataBlocks": [{"header": "made", "categories": tables}]})
    path = tmp_path / f"made{suffix}"
    path.write_bytes(gzip.compress(content) if suffix.endswith("gz") else content)
    (one,) = read_molecule(plain)
    (other,) = read_molecule(path)
    np.testing.assert_array_equal(other.positions, one.positions)
    np.testing.assert_array_equal(other.b_factors, one.b_factors)
    assert other.residue_labels == one.residue_labels
    assert other.residue_names == one.residue_names


@pytest.mark.parametrize(
    ("file", "said"),
    [
        (
            file_of(
                2**40,
                column("id", packed([1], INT8)),
            ),
            "more than .* values",
        ),
        (
            file_of(
                9,
                column("id", packed([1, 2**30], {"kind": "RunLength"}, INT32)),
            ),
            "more than .* rows",
        ),
        (file_of(3, column("id", packed([1], INT8))), "_atom_site.id has not 3 rows"),
        (
            file_of(
                1,
                column("id", packed([1], {"kind": "Zip"}, INT8)),
            ),
            "unknown encoding Zip",
        ),
        (
            file_of(
                1,
                column("id", strings(["1"]) | {"data": b"\xf0\xff\xff\xff"}),
            ),
            "KeyError",
        ),
        ({"dataBlocks": [[]] * 2**18}, "more than .* lists and maps"),
        ({"dataBlocks": [{"header": 1}]}, "no BinaryCIF"),
        ([1, 2], "no BinaryCIF"),
    ],
)
def test_a_file_that_claims_too_much_is_refused_before_memory_is_taken(file, said, tmp_path):
    path = tmp_path / "odd.bcif"
    path.write_bytes(msgpack.packb(file))
    tracemalloc.start()
    with pytest.raises(MeshError, match=rf"odd\.bcif: not readable .*{said}.* Download"):
        read_molecule(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MAX_BYTES + 2**24  # the buffer into which the file is read
    path.write_bytes(msgpack.packb(file)[:-1])
    with pytest.raises(MeshError, match=r"odd\.bcif: not readable .* or cut short"):
        read_molecule(path)
