"""Images and grids of values that lie beside bodies, as an array and its place in space."""

import math
import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats
from igps.mesh.formats import _volume_files
from igps.mesh.mesh import MeshError

_GRIDS = (".dx", ".mrc", ".map", ".ccp4")
SUFFIXES = (*_volume_files.READERS, *_GRIDS)
"""Of the files that are read."""

# Bytes of a value by the mode of a map, see the format MRC2014.
_MODES = {0: 1, 1: 2, 2: 4, 4: 8, 6: 2, 12: 2}


@lru_cache(maxsize=1)
def read(path: Path, changed: tuple[int, int, int]) -> tuple[NDArray[Any], Floats]:
    """Values (X, Y, Z) of an image or grid, and the affine (4, 4) from voxels to coordinates.

    NIfTI, MGH, NRRD, MetaImage and TIFF are in world coordinates (RAS, millimetres), OpenDX, MRC and CCP4 in ångström.
    The last file is not read again while `changed`, its `stamp_of`, is the same.
    """
    if path.name.lower().endswith(_GRIDS):
        return (_dx if path.suffix.lower() == ".dx" else _map)(path)
    volume = _volume_files.read_raw(path)
    return volume.layers[0], volume.affine


def _dx(path: Path) -> tuple[NDArray[Any], Floats]:
    """Of an OpenDX file, as APBS writes it; GridDataFormats does not return from one that is cut short."""
    text = path.read_bytes()
    head, _, rest = text.partition(b"data follows")
    number = rb"\s+(\S+)\s+(\S+)\s+(\S+)"
    counts, origin = re.search(rb"gridpositions\s+counts" + number, head), re.search(rb"origin" + number, head)
    deltas = re.findall(rb"delta" + number, head)
    if counts is None or origin is None or len(deltas) != 3:
        raise MeshError(f"{path}: expected counts, origin and three deltas of an OpenDX grid. Export it again.")
    sizes = [int(n) for n in counts.groups()]
    needed = math.prod(sizes)
    if min(sizes) < 2 or needed > len(rest):  # a number has a digit
        raise MeshError(f"{path}: announces {sizes} values, and has {len(rest)} bytes of them. Export it again.")
    words = rest.split(None, needed)[:needed]
    if len(words) < needed:
        raise MeshError(f"{path}: {len(words)} of {needed} values are there. Export it again.")
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = np.array(deltas, dtype=float).T, np.array(origin.groups(), dtype=float)
    return np.array(words, dtype=np.float32).reshape(sizes), affine


def _map(path: Path) -> tuple[NDArray[Any], Floats]:
    try:
        import mrcfile
    except ImportError as error:
        raise ImportError('Maps need mrcfile: pip install "interior-gps[molecules]".') from error
    head = np.fromfile(path, "<i4", 4)
    head = head.byteswap() if len(head) == 4 and not 0 <= head[3] < 256 else head
    needed = 1024 + (math.prod(map(int, head[:3])) * _MODES.get(int(head[3]), 1) if len(head) == 4 else 0)
    if len(head) < 4 or min(head[:3]) < 1 or path.stat().st_size < needed:
        raise MeshError(f"{path}: {path.stat().st_size} of {needed} announced bytes are there. Export it again.")
    with mrcfile.open(path) as file:
        header, values = file.header, file.data
        if values is None or values.ndim != 3 or not np.allclose(header.cellb.item(), 90):
            raise MeshError(f"{path}: expected a map of three axes at right angles. Resample it.")
        # Which of x, y and z columns, rows and sections run along; values (sections, rows, columns).
        along = [int(header[name]) for name in ("mapc", "mapr", "maps")]
        sides = np.array(file.voxel_size.item(), dtype=float)
        if not (sides > 0).all() or values.dtype.kind == "c":
            what = "complex numbers" if values.dtype.kind == "c" else f"voxels of {sides} Å"
            raise MeshError(f"{path}: a map of {what}; real numbers in voxels of known size expected. Write it anew.")
        starts = np.array([int(header[name]) for name in ("nxstart", "nystart", "nzstart")])[np.argsort(along)]
        # Of files that have both, most programs take the origin alone: it is the same place said twice
        origin, affine = np.array(header.origin.item(), dtype=float), np.eye(4)
        affine[:3, :3], affine[:3, 3] = np.diag(sides), origin if origin.any() else starts * sides
        return np.array(values.transpose(np.argsort(along[::-1]))), affine
