"""Images and grids of values around bodies, as arrays with affines."""

import gzip
import math
import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats
from igps.fields.volumes import _volume_files
from igps.fields.volumes._streams import check_gzip
from igps.mesh.errors import MeshError
from igps.mesh.limits import check_fits

MAPS = (".mrc", ".map", ".ccp4", ".mrc.gz", ".map.gz", ".ccp4.gz")
"""Suffixes of density maps."""

_GRIDS = (".dx", *MAPS)
SUFFIXES = (*_volume_files.READERS, *_GRIDS)
# Of a value, by the mode of an MRC map (MRC2014)
_MODE_BYTES = {
    0: 1,
    1: 2,
    2: 4,
    4: 8,
    6: 2,
    12: 2,
}


@lru_cache(maxsize=1)
def read(path: Path, changed: tuple[int, int, int]) -> tuple[NDArray[Any], Floats]:
    """Return the values (X, Y, Z) of an image or grid, and the affine (4, 4) from voxels to coordinates.

    NIfTI, MGH, NRRD, MetaImage and TIFF are in world coordinates (RAS, millimetres), OpenDX, MRC and CCP4 in ångström.
    The last file is cached; `changed`, its `stat_key`, is part of the cache key.
    """
    if path.name.lower().endswith(_GRIDS):
        return (_read_dx if path.suffix.lower() == ".dx" else _read_map)(path)
    volume = _volume_files.read_raw(path)
    return volume.layers[0], volume.affine


def _read_dx(path: Path) -> tuple[NDArray[Any], Floats]:
    """Read an OpenDX file as APBS writes it. GridDataFormats is not used: it hangs on truncated files."""
    text = path.read_bytes()
    head, _, body = text.partition(b"data follows")
    triple = rb"\s+(\S+)\s+(\S+)\s+(\S+)"
    counts = re.search(rb"gridpositions\s+counts" + triple, head)
    origin = re.search(rb"origin" + triple, head)
    deltas = re.findall(rb"delta" + triple, head)
    if counts is None or origin is None or len(deltas) != 3:
        raise MeshError(
            f"{path}: expected counts, origin and three deltas of an OpenDX grid. Export it again."
        )
    sizes = [int(n) for n in counts.groups()]
    n_values = math.prod(sizes)
    if min(sizes) < 2 or n_values > len(body):  # a value takes at least a byte
        raise MeshError(
            f"{path}: declares {sizes} values, got {len(body)} bytes of values. Export it again."
        )
    words = body.split(None, n_values)[:n_values]
    if len(words) < n_values:
        raise MeshError(f"{path}: expected {n_values} values, got {len(words)}. Export it again.")
    affine = np.eye(4)
    affine[:3, :3] = np.array(deltas, dtype=float).T
    affine[:3, 3] = np.array(origin.groups(), dtype=float)
    return np.array(words, dtype=np.float32).reshape(sizes), affine


def _read_map(path: Path) -> tuple[NDArray[Any], Floats]:
    try:
        import mrcfile
    except ImportError as error:
        raise ImportError('Maps need mrcfile: pip install "interior-gps[molecules]".') from error
    is_packed = path.name.lower().endswith(".gz")
    with gzip.open(path) if is_packed else path.open("rb") as file:
        head = np.frombuffer(file.read(96), "<i4")
    if len(head) < 24:
        raise MeshError(f"{path}: expected a header of 1024 bytes. Export it again.")
    if not 0 <= head[3] < 256:
        head = head.byteswap()
    n_values = math.prod(map(int, head[:3]))
    value_bytes = _MODE_BYTES.get(int(head[3]), 1)
    extended_header = max(int(head[23]), 0)
    n_expected = 1024 + extended_header + n_values * value_bytes
    n_bytes = n_expected if is_packed else path.stat().st_size
    if min(head[:3]) < 1 or n_bytes < n_expected:
        raise MeshError(f"{path}: expected {n_expected} bytes, got {n_bytes}. Export it again.")
    check_fits(2 * n_expected, f"{path}: the map needs", "Cut out or resample a smaller map.")
    if is_packed:
        check_gzip(path, n_expected)
    with mrcfile.open(path) as file:
        header = file.header
        values = file.data
        if values is None or values.ndim != 3 or not np.allclose(header.cellb.item(), 90):
            raise MeshError(f"{path}: expected a map of three axes at right angles. Resample it.")
        # The axes (1 to 3) of columns, rows and sections; the values are (sections, rows, columns)
        along = [int(header[name]) for name in ("mapc", "mapr", "maps")]
        sides = np.array(file.voxel_size.item(), dtype=float)
        if not (sides > 0).all() or values.dtype.kind == "c":
            kind = "complex numbers" if values.dtype.kind == "c" else f"voxels of {sides} Å"
            raise MeshError(
                f"{path}: expected real numbers in voxels of known size, got {kind}. Export it again."
            )
        starts = np.array([int(header[name]) for name in ("nxstart", "nystart", "nzstart")])
        starts = starts[np.argsort(along)]
        # If a file has both origin and starts, they state the same position, and most programs use the origin
        origin = np.array(header.origin.item(), dtype=float)
        affine = np.eye(4)
        affine[:3, :3] = np.diag(sides)
        affine[:3, 3] = origin if origin.any() else starts * sides
        order = np.argsort(along[::-1])
        return np.array(values.transpose(order)), affine
