"""Cache of surfaces, Signatures and what is made of them, failures and listings: one safetensors file for each key."""

import json
import logging
import os
import sys
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from igps._files import PARTIAL, atomic_write, sort_metadata
from igps.signature.signature import SAMPLE_KINDS, Samples, Signature, SignatureConfig

logger = logging.getLogger(__name__)

Kind = Literal[
    "surface", "signature", "attribute", "description", "failure", "listing", "picture", "measure"
]

_FORMAT = "igps-cache-3"
# Fields of a Signature besides arrays and configuration
_SCALAR_FIELDS = ("area", "volume", "name", "notes", "residual", "unit")
# Seconds until a partial file is removed; writing a file takes well below one second
_ABANDONED_AGE = 24 * 3600
_CHECKSUM_ROW = 4096  # bytes of a row of the matrix whose column sums enter a checksum
T = TypeVar("T")


def default_cache_dir() -> Path:
    """Return the user's cache directory for Signatures: `$XDG_CACHE_HOME/igps`, or `~/.cache/igps`."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "igps"
    except RuntimeError as error:
        raise ValueError(
            "cache_dir: expected a folder, because this user has no home folder. Give cache_dir, "
            "on the command line --cache_dir, or set XDG_CACHE_HOME."
        ) from error


@dataclass(frozen=True, eq=False)
class Record:
    """Arrays and texts by name, as they are written to a file."""

    arrays: Mapping[str, NDArray[Any]]
    texts: Mapping[str, str] = field(default_factory=dict)


class Cache:
    """Cache of records by key, which any number of processes can share.

    Files are written atomically, so a reader sees a whole file or none. Partial files of killed processes are removed
    after a day, see `remove_abandoned`. Processes that compute the same value write the same bytes.
    Permissions follow the umask. The directory is created if it is missing.
    """

    def __init__(self, directory: str | Path, kind: Kind) -> None:
        self.kind = kind
        self.directory = Path(directory) / f"{kind}s"

    def path(self, key: str) -> Path:
        """Return the file of a key, in one of 256 folders."""
        return self.directory / key[:2] / f"{key}.safetensors"

    def __contains__(self, key: str) -> bool:
        """Return whether a value is stored under `key`, judged by the header and the length of the file."""
        return self.texts(key) is not None

    def texts(self, key: str) -> Mapping[str, str] | None:
        """Return the texts of a record without its arrays; None if it is missing, or not usable (logged)."""
        return self._read(key, lambda file, texts: texts)

    def get(self, key: str, decode: Callable[[Record], T]) -> T | None:
        """Return the value of a key; None if missing, or damaged (logged).

        `decode` converts the record to the value, and raises a ValueError, KeyError or TypeError if that fails. If
        torch is loaded, arrays are views of the memory-mapped file.
        """

        def value(file: Any, texts: Mapping[str, str]) -> T:
            names = file.keys()
            arrays = {name: np.asarray(file.get_tensor(name)) for name in names}
            record = Record(arrays, texts)
            if texts.get("checksum") != checksum(record):
                raise ValueError("its content is damaged: it has another checksum")
            return decode(record)

        # torch maps arrays without a copy, but takes a second to load
        framework = "pt" if "torch" in sys.modules else "numpy"
        return self._read(key, value, framework)

    def _read(
        self, key: str, read: Callable[[Any, Mapping[str, str]], T], framework: str = "numpy"
    ) -> T | None:
        path = self.path(key)
        try:
            with safe_open(path, framework=framework) as file:
                texts = file.metadata() or {}
                if texts.get("format") != _FORMAT or texts.get("key") != key:
                    raise ValueError(f"not a {_FORMAT} file of this key")
                return read(file, texts)
        except FileNotFoundError:
            return None
        except (SafetensorError, ValueError, KeyError, TypeError, OSError) as error:
            message = "%s: cached %s is not usable (%s), and is computed again"
            logger.warning(message, path, self.kind, error)
            return None

    def put(self, key: str, record: Record) -> None:
        """Store a record under `key`."""
        path = self.path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        texts = {**record.texts, "format": _FORMAT, "key": key, "checksum": checksum(record)}
        # safetensors writes the memory of arrays, so they must be contiguous
        arrays = {name: np.ascontiguousarray(values) for name, values in record.arrays.items()}
        try:
            with atomic_write(path) as file:
                file.write(sort_metadata(save(arrays, metadata=texts)))
        except PermissionError:
            # Some file systems cannot replace a file that another process has open, which holds the same value
            if key not in self:
                raise
        except OSError as error:
            if error.errno is None or error.filename is not None:
                raise
            # The error for a full disk names no file
            raise OSError(error.errno, error.strerror, str(path)) from error

    def remove_abandoned(self) -> None:
        """Remove partial files of killed processes that are older than a day."""
        for partial in self.directory.glob(f"*/*{PARTIAL}"):
            try:
                if time.time() - partial.stat().st_mtime > _ABANDONED_AGE:
                    partial.unlink()
            except OSError:  # removed by another process, or owned by another user
                continue


def encode(signature: Signature) -> Record:
    """Return the arrays of a Signature by name, and its other fields as JSON."""
    arrays: dict[str, NDArray[Any]] = {
        "eigenvalues": np.asarray(signature.eigenvalues, np.float64, "C")
    }
    for kind in SAMPLE_KINDS:
        samples: Samples = getattr(signature, kind)
        arrays[f"{kind}.points"] = np.asarray(samples.points, np.float64, "C")
        arrays[f"{kind}.eigenfunctions"] = np.asarray(samples.eigenfunctions, np.float32, "C")
        for name, values in samples.attributes.items():
            arrays[f"{kind}.attributes.{name}"] = np.asarray(values, np.float32, "C")
    fields = {name: getattr(signature, name) for name in _SCALAR_FIELDS}
    fields["config"] = signature.config.as_dict()
    return Record(arrays, {name: json.dumps(value) for name, value in fields.items()})


def decode(record: Record) -> Signature:
    """Return the Signature that `encode` converted; raise a ValueError, KeyError or TypeError on bad input."""
    config: dict[str, Any] = json.loads(record.texts["config"])
    if config.pop("algorithm_version") != SignatureConfig.ALGORITHM_VERSION:
        raise ValueError("computed by another version of the algorithm")
    fields: dict[str, Any] = {name: json.loads(record.texts[name]) for name in _SCALAR_FIELDS}
    fields["notes"] = tuple(fields["notes"])
    for kind in SAMPLE_KINDS:
        prefix = f"{kind}.attributes."
        attributes = {
            name.removeprefix(prefix): values
            for name, values in record.arrays.items()
            if name.startswith(prefix)
        }
        points = record.arrays[f"{kind}.points"]
        fields[kind] = Samples(points, record.arrays[f"{kind}.eigenfunctions"], attributes)
    return Signature(record.arrays["eigenvalues"], config=SignatureConfig(**config), **fields)


def checksum(record: Record) -> str:
    """Return the hexadecimal CRC-32 of arrays and texts.

    For speed, an array enters the CRC by its column sums, as a matrix with 512 columns of 8 bytes.
    """
    crc = 0
    for name, value in sorted(record.texts.items()):
        if name not in ("format", "key", "checksum"):
            crc = zlib.crc32(f"{name}\0{value}\0".encode(), crc)
    for name, array in sorted(record.arrays.items()):
        crc = zlib.crc32(f"{name} {array.dtype.str} {array.shape}\0".encode(), crc)
        raw = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        end = raw.size // _CHECKSUM_ROW * _CHECKSUM_ROW
        rows = raw[:end].view(np.uint64).reshape(-1, _CHECKSUM_ROW // 8)
        crc = zlib.crc32(rows.sum(axis=0).data, crc)
        crc = zlib.crc32(raw[end:].data, crc)
    return f"{crc:08x}"
