"""File formats: what a format is, and which there are.

A format is a module that reads one kind of file. Those of this package lie in `igps.fields`; other packages add
theirs by the entry point `igps.formats`. All are imported when the first file is read.
"""

import importlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from igps.mesh.errors import MeshError
from igps.mesh.options import BodyKind, LoadOptions
from igps.mesh.raw_body import RawBody

FIELDS = ("meshes", "cad", "volumes", "molecules")
"""Packages of `igps.fields`, each with a tuple `FORMATS`, and perhaps `ATTRIBUTES`."""

# The start of messages of ITK, which names a line of its source and the address of an object.
_ITK_PREFIX = re.compile(r"^Exception thrown in SimpleITK .*ERROR: (\w+\(0x\w+\): )?")


@dataclass(frozen=True)
class Format:
    """A file format.

    `read` returns all bodies of a file, with distinct names, or only the body named `part`. It may raise any exception
    if the file is faulty, and defers slow surfaces to `RawBody.make`. "whole" and "pieces" are derived from its result.
    """

    name: str  # used in messages
    suffixes: tuple[str, ...]  # lower case, with the dot; the longest that ends a file name wins
    read: Callable[[Path, LoadOptions, str | None], Sequence[RawBody]]
    bodies: tuple[BodyKind, ...] = ("whole",)  # supported `LoadOptions.bodies`, the default first
    # Whether a search of folders takes files with these suffixes for bodies
    is_searched: bool = True
    ignored: tuple[str, ...] = ()  # suffixes of files of this format that hold no surface
    extra: str | None = None  # the extra of this package that installs the modules `read` needs
    has_triangles: bool = True  # whether the size of a file of one body tells how many there are
    # tells a file of this format whose name ends with no known suffix
    recognises: Callable[[Path], bool] | None = None
    # Finds other files on which the bodies depend
    beside: Callable[[Path, LoadOptions], Sequence[Path]] | None = None
    # Finds the table that names numbered bodies, by the file and `LoadOptions.names`
    names: Callable[[Path, str | None], Path | None] | None = None
    # makes bodies of an object in memory, and returns None for an object that it does not know
    in_memory: Callable[[Any, str, LoadOptions], Sequence[RawBody] | None] | None = None


@cache
def field_packages() -> tuple[ModuleType, ...]:
    """Return the packages of `igps.fields`, without those that are not installed."""
    found = []
    for field in FIELDS:
        name = f"igps.fields.{field}"
        try:
            found.append(importlib.import_module(name))
        except ModuleNotFoundError as error:
            if error.name not in ("igps.fields", name):
                raise
    return tuple(found)


@cache
def all_formats() -> tuple[Format, ...]:
    """Return the formats of this package, and of the entry points `igps.formats` of others.

    An entry point names a `Format` or a tuple of them. Where suffixes are equal, the format that comes last wins.
    """
    known: list[Format] = []
    for field in field_packages():
        known += field.FORMATS
    for entry in entry_points(group="igps.formats"):
        added = entry.load()
        known += (added,) if isinstance(added, Format) else added
    return tuple(known)


def format_of(path: str | Path) -> Format | None:
    """Return the format of a file by the longest known suffix, or else by its first bytes; None if unknown."""
    name = Path(path).name.lower()
    if any(name.endswith(kind.ignored) for kind in all_formats()):
        return None
    longest = ""
    best = None
    for kind in all_formats():
        for suffix in kind.suffixes:
            if name.endswith(suffix) and len(suffix) >= len(longest):
                longest = suffix
                best = kind
    if best is not None:
        return best
    for kind in all_formats():
        if kind.recognises is not None and kind.recognises(Path(path)):
            return kind
    return None


def dependencies_of(path: Path, options: LoadOptions = LoadOptions()) -> list[Path]:
    """Return a file and existing others on which its bodies depend; a MeshError if it is too damaged to list them."""
    kind = format_of(path)
    if kind is None or kind.beside is None or not path.is_file():
        return [path]
    with faults(path, kind):
        others = [*kind.beside(path, options), *names_of(path, options)]
        return [path, *(other for other in others if other.is_file())]


def has_numbers(path: Path) -> bool:
    """Return whether the bodies of a file have numbers, like labels, besides the names that a table gives them."""
    kind = format_of(path)
    return kind is not None and kind.names is not None


def names_of(path: Path, options: LoadOptions) -> list[Path]:
    """Return the table that names the bodies of a file; none if there is no table, or the format has no numbers."""
    kind = format_of(path)
    if kind is None or kind.names is None:
        return []
    table = kind.names(path, options.names)
    return [] if table is None else [table]


def is_searched(path: str | Path) -> bool:
    """Return whether a file of this name is taken for a body when a folder is searched."""
    kind = format_of(path)
    return kind is not None and kind.is_searched


def searched_suffixes() -> list[str]:
    """Return the suffixes of files that are taken for bodies when a folder is searched, sorted."""
    suffixes: list[str] = []
    for kind in all_formats():
        if kind.is_searched:
            suffixes += kind.suffixes
    return sorted(suffixes)


def stat_key(*paths: Path) -> tuple[int, int, int]:
    """Return the total size of files in bytes, and their latest mtime and ctime in nanoseconds."""
    stats = [os.stat(path) for path in paths]
    return (
        sum(s.st_size for s in stats),
        max(s.st_mtime_ns for s in stats),
        max(s.st_ctime_ns for s in stats),
    )


@contextmanager
def faults(path: object, kind: Format) -> Iterator[None]:
    """Turn exceptions of a reader, other than MemoryError, into a MeshError that names the file or body at `path`."""
    try:
        yield
    except (MeshError, MemoryError):
        raise
    except ImportError as error:
        missing = f"{path}: {kind.name} needs a module that is not installed ({error})."
        install = f'Install it: pip install "interior-gps[{kind.extra}]"; or convert the file to OFF, OBJ, PLY or STL.'
        raise MeshError(f"{missing} {install}") from error
    except Exception as error:  # the loaders of some thirty formats raise whatever they like
        words = " ".join(str(error).split())
        words = _ITK_PREFIX.sub("", words)[:300]
        fault = f"{path}: not readable as {kind.name} ({type(error).__name__}: {words})."
        remedy = "Check that the file is complete and that its suffix names its format, or export it again."
        raise MeshError(f"{fault} {remedy}") from error
