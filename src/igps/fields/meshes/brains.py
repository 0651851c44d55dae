"""Surfaces of brains in GIFTI and in FreeSurfer's triangle files (lh.pial, ...), both in millimetres."""

import base64
import re
from math import prod
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats
from igps.fields.meshes import _xml
from igps.mesh.formats import Format
from igps.mesh.limits import check_unpacked
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody

_TYPES = {
    "NIFTI_TYPE_FLOAT32": "f4",
    "NIFTI_TYPE_FLOAT64": "f8",
    "NIFTI_TYPE_INT32": "i4",
    "NIFTI_TYPE_UINT8": "u1",
}
_POINTS = "NIFTI_INTENT_POINTSET"
_TRIANGLES = "NIFTI_INTENT_TRIANGLE"
_MAX_AXES = 6
_MAGIC = b"\xff\xff\xfe"
# Behind the triangles if the points are in the coordinates of images
_SCANNER_TAG = np.array([2, 1], ">i4").tobytes()
# Lines at the end of a FreeSurfer file: axes and centre of the volume from which the surface was made.
_VOLUME_AXES = re.compile(rb"^[xyzc]ras\s*=\s*(\S+)\s+(\S+)\s+(\S+)", re.MULTILINE)
# The axes of that volume in the coordinates of the surface.
_SURFACE_AXES = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_KINDS = ("pial", "white", "inflated", "orig", "smoothwm", "sphere", "sphere.reg")
_SIDES = ("lh.", "rh.")
_SUFFIXES = tuple(side + kind for side in _SIDES for kind in _KINDS)


def read_gifti(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    arrays: dict[str, NDArray[np.generic]] = {}
    for element in _xml.parse(path.read_bytes()).iter("DataArray"):
        intent = element.get("Intent", "")
        if intent in (_POINTS, _TRIANGLES) and intent not in arrays:  # the first of several wins
            arrays[intent] = _array(element, path, options)
    if len(arrays) < 2:
        raise ValueError(
            "no surface in it: expected points and triangles, which maps of values on a surface lack"
        )
    vertices = arrays[_POINTS].astype(np.float64)
    faces = arrays[_TRIANGLES].astype(np.int64)
    return [RawBody(vertices, faces, unit="mm", frame="RAS")]


def gifti_values(path: Path, options: LoadOptions) -> dict[str, NDArray[np.generic]]:
    """Return the arrays of values at vertices of a GIFTI file by name."""
    arrays = {}
    for number, element in enumerate(_xml.parse(path.read_bytes()).iter("DataArray"), 1):
        if element.get("Intent") in (_POINTS, _TRIANGLES):
            continue
        title = None
        for entry in element.iter("MD"):
            if title is None and entry.findtext("Name") == "Name":
                title = entry.findtext("Value")
        arrays[title or f"array {number}"] = _array(element, path, options)
    return arrays


def _array(element: Element, path: Path, options: LoadOptions) -> NDArray[np.generic]:
    n_axes = int(element.get("Dimensionality", "2"))
    if n_axes > _MAX_AXES:
        raise ValueError(f"an array of {n_axes} axes, expected at most {_MAX_AXES}")
    shape = [int(element.get(f"Dim{i}", "0")) for i in range(n_axes)]
    kind = np.dtype(_TYPES[element.get("DataType", "")])
    n_bytes = prod(shape) * kind.itemsize
    check_unpacked(n_bytes, path, options.max_unpacked)
    encoding = element.get("Encoding")
    text = element.findtext("Data") or ""
    if encoding == "ASCII":
        values = _xml.from_text(text, kind)
    elif encoding in ("Base64Binary", "GZipBase64Binary"):
        content = base64.b64decode("".join(text.split()), validate=True)
        if encoding == "GZipBase64Binary":
            content = _xml.inflated(content, n_bytes)
        order = _xml.byte_order(element.get("Endian", ""))
        values = np.frombuffer(content, kind.newbyteorder(order))
    else:
        raise ValueError(f"its numbers are encoded as {encoding}, which is not supported")
    indexing = element.get("ArrayIndexingOrder", "RowMajorOrder")
    if indexing not in ("RowMajorOrder", "ColumnMajorOrder"):
        raise ValueError(f"expected RowMajorOrder or ColumnMajorOrder, got {indexing[:40]!r}")
    if indexing == "ColumnMajorOrder":
        return values.reshape(shape[::-1]).T
    return values.reshape(shape)


def read_freesurfer(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    content = path.read_bytes()
    at = content.find(b"\n\n") + 2  # behind a line about the author
    if not content.startswith(_MAGIC) or at < 2:
        raise ValueError("not a triangle file of FreeSurfer")
    n_vertices, n_faces = np.frombuffer(content, ">i4", 2, at).tolist()
    start = at + 8
    middle = start + 12 * n_vertices
    n_expected = 12 * (n_vertices + n_faces)
    n_bytes = len(content) - start
    if min(n_vertices, n_faces) < 0 or n_bytes < n_expected:
        raise ValueError(
            f"expected {n_vertices} vertices, {n_faces} triangles, {n_expected} bytes, got {n_bytes}"
        )
    vertices = np.frombuffer(content, ">f4", 3 * n_vertices, start).astype(np.float64)
    faces = np.frombuffer(content, ">i4", 3 * n_faces, middle).astype(np.int64)
    return [RawBody(vertices.reshape(-1, 3), faces.reshape(-1, 3), unit="mm", frame="RAS")]


def in_scanner(path: Path, points: Floats) -> Floats:
    """Transform points (P, 3) from the coordinates of a surface file to those of images.

    FreeSurfer's triangle files have their origin in the centre of a volume, whose position and axes stand at the end of
    the file. The points of other files are returned unchanged: they are in the coordinates of images.
    """
    if not path.is_file() or not _has_magic(path):
        return points
    content = path.read_bytes()
    at = content.find(b"\n\n") + 2
    n_rows = int(np.frombuffer(content, ">i4", 2, at).sum())  # of vertices and triangles
    tail = content[at + 8 + 12 * n_rows :]
    geometry = np.array(_VOLUME_AXES.findall(tail), dtype=np.float64)
    is_valid = re.search(rb"valid\s*=\s*1", tail) is not None
    if geometry.shape != (4, 3) or not is_valid or tail[:8] == _SCANNER_TAG:
        return points
    axes = geometry[:3]
    centre = geometry[3]
    return points @ _SURFACE_AXES.T @ axes + centre


def is_freesurfer(path: Path) -> bool:
    """Return whether a file is a surface of FreeSurfer: "lh." or "rh.", any ending, and the first bytes of the format.

    FreeSurfer 7 and FastSurfer write many endings, such as lh.pial.T1 and lh.white.preaparc, and also maps of values
    on the surface (lh.thickness), which begin with other bytes.
    """
    is_named_so = path.name.lower().startswith(_SIDES)
    return is_named_so and path.is_file() and _has_magic(path)


def _has_magic(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


GIFTI = Format(
    "GIFTI", (".gii",), read_gifti, ignored=(".func.gii", ".label.gii", ".shape.gii", ".time.gii")
)
FREESURFER = Format("FreeSurfer", _SUFFIXES, read_freesurfer, recognises=is_freesurfer)
