"""Archives and compressed files: unpacked to a folder of their own, as far as is allowed, and read there."""

import bz2
import gzip
import io
import lzma
import shutil
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import IO, Any

from igps.mesh.formats._format import Format, RawBody, check_unpacked, faults, joined
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions

_OPENERS: dict[str, Any] = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """A body for each file that is one, by its name."""
    bodies = []
    with tempfile.TemporaryDirectory() as folder:
        for name, place in _unpacked(path, Path(folder), options):
            try:
                if part in (None, name) and (found := _inside(place, path, options, None)):
                    bodies.append(replace(joined(found), part=name))
            except MeshError as fault:
                if options.bodies != "objects":  # the whole would lack it
                    raise
                bodies.append(RawBody(part=name, fault=fault))
    if not bodies:
        raise ValueError("no surface in it")
    return bodies


def read_compressed(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / path.stem
        with _OPENERS[path.suffix.lower()](path) as stream:
            _copy(_Counted(stream, path, options), place)
        found = _inside(place, path, options, part)
    if not found:
        raise ValueError(f"{path.stem} has no suffix of a format that is known")
    return found


def _inside(place: Path, path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """What an unpacked file holds; nothing if it is none of a body."""
    from igps.mesh.formats import format_of

    kind = format_of(place)
    if kind is None or not kind.is_searched:
        return []
    try:
        with faults(place, kind):
            return list(kind.read(place, options, part))
    except MeshError as error:
        raise MeshError(str(error).replace(str(place), f"{path}: {place.name}")) from error


def _unpacked(path: Path, folder: Path, options: LoadOptions) -> list[tuple[str, Path]]:
    """The names of the files in an archive, and where they are now; without links, hidden files and paths out of it."""
    found = []
    with _members(path, options) as members:
        for name, stream in members:
            inside = PurePosixPath(name.replace("\\", "/"))
            place = folder / inside  # elsewhere, of a name that begins with a slash, or on Windows with a drive
            if not place.is_relative_to(folder) or any(one.startswith(".") for one in inside.parts) or not inside.name:
                continue  # a Mac adds a hidden file of the same suffix to each
            place.parent.mkdir(parents=True, exist_ok=True)
            _copy(stream, place)
            found.append((name, place))
    return found


@contextmanager
def _members(path: Path, options: LoadOptions) -> Iterator[Iterator[tuple[str, IO[bytes]]]]:
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            files = [one for one in archive.infolist() if not one.is_dir()]
            check_unpacked(sum(one.file_size for one in files), path, options.max_unpacked)  # no more is read of any
            yield ((one.filename, archive.open(one)) for one in files)
        return
    last = path.suffix.lower()
    opener = _OPENERS.get({".tgz": ".gz", ".tbz2": ".bz2", ".txz": ".xz"}.get(last, last), open)
    with opener(path, "rb") as stream, tarfile.open(fileobj=_Counted(stream, path, options), mode="r|") as packed:
        yield ((one.name, file) for one in packed if one.isreg() and (file := packed.extractfile(one)))


class _Counted(io.RawIOBase):
    """A stream that gives no more than is allowed."""

    def __init__(self, stream: Any, path: Path, options: LoadOptions) -> None:
        self._stream, self._path, self._limit, self._n_read = stream, path, options.max_unpacked, 0

    def read(self, size: int = -1) -> bytes:
        content = bytes(self._stream.read(min(size, self._limit + 1) if size >= 0 else self._limit + 1))
        self._n_read += len(content)
        check_unpacked(self._n_read, self._path, self._limit)
        return content


def _copy(stream: Any, place: Path) -> None:
    with place.open("wb") as out:
        shutil.copyfileobj(stream, out)


ARCHIVE = Format(
    "an archive",
    (".zip", ".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tbz2", ".tar.xz", ".txz"),
    read,
    bodies=("whole", "objects"),
    is_searched=False,
)
COMPRESSED = Format("a compressed file", tuple(_OPENERS), read_compressed, is_searched=False)
