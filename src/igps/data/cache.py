"""Content-addressed cache of Signatures and descriptions on disk, with one safetensors file for each."""

import hashlib
import json
import logging
import os
import time
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from igps._arrays import Singles
from igps._files import PARTIAL, atomic_write, sort_metadata
from igps.signature.signature import SAMPLE_KINDS, SampleKind, Samples, Signature, SignatureConfig

logger = logging.getLogger(__name__)

# Fields of a Signature besides arrays and configuration
_SCALAR_FIELDS = ("area", "volume", "name", "notes", "residual", "unit")
_ABANDONED_AGE = (
    24 * 3600
)  # seconds until a partial file is removed; writing a file takes well below one second
_CHECKSUM_ROW = 4096  # bytes
T = TypeVar("T")
Result = TypeVar("Result")


def default_cache_dir() -> Path:
    """Return the user's cache directory for Signatures: `$XDG_CACHE_HOME/igps`, or `~/.cache/igps`."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "igps"
    except RuntimeError as error:
        raise ValueError(
            "cache_dir: expected a folder, because this user has no home folder. Give cache_dir, on the command line "
            "--cache_dir, or set XDG_CACHE_HOME."
        ) from error


def content_digest(path: Path, *companions: Path) -> bytes:
    """Return a digest of the content of a file and of the companion files that are read with it."""
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").digest()
    return (
        hashlib.sha256(digest + b"".join(map(content_digest, companions))).digest()
        if companions
        else digest
    )


class FileCache(Generic[T]):
    """Cache of values by key, which any number of processes can share.

    Files are written atomically, so a reader sees a whole file or none. Partial files of killed processes are removed
    after a day, see `remove_abandoned`. Processes that compute the same value write the same bytes. Permissions follow
    the umask. The directory is created if it is missing.
    """

    value_name: ClassVar[str]  # in messages and in the format
    folder: ClassVar[str] = ""  # subfolder of the directory
    # Convert a value to arrays and metadata, and back. Decoding raises ValueError, KeyError or TypeError on bad input
    _encode: Callable[[T], tuple[dict[str, np.ndarray], dict[str, str]]]
    _decode: Callable[[Mapping[str, np.ndarray], Mapping[str, str]], T]

    def __init__(self, directory: str | Path) -> None:
        self.directory = Path(directory) / self.folder
        self._format = f"igps-{self.value_name}-2"

    def path(self, key: str) -> Path:
        """Return the file of a key, in one of 256 folders."""
        return self.directory / key[:2] / f"{key}.safetensors"

    def __contains__(self, key: str) -> bool:
        """Return whether a value is stored under `key`, judged by the header and the length of the file."""
        return self._read(key, lambda file, metadata: True) is not None

    def get(self, key: str) -> T | None:
        """Return the value of a key, in views of the memory-mapped file; None if missing, or damaged (logged)."""
        return self._read(key, self._decode_checked)

    def _decode_checked(self, file: Any, metadata: Mapping[str, str]) -> T:
        tensors = {name: file.get_tensor(name).numpy() for name in file.keys()}  # noqa: SIM118 (no Mapping)
        check_checksum(tensors, metadata)
        return self._decode(tensors, metadata)

    def _read(self, key: str, read: Callable[[Any, Mapping[str, str]], Result]) -> Result | None:
        path = self.path(key)
        try:
            with safe_open(
                path, framework="pt"
            ) as file:  # framework="numpy" would copy every array
                metadata = file.metadata() or {}
                if metadata.get("format") != self._format or metadata.get("key") != key:
                    raise ValueError(f"not a {self._format} file of this key")
                return read(file, metadata)
        except FileNotFoundError:
            return None
        except (SafetensorError, ValueError, KeyError, TypeError, OSError) as error:
            logger.warning(
                "%s: cached %s is not usable (%s), and is computed again",
                path,
                self.value_name,
                error,
            )
            return None

    def put(self, key: str, value: T) -> None:
        """Store a value under `key`."""
        path = self.path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        tensors, metadata = self._encode(value)
        metadata |= {"format": self._format, "key": key, "checksum": checksum(tensors, metadata)}
        _remove_abandoned(path.parent.glob(f"*{PARTIAL}"))
        try:
            with atomic_write(path) as file:
                file.write(sort_metadata(save(tensors, metadata=metadata)))
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
        _remove_abandoned(self.directory.glob(f"*/*{PARTIAL}"))


def encode(signature: Signature) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the arrays of a Signature by name, and its other fields as JSON."""
    # safetensors writes the memory of arrays, so they must be contiguous
    tensors: dict[str, np.ndarray] = {
        "eigenvalues": np.ascontiguousarray(signature.eigenvalues, np.float64)
    }
    for kind in SAMPLE_KINDS:
        samples: Samples = getattr(signature, kind)
        tensors[f"{kind}.points"] = np.ascontiguousarray(samples.points, np.float64)
        tensors[f"{kind}.eigenfunctions"] = np.ascontiguousarray(samples.eigenfunctions, np.float32)
        for name, values in samples.attributes.items():
            tensors[f"{kind}.attributes.{name}"] = np.ascontiguousarray(values, np.float32)
    fields = {
        **{name: getattr(signature, name) for name in _SCALAR_FIELDS},
        "config": signature.config.as_dict(),
    }
    return tensors, {name: json.dumps(value) for name, value in fields.items()}


def decode(tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> Signature:
    """Return the Signature that `encode` converted; raise a ValueError, KeyError or TypeError on bad input."""
    config: dict[str, Any] = json.loads(metadata["config"])
    if config.pop("algorithm_version") != SignatureConfig.ALGORITHM_VERSION:
        raise ValueError("computed by another version of the algorithm")
    eigenvalues, samples_of = tensors["eigenvalues"], dict[str, Any]()
    _check_array("eigenvalues", eigenvalues, np.float64, (len(eigenvalues),))
    for kind in SAMPLE_KINDS:
        prefix = f"{kind}.attributes."
        attributes = {
            name.removeprefix(prefix): values
            for name, values in tensors.items()
            if name.startswith(prefix)
        }
        points, eigenfunctions = tensors[f"{kind}.points"], tensors[f"{kind}.eigenfunctions"]
        _check_array(f"{kind}.points", points, np.float64, (len(points), 3))
        _check_array(
            f"{kind}.eigenfunctions", eigenfunctions, np.float32, (len(points), len(eigenvalues))
        )
        for name, values in attributes.items():
            _check_array(
                f"{kind}.attributes.{name}", values, np.float32, (len(points), *values.shape[1:])
            )
        samples_of[kind] = Samples(points, eigenfunctions, attributes)
    fields: dict[str, Any] = {name: json.loads(metadata[name]) for name in _SCALAR_FIELDS}
    fields["notes"] = tuple(fields["notes"])
    return Signature(eigenvalues, **samples_of, config=SignatureConfig(**config), **fields)


def _check_array(
    name: str, values: np.ndarray, dtype: type[np.floating[Any]], shape: tuple[int, ...]
) -> None:
    if values.dtype != dtype or values.shape != shape:
        raise ValueError(
            f"{name}: expected {dtype.__name__} {shape}, got {values.dtype} {values.shape}"
        )


class SignatureCache(FileCache[Signature]):
    """Cache of Signatures."""

    value_name = "signature"
    _encode, _decode = staticmethod(encode), staticmethod(decode)

    def notes(self, key: str) -> tuple[str, ...]:
        """Return the notes on how the mesh of a Signature was changed; empty if there is no such Signature."""
        return self._read(key, lambda file, metadata: tuple(json.loads(metadata["notes"]))) or ()

    def unit(self, key: str) -> str | None:
        """Return the unit of length of a Signature; None if it is unknown, or there is no such Signature."""
        return self._read(key, lambda file, metadata: json.loads(metadata["unit"]))


def _without_metadata(
    arrays: Mapping[Any, Singles],
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    return {name: np.ascontiguousarray(values) for name, values in arrays.items()}, {}


class AttributeCache(FileCache[dict[SampleKind, Singles]]):
    """Cache of attributes; a value holds one attribute of one Signature by kind of sample."""

    value_name, folder = "attribute", "attributes"
    _encode = staticmethod(_without_metadata)
    _decode = staticmethod(lambda tensors, metadata: {kind: tensors[kind] for kind in SAMPLE_KINDS})


class DescriptionCache(FileCache[Singles]):
    """Cache of descriptions."""

    value_name, folder = "description", "descriptions"
    _encode = staticmethod(lambda value: _without_metadata({"values": value}))
    _decode = staticmethod(lambda tensors, metadata: tensors["values"])


def _remove_abandoned(partials: Iterable[Path]) -> None:
    for partial in partials:
        try:
            if time.time() - partial.stat().st_mtime > _ABANDONED_AGE:
                partial.unlink()
        except OSError:  # removed by another process, or owned by another user
            continue


def checksum(tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> str:
    """Return the hexadecimal CRC-32 of tensors and metadata.

    For speed, a tensor enters the CRC by its column sums, as a matrix with 512 columns of 8 bytes.
    """
    crc = 0
    for name, value in sorted(metadata.items()):
        if name not in ("format", "key", "checksum"):
            crc = zlib.crc32(f"{name}\0{value}\0".encode(), crc)
    for name, tensor in sorted(tensors.items()):
        crc = zlib.crc32(f"{name} {tensor.dtype.str} {tensor.shape}\0".encode(), crc)
        raw = tensor.reshape(-1).view(np.uint8)
        end = raw.size // _CHECKSUM_ROW * _CHECKSUM_ROW
        crc = zlib.crc32(
            raw[:end].view(np.uint64).reshape(-1, _CHECKSUM_ROW // 8).sum(axis=0).data, crc
        )
        crc = zlib.crc32(raw[end:].data, crc)
    return f"{crc:08x}"


def check_checksum(tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> None:
    """Raise a ValueError if tensors and metadata do not match the checksum in the metadata."""
    if metadata.get("checksum") != checksum(tensors, metadata):
        raise ValueError(
            "its content is damaged: the checksum differs from the one that was written"
        )
