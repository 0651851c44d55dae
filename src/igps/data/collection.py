"""Files that hold a whole collection of Signatures, without its meshes."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from igps._files import atomic_write
from igps.data.cache import Record, check_checksum, checksum, decode, encode
from igps.data.cache_hit import CacheHit
from igps.data.requirements import Requirements
from igps.data.sources import Bodies, file_name_of
from igps.mesh.options import LoadOptions
from igps.signature.signature import Signature, SignatureConfig

_FORMAT = "igps-collection-1"
_MAX_HEADER_BYTES = 100_000_000  # limit of safetensors
_DTYPES = {"float64": "F64", "float32": "F32"}


@dataclass(frozen=True)
class Contents:
    """Contents of a collection, besides the Signatures."""

    bodies: Bodies  # without folders
    classes: tuple[str, ...]  # class names in the order of their indices
    keys: tuple[str, ...]  # cache keys of the Signatures
    reading: LoadOptions  # of the meshes
    config: SignatureConfig  # of the Signatures

    def to_json(self) -> str:
        """Return the contents as JSON, without paths."""
        bodies = {name: value for name, value in vars(self.bodies).items() if name != "paths"}
        # Users may give numbers
        labels = None if self.bodies.labels is None else list(map(str, self.bodies.labels))
        names = {"labels": labels, "classes": list(map(str, self.classes)), "keys": self.keys}
        return json.dumps(
            {**bodies, **names, "reading": asdict(self.reading), "config": asdict(self.config)}
        )

    @staticmethod
    def from_json(text: str) -> Contents:
        """Parse the text of `to_json`; raise a ValueError, KeyError or TypeError if it is invalid."""
        data: dict[str, Any] = json.loads(text)
        names = _strings(data["names"])
        parts = tuple(data["parts"])
        columns = dict(data.get("columns", {}))
        labels = None if data["labels"] is None else _strings(data["labels"])
        columns = {name: tuple(values) for name, values in columns.items()}
        paths = tuple(
            Path(file_name_of(name, part)) for name, part in zip(names, parts, strict=True)
        )
        bodies = Bodies(paths, names, labels, parts, columns)
        classes = _strings(data["classes"])
        keys = _strings(data["keys"])
        if len(keys) != len(names) or len(parts) != len(names) or len(set(names)) < len(names):
            raise ValueError("its names are not unique, or differ in number from its parts or keys")
        optional_strings = [*parts, *(value for values in columns.values() for value in values)]
        if not set(labels or ()) <= set(classes) or not all(
            s is None or isinstance(s, str) for s in optional_strings
        ):
            raise ValueError(
                "a label is not one of its classes, or a part or a value of a column is not a string"
            )
        try:
            return Contents(
                bodies,
                classes,
                keys,
                LoadOptions(**data["reading"]),
                SignatureConfig(**data["config"]),
            )
        except (TypeError, KeyError, ValueError) as error:
            raise ValueError(f"parameters of another version: {error}") from error


def write_collection(path: Path, about: Contents, signature: Callable[[int], Signature]) -> None:
    """Write a collection atomically to a safetensors file, which is replaced if it exists.

    To save memory, `signature` is called with each index up to three times. A ValueError is raised if names are not
    unique, or if there are too many bodies for one file.
    """
    n = len(about.bodies)
    if len(set(about.bodies.names)) < n:
        duplicate = next(name for name, count in Counter(about.bodies.names).items() if count > 1)
        raise ValueError(
            f"{path}: expected unique names, got {duplicate} twice. Give each body once."
        )
    # Dtype, shape, bytes of each Signature's arrays
    arrays: list[dict[str, tuple[str, tuple[int, ...], int]]] = []
    all_metadata = []
    for i in range(n):
        record = encode(signature(i))
        all_metadata.append({**record.texts, "checksum": checksum(record)})
        arrays.append(
            {
                name: (values.dtype.name, values.shape, values.nbytes)
                for name, values in record.arrays.items()
            }
        )
    # Doubles come before singles, so that all arrays are aligned: the format allows no gaps
    order = [
        (i, name)
        for d in _DTYPES
        for i in range(n)
        for name, (dtype, *_) in arrays[i].items()
        if dtype == d
    ]
    header: dict[str, Any] = {}
    end = 0
    for i, name in order:
        dtype, shape, n_bytes = arrays[i][name]
        header[f"{i}.{name}"] = {
            "dtype": _DTYPES[dtype],
            "shape": shape,
            "data_offsets": (end, end + n_bytes),
        }
        end += n_bytes
    file_metadata = {
        "format": _FORMAT,
        "about": about.to_json(),
        "signatures": json.dumps(all_metadata),
    }
    file_metadata["checksum"] = checksum(Record({}, {"about": file_metadata["about"]}))
    text = json.dumps({"__metadata__": file_metadata, **header}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    if len(text) > _MAX_HEADER_BYTES:
        raise ValueError(
            f"{path}: {n} bodies are too many for one file. Export parts of the dataset."
        )
    with atomic_write(path) as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for (i, _), group in groupby(order, key=lambda key: (key[0], arrays[key[0]][key[1]][0])):
            record = encode(signature(i))
            for _, name in group:
                file.write(record.arrays[name].data)


def is_collection(path: Path) -> bool:
    """Return whether a file begins like those that `write_collection` writes."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return _FORMAT.encode() in file.read(100)


class CollectionFile:
    """Memory-mapped file of `write_collection`; each Signature is checked when it is read.

    Reading does not run code. A worker process that receives the object opens the file itself. A FileNotFoundError is
    raised if there is no such file, and a ValueError if it has another format or is damaged.
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
            about = {"about": metadata["about"], "checksum": metadata["checksum"]}
            check_checksum(Record({}, about))
            self.about = Contents.from_json(metadata["about"])
            self._metadata: list[dict[str, str]] = json.loads(metadata["signatures"])
            if len(self._metadata) != len(self.about.bodies):
                raise ValueError(
                    f"it has {len(self.about.bodies)} names for {len(self._metadata)} signatures"
                )
            names = set(self._file.keys())
        except (SafetensorError, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{self.path}: expected a collection in the format {_FORMAT} ({error}). Export it again."
            ) from error
        self._arrays: list[list[str]] = [[] for _ in self._metadata]
        for name in sorted(names):
            index, _, array = name.partition(".")
            if index.isdecimal() and int(index) < len(self._metadata):
                self._arrays[int(index)].append(array)

    def __reduce__(self) -> tuple[type[CollectionFile], tuple[Path]]:
        return CollectionFile, (self.path,)

    def __getitem__(self, index: int) -> Signature:
        """Return a Signature with views of the file; raise a ValueError if it is damaged or of another version."""
        metadata = self._metadata[index]
        try:
            arrays = {
                name: self._file.get_tensor(f"{index}.{name}").numpy()
                for name in self._arrays[index]
            }
            record = Record(arrays, metadata)
            check_checksum(record)
            return decode(record)
        except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
            name = self.about.bodies.names[index]
            raise ValueError(
                f"{self.path}: {name} is not usable ({error}). Export the collection again."
            ) from error

    def check_requirements(self, requirements: Requirements) -> None:
        """Raise a ValueError that names the file if its Signatures do not meet the requirements."""
        try:
            requirements.check_config(self.about.config)
        except ValueError as error:
            raise ValueError(
                f"{self.path}: {error} Or export the collection again for this descriptor."
            ) from error

    def hits(self) -> tuple[CacheHit, ...]:
        """Return the key of each Signature, with notes and unit."""
        pairs = zip(self.about.keys, self._metadata, strict=True)
        return tuple(CacheHit(key).with_header(texts) for key, texts in pairs)


def _strings(values: Sequence[object]) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise ValueError("names, labels, classes and keys must be lists of strings")
    return tuple(map(str, values))
