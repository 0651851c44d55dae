"""Formats: a file becomes bodies. Each has a module, and `FORMATS` lists them.

**To add a format**, write a module here with a function `read(path, options, part)` that returns a list of `RawBody`
and raises anything where the file is faulty; make it a `Format` with its suffixes; and add that to `FORMATS` below.
The rest is done for it: error messages that name the file, "whole" and "pieces", mending, listing, caching. What a
header claims is checked before memory is taken (`check_unpacked`), modules that not everybody has are imported within
`read`, no path that the file holds leads out of its folder, and other files that it reads are told by `Format.beside`.
"""

from pathlib import Path

from igps.mesh._label_measures import LabelVoxels, VoxelMeasures
from igps.mesh.formats import archives, brains, clouds, molecules, obj, off, ply, scenes, stl, threemf, volumes, vtk
from igps.mesh.formats._format import Format, RawBody, faults, stamp_of
from igps.mesh.options import LoadOptions

__all__ = [
    "FORMATS", "Format", "LabelVoxels", "RawBody", "VoxelMeasures", "files_read", "format_of", "is_searched",
    "searched_suffixes", "stamp_of",
]  # fmt: skip

FORMATS: tuple[Format, ...] = (
    off.FORMAT, obj.FORMAT, ply.FORMAT, stl.FORMAT, clouds.FORMAT, threemf.FORMAT, scenes.GLTF, scenes.STEP,
    scenes.OTHERS, vtk.LEGACY, vtk.XML, brains.GIFTI, brains.FREESURFER, volumes.FORMAT,
    molecules.FORMAT, archives.ARCHIVE, archives.COMPRESSED,
)  # fmt: skip


def format_of(path: str | Path) -> Format | None:
    """The format whose suffix ends the file's name, the longest of several; None if there is none."""
    name = Path(path).name.lower()
    found = [(len(suffix), kind) for kind in FORMATS for suffix in kind.suffixes if name.endswith(suffix)]
    ignored = any(name.endswith(suffix) for kind in FORMATS for suffix in kind.ignored)
    return None if ignored or not found else max(found, key=lambda one: one[0])[1]


def files_read(path: Path, options: LoadOptions = LoadOptions()) -> list[Path]:
    """All files on which the bodies of a file depend, as far as they are there: itself first.

    A MeshError of a file that cannot be read far enough to tell.
    """
    kind = format_of(path)
    if kind is None or kind.beside is None or not path.is_file():
        return [path]
    with faults(path, kind):
        return [path, *(one for one in kind.beside(path, options) if one.is_file())]


def is_searched(path: str | Path) -> bool:
    """Whether a file of this name is read where it lies in a folder."""
    found = format_of(path)
    return found is not None and found.is_searched


def searched_suffixes() -> list[str]:
    """The suffixes of files that are read where they lie in a folder, sorted."""
    return sorted(suffix for kind in FORMATS if kind.is_searched for suffix in kind.suffixes)
