"""A content-addressed store of Signatures and descriptions on disk, one safetensors file each."""

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
from igps._files import PARTIAL, whole_file, with_ordered_metadata
from igps.signature.signature import SAMPLE_KINDS, SampleKind, Samples, Signature, SignatureConfig

logger = logging.getLogger(__name__)

# What a Signature has beside arrays and configuration
_OTHERS = ("area", "volume", "name", "notes", "residual", "unit")
# A file still being written after so many seconds was left by a process that was killed: a write takes well below one.
_ABANDONED = 24 * 3600
_ROW = 4096  # bytes
T = TypeVar("T")
Read = TypeVar("Read")


def default_cache_dir() -> Path:
    """The user's cache directory for Signatures: `$XDG_CACHE_HOME/igps`, or `~/.cache/igps`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "igps"


def content_digest(path: Path, *beside: Path) -> bytes:
    """A digest of the content of a file, and of others that are read with it."""
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").digest()
    return hashlib.sha256(digest + b"".join(map(content_digest, beside))).digest() if beside else digest


class FileCache(Generic[T]):
    """Values by key, shared safely by any number of processes.

    A file is written beside its place and moved there in one step, so that a reader sees all of it or nothing. What a
    killed run leaves of one is removed a day later, see `remove_abandoned`. Two processes that compute the same value
    write the same bytes. Permissions follow the umask.

    The directory is made if it is missing.
    """

    what: ClassVar[str]  # one word for the values, in messages
    folder: ClassVar[str] = ""  # of the values in the directory, "" where they lie in it themselves
    # A value to arrays and metadata, and back; the latter raises a ValueError, KeyError or TypeError if they make none
    _encode: Callable[[T], tuple[dict[str, np.ndarray], dict[str, str]]]
    _decode: Callable[[Mapping[str, np.ndarray], Mapping[str, str]], T]

    def __init__(self, directory: str | Path) -> None:
        self.directory = Path(directory) / self.folder
        self._format = f"igps-{self.what}-2"

    def path(self, key: str) -> Path:
        """The file of a key, in one of 256 folders."""
        return self.directory / key[:2] / f"{key}.safetensors"

    def __contains__(self, key: str) -> bool:
        """Whether a value is stored under `key`, by the file's header and length."""
        return self._read(key, lambda file, metadata: True) is not None

    def get(self, key: str) -> T | None:
        """The value stored under `key`, or None if there is none or it cannot be trusted, which is logged.

        Its arrays are views of the file in memory, which is not copied.
        """
        return self._read(key, self._checked)

    def _checked(self, file: Any, metadata: Mapping[str, str]) -> T:
        tensors = {name: file.get_tensor(name).numpy() for name in file.keys()}  # noqa: SIM118 (no Mapping)
        check_checksum(tensors, metadata)
        return self._decode(tensors, metadata)

    def _read(self, key: str, read: Callable[[Any, Mapping[str, str]], Read]) -> Read | None:
        path = self.path(key)
        try:
            with safe_open(path, framework="pt") as file:  # framework="numpy" would copy every array
                metadata = file.metadata() or {}
                if metadata.get("format") != self._format or metadata.get("key") != key:
                    raise ValueError(f"not a {self._format} file of this key")
                return read(file, metadata)
        except FileNotFoundError:
            return None
        except (SafetensorError, ValueError, KeyError, TypeError, OSError) as error:
            logger.warning("%s: cached %s is not usable (%s); it is computed again", path, self.what, error)
            return None

    def put(self, key: str, value: T) -> None:
        """Store a value under `key`."""
        path = self.path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        tensors, metadata = self._encode(value)
        metadata |= {"format": self._format, "key": key, "checksum": checksum(tensors, metadata)}
        _remove_abandoned(path.parent.glob(f"*{PARTIAL}"))
        try:
            with whole_file(path) as file:
                file.write(with_ordered_metadata(save(tensors, metadata=metadata)))
        except PermissionError:
            # Some file systems replace no file that another process holds open. Where that process was first with the
            # same value, its file serves as well.
            if key not in self:
                raise
        except OSError as error:
            if error.errno is None or error.filename is not None:
                raise
            # The error of a full disk names no file
            raise OSError(error.errno, error.strerror, str(path)) from error

    def remove_abandoned(self) -> None:
        """Remove what killed processes left of files that they were writing, a day after."""
        _remove_abandoned(self.directory.glob(f"*/*{PARTIAL}"))


def encode(signature: Signature) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The arrays of a Signature by name, and all else as JSON."""
    # A file is written as the arrays lie in memory.
    tensors: dict[str, np.ndarray] = {"eigenvalues": np.ascontiguousarray(signature.eigenvalues, np.float64)}
    for kind in SAMPLE_KINDS:
        samples: Samples = getattr(signature, kind)
        tensors[f"{kind}.points"] = np.ascontiguousarray(samples.points, np.float64)
        tensors[f"{kind}.eigenfunctions"] = np.ascontiguousarray(samples.eigenfunctions, np.float32)
        for name, values in samples.attributes.items():
            tensors[f"{kind}.attributes.{name}"] = np.ascontiguousarray(values, np.float32)
    others = {**{name: getattr(signature, name) for name in _OTHERS}, "config": signature.config.as_dict()}
    return tensors, {name: json.dumps(value) for name, value in others.items()}


def decode(tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> Signature:
    """The Signature that `encode` was given; a ValueError, KeyError or TypeError where there is none."""
    config: dict[str, Any] = json.loads(metadata["config"])
    if config.pop("algorithm_version") != SignatureConfig.ALGORITHM_VERSION:
        raise ValueError("made by another version of the algorithm")
    eigenvalues, samples_of = tensors["eigenvalues"], dict[str, Any]()
    _check_array("eigenvalues", eigenvalues, np.float64, (len(eigenvalues),))
    for kind in SAMPLE_KINDS:
        prefix = f"{kind}.attributes."
        attributes = {name.removeprefix(prefix): values for name, values in tensors.items() if name.startswith(prefix)}
        points, eigenfunctions = tensors[f"{kind}.points"], tensors[f"{kind}.eigenfunctions"]
        _check_array(f"{kind}.points", points, np.float64, (len(points), 3))
        _check_array(f"{kind}.eigenfunctions", eigenfunctions, np.float32, (len(points), len(eigenvalues)))
        for name, values in attributes.items():
            _check_array(f"{kind}.attributes.{name}", values, np.float32, (len(points), *values.shape[1:]))
        samples_of[kind] = Samples(points, eigenfunctions, attributes)
    others: dict[str, Any] = {name: json.loads(metadata[name]) for name in _OTHERS}
    others["notes"] = tuple(others["notes"])
    return Signature(eigenvalues, **samples_of, config=SignatureConfig(**config), **others)


def _check_array(name: str, values: np.ndarray, kind: type[np.floating[Any]], shape: tuple[int, ...]) -> None:
    if values.dtype != kind or values.shape != shape:
        raise ValueError(f"{name}: expected {kind.__name__} {shape}, got {values.dtype} {values.shape}")


class SignatureCache(FileCache[Signature]):
    """Signatures by key, see `FileCache`."""

    what = "signature"
    _encode, _decode = staticmethod(encode), staticmethod(decode)

    def notes(self, key: str) -> tuple[str, ...]:
        """What was done to the mesh of the Signature under `key`, in words; nothing if there is none."""
        return self._read(key, lambda file, metadata: tuple(json.loads(metadata["notes"]))) or ()

    def unit(self, key: str) -> str | None:
        """The unit of length of the Signature under `key`; None where it has none, or there is none."""
        return self._read(key, lambda file, metadata: json.loads(metadata["unit"]))


def _arrays_alone(arrays: Mapping[Any, Singles]) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    return {name: np.ascontiguousarray(one) for name, one in arrays.items()}, {}


class AttributeCache(FileCache[dict[SampleKind, Singles]]):
    """Attributes of the samples of one Signature by kind, beside the Signatures."""

    what, folder = "attribute", "attributes"
    _encode = staticmethod(_arrays_alone)
    _decode = staticmethod(lambda tensors, metadata: {kind: tensors[kind] for kind in SAMPLE_KINDS})


class DescriptionCache(FileCache[Singles]):
    """Descriptions by key, beside the Signatures, see `FileCache`."""

    what, folder = "description", "descriptions"
    _encode = staticmethod(lambda value: _arrays_alone({"values": value}))
    _decode = staticmethod(lambda tensors, metadata: tensors["values"])


def _remove_abandoned(partials: Iterable[Path]) -> None:
    for partial in partials:
        try:
            if time.time() - partial.stat().st_mtime > _ABANDONED:
                partial.unlink()
        except OSError:  # another process was first, or only another user may
            continue


def checksum(tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> str:
    """Of all that a value is read from, in hexadecimal, as fast as memory can be read.

    The arrays enter by the sums of their columns, where each is seen as rows of 512 words of eight bytes.
    """
    found = 0
    for name, value in sorted(metadata.items()):
        if name not in ("format", "key", "checksum"):
            found = zlib.crc32(f"{name}\0{value}\0".encode(), found)
    for name, tensor in sorted(tensors.items()):
        found = zlib.crc32(f"{name} {tensor.dtype.str} {tensor.shape}\0".encode(), found)
        raw = tensor.reshape(-1).view(np.uint8)
        end = raw.size // _ROW * _ROW
        found = zlib.crc32(raw[:end].view(np.uint64).reshape(-1, _ROW // 8).sum(axis=0).data, found)
        found = zlib.crc32(raw[end:].data, found)
    return f"{found:08x}"


def check_checksum(tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> None:
    """Raise a ValueError where what was read is not what was written."""
    if metadata.get("checksum") != checksum(tensors, metadata):
        raise ValueError("its content is damaged: it does not have the checksum that it was written with")
