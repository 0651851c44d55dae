"""Attribute sources that read files, and how a name or a suffix finds its source.

Each field lists its kinds of sources in `ATTRIBUTES` of its package.

A value is missing if the sample lies more than half a voxel outside the image, or if the value is not finite or at
least 10¹⁵ in size. A missing value is replaced by the value of the nearest sample that has one, and the number of
replaced values is logged. If more than a tenth of the values are missing, the body is rejected.
"""

import contextlib
import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from igps._arrays import Floats
from igps.data.added_attributes import AttributeSource
from igps.data.grids import is_known
from igps.data.keys import content_digest
from igps.mesh.errors import MeshError
from igps.mesh.formats import dependencies_of, field_packages, stat_key
from igps.mesh.loading import BodyRef
from igps.mesh.options import LoadOptions

logger = logging.getLogger(__name__)

_MAX_MISSING_SHARE = 0.1


@dataclass(frozen=True)
class FileAttribute(ABC):
    """An attribute from a file whose path is given by a pattern.

    Args:
        path: a pattern, in which {stem} stands for the name of the body's file without suffixes, {file} for its path
            below `root`, and {part} for the name of the body in its file. #NAME at the end selects an array of a file
            with several arrays. The resulting path must lie below `root`.
        root: the folder of relative paths; the folder of the body's file if None.
    """

    path: str
    root: Path | None = None

    def cache_tag(self, body: BodyRef) -> str:
        """Return kind of source, name of the array, and checksum of the file; raise a MeshError if it is missing."""
        file, name = self.file(body)
        files = dependencies_of(file)
        return f"{type(self).__name__} 4 {name} {_checksum(*files, stamp=stat_key(*files))}"

    def __call__(self, body: BodyRef, points: Floats) -> Floats:
        """Return values (P,) or (P, C) at points (P, 3); raise a MeshError if the file cannot be used."""
        file, name = self.file(body)
        try:
            values = self.values(body, file, name, points)
        except MemoryError:
            raise
        except MeshError as error:
            if str(body) in str(error):
                raise
            # The body may be one of thousands
            raise MeshError(f"{body}: its attribute file {error}") from error
        except Exception as error:  # the readers of the formats raise exceptions of many types
            raise MeshError(
                f"{body}: its attribute file {file} is not readable ({type(error).__name__}: "
                f"{' '.join(str(error).split())}). Check that it is complete and that its suffix fits its format."
            ) from error
        return fill_missing(values, points, f"{body}: {file}")

    def reading_by(self, options: LoadOptions) -> Self:
        """Return a source that reads the body's own file by these options, if it does read it."""
        return self

    @abstractmethod
    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        """Return values (P,) or (P, C) at points (P, 3), NaN where they are missing."""

    def files(self, paths: Iterable[Path]) -> set[Path]:
        """Return the attribute files of bodies, see `FileSource`, except for patterns with {part}."""
        files = set()
        for path in paths:
            with contextlib.suppress(MeshError):
                file, _ = self.file(BodyRef(path))
                if file != path:
                    files.add(file)
        return files

    def file(self, body: BodyRef) -> tuple[Path, str]:
        """Return the file of a body and the name of its array, or ""; raise a MeshError if there is no such file."""
        pattern, _, name = self.path.partition("#")
        root = body.path.parent if self.root is None else self.root
        # Links in the path of the folder are resolved only if needed. The file itself may be a link to any place
        locations = (
            (Path(os.path.abspath(body.path)), Path(os.path.abspath(root))),
            (body.path.parent.resolve() / body.path.name, root.resolve()),
        )
        below_root = body.path.name
        for file, folder in locations:
            if file.is_relative_to(folder):
                below_root = file.relative_to(folder).as_posix()
                break
        if Path(pattern).is_absolute():
            fixed, _, _ = pattern.partition("{")
            root = Path(fixed).parent
        values = {
            "{stem}": body.path.name.partition(".")[0],
            "{file}": below_root,
            "{part}": body.part or "",
        }
        for placeholder, value in values.items():
            pattern = pattern.replace(placeholder, value)
        path = root / pattern
        if not path.resolve().is_relative_to(root.resolve()):
            raise MeshError(
                f"{body}: its attribute file {path} lies outside of {root}. Put it into that folder."
            )
        if not path.is_file():
            raise MeshError(
                f"{body}: its attribute file {path} does not exist. Check the pattern {self.path!r}."
            )
        return path, name


@lru_cache(maxsize=1000)
def _checksum(*files: Path, stamp: tuple[int, int, int]) -> str:
    """Return a checksum of files, cached because the many bodies of a volume may share one image."""
    return content_digest(*files).hex()


@dataclass(frozen=True)
class SourceKind:
    """A kind of attribute sources."""

    make: Callable[[str, Path | None], AttributeSource]  # of a name, or of a pattern and its root
    names: tuple[str, ...] = ()  # attributes that the file of a body itself gives
    suffixes: tuple[str, ...] = ()  # of files with values, in lower case; "" for all other files


def attribute_source(path: str, root: Path | None = None) -> AttributeSource:
    """Return the source for the name of an attribute, or for a pattern of paths by its suffix."""
    named = named_source(path)
    if named is not None:
        return named
    file = path.partition("#")[0].lower()
    matches: dict[str, SourceKind] = {}
    for kind in _source_kinds():
        matches |= {suffix: kind for suffix in kind.suffixes if file.endswith(suffix)}
    if not matches:
        raise ValueError(f"attribute: no installed field reads {path!r}. Check its suffix.")
    return matches[max(matches, key=len)].make(path, root)


def named_source(name: str) -> AttributeSource | None:
    """Return the source of an attribute that the file of a body itself gives; None if no field has the name."""
    for kind in _source_kinds():
        if name in kind.names:
            return kind.make(name, None)
    return None


def attribute_names() -> list[str]:
    """Return the names of attributes that the file of a body itself may give."""
    return [name for kind in _source_kinds() for name in kind.names]


def _source_kinds() -> list[SourceKind]:
    return [kind for field in field_packages() for kind in getattr(field, "ATTRIBUTES", ())]


def with_load_options(source: AttributeSource, options: LoadOptions) -> AttributeSource:
    """Return a source that reads the body itself by these options, but with open surfaces closed."""
    if not isinstance(source, FileAttribute):
        return source
    return source.reading_by(replace(options, allow_open=False, mend="auto"))


def attribute_sources(definitions: Sequence[str], root: Path | None) -> dict[str, AttributeSource]:
    """Parse definitions such as ``ct=images/{stem}.nii.gz`` into sources by name; raise a ValueError if invalid."""
    sources = {}
    for text in definitions:
        name, _, path = text.partition("=")
        if not name.isidentifier() or not path or name in sources:
            raise ValueError(
                f"attribute: expected a new name and a path, as in ct={{stem}}.nii.gz, got {text!r}."
            )
        sources[name] = attribute_source(path, root)
    return sources


def fill_missing(values: Floats, points: Floats, label: str) -> Floats:
    """Return values (P,) or (P, C) at points (P, 3), with missing values replaced by those of the nearest point.

    The number of replaced values is logged. A MeshError is raised if more than a tenth of the values are missing.
    """
    known = np.asarray(is_known(values.reshape(len(points), -1)).all(axis=1))
    n_missing = int((~known).sum())
    if n_missing > _MAX_MISSING_SHARE * len(known):
        low = ", ".join(f"{x:.4g}" for x in points.min(axis=0))
        high = ", ".join(f"{x:.4g}" for x in points.max(axis=0))
        raise MeshError(
            f"{label}: has no value at {n_missing} of {len(known)} points of the body, which extends from ({low}) to "
            f"({high}); at most {_MAX_MISSING_SHARE:.0%} of the points may lack a value. Give values of this body, in "
            "the coordinates of its file."
        )
    if n_missing:
        logger.warning(
            "%s: %d of %d values were taken from the nearest point", label, n_missing, len(known)
        )
        _, nearest = cKDTree(points[known]).query(points[~known])
        values = values.copy()
        values[~known] = values[known][nearest]
    return values
