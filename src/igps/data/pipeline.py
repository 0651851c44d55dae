"""How a body in a file becomes a Signature: read, computed and cached, in this process or in a worker."""

import hashlib
import importlib.metadata
import json
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Protocol

import numpy as np

from igps._parallel import Failed, MachineError, attempt
from igps.data.attribute_sources import with_load_options
from igps.data.attributes import AttributeSource, with_attribute
from igps.data.cache import AttributeCache, SignatureCache, content_digest
from igps.mesh.formats import files_read, stamp_of
from igps.mesh.loading import BodyRef, each_body, load_mesh
from igps.mesh.mending import MENDING_VERSION, repair_steps
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.options import LoadOptions
from igps.signature.signature import SAMPLE_KINDS, Signature, SignatureConfig, compute_signature


class PreTransform(Protocol):
    """What changes every Signature before it is cached; picklable."""

    @property
    def cache_tag(self) -> str:
        """All that the change depends on, in words."""

    def __call__(self, signature: Signature) -> Signature:
        """The changed Signature; the name of the given one is its key in the cache."""


@dataclass(frozen=True)
class BodyFile:
    """What the key of a Signature depends on of a file."""

    stamp: tuple[int, int, int]  # see `stamp_of`
    digest: bytes  # of its content, and of what is read with it


@dataclass(frozen=True)
class CacheHit:
    """The Signature in the cache that serves a body."""

    key: str  # its name in the cache; that of a larger one, if that is there
    n_bytes: int  # size of its file
    notes: tuple[str, ...]  # what was done to the mesh, in words
    stamp: tuple[int, int, int]  # of the body's file when it was read, see `stamp_of`
    attributes: Mapping[str, str] = field(default_factory=dict)  # names in the cache of what was added, by attribute

    @property
    def whole_key(self) -> str:
        """A name for the Signature with its attributes."""
        return _digest([self.key, sorted(self.attributes.items())]) if self.attributes else self.key


@dataclass(frozen=True)
class SignaturePipeline:
    """All that the Signature of a body depends on, and where it is kept; small, as workers get it."""

    config: SignatureConfig
    reading: LoadOptions
    cache_dir: Path
    attributes: Mapping[str, AttributeSource] = field(default_factory=dict)  # added to the samples, by name
    pre_transform: PreTransform | None = None  # done to the Signature with its attributes before it is kept
    # Of bodies in memory, or what is wrong with them
    meshes: Mapping[BodyRef, Mesh | MeshError] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.pre_transform is not None and not getattr(self.pre_transform, "cache_tag", None):
            raise ValueError(
                f"pre_transform: expected a cache_tag, its name in the cache, got {self.pre_transform!r} without one. "
                "Derive it from igps.data.transforms.Transform, or give it as transform=, which is not cached."
            )

    def mesh(self, body: BodyRef) -> Mesh:
        """The checked mesh of a body; a MeshError where it cannot be used."""
        if body not in self.meshes:
            return load_mesh(body.path, self.reading, part=body.part, least_vertices=self.config.n_vertices_read)
        if isinstance(mesh := self.meshes[body], MeshError):
            raise mesh
        return mesh

    def _file(self, body: BodyRef) -> BodyFile:
        """The file of a body, or what stands for one in memory; a MeshError where it cannot be read."""
        if body in self.meshes:
            mesh = self.mesh(body)
            content = mesh.vertices.tobytes(), mesh.faces.tobytes(), repr((mesh.unit, mesh.notes)).encode()
            return BodyFile((0, 0, 0), b"".join(hashlib.sha256(one).digest() for one in content))
        try:
            files = files_read(body.path, self.reading)
            return BodyFile(stamp_of(*files), content_digest(*files))
        except OSError as error:
            raise MeshError(f"{body.path}: cannot be read ({error.strerror}). Check the path.") from error

    def signature(self, body: BodyRef) -> Signature:
        """The Signature of a body, from the cache where it or a larger one is there, and there afterwards."""
        file = self._file(body)
        hit = self._lookup(body, file)
        found = None if hit is None else self.read(hit)
        return self._compute(body, file)[1] if found is None else found

    def fill(self, bodies: Sequence[BodyRef]) -> list[CacheHit | Failed]:
        """Put the Signatures of bodies of one file into the cache; they are not returned, to spare the way back.

        Returned is what serves each, or of one of several that cannot be used, why. A MeshError where the only one
        cannot be used, a MachineError where the disk is full, or the like.
        """
        if len(bodies) == 1:
            return [self.hit(bodies[0])]
        if bodies[0] in self.meshes:
            return [attempt(partial(self.hit, body)) for body in bodies]
        file = self._file(bodies[0])
        served = {body: self._lookup(body, file) for body in bodies}
        done: dict[BodyRef, CacheHit | Failed] = {body: hit for body, hit in served.items() if hit is not None}
        missing = {body.part: body for body in bodies if body not in done}
        least = self.config.n_vertices_read
        try:
            for ref, mesh in each_body(bodies[0].path, self.reading, parts=[*missing], least_vertices=least):
                body = missing[ref.part]
                if isinstance(mesh, MeshError):
                    done[body] = Failed(str(mesh))
                else:
                    done[body] = attempt(partial(self.hit, body, file, mesh))
        except MeshError as error:  # of the file: so of each
            done = {**dict.fromkeys(missing.values(), Failed(str(error))), **done}
        # A body that the file lacks fails by itself
        return [done[body] if body in done else attempt(partial(self.hit, body, file)) for body in bodies]

    def hit(self, body: BodyRef, file: BodyFile | None = None, mesh: Mesh | None = None) -> CacheHit:
        """What serves a body, which is in the cache then; a MeshError where it cannot be used."""
        file = file or self._file(body)
        return self._lookup(body, file) or self._compute(body, file, mesh)[0]

    def lookup(self, bodies: Sequence[BodyRef]) -> list[CacheHit | None]:
        """What in the cache serves each body of one file, None where nothing does; a MeshError if unreadable."""
        file = self._file(bodies[0])
        return [self._lookup(body, self._file(body) if body in self.meshes else file) for body in bodies]

    def with_attributes(self, body: BodyRef, hit: CacheHit) -> CacheHit | None:
        """The cache entry of a body whose Signature is known, with its attributes; None if one is missing."""
        if not self.attributes or self.pre_transform is not None:
            return hit
        try:
            keys = {name: self._attribute_key(body, hit.key, name) for name in self.attributes}
        except MeshError:  # computing it will say why
            return None
        cache = AttributeCache(self.cache_dir)
        return replace(hit, attributes=keys) if all(key in cache for key in keys.values()) else None

    def read(self, hit: CacheHit) -> Signature | None:
        """The Signature that was found in the cache; None if it is there no more."""
        signature = SignatureCache(self.cache_dir).get(hit.key)
        if signature is None:
            return None
        signature = signature.truncated(self.config) if self.pre_transform is None else signature
        for name, key in hit.attributes.items():
            values = AttributeCache(self.cache_dir).get(key)
            if values is None:
                return None
            signature = with_attribute(signature, name, values)
        return signature

    def key(self, body: BodyRef) -> str:
        """A Signature's name in the cache, by all that it depends on; a MeshError where the file cannot be read."""
        key = self._key(body, self._file(body), self.config, False)
        return key if self.pre_transform is None else self._changed_key(body, key)

    def _lookup(self, body: BodyRef, file: BodyFile) -> CacheHit | None:
        cache = SignatureCache(self.cache_dir)
        if self.pre_transform is None:
            key = next(self._cached(body, file), None)
        else:
            keys = (self._changed_key(body, self._key(body, file, self.config, mended)) for mended in (False, True))
            key = next((key for key in keys if key in cache), None)
        if key is None:
            return None
        hit = CacheHit(key, cache.path(key).stat().st_size, cache.notes(key), file.stamp)
        return self.with_attributes(body, hit)

    def _compute(self, body: BodyRef, file: BodyFile, mesh: Mesh | None = None) -> tuple[CacheHit, Signature]:
        """The Signature of a body, with what serves it from now on."""
        cache = SignatureCache(self.cache_dir)
        key, signature = self._compute_plain(body, file, mesh)
        keys = {}
        for name in self.attributes:
            keys[name] = self._attribute_key(body, key, name)
            signature = self._with_attribute(body, signature, name, keys[name])
        if self.pre_transform is not None:
            key = self._key(body, file, self.config, bool(repair_steps(signature.notes)))
            # What it draws by the name must not depend on which of several copies of a file comes first.
            signature = replace(self.pre_transform(replace(signature, name=key)), name=signature.name)
            key, keys = self._changed_key(body, key), {}
            cache.put(key, signature)
        return CacheHit(key, cache.path(key).stat().st_size, tuple(signature.notes), file.stamp, keys), signature

    def _compute_plain(self, body: BodyRef, file: BodyFile, mesh: Mesh | None) -> tuple[str, Signature]:
        """The Signature as it is computed, and its key in the cache, where it is then."""
        cache = SignatureCache(self.cache_dir)
        for key in self._cached(body, file):
            signature = cache.get(key)
            if signature is not None:
                return key, signature.truncated(self.config)
        signature = compute_signature(self.mesh(body) if mesh is None else mesh, self.config)
        key = self._key(body, file, self.config, bool(repair_steps(signature.notes)))
        cache.put(key, signature)
        return key, signature

    def _with_attribute(self, body: BodyRef, signature: Signature, name: str, key: str) -> Signature:
        cache = AttributeCache(self.cache_dir)
        values = cache.get(key)
        if values is not None:
            return with_attribute(signature, name, values)
        points = [getattr(signature, kind).points for kind in SAMPLE_KINDS]
        rows = with_load_options(self.attributes[name], self.reading)(body, np.concatenate(points))
        found = dict(zip(SAMPLE_KINDS, np.split(rows, [len(points[0])]), strict=True))
        signature = with_attribute(signature, name, found)
        cache.put(key, {kind: getattr(signature, kind).attributes[name] for kind in SAMPLE_KINDS})
        return signature

    def _cached(self, body: BodyRef, file: BodyFile) -> Iterator[str]:
        """The keys that the cache has of the Signature of a body and of larger ones, which begin with it."""
        cache = SignatureCache(self.cache_dir)
        for config, mended in product(_serving(self.config), (False, True)):
            key = self._key(body, file, config, mended)
            if key in cache:
                steps = repair_steps(cache.notes(key))
                # A former version of the mending made another body.
                of_this_version = mended or not steps
                # A mesh that was subdivided for more vertices is another one.
                read_alike = config.n_vertices_read == self.config.n_vertices_read
                if of_this_version and (read_alike or "subdivided" not in steps):
                    yield key

    def _key(self, body: BodyRef, file: BodyFile, config: SignatureConfig, mended: bool) -> str:
        # The version of the mending counts where anything was done to the mesh: a new one leaves the others as they are
        # The suffix chooses the reader, so the same bytes under another suffix are another mesh.
        versions = config.ALGORITHM_VERSION, MENDING_VERSION if mended else None
        name = body.path.name.lower()
        suffix = ".pqr.gz" if name.endswith(".pqr.gz") else Path(name).suffix  # the same lines may be a .pdb.gz
        how = _parameters(suffix, body.part, self.reading, config, versions)
        return hashlib.sha256(how + file.digest).hexdigest()

    def _attribute_key(self, body: BodyRef, key: str, name: str) -> str:
        return _digest(["attribute", key, name, self.attributes[name].cache_tag(body)])

    def _changed_key(self, body: BodyRef, key: str) -> str:
        """The key of the changed Signature: by the Signature's own, the change, and the attributes."""
        assert self.pre_transform is not None
        attributes = [self._attribute_key(body, key, name) for name in sorted(self.attributes)]
        return _digest(["changed", key, self.pre_transform.cache_tag, attributes])


def _digest(words: Sequence[object]) -> str:
    return hashlib.sha256(json.dumps(words).encode()).hexdigest()


@lru_cache
def _parameters(
    suffix: str, part: str | None, reading: LoadOptions, config: SignatureConfig, versions: tuple[int, int | None]
) -> bytes:
    """What a key depends on beside the content of the file, the same for thousands of files."""
    algorithm, mending = versions
    how = {"suffix": suffix, "part": part, "reading": reading.as_dict(), "mending_version": mending}
    return json.dumps([how, {**config.as_dict(), "algorithm_version": algorithm}], sort_keys=True).encode()


@lru_cache
def _serving(config: SignatureConfig) -> tuple[SignatureConfig, ...]:
    """The configurations whose Signatures hold those of this one; the same for thousands of files."""
    return (config, *config.larger())


def version() -> str:
    """What must be the same wherever Signatures of one cache are computed."""
    return f"{importlib.metadata.version('interior-gps')}, signatures {SignatureConfig.ALGORITHM_VERSION}"


def fill_elsewhere(
    fill: Callable[[Sequence[BodyRef]], list[CacheHit | Failed]], expected: str, bodies: Sequence[BodyRef]
) -> list[CacheHit | Failed]:
    """`SignaturePipeline.fill` by a worker of a cluster; a MachineError where that has another version."""
    if version() != expected:
        raise MachineError(
            f"the worker on {socket.gethostname()} has igps {version()}, where {expected} is asked for. Install one "
            "version everywhere and run again: what is done is kept."
        )
    return fill(bodies)
