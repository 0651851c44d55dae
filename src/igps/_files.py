"""Atomic and reproducible writing of files, and reading of text as spreadsheets and editors save it."""

import codecs
import contextlib
import json
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

PARTIAL = ".partial"
"""Suffix of files that are still being written."""


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[IO[bytes]]:
    """Open a temporary file for writing, which replaces `path` in one step when the context ends without an error."""
    # Plain `open` respects the umask; tempfile and safetensors create files that only their owner can read.
    partial = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(8)}{PARTIAL}")
    try:
        with open(partial, "xb") as file:
            yield file
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def sort_metadata(content: bytes) -> bytes:
    """Return a safetensors file with sorted metadata. The library writes them in an order that differs each time."""
    end = 8 + int.from_bytes(content[:8], "little")
    header: dict[str, Any] = json.loads(content[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return b"".join((len(text).to_bytes(8, "little"), text, memoryview(content)[end:]))


def table_text(path: Path) -> str:
    """Read a text file in UTF-8, in UTF-16 with its mark, or else in cp1252, as Windows writes it."""
    content = path.read_bytes()
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16", "replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", "replace")


def delimiter_of(text: str) -> str:
    """Return what separates the columns of a table: a comma, a semicolon or a tab, by its first line."""
    first_line = text.partition("\n")[0]
    return max(",;\t", key=first_line.count)
