"""XML from strangers: no entities, no other files, and arrays that unpack to no more than they announce."""

import lzma
import zlib
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray


def parse(content: bytes) -> ElementTree.Element:
    """The tree of a document, with names without prefixes."""
    builder = ElementTree.TreeBuilder()
    parser = _parser(lambda name, attributes: builder.start(name, attributes))
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.Parse(content, True)
    return builder.close()


def walk(stream: Any, start: Callable[[str, dict[str, str]], Any]) -> None:
    """Call `start` with the name, without prefix, and the attributes of every element of a document, as it is read."""
    _parser(start).ParseFile(stream)


def _parser(start: Callable[[str, dict[str, str]], Any]) -> expat.XMLParserType:
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.EntityDeclHandler = _refuse
    parser.StartElementHandler = lambda name, attributes: start(name.rpartition(":")[2], attributes)
    return parser


def _refuse(name: str, *_: object) -> None:
    raise ValueError(f"its XML declares the entity {name!r}, which such files do without")


def from_text(text: str, kind: np.dtype) -> NDArray[np.generic]:
    """Numbers separated by white space."""
    return np.array(text.split(), dtype=kind)  # as an array of words it would be as wide as the longest


def inflated(content: bytes, n_bytes: int, name: str = "zlib") -> bytes:
    """The bytes of a compressed block; a ValueError if they are not as many as expected."""
    if name == "lzma":
        unpacked = lzma.LZMADecompressor().decompress(content, n_bytes + 1)
    else:
        unpacked = zlib.decompressobj(wbits=47).decompress(content, n_bytes + 1)  # with a header of zlib or gzip
    if len(unpacked) != n_bytes:
        raise ValueError(f"a block unpacks to {len(unpacked)} bytes or more, not to the {n_bytes} that it announces")
    return unpacked
