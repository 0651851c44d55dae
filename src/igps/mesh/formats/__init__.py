"""File formats: each module reads one kind of file, and `FORMATS` lists them.

**To add a format**, write a module here with a function `read(path, options, part)` that returns a list of `RawBody`
and raises any exception if the file is faulty. Make a `Format` of it, with the suffixes of its files, and add that
`Format` to `FORMATS` below. Error messages that name the file, the bodies "whole" and "pieces", mending, listing and
caching then work without further code. A reader checks declared sizes before it takes memory for them
(`check_unpacked`), imports optional dependencies within `read`, and refuses paths in the file that lead out of its
folder. `Format.beside` lists the other files that it reads.
"""

from pathlib import Path

from igps.mesh._label_measures import LabelVoxels, VoxelMeasures
from igps.mesh.formats import (
    archives,
    brains,
    clouds,
    molecules,
    obj,
    off,
    ply,
    scenes,
    stl,
    threemf,
    volumes,
    vtk,
)
from igps.mesh.formats._format import Format, RawBody, faults, stat_key
from igps.mesh.options import LoadOptions

__all__ = [
    "FORMATS",
    "Format",
    "LabelVoxels",
    "RawBody",
    "VoxelMeasures",
    "dependencies_of",
    "format_of",
    "is_searched",
    "searched_suffixes",
    "stat_key",
]

FORMATS: tuple[Format, ...] = (
    off.FORMAT,
    obj.FORMAT,
    ply.FORMAT,
    stl.FORMAT,
    clouds.FORMAT,
    threemf.FORMAT,
    scenes.GLTF,
    scenes.STEP,
    scenes.OTHERS,
    vtk.LEGACY,
    vtk.XML,
    brains.GIFTI,
    brains.FREESURFER,
    volumes.FORMAT,
    molecules.FORMAT,
    archives.ARCHIVE,
    archives.COMPRESSED,
)


def format_of(path: str | Path) -> Format | None:
    """Return the format of a file by the longest known suffix, or else by its first bytes; None if unknown."""
    name = Path(path).name.lower()
    if any(name.endswith(kind.ignored) for kind in FORMATS):
        return None
    matches = {
        suffix: kind for kind in FORMATS for suffix in kind.suffixes if name.endswith(suffix)
    }
    if matches:
        return matches[max(matches, key=len)]
    for kind in FORMATS:
        if kind.recognises is not None and kind.recognises(Path(path)):
            return kind
    return None


def dependencies_of(path: Path, options: LoadOptions = LoadOptions()) -> list[Path]:
    """Return a file and existing others on which its bodies depend; a MeshError if it is too damaged to list them."""
    kind = format_of(path)
    if kind is None or kind.beside is None or not path.is_file():
        return [path]
    with faults(path, kind):
        return [path, *(other for other in kind.beside(path, options) if other.is_file())]


def is_searched(path: str | Path) -> bool:
    """Return whether a file of this name is taken for a body when a folder is searched."""
    kind = format_of(path)
    return kind is not None and kind.is_searched


def searched_suffixes() -> list[str]:
    """Return the suffixes of files that are taken for bodies when a folder is searched, sorted."""
    return sorted(suffix for kind in FORMATS if kind.is_searched for suffix in kind.suffixes)
