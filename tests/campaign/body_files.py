"""Label volumes, molecules, scenes, and images, grids and vertex values beside bodies, intact or with a fault."""

from __future__ import annotations

import gzip
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import cycle
from pathlib import Path
from typing import Any

import gemmi
import nibabel
import numpy as np
import tifffile
import trimesh
from damage import broken_bytes
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[2]))
from tests.fields.cad.step_files import write_step
from tests.fields.volumes import test_volumes

Array = NDArray[Any]

REFUSED, AS_IT_IS = "refused", "as it is"


@dataclass(frozen=True)
class BodyFile:
    """A file of bodies, and the files beside it.

    Args:
        kind: "volume", "molecule", "scene" or "image".
        files: contents by name, the file of the bodies first.
        expected: `REFUSED` if the whole file is refused. Else for each body, by name, the volume, `REFUSED`, or
            `AS_IT_IS` for the volume in the file without a fault. None if a second reader provides the expected result.
        story: the fault, in words.
        options: arguments of `LoadOptions`.
    """

    kind: str
    files: dict[str, bytes]
    expected: Any
    story: str = "nothing"
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self):
        """Name of the file of the bodies."""
        return next(iter(self.files))


def body_file(seed, number):
    """Make the file of a seed and a number. Kinds alternate, and faults are random."""
    generator = np.random.default_rng([seed, number])
    make = (_volume, _molecule, _image, _volume, _molecule, _scene, _pqr, _beside, _dicom, _beside)[
        number % 10
    ]
    return make(generator)


def _drawn(generator, faults):
    return str(generator.choice(list(faults)))


def _damaged(generator, given, packed):
    """Damage bytes or words of a file, inside or outside the compression."""
    name = given.name
    content = given.files[given.name]
    inside = packed and generator.random() < 0.5
    if inside:
        content = gzip.decompress(content)
    fault, content = broken_bytes(generator, content)
    if inside:
        content = gzip.compress(content, mtime=0)
    return replace(given, files={**given.files, name: content}, expected=None, story=fault)


# Label volumes.

AFFINE = np.array([[-0.8, -0.9, 0.1, 30], [-0.6, 1.2, 0, -20], [0, 0, 2.5, 10], [0, 0, 0, 1]])
SHAPE = (24, 22, 14)
LABELS = {1: "liver", 4: "spleen", 9: "kidney"}
_VOLUMES = ("nii", "nii.gz", "mgz", "nrrd", "mha", "tif")


@cache
def labels():
    """Three ellipsoids; two of them touch, and one is at the border."""
    x, y, z = np.indices(SHAPE)
    volume = np.zeros(SHAPE, dtype=np.int16)
    for label, (cx, cy, cz), (a, b, c) in (
        (1, (7, 7, 7), (6, 6, 5)),
        (4, (17, 7, 7), (5, 5, 4)),
        (9, (12, 19, 6), (8, 5, 5)),
    ):
        volume[
            (volume == 0) & (((x - cx) / a) ** 2 + ((y - cy) / b) ** 2 + ((z - cz) / c) ** 2 < 1)
        ] = label
    return volume


def _volume(generator):
    suffix = str(generator.choice(_VOLUMES))
    values = labels().copy()
    affine = AFFINE.copy()
    fault = _drawn(generator, _ON_VOLUMES) if generator.random() < 0.7 else "damage"
    if fault == "damage":
        whole = BodyFile("volume", {f"x.{suffix}": written_volume(suffix, values, affine)}, None)
        return _damaged(generator, whole, suffix in ("nii.gz", "mgz"))
    cell = 1.0 if suffix == "tif" else abs(np.linalg.det(affine[:3, :3]))
    expected = {str(label): cell * float((values == label).sum()) for label in LABELS}
    beside = {}
    options = {}
    if (change := _ON_VOLUMES[fault]) is not None:
        values, affine, refused = change(generator, values, affine)
        expected = REFUSED if refused else expected
    if fault == "seven voxels":
        values[0, 0, :7] = 20
        expected["20"] = REFUSED
    elif fault == "probabilities":
        values = (labels() == 4) * 0.75
        expected = {"x": expected["4"]}
    elif fault in ("names", "names repeat", "names of others"):
        given = {
            "names": LABELS,
            "names repeat": dict.fromkeys(LABELS, "liver"),
            "names of others": {77: "heart"},
        }[fault]
        beside["x.csv"] = "\n".join(
            ["label,name", *(f"{label},{name}" for label, name in given.items())]
        ).encode()
        # Repeated names are followed by the number of the label
        is_repeated = fault == "names repeat"
        expected = {
            f"liver ({k})" if is_repeated else given.get(int(k), k): v for k, v in expected.items()
        }
    elif fault in ("no names", "no such names"):
        options["names"] = "names.csv" if fault == "no names" else "none.csv"
        beside = {"names.csv": b"nothing is named here\n"} if fault == "no names" else {}
        expected = "refused, the table is named"
    if fault in ("complex", "colours"):  # NIfTI supports these types
        suffix = "nii"
    if fault in ("singular", "axis without length"):
        suffix = suffix if suffix in ("nii", "nii.gz") else "nii"
    if suffix == "mgz":
        values = values.astype(np.float32 if values.dtype.kind == "f" else np.int32)
    if suffix == "tif" and values.ndim == 4:
        suffix = "nrrd"
    content = (
        _oversized(generator, suffix)
        if fault == "promises"
        else written_volume(suffix, values, affine)
    )
    expected = REFUSED if fault == "promises" else expected
    return BodyFile(
        "volume", {f"x.{suffix}": content, **beside}, expected, f"{suffix}: {fault}", options
    )


def written_volume(suffix, values, affine):
    """Write an array, valid or not, in a format."""
    if suffix in ("nii", "nii.gz"):
        image = nibabel.Nifti1Image(values, None, dtype=values.dtype)
        for row, words in zip("xyz", affine, strict=False):
            image.header[f"srow_{row}"] = words
        image.header["sform_code"] = 1
        content = image.to_bytes()
        return gzip.compress(content, mtime=0) if suffix == "nii.gz" else content
    if suffix == "mgz":
        return gzip.compress(nibabel.MGHImage(values, affine).to_bytes(), mtime=0)
    if suffix == "tif":
        with tempfile.NamedTemporaryFile(suffix=".tif") as file:
            tifffile.imwrite(file.name, np.ascontiguousarray(values.T), photometric="minisblack")
            return Path(file.name).read_bytes()
    lps = np.diag([-1, -1, 1, 1]) @ affine
    raw = np.asfortranarray(values).tobytes(order="F")
    sizes = " ".join(map(str, values.shape))
    axes = lps[:3, :3].T
    if suffix == "mha":
        kinds = {"int16": "MET_SHORT", "float32": "MET_FLOAT", "float64": "MET_DOUBLE"}
        sides = np.linalg.norm(axes, axis=1)
        zeros = [0.0] * (values.ndim - 3)
        directions = np.eye(values.ndim)
        directions[:3, :3] = axes / sides[:, None]
        rows = (
            f"ObjectType = Image\nNDims = {values.ndim}\nBinaryData = True\nBinaryDataByteOrderMSB = False\n"
            f"TransformMatrix = {_words(directions.ravel())}\nOffset = {_words([*lps[:3, 3], *zeros])}\n"
            f"ElementSpacing = {_words([*sides, *(1 + x for x in zeros)])}\nDimSize = {sizes}\n"
            f"ElementType = {kinds[str(values.dtype)]}\nElementDataFile = LOCAL\n"
        )
        return rows.encode() + raw
    kinds = {"int16": "short", "float32": "float", "float64": "double"}
    space = " ".join(f"({','.join(map(str, axis))})" for axis in axes) + " none" * (values.ndim - 3)
    rows = (
        f"NRRD0004\ntype: {kinds[str(values.dtype)]}\ndimension: {values.ndim}\nspace: left-posterior-superior\n"
        f"sizes: {sizes}\nspace directions: {space}\nkinds:{' domain' * 3}{' list' * (values.ndim - 3)}\n"
        f"endian: little\nencoding: gzip\nspace origin: ({','.join(map(str, lps[:3, 3]))})\n\n"
    )
    return rows.encode() + gzip.compress(raw, mtime=0)


def _words(numbers):
    return " ".join(repr(float(x)) for x in numbers)


def _oversized(generator, suffix):
    """A file with few voxels, whose header declares 10^13 voxels or more."""
    content = written_volume(suffix, labels(), AFFINE)
    if suffix in ("nrrd", "mha"):
        return content.replace(b" ".join(b"%d" % n for n in SHAPE), b"100000 100000 100000")
    if suffix == "tif":
        return content.replace(np.array(SHAPE[0], "<u2").tobytes(), b"\xff\xff", 1).replace(
            b"\x16\0\0\0", b"\xff\xff\xff\x7f"
        )
    packed = suffix != "nii"
    head = bytearray(gzip.decompress(content) if packed else content)
    if suffix == "mgz":
        head[4:16] = np.array([100_000] * 3, dtype=">i4").tobytes()
    else:
        head[42:48] = np.array([32767] * 3, dtype="<i2").tobytes()
    return gzip.compress(bytes(head), mtime=0) if packed else bytes(head)


def _refusing(change):
    return lambda generator, values, affine: (*change(generator, values, affine), True)


def _poked(values, kind, value):
    values = values.astype(kind)
    values[5, 5, 5] = value
    return values


def _colours(values):
    colours = np.zeros(values.shape, dtype=[("R", "u1"), ("G", "u1"), ("B", "u1")])
    colours["R"] = values
    return colours


_ON_VOLUMES = {
    "nothing": None,
    "promises": None,
    "seven voxels": None,
    "names": None,
    "names repeat": None,
    "names of others": None,
    "no names": None,
    "no such names": None,
    "probabilities": None,
    "whole numbers as floats": lambda g, v, a: (v.astype(np.float32), a, False),
    "four axes": _refusing(lambda g, v, a: (np.stack([v, v], axis=-1), a)),
    "colours": _refusing(lambda g, v, a: (_colours(v), a)),
    "complex": _refusing(lambda g, v, a: (v.astype(np.complex64), a)),
    "not finite": _refusing(lambda g, v, a: (_poked(v, np.float32, g.choice([np.nan, np.inf])), a)),
    "negative": _refusing(lambda g, v, a: (_poked(v, np.int16, -3), a)),
    "fractional": _refusing(lambda g, v, a: (_poked(v, np.float32, 2.5), a)),
    "too large": _refusing(lambda g, v, a: (_poked(v, np.float32, 1e30), a)),
    "an image": _refusing(lambda g, v, a: (g.integers(0, 30000, (64, 64, 20)).astype(np.int16), a)),
    "singular": _refusing(lambda g, v, a: (v, a[:, [0, 0, 2, 3]])),
    "axis without length": _refusing(lambda g, v, a: (v, a * [1, 1, 0, 1])),
    "one slice": _refusing(lambda g, v, a: (v[:, :, :1], a)),
    "no label": _refusing(lambda g, v, a: (0 * v, a)),
}


@cache
def segmentation():
    """A DICOM SEG file of the ellipsoids."""
    with tempfile.NamedTemporaryFile(suffix=".dcm") as file:
        masks = test_volumes.masks_of(labels())
        test_volumes.write_segmentation(Path(file.name), masks, list(LABELS.values()), "BINARY")
        return Path(file.name).read_bytes()


def _dicom(generator):
    content = segmentation()
    fault = _drawn(generator, ("nothing", "an image", "no modality", "damage", "damage"))
    cell = abs(np.linalg.det(test_volumes.AFFINE[:3, :3]))
    expected = {name: cell * float((labels() == label).sum()) for label, name in LABELS.items()}
    if fault == "damage":
        return _damaged(generator, BodyFile("volume", {"x.dcm": content}, None), False)
    if fault != "nothing":
        content = content.replace(
            b"CS\4\0SEG ", b"CS\4\0CT  " if fault == "an image" else b"CS\4\0    "
        )
        expected = REFUSED
    return BodyFile("volume", {"x.dcm": content}, expected, f"dcm: {fault}")


# Molecules.


@cache
def helices():
    """Lines of a PDB file of two helices, A and B, without hydrogens."""
    lines = []
    serial = 0
    for chain, n, x in (("A", 12, 0.0), ("B", 9, 14.0)):
        for i in range(n):
            residue = ("ALA", "LEU", "SER", "GLU", "GLY")[i % 5]
            atoms = (
                ("N", 1.55, 0, 0.0),
                ("CA", 2.29, 28, 0.85),
                ("C", 1.66, 55, 1.85),
                ("O", 2.0, 60, 3.05),
                ("CB", 3.3, 20, 0.2),
            )
            for name, radius, turn, up in atoms[: 4 if residue == "GLY" else 5]:
                serial += 1
                angle = np.radians(100 * i + turn)
                at = (x + radius * np.cos(angle), radius * np.sin(angle), 1.5 * i + up)
                lines.append(Atom(serial, name, residue, chain, i + 1, at).line())
        lines.append("TER")
    return tuple(lines)


@dataclass(frozen=True)
class Atom:
    """An atom of a PDB file, at its place in a chain."""

    serial: int
    name: str
    residue: str
    chain: str
    number: int
    at: Iterable[float]
    record: str = "ATOM"

    def line(self):
        """The line of the atom in the file."""
        position = "".join(f"{x:8.3f}"[:8] for x in self.at)
        return (
            f"{self.record:<6}{self.serial:>5} {f' {self.name}':<4} {self.residue:>3} "
            f"{self.chain}{self.number:>4}    {position}"
            f"{1:6.2f}{20:6.2f}          {self.name[0]:>2}"
        )


def _molecule(generator):
    lines = list(helices())
    suffix = str(generator.choice(["pdb", "pdb.gz", "cif", "ent"]))
    fault = _drawn(generator, _ON_MOLECULES) if generator.random() < 0.65 else "damage"
    expected = {"chain A": AS_IT_IS, "chain B": AS_IT_IS}
    if fault != "damage":
        lines, changed = _ON_MOLECULES[fault](generator, lines)
        expected = {**expected, **changed} if isinstance(changed, dict) else changed
    if fault in ("nowhere", "all nowhere"):  # only PDB files may have asterisks in place of numbers
        suffix = "pdb"
    text = "\n".join(lines) + "\n"
    content = (
        gemmi.read_pdb_string(text).make_mmcif_document().as_string() if suffix == "cif" else text
    )
    packed = suffix.endswith(".gz")
    whole = BodyFile(
        "molecule",
        {f"x.{suffix}": gzip.compress(content.encode(), mtime=0) if packed else content.encode()},
        expected,
        f"{suffix}: {fault}",
    )
    return _damaged(generator, whole, packed) if fault == "damage" else whole


Change = tuple[list[str], Any]


def _each_atom(lines, change):
    """Change the line of each atom, or leave it out if the change is None."""
    changed = [change(line, i) if line.startswith("ATOM") else line for i, line in enumerate(lines)]
    return [line for line in changed if line is not None]


def _of_chain_a(change, last=10**6):
    return lambda g, lines: _each_atom(
        lines, lambda line, i: change(line) if line[21] == "A" and i <= last else line
    )


def _numbered(line, number):
    return f"{line[:22]}{number:>4}{line[26:]}"


def _placed(line, at):
    return line[:30] + "".join(f"{x:8.3f}"[:8] for x in at) + line[54:]


def _alternatives(generator, lines):
    found = []
    for line in lines:
        if line.startswith("ATOM") and generator.random() < 0.2:
            found.append(f"{line[:16]}A{line[17:54]}  0.60{line[60:]}")
            found.append(
                _placed(f"{line[:16]}B{line[17:54]}  0.40{line[60:]}", generator.normal(size=3) * 5)
            )
        else:
            found.append(line)
    return found, {}


_ON_MOLECULES = {
    "nothing": lambda g, lines: (lines, {}),
    "alternatives": _alternatives,
    "negative numbers": lambda g, lines: (
        _each_atom(lines, lambda line, i: _numbered(line, int(line[22:26]) - 6)),
        {},
    ),
    "repeated numbers": lambda g, lines: (
        _each_atom(lines, lambda line, i: _numbered(line, (int(line[22:26]) + 1) // 2)),
        {},
    ),
    "repeated serials": lambda g, lines: (
        _each_atom(lines, lambda line, i: f"{line[:6]}    1{line[11:]}"),
        {},
    ),
    "serials of letters": lambda g, lines: (
        _each_atom(lines, lambda line, i: f"{line[:6]}***** {line[12:]}"),
        {},
    ),
    "unknown residues": lambda g, lines: (
        _each_atom(
            lines, lambda line, i: line if line[17:20] == "GLY" else f"{line[:17]}XQZ{line[20:]}"
        ),
        {"chain A": None, "chain B": None},  # what an unknown residue lacks is not known either
    ),
    "no elements": lambda g, lines: (_each_atom(lines, lambda line, i: line[:76]), {}),
    "hydrogens": lambda g, lines: (
        [*lines[:3], Atom(900, "H", "ALA", "A", 1, (0, 0, 30)).line(), *lines[3:]],
        {},
    ),
    "water": lambda g, lines: (
        [
            *lines,
            *(
                Atom(900 + i, "O", "HOH", "C", i, (i, 40, 0), record="HETATM").line()
                for i in range(9)
            ),
        ],
        {},
    ),
    "other ends of lines": lambda g, lines: ([line + "\r" for line in lines], {}),
    "remarks": lambda g, lines: (
        ["HEADER    NONE", "REMARK   2 é", *lines, "CONECT    1    2"],
        {},
    ),
    "unknown elements": lambda g, lines: (
        _of_chain_a(lambda line: f"{line[:76]} Q", 5)(g, lines),
        {"chain A": None},
    ),
    "nowhere": lambda g, lines: (
        _of_chain_a(lambda line: f"{line[:30]}********{line[38:]}", 5)(g, lines),
        {"chain A": None},
    ),
    "far away": lambda g, lines: (
        _of_chain_a(lambda line: _placed(line, (9999, 9999, 9999)), 0)(g, lines),
        {"chain A": REFUSED},
    ),
    "all in one place": lambda g, lines: (
        _of_chain_a(lambda line: _placed(line, (1, 2, 3)))(g, lines),
        {"chain A": None},
    ),
    "no atoms": lambda g, lines: (["HEADER    NONE", "END"], REFUSED),
    "water alone": lambda g, lines: (
        [Atom(i, "O", "HOH", "A", i, (3 * i, 0, 0), record="HETATM").line() for i in range(9)],
        REFUSED,
    ),
    "all nowhere": lambda g, lines: (
        _each_atom(lines, lambda line, i: f"{line[:30]}{'*' * 24}{line[54:]}"),
        REFUSED,
    ),
    "one line": lambda g, lines: (lines[:1], None),
}


def _pqr(generator):
    """A PQR file: words separated by spaces, with charges and radii in the last columns."""
    lines = [
        f"ATOM {line[6:11]} {line[12:16]} {line[17:20]} {line[21]} {line[22:26]} {line[30:54]} {charge:.4f} 1.80"
        for line, charge in zip(
            (x for x in helices() if x.startswith("ATOM")), cycle([0.1, -0.1]), strict=False
        )
    ]
    fault = _drawn(
        generator, ("nothing", "remarks", "no chains", "radius", "charge", "damage", "damage")
    )
    expected = {"chain A": None, "chain B": None}
    if fault == "remarks":
        lines = ["REMARK   1 PQR file generated by PDB2PQR", "", *lines, "TER", "END"]
    elif fault == "no chains":
        lines = [" ".join((words := line.split())[:4] + words[5:]) for line in lines]
        expected = None
    elif fault in ("radius", "charge"):
        words = lines[7].split()
        at = -1 if fault == "radius" else -2
        words[at] = str(generator.choice(["nan", "inf", "1e9", "-1", "word"]))
        lines[7] = " ".join(words)
        expected = None
    name = str(generator.choice(["x.pqr", "x.pqr.gz"]))
    content = "\n".join([*lines, ""]).encode()
    packed = name.endswith(".gz")
    whole = BodyFile(
        "molecule",
        {name: gzip.compress(content, mtime=0) if packed else content},
        expected,
        f"{name}: {fault}",
    )
    return _damaged(generator, whole, packed) if fault == "damage" else whole


# Scenes and CAD files.


def _scene(generator):
    boxes = {"shaft": (1.0, 2.0, 3.0), "wheel": (2.0, 2.0, 1.0), "plate": (4.0, 3.0, 0.5)}
    step = generator.random() < 0.4
    fault = str(
        generator.choice(
            ["nothing", "damage", "damage"]
            if step
            else ["nothing", "not finite", "repeat", "damage"]
        )
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("x.step" if step else "x.glb")
        if step:
            write_step(path, {name: [((0, 0, 0), side)] for name, side in boxes.items()})
        else:
            scene = trimesh.Scene()
            for i, (name, sides) in enumerate(boxes.items()):
                mesh = trimesh.creation.box(sides)
                if fault == "not finite" and name == "wheel":
                    mesh.vertices[3, 2] = np.nan
                scene.add_geometry(
                    mesh, node_name=name, geom_name=name, transform=np.diag([(-1) ** i, 1, 1, 1])
                )
            if fault == "repeat":
                scene.add_geometry(
                    scene.geometry["shaft"], node_name="shaft again", geom_name="shaft"
                )
            scene.export(path)
        content = path.read_bytes()
    expected = {name: float(np.prod(sides)) for name, sides in boxes.items()}
    if fault == "not finite":
        expected["wheel"] = REFUSED
    if fault == "repeat":
        expected["shaft again"] = expected["shaft"]
    whole = BodyFile(
        "scene", {path.name: content}, expected, f"{path.suffix}: {fault}", {"bodies": "objects"}
    )
    return _damaged(generator, whole, False) if fault == "damage" else whole


# Images beside bodies.


def field_at(points):
    """Values of the image at points (P, 3)."""
    return 100 + points @ np.array([2.0, -3.0, 1.0])


def _image(generator):
    suffix = str(generator.choice(["nii.gz", "nrrd", "mha", "nii"]))
    fault = _drawn(
        generator, ("nothing", "some holes", "border", "half", "of another", "not finite", "damage")
    )
    affine = np.diag([-0.5, 0.6, 0.4, 1.0])
    shape = np.array([24, 20, 30])
    affine[:3, 3] = -affine[:3, :3] @ ((shape - 1) / 2)
    if fault in ("half", "of another"):
        affine[0, 3] += 6 if fault == "half" else 1000
    index = np.stack(np.indices(tuple(shape)), axis=-1)
    values = field_at(index @ affine[:3, :3].T + affine[:3, 3]).astype(np.float32)
    if fault == "some holes":
        values[tuple((shape * [0.5, 0.6, 0.5]).astype(int))] = generator.choice(
            [np.nan, np.inf, 7e18]
        )
    elif fault == "border":
        values[[0, -1]] = values[:, [0, -1]] = values[:, :, [0, -1]] = 7e18
    elif fault == "not finite":
        values[:, ::2] = np.nan
    ball = trimesh.creation.icosphere(subdivisions=2, radius=3.0)
    beside = {f"x.{suffix}": written_volume(suffix, values, affine)}
    expected = REFUSED if fault in ("half", "of another", "not finite") else {"linear": 0.0}
    if fault == "damage":
        broken = _damaged(generator, BodyFile("image", beside, None), suffix == "nii.gz")
        beside = broken.files
        expected = None
    body = trimesh.exchange.off.export_off(ball, digits=9).encode()
    return BodyFile("image", {"x.off": body, **beside}, expected, f"{suffix}: {fault}")


def _beside(generator):
    """A grid or values at vertices, beside a ball."""
    suffix = str(generator.choice(["dx", "mrc", "map", "ply", "vtk", "shape.gii", "curv"]))
    is_grid = suffix in ("dx", "mrc", "map")
    faults = ["nothing", "damage", "damage", "some holes", "not finite"]
    fault = _drawn(
        generator, [*faults, "half", "of another", "border"] if is_grid else [*faults, "of another"]
    )
    ball = trimesh.creation.icosphere(subdivisions=2, radius=3.0)
    content = (_grid if is_grid else _at_vertices)(generator, suffix, fault, ball)
    # One vertex gets the value of a neighbour, with an error of 2. The mean weight of a vertex inside is 1/162, and at
    # nearly all points its weight is at most twice the mean.
    slack = 2 * 2 / len(ball.vertices) if fault == "some holes" and not is_grid else 0.0
    beside = {f"x.{suffix}": content}
    expected = {"linear": slack}
    if fault in ("half", "of another", "not finite"):
        expected = REFUSED
    if fault == "damage":
        broken = _damaged(generator, BodyFile("image", beside, None), False)
        beside = broken.files
        expected = None
    body = trimesh.exchange.off.export_off(ball, digits=9).encode()
    return BodyFile("image", {"x.off": body, **beside}, expected, f"{suffix}: {fault}")


def _holed(generator, values, fault):
    if fault == "some holes":
        values.flat[values.size // 2] = generator.choice([np.nan, np.inf, 7e18])
    elif fault == "not finite":
        values.flat[::2] = generator.choice([np.nan, np.inf, 7e18])
    return values


def _grid(generator, suffix, fault, ball):
    side = np.array([0.5, 0.6, 0.4])
    shape = np.array([17, 15, 21])
    origin = -side * (shape - 1) / 2 + np.array(
        [{"half": 5, "of another": 1000}.get(fault, 0), 0, 0]
    )
    values = field_at(np.stack(np.indices(tuple(shape)), axis=-1) * side + origin).astype(
        np.float32
    )
    if fault == "border":
        values[[0, -1]] = values[:, [0, -1]] = values[:, :, [0, -1]] = 7e18
    values = _holed(generator, values, fault)
    if suffix == "dx":
        rows = [
            "# data of a potential",
            f"object 1 class gridpositions counts {_integers(shape)}",
            f"origin {_words(origin)}",
            *(f"delta {_words(row)}" for row in np.diag(side)),
            f"object 2 class gridconnections counts {_integers(shape)}",
            f"object 3 class array type double rank 0 items {values.size} data follows",
            *(
                " ".join(f"{x:.6e}" for x in row)
                for row in np.array_split(values.ravel(), values.size // 3)
            ),
            'attribute "dep" string "positions"',
        ]
        return "\n".join([*rows, ""]).encode()
    head = np.zeros(256, "<i4")
    head[:3] = shape
    head[3] = 2
    head[7:10] = shape
    head[16:19] = (1, 2, 3)
    floats = head.view("<f4")
    floats[10:13] = side * shape
    floats[13:16] = 90
    floats[49:52] = origin
    head[52:54] = np.frombuffer(b"MAP \x44\x44\0\0", "<i4")
    return head.tobytes() + values.astype("<f4").tobytes(order="F")


def _integers(numbers):
    return " ".join(str(int(x)) for x in numbers)


def _at_vertices(generator, suffix, fault, ball):
    """A file of values at vertices. GIFTI is written by nibabel, other formats are assembled here."""
    values = _holed(generator, field_at(ball.vertices).astype(np.float32), fault)
    values = values[:-1] if fault == "of another" else values
    if suffix == "shape.gii":
        return nibabel.GiftiImage(darrays=[nibabel.gifti.GiftiDataArray(values)]).to_bytes()
    if suffix == "curv":
        return (
            b"\xff\xff\xff"
            + np.array([len(values), len(ball.faces), 1], ">i4").tobytes()
            + values.astype(">f4").tobytes()
        )
    places = ball.vertices[: len(values)]
    if suffix == "vtk":
        rows = [
            "# vtk DataFile Version 3.0",
            "x",
            "ASCII",
            "DATASET POLYDATA",
            f"POINTS {len(places)} float",
        ]
        rows += [_words(place) for place in places]
        rows += [f"POINT_DATA {len(values)}", "SCALARS value float 1", "LOOKUP_TABLE default"]
        return "\n".join([*rows, *map(repr, values.tolist()), ""]).encode()
    names = "\n".join(f"property float {name}" for name in ("x", "y", "z", "value"))
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(values)}\n{names}\nend_header\n"
    )
    return head.encode() + np.column_stack([places, values]).astype("<f4").tobytes()
