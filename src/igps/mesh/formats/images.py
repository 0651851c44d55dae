"""Images and grids of values that lie beside bodies, as an array and its place in space."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igps.mesh.formats import _volume_files
from igps.mesh.mesh import MeshError

_GRIDS = (".dx", ".mrc", ".map", ".ccp4")
SUFFIXES = (*_volume_files.READERS, *_GRIDS)
"""Of the files that are read."""

# Bytes of a value by the mode of a map, see the format MRC2014.
_MODES = {0: 1, 1: 2, 2: 4, 4: 8, 6: 2, 12: 2}


@lru_cache(maxsize=1)
def read(path: Path, changed: int) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Values (X, Y, Z) of an image or grid, and the affine (4, 4) from voxels to coordinates.

    NIfTI, MGH, NRRD, MetaImage and TIFF are in world coordinates (RAS, millimetres), OpenDX, MRC and CCP4 in ångström.

    Args:
        path: the file.
        changed: when that was, so that the last file need not be read again.

    Raises:
        MeshError: another format, an image that does not fit into memory, or a file cut short.
        ImportError: a module is missing.
    """
    name = path.name.lower()
    if name.endswith(_GRIDS):
        return _grid(path, "dx" if name.endswith(".dx") else "mrc")
    readers = [suffix for suffix in _volume_files.READERS if name.endswith(suffix)]
    if not readers:
        raise MeshError(f"{path}: not an image that is read. Convert it to one of {', '.join(SUFFIXES)}.")
    volume = _volume_files.READERS[max(readers, key=len)](path)
    return volume.layers[0], volume.affine


def _grid(path: Path, kind: str) -> tuple[NDArray[Any], NDArray[np.float64]]:
    try:
        from gridData import Grid
    except ImportError as error:
        raise ImportError('Grids need GridDataFormats: pip install "interior-gps[molecules]".') from error
    if kind == "mrc":
        head = np.fromfile(path, "<i4", 4)
        head = head.byteswap() if len(head) == 4 and not 0 <= head[3] < 256 else head
        sizes = [int(n) for n in head[:3]]
        needed = 1024 + (sizes[0] * sizes[1] * sizes[2] * _MODES.get(int(head[3]), 1) if len(head) == 4 else 0)
        if len(head) < 4 or min(sizes) < 1 or path.stat().st_size < needed:
            raise MeshError(f"{path}: {path.stat().st_size} of the {needed} bytes that its header announces.")
    grid = Grid(str(path), file_format=kind)
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = np.diag(grid.delta), grid.origin
    return np.asarray(grid.grid), affine
