"""A whole collection of Signatures in one file, which travels without its meshes."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from igps._files import whole_file
from igps.data.cache import check_checksum, checksum, decode, encode
from igps.data.requirements import Requirements
from igps.data.sources import Bodies, file_name_of
from igps.mesh.options import LoadOptions
from igps.signature.signature import Signature, SignatureConfig

_FORMAT = "igps-collection-1"
# A longer header of names is refused by safetensors.
_MOST_HEADER = 100_000_000
_KINDS = {"float64": "F64", "float32": "F32"}


@dataclass(frozen=True)
class Contents:
    """What a collection holds beside the Signatures."""

    bodies: Bodies  # without folders
    classes: tuple[str, ...]  # all names of classes, in the order of their numbers
    keys: tuple[str, ...]  # of the Signatures in the cache that they come from
    reading: LoadOptions  # how the meshes were read
    config: SignatureConfig  # of the Signatures

    def to_json(self) -> str:
        """All of it as JSON, but for the paths."""
        bodies = {name: value for name, value in vars(self.bodies).items() if name != "paths"}
        labels = None if self.bodies.labels is None else list(map(str, self.bodies.labels))  # numbers may be given
        words = {"labels": labels, "classes": list(map(str, self.classes)), "keys": self.keys}
        return json.dumps({**bodies, **words, "reading": asdict(self.reading), "config": asdict(self.config)})

    @staticmethod
    def from_json(text: str) -> Contents:
        """What was written; a ValueError, KeyError or TypeError where it does not fit together."""
        told: dict[str, Any] = json.loads(text)
        names, parts, columns = _words(told["names"]), tuple(told["parts"]), dict(told.get("columns", {}))
        labels = None if told["labels"] is None else _words(told["labels"])
        columns = {name: tuple(values) for name, values in columns.items()}
        paths = tuple(Path(file_name_of(name, part)) for name, part in zip(names, parts, strict=True))
        bodies = Bodies(paths, names, labels, parts, columns)
        classes, keys = _words(told["classes"]), _words(told["keys"])
        if len(keys) != len(names) or len(parts) != len(names) or len(set(names)) < len(names):
            raise ValueError("its names, parts, labels and keys do not fit each other")
        words = [*parts, *(value for values in columns.values() for value in values)]
        if not set(labels or ()) <= set(classes) or not all(one is None or isinstance(one, str) for one in words):
            raise ValueError("its labels are none of its classes, or its parts or columns no words")
        try:
            return Contents(bodies, classes, keys, LoadOptions(**told["reading"]), SignatureConfig(**told["config"]))
        except (TypeError, KeyError, ValueError) as error:
            raise ValueError(f"parameters of another version: {error}") from error


def write_collection(path: Path, about: Contents, signature: Callable[[int], Signature]) -> None:
    """Write a collection, whole or not at all: a safetensors file of the arrays of all Signatures.

    A file that is there is replaced. Each Signature is asked for by its number, several times, and not kept.
    """
    n = len(about.bodies)
    if len(set(about.bodies.names)) < n:
        twice = next(name for name, count in Counter(about.bodies.names).items() if count > 1)
        raise ValueError(f"{path}: {twice} is there twice; names that differ expected. Give each body once.")
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
    words = {"format": _FORMAT, "about": about.to_json(), "signatures": json.dumps(told)}
    words["checksum"] = checksum({}, {"about": words["about"]})
    text = json.dumps({"__metadata__": words, **header}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    if len(text) > _MOST_HEADER:
        raise ValueError(f"{path}: {n} bodies are too many for one file. Export parts of the dataset.")
    with whole_file(path) as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for (i, _), group in groupby(order, key=lambda one: (one[0], arrays[one[0]][one[1]][0])):
            tensors, _ = encode(signature(i))
            for _, name in group:
                file.write(tensors[name].data)


def is_collection(path: Path) -> bool:
    """Whether a file is one that `write_collection` wrote, by its beginning."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return _FORMAT.encode() in file.read(100)


class CollectionFile:
    """The Signatures of a file that `write_collection` wrote, read by memory map and checked at each reading.

    Reading runs no code. A worker process that is given one opens the file for itself. A FileNotFoundError without it,
    a ValueError of another file, or a damaged one.
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
            check_checksum({}, {"about": metadata["about"], "checksum": metadata["checksum"]})
            self.about = Contents.from_json(metadata["about"])
            self._metadata: list[dict[str, str]] = json.loads(metadata["signatures"])
            if len(self._metadata) != len(self.about.bodies):
                raise ValueError(f"{len(self.about.bodies)} names for {len(self._metadata)} signatures")
            names = set(self._file.keys())
        except (SafetensorError, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{self.path}: expected a collection in the format {_FORMAT} ({error}). Export it again."
            ) from error
        self._arrays: list[list[str]] = [[] for _ in self._metadata]
        for name in sorted(names):
            number, _, array = name.partition(".")
            if number.isdecimal() and int(number) < len(self._metadata):
                self._arrays[int(number)].append(array)

    def __reduce__(self) -> tuple[type[CollectionFile], tuple[Path]]:
        return CollectionFile, (self.path,)

    def __getitem__(self, index: int) -> Signature:
        """A Signature by its number, its arrays views of the file; a ValueError where it is damaged, or out of date."""
        metadata = self._metadata[index]
        try:
            tensors = {name: self._file.get_tensor(f"{index}.{name}").numpy() for name in self._arrays[index]}
            check_checksum(tensors, metadata)
            return decode(tensors, metadata)
        except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
            name = self.about.bodies.names[index]
            raise ValueError(f"{self.path}: {name} is not usable ({error}). Export the collection again.") from error

    def check_serves(self, requirements: Requirements) -> None:
        """Raise a ValueError that names the file where its Signatures have less than what is required."""
        try:
            requirements.check_config(self.about.config)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error} Or export the folder again for this descriptor.") from error

    def notes(self, index: int) -> tuple[str, ...]:
        """What was done to the mesh of a Signature, in words."""
        return tuple(json.loads(self._metadata[index]["notes"]))


def _words(values: Sequence[object]) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(one, str) for one in values):
        raise ValueError("a list of names holds something else")
    return tuple(map(str, values))
