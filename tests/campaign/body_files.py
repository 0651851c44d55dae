"""Label volumes, molecules, scenes, and images, grids and vertex values beside bodies, intact or damaged.

Faults that can be named are those of the tests; here bytes and words are damaged at random.
"""

from __future__ import annotations

import gzip
import sys
import tempfile
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import gemmi
import gridData
import nibabel
import numpy as np
import SimpleITK
import tifffile
import trimesh
from damage import broken_bytes
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[1]))
sys.path.append(str(Path(__file__).parents[2]))
from tests.fields.cad.step_files import write_step
from tests.fields.molecules.test_molecules import Atom
from tests.fields.volumes import test_volumes

Array = NDArray[Any]


@dataclass(frozen=True)
class BodyFile:
    """A file of bodies, and the files beside it.

    Args:
        kind: "volume", "molecule", "scene" or "image".
        files: contents by name, the file of the bodies first.
        expected: for each body, by name, the volume, or None for any. None if a second reader provides the expected
            result.
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


def _perhaps_damaged(generator, given, packed=False):
    """Every third file is intact. Of an image, the file beside the body is damaged."""
    if generator.random() < 0.33:
        return given
    return _damaged(generator, given, packed)


def _damaged(generator, given, packed):
    """Damage bytes or words of a file, inside or outside the compression."""
    name = list(given.files)[-1]
    content = given.files[name]
    inside = packed and generator.random() < 0.5
    if inside:
        content = gzip.decompress(content)
    fault, content = broken_bytes(generator, content)
    if inside:
        content = gzip.compress(content, mtime=0)
    return replace(
        given,
        files={**given.files, name: content},
        expected=None,
        story=fault,
    )


# Label volumes.

AFFINE = np.array(
    [
        [-0.8, -0.9, 0.1, 30],
        [-0.6, 1.2, 0, -20],
        [0, 0, 2.5, 10],
        [0, 0, 0, 1],
    ]
)
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
    cell = 1.0 if suffix == "tif" else abs(np.linalg.det(AFFINE[:3, :3]))
    expected = {str(label): cell * float((labels() == label).sum()) for label in LABELS}
    values = labels().astype(np.int32) if suffix == "mgz" else labels()
    files = {f"x.{suffix}": written_volume(suffix, values, AFFINE)}
    whole = BodyFile("volume", files, expected, suffix)
    return _perhaps_damaged(generator, whole, suffix in ("nii.gz", "mgz"))


def written_volume(suffix, values, affine):
    """Write an array in a format."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"x.{suffix}"
        if suffix in ("nii", "nii.gz", "mgz"):
            kind = nibabel.MGHImage if suffix == "mgz" else nibabel.Nifti1Image
            kind(values, affine).to_filename(path)
        elif suffix == "tif":
            tifffile.imwrite(path, np.ascontiguousarray(values.T), photometric="minisblack")
        else:
            image = test_volumes.itk_image(values, affine)
            SimpleITK.WriteImage(image, str(path), useCompression=True)
        return path.read_bytes()


@cache
def segmentation():
    """A DICOM SEG file of the ellipsoids."""
    with tempfile.NamedTemporaryFile(suffix=".dcm") as file:
        masks = test_volumes.masks_of(labels())
        test_volumes.write_segmentation(Path(file.name), masks, list(LABELS.values()), "BINARY")
        return Path(file.name).read_bytes()


def _dicom(generator):
    cell = abs(np.linalg.det(test_volumes.AFFINE[:3, :3]))
    expected = {name: cell * float((labels() == label).sum()) for label, name in LABELS.items()}
    whole = BodyFile("volume", {"x.dcm": segmentation()}, expected, "dcm")
    return _perhaps_damaged(generator, whole)


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
                atom = Atom(serial, name, *at, residue, chain, place=f"{i + 1:>4} ")
                lines.append(atom.line().rstrip())
        lines.append("TER")
    return tuple(lines)


def _molecule(generator):
    suffix = str(generator.choice(["pdb", "pdb.gz", "cif", "ent"]))
    text = "\n".join(helices()) + "\n"
    if suffix == "cif":
        text = gemmi.read_pdb_string(text).make_mmcif_document().as_string()
    return _text_molecule(generator, f"x.{suffix}", text)


def _text_molecule(generator, name, text):
    content = text.encode()
    packed = name.endswith(".gz")
    if packed:
        content = gzip.compress(content, mtime=0)
    expected = {"chain A": None, "chain B": None}
    whole = BodyFile("molecule", {name: content}, expected, name)
    return _perhaps_damaged(generator, whole, packed)


def _pqr(generator):
    """A PQR file: words separated by spaces, with charges and radii in the last columns."""
    lines = []
    for number, line in enumerate(x for x in helices() if x.startswith("ATOM")):
        charge = 0.1 * (-1) ** number
        words = f"{line[6:11]} {line[12:16]} {line[17:20]} {line[21]} {line[22:26]} {line[30:54]}"
        lines.append(f"ATOM {words} {charge:.4f} 1.80")
    name = str(generator.choice(["x.pqr", "x.pqr.gz"]))
    return _text_molecule(generator, name, "\n".join([*lines, ""]))


# Scenes and CAD files.


def _scene(generator):
    boxes = {
        "shaft": (1.0, 2.0, 3.0),
        "wheel": (2.0, 2.0, 1.0),
        "plate": (4.0, 3.0, 0.5),
    }
    suffix = str(generator.choice(["step", "glb"]))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"x.{suffix}"
        if suffix == "step":
            write_step(
                path,
                {name: [((0, 0, 0), side)] for name, side in boxes.items()},
            )
        else:
            scene = trimesh.Scene()
            for i, (name, sides) in enumerate(boxes.items()):
                mirror = np.diag([(-1) ** i, 1, 1, 1])
                names = {"node_name": name, "geom_name": name}
                scene.add_geometry(trimesh.creation.box(sides), transform=mirror, **names)
            scene.export(path)
        content = path.read_bytes()
    expected = {name: float(np.prod(sides)) for name, sides in boxes.items()}
    whole = BodyFile("scene", {path.name: content}, expected, suffix, {"bodies": "objects"})
    return _perhaps_damaged(generator, whole)


# Images beside bodies.


def field_at(points):
    """Values of the image at points (P, 3)."""
    return 100 + points @ np.array([2.0, -3.0, 1.0])


def _image(generator):
    suffix = str(generator.choice(["nii.gz", "nrrd", "mha", "nii"]))
    affine = np.diag([-0.5, 0.6, 0.4, 1.0])
    shape = np.array([24, 20, 30])
    affine[:3, 3] = -affine[:3, :3] @ ((shape - 1) / 2)
    index = np.stack(np.indices(tuple(shape)), axis=-1)
    values = field_at(index @ affine[:3, :3].T + affine[:3, 3]).astype(np.float32)
    content = written_volume(suffix, values, affine)
    return _beside_a_ball(generator, suffix, content, suffix == "nii.gz")


def _beside(generator):
    """A grid or values at vertices, beside a ball."""
    suffix = str(generator.choice(["dx", "mrc", "map", "ply", "vtk", "shape.gii", "curv"]))
    write = _grid if suffix in ("dx", "mrc", "map") else _at_vertices
    return _beside_a_ball(generator, suffix, write(suffix))


def _ball():
    return trimesh.creation.icosphere(subdivisions=2, radius=3.0)


def _beside_a_ball(generator, suffix, content, packed=False):
    body = trimesh.exchange.off.export_off(_ball(), digits=9).encode()
    files = {"x.off": body, f"x.{suffix}": content}
    whole = BodyFile("image", files, {"linear": 0.0}, suffix)
    return _perhaps_damaged(generator, whole, packed)


def _grid(suffix):
    side = np.array([0.5, 0.6, 0.4])
    shape = np.array([17, 15, 21])
    origin = -side * (shape - 1) / 2
    places = np.stack(np.indices(tuple(shape)), axis=-1) * side + origin
    grid = gridData.Grid(field_at(places), origin=origin, delta=side)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("x.dx" if suffix == "dx" else "x.mrc")
        grid.export(str(path))
        return path.read_bytes()


def _at_vertices(suffix):
    """A file of values at vertices. GIFTI is written by nibabel, other formats are assembled here."""
    ball = _ball()
    values = field_at(ball.vertices).astype(np.float32)
    if suffix == "shape.gii":
        return nibabel.GiftiImage(darrays=[nibabel.gifti.GiftiDataArray(values)]).to_bytes()
    if suffix == "curv":
        return (
            b"\xff\xff\xff"
            + np.array([len(values), len(ball.faces), 1], ">i4").tobytes()
            + values.astype(">f4").tobytes()
        )
    places = ball.vertices
    if suffix == "vtk":
        rows = [
            "# vtk DataFile Version 3.0",
            "x",
            "ASCII",
            "DATASET POLYDATA",
            f"POINTS {len(places)} float",
        ]
        rows += [" ".join(map(repr, place)) for place in places.tolist()]
        rows += [f"POINT_DATA {len(values)}", "SCALARS value float 1", "LOOKUP_TABLE default"]
        return "\n".join([*rows, *map(repr, values.tolist()), ""]).encode()
    names = "\n".join(f"property float {name}" for name in ("x", "y", "z", "value"))
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(values)}\n{names}\nend_header\n"
    )
    return head.encode() + np.column_stack([places, values]).astype("<f4").tobytes()
