"""Archives and compressed files: unpacked to a temporary folder, up to the allowed size, and read there."""

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

from igps.mesh.errors import MeshError
from igps.mesh.formats import Format, faults, format_of
from igps.mesh.limits import check_unpacked
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody, joined

_BLOCK = 1 << 20  # bytes
_OPENERS: dict[str, Any] = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Return a body, named by its path in the archive, for each file in a known format."""
    bodies = []
    with tempfile.TemporaryDirectory() as folder:
        for name, unpacked in _unpack(path, Path(folder), options):
            try:
                inner = []
                if part in (None, name):
                    inner = _read_unpacked(unpacked, path, options, None)
                if inner:
                    bodies.append(replace(joined(inner), part=name))
            except MeshError as fault:
                if options.bodies != "objects":  # otherwise the whole would be incomplete
                    raise
                bodies.append(RawBody(part=name, fault=fault))
    if not bodies:
        raise ValueError("no surface in it")
    return bodies


def read_compressed(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    with tempfile.TemporaryDirectory() as folder:
        unpacked = Path(folder) / path.stem
        with _OPENERS[path.suffix.lower()](path) as stream:
            _copy(_LimitedStream(stream, path, options), unpacked)
        bodies = _read_unpacked(unpacked, path, options, part)
    if not bodies:
        raise ValueError(f"{path.stem} has no suffix of a known format")
    return bodies


def _read_unpacked(
    unpacked: Path, path: Path, options: LoadOptions, part: str | None
) -> list[RawBody]:
    """Read the bodies of a file unpacked from `path`; none if its format is unknown or is that of an archive."""
    kind = format_of(unpacked)
    if kind is None or not kind.is_searched:
        return []
    try:
        with faults(unpacked, kind):
            return list(kind.read(unpacked, options, part))
    except MeshError as error:
        raise MeshError(str(error).replace(str(unpacked), f"{path}: {unpacked.name}")) from error


def _unpack(path: Path, folder: Path, options: LoadOptions) -> list[tuple[str, Path]]:
    """Unpack an archive, without links, hidden files and paths out of the folder; return names and unpacked files."""
    files = []
    with _members(path, options) as members:
        for name, stream in members:
            member = PurePosixPath(name.replace("\\", "/"))
            # Outside of the folder if the name begins with a slash, or a drive of Windows
            target = folder / member
            # Parts with a leading dot are "..", or hidden: macOS adds hidden files with the suffixes of the others
            is_inside = target.is_relative_to(folder) and not any(
                part.startswith(".") for part in member.parts
            )
            if is_inside and member.name:
                target.parent.mkdir(parents=True, exist_ok=True)
                _copy(stream, target)
                files.append((name, target))
    return files


@contextmanager
def _members(path: Path, options: LoadOptions) -> Iterator[Iterator[tuple[str, IO[bytes]]]]:
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            files = [info for info in archive.infolist() if not info.is_dir()]
            # The module reads no more of a member than its declared size
            check_unpacked(sum(info.file_size for info in files), path, options.max_unpacked)
            yield ((info.filename, archive.open(info)) for info in files)
        return
    suffix = path.suffix.lower()
    opener = _OPENERS.get({".tgz": ".gz", ".tbz2": ".bz2", ".txz": ".xz"}.get(suffix, suffix), open)
    with (
        opener(path, "rb") as stream,
        tarfile.open(fileobj=_LimitedStream(stream, path, options), mode="r|") as packed,
    ):
        yield (
            (info.name, file)
            for info in packed
            if info.isreg() and (file := packed.extractfile(info))
        )
        # Behind the last member stand the checksums of the compressed stream.
        while stream.read(_BLOCK):
            pass


class _LimitedStream(io.RawIOBase):
    """A stream that raises a MeshError once more bytes than allowed are read."""

    def __init__(self, stream: Any, path: Path, options: LoadOptions) -> None:
        self._stream = stream
        self._path = path
        self._limit = options.max_unpacked
        self._n_read = 0

    def read(self, size: int = -1) -> bytes:
        content = bytes(
            self._stream.read(min(size, self._limit + 1) if size >= 0 else self._limit + 1)
        )
        self._n_read += len(content)
        check_unpacked(self._n_read, self._path, self._limit)
        return content


def _copy(stream: Any, target: Path) -> None:
    with target.open("wb") as out:
        shutil.copyfileobj(stream, out)


_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tbz2", ".tar.xz", ".txz")
ARCHIVE = Format("an archive", _SUFFIXES, read, bodies=("whole", "objects"), is_searched=False)
COMPRESSED = Format("a compressed file", tuple(_OPENERS), read_compressed, is_searched=False)
