"""Arrays of numbers in XML files, as text, base64 or compressed: no more is unpacked than what their sizes promise."""

from __future__ import annotations

import base64
import lzma
import zlib

import numpy as np
from numpy.typing import NDArray


def from_text(text: str, kind: np.dtype) -> NDArray[np.generic]:
    """Numbers separated by white space."""
    return np.array(text.split(), dtype="U").astype(kind) if text.split() else np.zeros(0, kind)


def from_base64(text: str) -> bytes:
    """Bytes, white space passed over."""
    return base64.b64decode("".join(text.split()), validate=True)


def inflated(content: bytes, n_bytes: int, name: str = "zlib") -> bytes:
    """Exactly so many bytes of a compressed block.

    Raises:
        ValueError: there are more, or fewer.
    """
    if name == "lzma":
        unpacked = lzma.LZMADecompressor().decompress(content, n_bytes + 1)
    else:
        unpacked = zlib.decompressobj(wbits=47).decompress(content, n_bytes + 1)  # with a header of zlib or gzip
    if len(unpacked) != n_bytes:
        raise ValueError(f"a block unpacks to {len(unpacked)} bytes or more, not to the {n_bytes} that it announces")
    return unpacked
