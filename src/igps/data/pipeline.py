"""Pipeline from the file of a body to its cached Signature, in this process or in a worker."""

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

from igps._failures import Failed, MachineError, attempt
from igps.data.attribute_sources import with_load_options
from igps.data.attributes import AttributeSource, with_attribute
from igps.data.cache import AttributeCache, SignatureCache, content_digest
from igps.mesh.errors import MeshError
from igps.mesh.formats import dependencies_of, stat_key
from igps.mesh.loading import BodyRef, each_body, load_mesh
from igps.mesh.mending import MENDING_VERSION, repair_steps
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.signature.signature import SAMPLE_KINDS, Signature, SignatureConfig, compute_signature


class PreTransform(Protocol):
    """Picklable transform of every Signature before it is cached."""

    @property
    def cache_tag(self) -> str:
        """Text that identifies the transform with all its parameters."""

    def __call__(self, signature: Signature) -> Signature:
        """Return the transformed Signature. The name of the given Signature is its cache key."""


@dataclass(frozen=True)
class BodyFile:
    """Time stamp and content of the file of a body."""

    stamp: tuple[int, int, int]  # see `stat_key`
    digest: bytes  # of the content of the file, and of the files that are read with it


@dataclass(frozen=True)
class CacheHit:
    """The cache entry of a body."""

    key: str  # of the Signature, which may have more eigenpairs or attributes than requested
    n_bytes: int  # size of the cached file
    notes: tuple[str, ...]  # on how the mesh was changed
    stamp: tuple[int, int, int]  # of the body's file when it was read, see `stat_key`
    attributes: Mapping[str, str] = field(
        default_factory=dict
    )  # cache keys of added attributes, by name

    @property
    def whole_key(self) -> str:
        """Key of the Signature with its attributes."""
        return _digest([self.key, sorted(self.attributes.items())]) if self.attributes else self.key


@dataclass(frozen=True)
class SignaturePipeline:
    """Computation of the Signatures of bodies through a cache. It is sent to workers, so it holds little data."""

    config: SignatureConfig
    reading: LoadOptions
    cache_dir: Path
    attributes: Mapping[str, AttributeSource] = field(
        default_factory=dict
    )  # additional attributes by name
    pre_transform: PreTransform | None = None  # applied after the attributes are added, and cached
    meshes: Mapping[BodyRef, Mesh | MeshError] = field(
        default_factory=dict
    )  # bodies in memory, or their errors

    def __post_init__(self) -> None:
        if self.pre_transform is not None and not getattr(self.pre_transform, "cache_tag", None):
            raise ValueError(
                f"pre_transform: expected an object with a cache_tag, got {self.pre_transform!r}. Derive it from "
                "igps.data.transforms.Transform, or pass it as transform=, which is not cached."
            )

    def mesh(self, body: BodyRef) -> Mesh:
        """Return the checked mesh of a body; raise a MeshError if it cannot be used."""
        if body not in self.meshes:
            return load_mesh(
                body.path, self.reading, part=body.part, least_vertices=self.config.n_vertices_read
            )
        if isinstance(mesh := self.meshes[body], MeshError):
            raise mesh
        return mesh

    def _file(self, body: BodyRef) -> BodyFile:
        """Return stamp and digest of the file of a body, or of its mesh in memory; raise a MeshError if unreadable."""
        if body in self.meshes:
            mesh = self.mesh(body)
            content = (
                mesh.vertices.tobytes(),
                mesh.faces.tobytes(),
                repr((mesh.unit, mesh.notes)).encode(),
            )
            return BodyFile((0, 0, 0), b"".join(hashlib.sha256(data).digest() for data in content))
        try:
            files = dependencies_of(body.path, self.reading)
            return BodyFile(stat_key(*files), content_digest(*files))
        except OSError as error:
            raise MeshError(
                f"{body.path}: cannot be read ({error.strerror}). Check the path."
            ) from error

    def signature(self, body: BodyRef) -> Signature:
        """Return the Signature of a body from the cache, where it is stored if it was missing."""
        file = self._file(body)
        hit = self._lookup(body, file)
        cached = None if hit is None else self.read(hit)
        return self._compute(body, file)[1] if cached is None else cached

    def fill(self, bodies: Sequence[BodyRef]) -> list[CacheHit | Failed]:
        """Store the Signatures of bodies of one file in the cache, and return the cache entry or failure of each.

        Signatures are not returned, because sending them from a worker would take time. If the only body cannot be
        used, a MeshError is raised; if the machine is at fault, a MachineError.
        """
        if len(bodies) == 1:
            return [self.hit(bodies[0])]
        if bodies[0] in self.meshes:
            return [attempt(partial(self.hit, body)) for body in bodies]
        file = self._file(bodies[0])
        cached = {body: self._lookup(body, file) for body in bodies}
        outcomes: dict[BodyRef, CacheHit | Failed] = {
            body: hit for body, hit in cached.items() if hit is not None
        }
        missing = {body.part: body for body in bodies if body not in outcomes}
        min_vertices = self.config.n_vertices_read
        try:
            for ref, mesh in each_body(
                bodies[0].path, self.reading, parts=[*missing], least_vertices=min_vertices
            ):
                body = missing[ref.part]
                if isinstance(mesh, MeshError):
                    outcomes[body] = Failed(str(mesh))
                else:
                    outcomes[body] = attempt(partial(self.hit, body, file, mesh))
        except MeshError as error:  # in the file, and thus in all bodies that were not read before
            outcomes = {**dict.fromkeys(missing.values(), Failed(str(error))), **outcomes}
        # The error of a body that is not in the file is raised by `hit`
        return [
            outcomes[body] if body in outcomes else attempt(partial(self.hit, body, file))
            for body in bodies
        ]

    def hit(
        self, body: BodyRef, file: BodyFile | None = None, mesh: Mesh | None = None
    ) -> CacheHit:
        """Return the cache entry of a body, computed if missing; raise a MeshError if the body cannot be used."""
        file = file or self._file(body)
        return self._lookup(body, file) or self._compute(body, file, mesh)[0]

    def lookup(self, bodies: Sequence[BodyRef]) -> list[CacheHit | None]:
        """Return the cache entries of bodies of one file, None if missing; raise a MeshError if it is unreadable."""
        file = self._file(bodies[0])
        return [
            self._lookup(body, self._file(body) if body in self.meshes else file) for body in bodies
        ]

    def with_attributes(self, body: BodyRef, hit: CacheHit) -> CacheHit | None:
        """Return the cache entry of a body with the keys of its attributes; None if one is not cached."""
        if not self.attributes or self.pre_transform is not None:
            return hit
        try:
            keys = {name: self._attribute_key(body, hit.key, name) for name in self.attributes}
        except MeshError:  # which the computation reports
            return None
        cache = AttributeCache(self.cache_dir)
        return replace(hit, attributes=keys) if all(key in cache for key in keys.values()) else None

    def read(self, hit: CacheHit) -> Signature | None:
        """Read the Signature of a cache entry; None if it is no longer in the cache."""
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
        """Return the cache key of a Signature; raise a MeshError if the file cannot be read."""
        key = self._key(body, self._file(body), self.config, False)
        return key if self.pre_transform is None else self._transformed_key(body, key)

    def _lookup(self, body: BodyRef, file: BodyFile) -> CacheHit | None:
        cache = SignatureCache(self.cache_dir)
        if self.pre_transform is None:
            key = next(self._cached_keys(body, file), None)
        else:
            keys = (
                self._transformed_key(body, self._key(body, file, self.config, mended))
                for mended in (False, True)
            )
            key = next((key for key in keys if key in cache), None)
        if key is None:
            return None
        hit = CacheHit(key, cache.path(key).stat().st_size, cache.notes(key), file.stamp)
        return self.with_attributes(body, hit)

    def _compute(
        self, body: BodyRef, file: BodyFile, mesh: Mesh | None = None
    ) -> tuple[CacheHit, Signature]:
        """Compute the Signature of a body into the cache, and return its cache entry and the Signature."""
        cache = SignatureCache(self.cache_dir)
        key, signature = self._compute_without_attributes(body, file, mesh)
        attribute_keys = {}
        for name in self.attributes:
            attribute_keys[name] = self._attribute_key(body, key, name)
            signature = self._with_attribute(body, signature, name, attribute_keys[name])
        if self.pre_transform is not None:
            key = self._key(body, file, self.config, bool(repair_steps(signature.notes)))
            # Transforms seed random numbers by the name, so copies of a file get the same numbers only by its key
            signature = replace(
                self.pre_transform(replace(signature, name=key)), name=signature.name
            )
            key, attribute_keys = self._transformed_key(body, key), {}
            cache.put(key, signature)
        n_bytes = cache.path(key).stat().st_size
        return CacheHit(key, n_bytes, tuple(signature.notes), file.stamp, attribute_keys), signature

    def _compute_without_attributes(
        self, body: BodyRef, file: BodyFile, mesh: Mesh | None
    ) -> tuple[str, Signature]:
        """Return the key and the Signature of a body before attributes and transform, computed if missing."""
        cache = SignatureCache(self.cache_dir)
        for key in self._cached_keys(body, file):
            signature = cache.get(key)
            if signature is not None:
                return key, signature.truncated(self.config)
        signature = compute_signature(self.mesh(body) if mesh is None else mesh, self.config)
        key = self._key(body, file, self.config, bool(repair_steps(signature.notes)))
        cache.put(key, signature)
        return key, signature

    def _with_attribute(
        self, body: BodyRef, signature: Signature, name: str, key: str
    ) -> Signature:
        cache = AttributeCache(self.cache_dir)
        values = cache.get(key)
        if values is not None:
            return with_attribute(signature, name, values)
        points = [getattr(signature, kind).points for kind in SAMPLE_KINDS]
        rows = with_load_options(self.attributes[name], self.reading)(body, np.concatenate(points))
        rows_by_kind = dict(zip(SAMPLE_KINDS, np.split(rows, [len(points[0])]), strict=True))
        signature = with_attribute(signature, name, rows_by_kind)
        cache.put(key, {kind: getattr(signature, kind).attributes[name] for kind in SAMPLE_KINDS})
        return signature

    def _cached_keys(self, body: BodyRef, file: BodyFile) -> Iterator[str]:
        """Yield the cached keys of the Signature of a body, or of larger Signatures that contain it."""
        cache = SignatureCache(self.cache_dir)
        for config, mended in product(_sufficient_configs(self.config), (False, True)):
            key = self._key(body, file, config, mended)
            if key in cache:
                steps = repair_steps(cache.notes(key))
                # Not a body that an earlier version mended, whose key lacks the version
                has_current_mending = mended or not steps
                # Not a mesh that was subdivided for another number of vertices
                has_same_mesh = (
                    config.n_vertices_read == self.config.n_vertices_read
                    or "subdivided" not in steps
                )
                if has_current_mending and has_same_mesh:
                    yield key

    def _key(self, body: BodyRef, file: BodyFile, config: SignatureConfig, mended: bool) -> str:
        # The version of the mending matters only for mended meshes, so a new version keeps the keys of all others
        versions = config.ALGORITHM_VERSION, MENDING_VERSION if mended else None
        # The suffix selects the reader: the same lines in .pdb.gz and .pqr.gz are different molecules
        name = body.path.name.lower()
        suffix = ".pqr.gz" if name.endswith(".pqr.gz") else Path(name).suffix
        parameters = _key_parameters(suffix, body.part, self.reading, config, versions)
        return hashlib.sha256(parameters + file.digest).hexdigest()

    def _attribute_key(self, body: BodyRef, key: str, name: str) -> str:
        return _digest(["attribute", key, name, self.attributes[name].cache_tag(body)])

    def _transformed_key(self, body: BodyRef, key: str) -> str:
        """Return the key of a Signature after `pre_transform`, for its key before."""
        assert self.pre_transform is not None
        attributes = [self._attribute_key(body, key, name) for name in sorted(self.attributes)]
        return _digest(["changed", key, self.pre_transform.cache_tag, attributes])


def _digest(values: Sequence[object]) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()


@lru_cache
def _key_parameters(
    suffix: str,
    part: str | None,
    reading: LoadOptions,
    config: SignatureConfig,
    versions: tuple[int, int | None],
) -> bytes:
    """Return the part of a key that is not the content of the file; cached, because thousands of files share it."""
    algorithm, mending = versions
    loading = {
        "suffix": suffix,
        "part": part,
        "reading": reading.as_dict(),
        "mending_version": mending,
    }
    return json.dumps(
        [loading, {**config.as_dict(), "algorithm_version": algorithm}], sort_keys=True
    ).encode()


@lru_cache
def _sufficient_configs(config: SignatureConfig) -> tuple[SignatureConfig, ...]:
    """Return the configurations whose Signatures contain those of `config`."""
    return (config, *config.larger())


def version() -> str:
    """Return the versions that must be the same on all machines that compute Signatures for a cache."""
    return f"{importlib.metadata.version('interior-gps')}, signatures {SignatureConfig.ALGORITHM_VERSION}"


def fill_elsewhere(
    fill: Callable[[Sequence[BodyRef]], list[CacheHit | Failed]],
    expected: str,
    bodies: Sequence[BodyRef],
) -> list[CacheHit | Failed]:
    """Call `SignaturePipeline.fill` on a worker of a cluster; raise a MachineError if it has another version."""
    if version() != expected:
        raise MachineError(
            f"the worker on {socket.gethostname()} has igps {version()}, but {expected} is required. Install the same "
            "version everywhere and run again: finished results are kept."
        )
    return fill(bodies)
