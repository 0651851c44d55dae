"""Pipeline from the file of a body to its cached Signature, in this process or in a worker."""

import importlib.metadata
import json
import logging
import socket
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from igps._arrays import Singles
from igps._threads import one_thread
from igps.data.added_attributes import AttributeSource, with_attribute
from igps.data.attribute_sources import with_load_options
from igps.data.cache import Cache, Kind, Record, decode, encode
from igps.data.cache_hit import CacheHit
from igps.data.keys import Content, derived_key, file_digest, signature_key
from igps.data.surfaces import known_surface, surface_record
from igps.failures import Failed, MachineError, attempt
from igps.mesh.errors import MeshError
from igps.mesh.formats import dependencies_of, names_of
from igps.mesh.loading import BodyRef, each_surface, read_surface, refined, surface_body
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody
from igps.signature.measures import MEASURES_VERSION, measures
from igps.signature.signature import (
    SAMPLE_KINDS,
    SampleKind,
    Signature,
    SignatureConfig,
    compute_signature,
)

logger = logging.getLogger(__name__)


class PreTransform(Protocol):
    """Picklable transform of every Signature before it is cached."""

    @property
    def cache_tag(self) -> str:
        """Text that identifies the transform with all its parameters."""

    def __call__(self, signature: Signature) -> Signature:
        """Return the transformed Signature. The name of the given Signature is its cache key."""


@dataclass(frozen=True)
class SignaturePipeline:
    """Computation of the Signatures of bodies through a cache. It is sent to workers, so it holds little data."""

    config: SignatureConfig
    reading: LoadOptions
    cache_dir: Path
    attributes: Mapping[str, AttributeSource] = field(default_factory=dict)  # additional, by name
    pre_transform: PreTransform | None = None  # applied after the attributes are added, and cached
    # Bodies in memory, or their errors
    meshes: Mapping[BodyRef, Mesh | MeshError] = field(default_factory=dict)
    needs_cache: bool = True  # if not, what cannot be stored is only computed

    def __post_init__(self) -> None:
        if self.pre_transform is not None and not getattr(self.pre_transform, "cache_tag", None):
            raise ValueError(
                f"pre_transform: expected an object with a cache_tag, got {self.pre_transform!r}. "
                "Give it one, or pass it as transform=, which is "
                "not cached."
            )

    def cache(self, kind: Kind) -> Cache:
        """Return the cache of a kind of records."""
        return Cache(self.cache_dir, kind)

    def mesh(self, body: BodyRef) -> Mesh:
        """Return the checked mesh of a body, as for its Signature; raise a MeshError if it cannot be used."""
        return self.refined(self._read(body))

    @one_thread()
    def refined(self, mesh: Mesh) -> Mesh:
        """Return a mesh that was read with as many vertices as the configuration requires."""
        return refined(mesh, self.reading, self.config.n_vertices_read)

    @one_thread()
    def _read(self, body: BodyRef, content: Content | None = None) -> Mesh:
        """Return the mesh of a body as it was read and mended, whatever the configuration."""
        if body in self.meshes:
            mesh = self.meshes[body]
            if isinstance(mesh, MeshError):
                raise mesh
            return mesh
        content = content or self.content(body)
        raw = self._known_surface(body, content)
        if raw is None:
            raw = read_surface(body.path, self.reading, part=body.part)
            self.keep_surface(body, content, raw)
        return self._body(raw, BodyRef(body.path, raw.part))

    @one_thread()
    def _body(self, raw: RawBody, body: BodyRef) -> Mesh:
        return surface_body(raw, body, self.reading)

    def _surfaces(
        self, bodies: Iterable[BodyRef], content: Content
    ) -> Iterator[tuple[BodyRef, RawBody]]:
        """Iterate over the unchecked surfaces of bodies of one file, which is read for those that are not cached."""
        unread: dict[str | None, BodyRef] = {}
        for body in bodies:
            known = self._known_surface(body, content)
            if known is None:
                unread[body.part] = body
            else:
                yield body, known
        if not unread:
            return
        path = next(iter(unread.values())).path
        for ref, raw in each_surface(path, self.reading, parts=[*unread]):
            body = unread[ref.part]
            self.keep_surface(body, content, raw)
            yield body, raw

    def _known_surface(self, body: BodyRef, content: Content) -> RawBody | None:
        key = signature_key(content, body, self.reading, None)
        return known_surface(self.cache("surface"), key, body.part)

    def keep_surface(self, body: BodyRef, content: Content, raw: RawBody) -> None:
        """Store the surface of a label, which took time to compute."""
        if raw.voxels is not None and raw.fault is None:
            key = signature_key(content, body, self.reading, None)
            self.put("surface", key, surface_record(raw))

    def content(self, body: BodyRef, known: Mapping[Path, bytes] | None = None) -> Content:
        """Return the content of a body, with the digests of files that are known; raise a MeshError if unreadable."""
        if body in self.meshes:
            return Content.of_mesh(self._read(body))
        known = known or {}
        try:
            paths = dependencies_of(body.path, self.reading)
            digests = {path: known.get(path) or file_digest(path) for path in paths}
            return Content.of_files(digests, names_of(body.path, self.reading))
        except OSError as error:
            cause = f"{body.path}: cannot be read ({error.strerror})"
            raise MeshError(f"{cause}. Check the path.") from error

    def key(self, body: BodyRef) -> str:
        """Return the cache key of a Signature; raise a MeshError if the file cannot be read."""
        return self._keys(body, self.content(body)).key

    def find(self, body: BodyRef, content: Content) -> CacheHit | Failed | None:
        """Return the cache entry of a body, or why it could not be used before; None if neither is known."""
        try:
            keys = self._keys(body, content)
        except MeshError:  # a missing file of an attribute, which the computation reports
            return None
        texts = self.cache("signature").texts(keys.key)
        numbers = self._known_measures(body, content)
        if texts is None or numbers is None:
            return self._known_failure(body, content)
        attributes = self.cache("attribute")
        if not all(key in attributes for key in keys.attributes.values()):
            return None
        return replace(keys.with_header(texts), measures=numbers)

    def read(self, hit: CacheHit) -> Signature | None:
        """Read the Signature of a cache entry; None if it is no longer in the cache."""
        signature = self.cache("signature").get(hit.key, decode)
        if signature is None:
            return None
        for name, key in hit.attributes.items():
            values = self.cache("attribute").get(key, _values_of)
            if values is None:
                return None
            signature = with_attribute(signature, name, values)
        return replace(signature, measures=hit.measures)

    def signature(self, body: BodyRef) -> Signature:
        """Return the Signature of a body from the cache, where it is stored if it was missing."""
        content = self.content(body)
        found = self.find(body, content)
        if isinstance(found, Failed):
            raise MeshError(found.reason)
        cached = None if found is None else self.read(found)
        if cached is not None:
            return cached
        return replace(self, needs_cache=False)._compute(body, content)

    def fill(self, bodies: Sequence[BodyRef]) -> list[CacheHit | Failed]:
        """Store the Signatures of bodies of one file in the cache, and return the cache entry or failure of each.

        Signatures are not returned, because sending them from a worker would take time. If the only body cannot be
        used, a MeshError is raised; if the machine is at fault, a MachineError.
        """
        content = self.content(bodies[0])
        if len(bodies) == 1:
            return [self.hit(bodies[0], content)]
        outcomes: dict[BodyRef, CacheHit | Failed] = {}
        missing = []
        for body in bodies:
            found = self.find(body, content)
            if found is None:
                missing.append(body)
            else:
                outcomes[body] = found
        try:
            for body, raw in self._surfaces(missing, content):
                try:
                    mesh = self._body(raw, body)
                except MeshError as error:
                    outcomes[body] = self.remember(body, content, error)
                else:
                    outcomes[body] = attempt(partial(self._new_hit, body, content, mesh))
        except MeshError as error:  # in the file, and thus in all bodies that were not read before
            for body in missing:
                if body not in outcomes:
                    outcomes[body] = self.remember(body, content, error)
        for body in bodies:
            if body not in outcomes:  # it is not in the file, which reading it alone reports
                outcomes[body] = attempt(partial(self._new_hit, body, content))
        return [outcomes[body] for body in bodies]

    def hit(self, body: BodyRef, content: Content) -> CacheHit:
        """Return the cache entry of a body, computed if missing; raise a MeshError if the body cannot be used."""
        found = self.find(body, content)
        if isinstance(found, Failed):
            raise MeshError(found.reason)
        return self._new_hit(body, content) if found is None else found

    def _new_hit(self, body: BodyRef, content: Content, mesh: Mesh | None = None) -> CacheHit:
        signature = self._compute(body, content, mesh)
        return replace(
            self._keys(body, content),
            notes=tuple(signature.notes),
            unit=signature.unit,
            measures=signature.measures,
        )

    def _keys(self, body: BodyRef, content: Content) -> CacheHit:
        """Return the cache entry that a body has, or would have, without what its header tells."""
        key = signature_key(content, body, self.reading, self.config)
        attributes = {
            name: derived_key("attribute", key, name, source.cache_tag(body))
            for name, source in self.attributes.items()
        }
        if self.pre_transform is None:
            return CacheHit(key, attributes)
        tag = self.pre_transform.cache_tag
        transformed = derived_key("transformed", key, tag, sorted(attributes.items()))
        return CacheHit(transformed)

    def _compute(self, body: BodyRef, content: Content, mesh: Mesh | None = None) -> Signature:
        """Compute the Signature of a body, with attributes and transform, into the cache."""
        plain = replace(self, pre_transform=None)
        keys = plain._keys(body, content)
        signature = self._without_attributes(body, content, keys.key, mesh)
        for name, key in keys.attributes.items():
            values = self._attribute(body, signature, name, key)
            signature = with_attribute(signature, name, values)
        if self.pre_transform is not None:
            # Transforms seed random numbers by the name, so copies of a file get the same numbers only by its key
            changed = self.pre_transform(replace(signature, name=keys.key))
            signature = replace(changed, name=signature.name)
            self.put("signature", self._keys(body, content).key, encode(signature))
        return signature

    def put(self, kind: Kind, key: str, record: Record) -> None:
        """Store a record; if it cannot be stored, only warn where the cache is not needed."""
        try:
            self.cache(kind).put(key, record)
        except OSError as error:
            if self.needs_cache:
                raise
            logger.warning("%s: a %s is not stored (%s)", self.cache_dir, kind, error)

    def _without_attributes(
        self, body: BodyRef, content: Content, key: str, mesh: Mesh | None
    ) -> Signature:
        """Return the Signature of a body before attributes and transform, computed into the cache if missing."""
        signature = self.cache("signature").get(key, decode)
        numbers = self._known_measures(body, content)
        if signature is not None and numbers is not None:
            return replace(signature, measures=numbers)
        config = None  # on which reading does not depend
        try:
            mesh = self._read(body, content) if mesh is None else mesh
            config = self.config
            finer = self.refined(mesh)
            if signature is None:
                signature = compute_signature(finer, replace(config, measures=False))
                self.put("signature", key, encode(signature))
            if numbers is None:
                has_usual_points = config.has_usual_samples and finer is mesh
                points = signature.interior.points if has_usual_points else None
                numbers = measures(mesh, points)
                texts = {"measures": json.dumps(numbers)}
                self.put("measure", self._measures_key(body, content), Record({}, texts))
        except MeshError as error:
            self.remember(body, content, error, config)
            raise
        return replace(signature, measures=numbers)

    def _known_measures(self, body: BodyRef, content: Content) -> Mapping[str, float] | None:
        """Return the plain numbers of a body; none if they are not asked for, None if they are not in the cache."""
        if not self.config.measures:
            return {}
        key = self._measures_key(body, content)
        return self.cache("measure").get(key, lambda record: json.loads(record.texts["measures"]))

    def _measures_key(self, body: BodyRef, content: Content) -> str:
        surface = signature_key(content, body, self.reading, None)
        return derived_key("measure", surface, MEASURES_VERSION)

    def _attribute(
        self, body: BodyRef, signature: Signature, name: str, key: str
    ) -> Mapping[SampleKind, Singles]:
        """Return the values of an attribute at the samples, computed into the cache if missing."""
        cache = self.cache("attribute")
        cached = cache.get(key, _values_of)
        if cached is not None:
            return cached
        points = [getattr(signature, kind).points for kind in SAMPLE_KINDS]
        source = with_load_options(self.attributes[name], self.reading)
        rows = np.split(source(body, np.concatenate(points)), [len(points[0])])
        checked = with_attribute(signature, name, dict(zip(SAMPLE_KINDS, rows, strict=True)))
        values: dict[Any, Singles] = {
            kind: getattr(checked, kind).attributes[name] for kind in SAMPLE_KINDS
        }
        self.put("attribute", key, Record(values))
        return values

    def _failure_key(self, body: BodyRef, content: Content, config: SignatureConfig | None) -> str:
        # A message names the file, and another version of the library may be able to read it
        key = signature_key(content, body, self.reading, config)
        return derived_key("failure", key, str(body), version())

    def _known_failure(self, body: BodyRef, content: Content) -> Failed | None:
        """Return why a body could not be used before, with any configuration or with this one."""
        for config in (None, self.config):
            failure = self.cache("failure").texts(self._failure_key(body, content, config))
            if failure is not None:
                return Failed(failure["reason"], failure.get("summary", ""))
        return None

    def remember(
        self,
        body: BodyRef,
        content: Content,
        error: MeshError,
        config: SignatureConfig | None = None,
    ) -> Failed:
        """Keep why a body cannot be used, with a configuration or any, unless the machine may be at fault."""
        failed = Failed.of(error)
        if body not in self.meshes and not isinstance(error.__cause__, OSError):
            record = Record({}, {"reason": failed.reason, "summary": failed.summary})
            self.put("failure", self._failure_key(body, content, config), record)
        return failed


def _values_of(record: Record) -> dict[SampleKind, Singles]:
    return {kind: record.arrays[kind] for kind in SAMPLE_KINDS}


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
