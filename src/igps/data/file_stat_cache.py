"""Which Signature in a cache serves a body, remembered, so that files that did not change are not read again."""

import contextlib
import hashlib
import json
import logging
import os
import sqlite3
import time
from collections.abc import Generator, Iterable, Mapping
from functools import lru_cache

from igps.data.cache import SignatureCache
from igps.data.pipeline import CacheHit, SignaturePipeline
from igps.mesh.formats import files_read, stamp_of
from igps.mesh.loading import BodyRef
from igps.mesh.mending import MENDING_VERSION
from igps.mesh.mesh import MeshError

logger = logging.getLogger(__name__)

_FILE = "known_files.sqlite"
# A writer holds it for milliseconds.
_PATIENCE = 30.0
# A file may change again before its clock moves on: one that is younger than this is not remembered.
_YOUNG = 2 * 10**9
_TABLE = (
    "CREATE TABLE IF NOT EXISTS body (pipeline TEXT, path TEXT, part TEXT, size INTEGER, mtime INTEGER, ctime INTEGER, "
    "key TEXT, bytes INTEGER, notes TEXT, PRIMARY KEY (pipeline, path, part)) WITHOUT ROWID"
)


class FileStatCache:
    """The bodies of one pipeline, by path, part, size and times of change, in a small database beside its cache.

    It may be removed at any time, and nothing fails where it cannot be read or written.
    """

    def __init__(self, pipeline: SignaturePipeline) -> None:
        self._pipeline = pipeline
        self._path = pipeline.cache_dir / _FILE
        changed = pipeline.pre_transform.cache_tag if pipeline.pre_transform else None
        words = [pipeline.reading.as_dict(), pipeline.config.as_dict(), MENDING_VERSION, changed]
        words += [pipeline.reading.names] if pipeline.reading.names else []  # another table may have the same time
        self._name = hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()[:32]
        # What attributes depend on may change while the file does not, and a transform may depend on them.
        self._is_useful = not (pipeline.attributes and pipeline.pre_transform)

    def ready(self, bodies: Iterable[BodyRef]) -> dict[BodyRef, CacheHit]:
        """The bodies whose files have not changed since, and whose Signatures are complete in the cache."""
        found: dict[BodyRef, CacheHit] = {}
        if not self._path.exists() or not self._is_useful:
            return found
        cache = SignatureCache(self._pipeline.cache_dir)
        stamp_now = lru_cache(maxsize=1)(lambda path: stamp_of(*files_read(path, self._pipeline.reading)))
        with self._tolerating_faults(), contextlib.closing(self._database()) as database:
            for body in bodies:
                row = database.execute(
                    "SELECT size, mtime, ctime, key, bytes, notes FROM body "
                    "WHERE pipeline = ? AND path = ? AND part = ?",
                    (self._name, *_row_key(body)),
                ).fetchone()
                if row is None:
                    continue
                *stamp, key, n_bytes, notes = row
                with contextlib.suppress(OSError, MeshError):
                    same = stamp_now(body.path) == tuple(stamp)
                    if same and os.stat(cache.path(key)).st_size == n_bytes:
                        hit = CacheHit(key, n_bytes, tuple(json.loads(notes)), tuple(stamp))
                        if (whole := self._pipeline.with_attributes(body, hit)) is not None:
                            found[body] = whole
        return found

    def remember(self, hits: Mapping[BodyRef, CacheHit]) -> None:
        """Keep what serves these bodies, but for files that changed just now."""
        now = time.time_ns()
        rows = [
            (self._name, *_row_key(body), *hit.stamp, hit.key, hit.n_bytes, json.dumps(hit.notes))
            for body, hit in hits.items()
            if now - max(hit.stamp[1:]) > _YOUNG
        ]
        if rows and self._is_useful:
            with self._tolerating_faults(), contextlib.closing(self._database()) as database, database:
                database.executemany("INSERT OR REPLACE INTO body VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)

    def _database(self) -> sqlite3.Connection:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        database = sqlite3.connect(self._path, timeout=_PATIENCE)
        database.execute(_TABLE)
        return database

    @contextlib.contextmanager
    def _tolerating_faults(self) -> Generator[None, None, None]:
        """A fault of the database is logged, and costs no more than the database would have saved."""
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            logger.warning("%s: not usable (%s); files are read again where it would save that", self._path, error)
            if isinstance(error, sqlite3.DatabaseError) and not isinstance(error, sqlite3.OperationalError):
                with contextlib.suppress(OSError):  # no database any more: the next run makes another
                    self._path.unlink()


def _row_key(body: BodyRef) -> tuple[str, str]:
    return os.path.abspath(body.path), body.part or ""
