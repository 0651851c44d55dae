"""Compressed streams, read to their end: only there stand the checksum and the length that show damage."""

import gzip
import zlib
from pathlib import Path
from typing import IO

from igps.mesh.errors import MeshError

_BLOCK = 1 << 20  # bytes that are held at a time
_GZIP_OR_ZLIB = 47  # window bits: the header of the stream tells which of the two it is


def check_gzip(path: Path, n_expected: int, *, start: int = 0, n_more: int = 0) -> None:
    """Raise a MeshError unless a gzip stream is undamaged and holds the expected bytes.

    Args:
        n_expected: least number of unpacked bytes.
        start: place in the file where the stream begins.
        n_more: bytes that may follow the expected ones.
    """
    with path.open("rb") as file:
        file.seek(start)
        stream = gzip.GzipFile(fileobj=file)
        n_unpacked = check_rest(stream, path, n_expected + n_more)
    if n_unpacked < n_expected:
        raise _wrong_length(path, n_expected, str(n_unpacked))


def check_rest(stream: gzip.GzipFile, path: Path, n_more: int) -> int:
    """Return how many bytes follow in a gzip stream; a MeshError if it is damaged, or they are too many."""
    start = stream.tell()
    try:
        while stream.read(_BLOCK):
            if stream.tell() > start + n_more:
                raise _wrong_length(path, start + n_more, "more")
    except (OSError, EOFError, zlib.error) as error:
        raise _damaged(path, error) from error
    return stream.tell() - start


def check_zlib(stream: IO[bytes], path: Path, n_expected: int) -> int:
    """Return the number of bytes of a zlib or gzip stream; a MeshError if it is damaged or has another length."""
    inflater = zlib.decompressobj(wbits=_GZIP_OR_ZLIB)
    n_packed = 0
    n_unpacked = 0
    while not inflater.eof:
        packed = inflater.unconsumed_tail
        if not packed:
            packed = stream.read(_BLOCK)
            n_packed += len(packed)
        if not packed:
            raise _damaged(path, "it is cut short")
        try:
            n_unpacked += len(inflater.decompress(packed, _BLOCK))
        except zlib.error as error:
            raise _damaged(path, error) from error
        if n_unpacked > n_expected:
            raise _wrong_length(path, n_expected, "more")
    if n_unpacked < n_expected:
        raise _wrong_length(path, n_expected, str(n_unpacked))
    return n_packed - len(inflater.unused_data)


def _damaged(path: Path, error: object) -> MeshError:
    return MeshError(
        f"{path}: its compressed data is damaged ({error}). Copy the file again, or export it again."
    )


def _wrong_length(path: Path, n_expected: int, got: str) -> MeshError:
    fault = f"{path}: its compressed data unpacks to {got} bytes, expected {n_expected}"
    return MeshError(f"{fault}. Copy the file again, or export it again.")
