"""How a mesh file becomes a Signature: read, computed and cached, in this process or in a worker."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from igps._parallel import MachineError
from igps.data.cache import SignatureCache
from igps.mesh.loading import load_mesh
from igps.mesh.mending import MENDING_VERSION, mended_by
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.options import LoadOptions
from igps.signature.signature import Signature, SignatureConfig, compute_signature


@dataclass(frozen=True)
class CacheHit:
    """The Signature in the cache that serves a file.

    Args:
        key: its name in the cache; that of a larger one, if that is there.
        n_bytes: size of its file.
        notes: what was done to the mesh, in words.
        stamp: of the mesh file when it was read, see `stamp_of`.
    """

    key: str
    n_bytes: int
    notes: tuple[str, ...]
    stamp: tuple[int, int, int]

    @staticmethod
    def stamp_of(path: Path) -> tuple[int, int, int]:
        """Bytes of a file, and when its content and its name or rights were last changed, in nanoseconds."""
        found = os.stat(path)
        return found.st_size, found.st_mtime_ns, found.st_ctime_ns


@dataclass(frozen=True)
class SignaturePipeline:
    """All that the Signature of a file depends on, and where it is kept; small, so that workers get no more than this.

    Args:
        config: parameters of the Signature.
        reading: how the file is read.
        cache_dir: where Signatures are kept.
    """

    config: SignatureConfig
    reading: LoadOptions
    cache_dir: Path

    def mesh(self, path: Path) -> Mesh:
        """The checked mesh of a file.

        Raises:
            MeshError: it cannot be used.
        """
        return load_mesh(path, self.reading, least_vertices=self.config.n_vertices_read)

    def signature(self, path: Path) -> Signature:
        """The Signature of a file, from the cache where it or a larger one is there, and there afterwards."""
        cache = SignatureCache(self.cache_dir)
        for key in self._cached(path):
            signature = cache.get(key)
            if signature is not None:
                return signature.beginning(self.config)
        return self._put(path)[1]

    def fill(self, path: Path) -> CacheHit:
        """Put the Signature of a file into the cache; it is not returned, so that it need not travel to the caller."""
        stamp = _stamp(path)
        served = self.served(path)
        if served is not None:
            return served
        key, signature = self._put(path)
        return CacheHit(key, SignatureCache(self.cache_dir).path(key).stat().st_size, tuple(signature.notes), stamp)

    def served(self, path: Path) -> CacheHit | None:
        """What in the cache serves a file, None if nothing does.

        Raises:
            MeshError: the file cannot be read.
        """
        stamp = _stamp(path)
        key = next(self._cached(path), None)
        if key is None:
            return None
        cache = SignatureCache(self.cache_dir)
        return CacheHit(key, cache.path(key).stat().st_size, cache.notes(key), stamp)

    def notes(self, path: Path) -> tuple[str, ...]:
        """What was done to the mesh of a cached Signature, in words."""
        key = next(self._cached(path), None)
        return () if key is None else SignatureCache(self.cache_dir).notes(key)

    def is_cached(self, path: Path) -> bool:
        """Whether the Signature of a file can be read; false for a file that cannot."""
        try:
            return self.served(path) is not None
        except MeshError:
            return False

    def key(self, path: Path, *, mended: bool = False) -> str:
        """A Signature's name in the cache: content of the file, how it is read, every parameter and version.

        Args:
            path: the file.
            mended: whether anything was done to its mesh. Only then does the version of the mending count, so that a
                new one leaves the Signatures of bodies that are read as they are.

        Raises:
            MeshError: the file cannot be read.
        """
        return self._key(path, _content(path), self.config, mended)

    def _put(self, path: Path) -> tuple[str, Signature]:
        """The Signature of a file, computed, and its key in the cache where it is then."""
        signature = compute_signature(self.mesh(path), self.config)
        key = self.key(path, mended=bool(mended_by(signature.notes)))
        SignatureCache(self.cache_dir).put(key, signature)
        return key, signature

    def _cached(self, path: Path) -> Iterator[str]:
        """The keys that the cache has of the Signature of a file and of larger ones, which begin with it."""
        cache, content = SignatureCache(self.cache_dir), _content(path)
        for config in (self.config, *self.config.larger()):
            for mended in (False, True):
                key = self._key(path, content, config, mended)
                if key not in cache:
                    continue
                steps = mended_by(cache.notes(key))
                # A former version of the mending made another body.
                of_this_version = mended or not steps
                # A mesh that was subdivided for more vertices is another one.
                read_alike = config.n_vertices_read == self.config.n_vertices_read
                if of_this_version and (read_alike or "subdivided" not in steps):
                    yield key

    def _key(self, path: Path, content: bytes, config: SignatureConfig, mended: bool) -> str:
        # The suffix chooses the reader, so the same bytes under another suffix are another mesh.
        versions = config.ALGORITHM_VERSION, MENDING_VERSION if mended else None
        parameters = _parameters(path.suffix.lower(), self.reading, config, versions)
        key = hashlib.sha256(parameters + b"\0")
        key.update(content)  # not joined with them: the file may be large
        return key.hexdigest()


@lru_cache
def _parameters(suffix: str, reading: LoadOptions, config: SignatureConfig, versions: tuple[int, int | None]) -> bytes:
    """What a key depends on beside the content of the file, the same for thousands of files."""
    algorithm, mending = versions
    how: list[object] = [suffix, reading.as_dict()]
    if mending is not None:
        how.append({"mending_version": mending})
    return json.dumps([how, {**config.as_dict(), "algorithm_version": algorithm}], sort_keys=True).encode()


def version() -> str:
    """What must be the same wherever Signatures of one cache are computed."""
    return f"{importlib.metadata.version('interior-gps')}, signatures {SignatureConfig.ALGORITHM_VERSION}"


def fill_elsewhere(pipeline: SignaturePipeline, expected: str, path: Path) -> CacheHit:
    """`SignaturePipeline.fill` by a worker of a cluster.

    Raises:
        MachineError: the worker has another version of the library.
    """
    here = version()
    if here != expected:
        raise MachineError(
            f"the worker on {socket.gethostname()} has igps {here}, where {expected} is asked for. Install one version "
            "everywhere and run again: what is done is kept."
        )
    return pipeline.fill(path)


def _stamp(path: Path) -> tuple[int, int, int]:
    try:
        return CacheHit.stamp_of(path)
    except OSError as error:
        raise MeshError(f"{path}: cannot be read ({error.strerror}). Check the path.") from error


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise MeshError(f"{path}: cannot be read ({error.strerror}). Check the path.") from error
