"""Surfaces of brains: GIFTI, and FreeSurfer's triangle files (lh.pial, ...). Both are in millimetres."""

import base64
import re
from math import prod
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats
from igps.mesh.formats import _xml
from igps.mesh.formats._format import Format, RawBody, check_unpacked
from igps.mesh.options import LoadOptions

_TYPES = {"NIFTI_TYPE_FLOAT32": "f4", "NIFTI_TYPE_FLOAT64": "f8", "NIFTI_TYPE_INT32": "i4", "NIFTI_TYPE_UINT8": "u1"}
_POINTS, _TRIANGLES = "NIFTI_INTENT_POINTSET", "NIFTI_INTENT_TRIANGLE"
_MOST_AXES = 6
_MAGIC = b"\xff\xff\xfe"
# A mark of those whose points are in the coordinates of images.
_IN_SCANNER = np.array([2, 1], ">i4").tobytes()
# Where the end of a surface file of FreeSurfer tells of the volume that the surface was made of.
_AXES = re.compile(rb"^[xyzc]ras\s*=\s*(\S+)\s+(\S+)\s+(\S+)", re.MULTILINE)
_AXES_OF_SURFACES = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_SURFACES = ("pial", "white", "inflated", "orig", "smoothwm", "sphere", "sphere.reg")


def read_gifti(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    root = _xml.parse(path.read_bytes())
    arrays = {
        intent: _array(element, path, options)
        for element in reversed(list(root.iter("DataArray")))  # the first of several stays
        if (intent := element.get("Intent")) in (_POINTS, _TRIANGLES)
    }
    if len(arrays) < 2:
        raise ValueError("no surface in it: it lacks points or triangles; maps of values on a surface have neither")
    return [RawBody(arrays[_POINTS].astype(np.float64), arrays[_TRIANGLES].astype(np.int64), unit="mm")]


def gifti_values(path: Path, options: LoadOptions) -> dict[str, NDArray[np.generic]]:
    """The arrays of values at vertices of a GIFTI file, by their names."""
    found = {}
    for number, element in enumerate(_xml.parse(path.read_bytes()).iter("DataArray"), 1):
        if element.get("Intent") not in (_POINTS, _TRIANGLES):
            names = [one.findtext("Value") for one in element.iter("MD") if one.findtext("Name") == "Name"]
            found[(names or [None])[0] or f"array {number}"] = _array(element, path, options)
    return found


def _array(element: Element, path: Path, options: LoadOptions) -> NDArray[np.generic]:
    if (n_axes := int(element.get("Dimensionality", "2"))) > _MOST_AXES:
        raise ValueError(f"an array of {n_axes} axes, of which GIFTI has {_MOST_AXES} at most")
    shape = [int(element.get(f"Dim{i}", "0")) for i in range(n_axes)]
    kind = np.dtype(_TYPES[element.get("DataType", "")])
    n_bytes = prod(shape) * kind.itemsize
    check_unpacked(n_bytes, path, options.max_unpacked)
    encoding, text = element.get("Encoding"), element.findtext("Data") or ""
    if encoding == "ASCII":
        values = _xml.from_text(text, kind)
    elif encoding in ("Base64Binary", "GZipBase64Binary"):
        content = base64.b64decode("".join(text.split()), validate=True)
        content = _xml.inflated(content, n_bytes) if encoding.startswith("GZip") else content
        values = np.frombuffer(content, kind.newbyteorder("<" if element.get("Endian") == "LittleEndian" else ">"))
    else:
        raise ValueError(f"its numbers are encoded as {encoding}, which is not read")
    by_columns = element.get("ArrayIndexingOrder") == "ColumnMajorOrder"
    return values.reshape(shape[::-1]).T if by_columns else values.reshape(shape)


def read_freesurfer(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    content = path.read_bytes()
    at = content.find(b"\n\n") + 2  # behind a line that tells who made it
    if not content.startswith(_MAGIC) or at < 2:
        raise ValueError("not a triangle file of FreeSurfer")
    n_vertices, n_faces = (int(n) for n in np.frombuffer(content, ">i4", 2, at))
    needed, there = 12 * (n_vertices + n_faces), len(content) - at - 8
    if min(n_vertices, n_faces) < 0 or there < needed:
        raise ValueError(f"{n_vertices} vertices and {n_faces} triangles announced, {there} of {needed} bytes there")
    vertices = np.frombuffer(content, ">f4", 3 * n_vertices, at + 8).astype(np.float64)
    faces = np.frombuffer(content, ">i4", 3 * n_faces, at + 8 + 12 * n_vertices).astype(np.int64)
    return [RawBody(vertices.reshape(-1, 3), faces.reshape(-1, 3), unit="mm")]


def in_scanner(path: Path, points: Floats) -> Floats:
    """Points (P, 3) of the body of a file in the coordinates of images.

    Points of FreeSurfer's triangle files have their origin in the middle of a volume, whose place and axes are written
    at the end of the file. Those of other files are in the coordinates of images already.
    """
    if not path.name.lower().endswith(FREESURFER.suffixes):
        return points
    content = path.read_bytes()
    at = content.find(b"\n\n") + 2
    tail = content[at + 8 + 12 * int(np.frombuffer(content, ">i4", 2, at).sum()) :]
    told = np.array(_AXES.findall(tail), dtype=np.float64)
    if told.shape != (4, 3) or not re.search(rb"valid\s*=\s*1", tail) or tail[:8] == _IN_SCANNER:
        return points
    return points @ _AXES_OF_SURFACES.T @ told[:3] + told[3]


GIFTI = Format("GIFTI", (".gii",), read_gifti, ignored=(".func.gii", ".label.gii", ".shape.gii", ".time.gii"))
FREESURFER = Format(
    "FreeSurfer", tuple(f"{side}.{kind}" for side in ("lh", "rh") for kind in _SURFACES), read_freesurfer
)
