"""Which bodies a file holds: asked of the file once, and afterwards of the cache."""

import contextlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from igps.data.cache import Cache, Record
from igps.data.keys import Content, derived_key
from igps.data.known_files import KnownFiles
from igps.data.pipeline import SignaturePipeline, version
from igps.mesh.errors import MeshError, NoBodyError
from igps.mesh.formats import dependencies_of
from igps.mesh.loading import BodyRef, is_one_body, list_bodies
from igps.mesh.options import LoadOptions
from igps.signature.config import SignatureConfig


@dataclass(frozen=True)
class Listing:
    """Lists the bodies of files; without a cache, all files are read."""

    options: LoadOptions
    cache_dir: Path | None = None

    def of(self, paths: Iterable[Path]) -> dict[Path, list[BodyRef]]:
        """Return the bodies of each file; the file itself if it is unreadable, which the computation reports."""
        listed: dict[Path, list[BodyRef]] = {}
        several: dict[Path, list[Path]] = {}  # files that may hold several, with those beside them
        for path in dict.fromkeys(paths):
            listed[path] = [BodyRef(path)]
            try:
                if not is_one_body(path, self.options):
                    several[path] = dependencies_of(path, self.options)
            except MeshError:
                continue
        known: dict[Path, bytes] = {}
        if self.cache_dir is not None:
            all_files = (file for files in several.values() for file in files)
            known = KnownFiles(self.cache_dir).digests(all_files)
        for path, files in several.items():
            if all(file in known for file in files):
                content = Content.of_files({file: known[file] for file in files})
                listed[path] = self._cached(path, content)
            else:
                listed[path], _ = _read(path, self.options)
        return listed

    def _cached(self, path: Path, content: Content) -> list[BodyRef]:
        """Return the bodies of a file from the cache, where they are stored if they were missing."""
        assert self.cache_dir is not None
        cache = Cache(self.cache_dir, "listing")
        options = json.dumps([self.options.as_dict(), self.options.names], sort_keys=True)
        key = derived_key("listing", content.digest.hex(), path.name, options, version())
        texts = cache.texts(key)
        if texts is not None:
            return [BodyRef(path, part, number) for part, number in json.loads(texts["bodies"])]
        bodies, nothing = _read(path, self.options)
        if isinstance(nothing, NoBodyError):
            pipeline = SignaturePipeline(
                SignatureConfig(), self.options, self.cache_dir, needs_cache=False
            )
            pipeline.remember(bodies[0], content, nothing)  # it need not be read once more
        if nothing is None or isinstance(nothing, NoBodyError):
            rows = json.dumps([(body.part, body.number) for body in bodies])
            with contextlib.suppress(OSError):  # a folder that cannot be written is reported later
                cache.put(key, Record({}, {"bodies": rows}))
        return bodies


def _read(path: Path, options: LoadOptions) -> tuple[list[BodyRef], MeshError | None]:
    """Return the bodies of a file, or the file itself and the error if it could not be read."""
    try:
        return list_bodies(path, options) or [BodyRef(path)], None
    except MeshError as error:
        return [BodyRef(path)], error
