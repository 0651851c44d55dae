"""XML of strangers: it declares no entities, and nothing from elsewhere is read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat


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
