"""Untrusted XML: entities and references to other files are refused, and arrays must unpack to their declared size."""

import lzma
import zlib
from collections.abc import Callable
from typing import Any, Literal
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray


def parse(content: bytes) -> ElementTree.Element:
    """Parse a document into a tree; prefixes of element names are removed."""
    builder = ElementTree.TreeBuilder()
    parser = _parser(builder.start)
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.Parse(content, True)
    return builder.close()


def walk(stream: Any, start: Callable[[str, dict[str, str]], Any]) -> None:
    """Call `start` with the name, without prefix, and the attributes of every element while a document is read."""
    _parser(start).ParseFile(stream)


def _parser(start: Callable[[str, dict[str, str]], Any]) -> expat.XMLParserType:
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.EntityDeclHandler = _refuse
    parser.StartElementHandler = lambda name, attributes: start(name.rpartition(":")[2], attributes)
    return parser


def _refuse(name: str, *_: object) -> None:
    raise ValueError(f"its XML declares the entity {name!r}, which is not allowed")


def from_text(text: str, kind: np.dtype) -> NDArray[np.generic]:
    """Parse numbers separated by white space."""
    return np.array(text.split(), dtype=kind)  # an array of strings would be as wide as the longest


def byte_order(name: str) -> Literal["<", ">"]:
    """Return numpy's sign of a byte order; a ValueError for any other word, which damage may have left."""
    if name == "LittleEndian":
        return "<"
    if name == "BigEndian":
        return ">"
    raise ValueError(f"expected the byte order LittleEndian or BigEndian, got {name[:40]!r}")


def inflated(content: bytes, n_bytes: int, name: str = "zlib") -> bytes:
    """Decompress a block with zlib or lzma; a ValueError unless it is complete and has `n_bytes` bytes.

    A checksum is compared only at the end of the stream, so that one more byte is asked for than expected.
    """
    inflater: Any = lzma.LZMADecompressor()
    if name != "lzma":
        inflater = zlib.decompressobj(wbits=47)  # zlib or gzip by the header
    unpacked: bytes = inflater.decompress(content, n_bytes + 1)
    if len(unpacked) != n_bytes:
        raise ValueError(f"a block unpacks to {len(unpacked)} bytes or more, expected {n_bytes}")
    if not inflater.eof or inflater.unused_data:
        raise ValueError("a compressed block is cut short, or longer than it should be")
    return unpacked
