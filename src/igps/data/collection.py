"""A whole collection of Signatures in one file, which travels without its meshes."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from igps.data.cache import checksum, decode, encode
from igps.signature.signature import Signature

_FORMAT = "igps-collection-1"
# A longer header of names is refused by safetensors.
_MOST_HEADER = 100_000_000
_KINDS = {"float64": "F64", "float32": "F32"}


@dataclass(frozen=True)
class About:
    """What a collection tells of itself.

    Args:
        names: of the bodies.
        parts: of their files; None for a file that is one body.
        labels: their classes, or None.
        classes: all names of classes, in the order of their numbers.
        keys: of the Signatures in the cache that they come from.
        reading: how the meshes were read, by the names of `LoadOptions`.
        config: of the Signatures, by the names of `SignatureConfig`.
        columns: what else is known of the bodies, see `Bodies`.
    """

    names: tuple[str, ...]
    parts: tuple[str | None, ...]
    labels: tuple[str, ...] | None
    classes: tuple[str, ...]
    keys: tuple[str, ...]
    reading: dict[str, Any]
    config: dict[str, Any]
    columns: dict[str, tuple[str | None, ...]] = field(default_factory=dict)


def write_collection(path: Path, about: About, signature: Callable[[int], Signature]) -> None:
    """Write a collection, whole or not at all: a safetensors file of the arrays of all Signatures.

    Args:
        path: the file; one that is there is replaced.
        about: N bodies.
        signature: of each, by its number; asked for several times, and not kept.

    Raises:
        ValueError: so many that no reader would take the file.
    """
    n = len(about.names)
    arrays: list[dict[str, tuple[str, tuple[int, ...], int]]] = []
    told = []
    for i in range(n):
        tensors, metadata = encode(signature(i))
        told.append({**metadata, "checksum": checksum(tensors, metadata)})
        arrays.append({name: (values.dtype.name, values.shape, values.nbytes) for name, values in tensors.items()})
    # The format has no gaps, so arrays of longer numbers come first: each then begins where its kind may.
    order = [(i, name) for kind in _KINDS for i in range(n) for name, (its, *_) in arrays[i].items() if its == kind]
    header: dict[str, Any] = {}
    end = 0
    for i, name in order:
        kind, shape, n_bytes = arrays[i][name]
        header[f"{i}.{name}"] = {"dtype": _KINDS[kind], "shape": shape, "data_offsets": (end, end + n_bytes)}
        end += n_bytes
    words = {"format": _FORMAT, "about": json.dumps(vars(about)), "signatures": json.dumps(told)}
    text = json.dumps({"__metadata__": words, **header}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    if len(text) > _MOST_HEADER:
        raise ValueError(f"{path}: {n} bodies are too many for one file. Export parts of the dataset.")
    partial = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(8)}.partial")
    try:
        with open(partial, "xb") as file:
            file.write(len(text).to_bytes(8, "little") + text)
            for (i, _), group in groupby(order, key=lambda one: (one[0], arrays[one[0]][one[1]][0])):
                tensors, _ = encode(signature(i))
                for _, name in group:
                    file.write(tensors[name].data)
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


class CollectionFile:
    """The Signatures of a file that `write_collection` wrote, read by memory map and checked at each reading.

    Reading runs no code. A worker process that is given one opens the file for itself.

    Args:
        path: the file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a collection, or a damaged one.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).absolute()
        if not self.path.is_file():
            raise FileNotFoundError(f"{self.path}: no such file. Check the path.")
        try:
            self._file = safe_open(self.path, framework="pt")
            metadata = self._file.metadata() or {}
            if metadata.get("format") != _FORMAT:
                raise ValueError(f"its format is {metadata.get('format')!r}")
            self.about = _about(json.loads(metadata["about"]))
            self._told: list[dict[str, str]] = json.loads(metadata["signatures"])
            if len(self._told) != len(self.about.names):
                raise ValueError(f"{len(self.about.names)} names for {len(self._told)} signatures")
            names = set(self._file.keys())
        except (SafetensorError, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{self.path}: expected a collection in the format {_FORMAT} ({error}). Export it again."
            ) from error
        self._arrays: list[list[str]] = [[] for _ in self._told]
        for name in sorted(names):
            number, _, array = name.partition(".")
            if number.isdecimal() and int(number) < len(self._told):
                self._arrays[int(number)].append(array)

    def __reduce__(self) -> tuple[type[CollectionFile], tuple[Path]]:
        return CollectionFile, (self.path,)

    def __getitem__(self, index: int) -> Signature:
        """A Signature by its number; its arrays are views of the file.

        Raises:
            ValueError: it is damaged, or of another version of the algorithm.
        """
        metadata = self._told[index]
        try:
            tensors = {name: self._file.get_tensor(f"{index}.{name}").numpy() for name in self._arrays[index]}
            if metadata.get("checksum") != checksum(tensors, metadata):
                raise ValueError("its content is damaged: it does not have the checksum that it was written with")
            return decode(tensors, metadata)
        except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
            name = self.about.names[index]
            raise ValueError(f"{self.path}: {name} is not usable ({error}). Export the collection again.") from error

    def notes(self, index: int) -> tuple[str, ...]:
        """What was done to the mesh of a Signature, in words."""
        return tuple(json.loads(self._told[index]["notes"]))


def _about(told: dict[str, Any]) -> About:
    names, parts = _words(told["names"]), tuple(told["parts"])
    labels = None if told["labels"] is None else _words(told["labels"])
    keys, columns = _words(told["keys"]), {name: tuple(values) for name, values in told.get("columns", {}).items()}
    about = About(names, parts, labels, _words(told["classes"]), keys, told["reading"], told["config"], columns)
    lengths = {len(names), len(parts), len(keys), len(names if labels is None else labels), *map(len, columns.values())}
    if len(lengths) > 1 or len(set(names)) < len(names):
        raise ValueError("its names, parts, labels and keys do not fit each other")
    words = [*parts, *(value for values in columns.values() for value in values)]
    if not set(labels or ()) <= set(about.classes) or not all(one is None or isinstance(one, str) for one in words):
        raise ValueError("its labels are none of its classes, or its parts or columns no words")
    if not isinstance(about.reading, dict) or not isinstance(about.config, dict):
        raise ValueError("its reading or configuration is none")
    return about


def _words(values: Sequence[object]) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(one, str) for one in values):
        raise ValueError("a list of names holds something else")
    return tuple(map(str, values))
