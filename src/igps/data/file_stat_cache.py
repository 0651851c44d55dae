"""Cache of the keys of Signatures by file, so that unchanged files are not read again to find their Signatures."""

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
from igps.mesh.errors import MeshError
from igps.mesh.formats import dependencies_of, stat_key
from igps.mesh.loading import BodyRef
from igps.mesh.mending import MENDING_VERSION

logger = logging.getLogger(__name__)

_FILE = "known_files.sqlite"
_LOCK_TIMEOUT = 30.0  # seconds; a writer holds the lock of the database for milliseconds
MIN_AGE = (
    2 * 10**9
)  # nanoseconds; a file that was changed more recently may change again without a new time stamp
_TABLE = (
    "CREATE TABLE IF NOT EXISTS body (pipeline TEXT, path TEXT, part TEXT, size INTEGER, mtime INTEGER, ctime INTEGER, "
    "key TEXT, bytes INTEGER, notes TEXT, PRIMARY KEY (pipeline, path, part)) WITHOUT ROWID"
)
_QUERY = "SELECT size, mtime, ctime, key, bytes, notes FROM body WHERE pipeline = ? AND path = ? AND part = ?"


class FileStatCache:
    """Records of the bodies of one pipeline by path, part, size and times of change, in a database in its cache.

    The database may be removed at any time. If it cannot be read or written, a warning is logged and nothing fails.
    """

    def __init__(self, pipeline: SignaturePipeline) -> None:
        self._pipeline = pipeline
        self._path = pipeline.cache_dir / _FILE
        tag = pipeline.pre_transform.cache_tag if pipeline.pre_transform else None
        fields = [pipeline.reading.as_dict(), pipeline.config.as_dict(), MENDING_VERSION, tag]
        fields += (
            [pipeline.reading.names] if pipeline.reading.names else []
        )  # tables of names may have equal stamps
        self._pipeline_id = hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()[
            :32
        ]
        # A transform may depend on attributes, whose sources can change while the file of the body does not
        self._is_enabled = not (pipeline.attributes and pipeline.pre_transform)

    def ready(self, bodies: Iterable[BodyRef]) -> dict[BodyRef, CacheHit]:
        """Return the cache entries of the bodies whose files are unchanged and whose Signatures are in the cache."""
        hits: dict[BodyRef, CacheHit] = {}
        if not self._path.exists() or not self._is_enabled:
            return hits
        cache = SignatureCache(self._pipeline.cache_dir)
        current_stamp = lru_cache(maxsize=1)(
            lambda path: stat_key(*dependencies_of(path, self._pipeline.reading))
        )
        with self._tolerate_database_errors(), contextlib.closing(self._database()) as database:
            for body in bodies:
                row = database.execute(_QUERY, (self._pipeline_id, *_row_key(body))).fetchone()
                if row is None:
                    continue
                *stamp, key, n_bytes, notes = row
                with contextlib.suppress(OSError, MeshError):
                    is_unchanged = current_stamp(body.path) == tuple(stamp)
                    if is_unchanged and os.stat(cache.path(key)).st_size == n_bytes:
                        hit = CacheHit(key, n_bytes, tuple(json.loads(notes)), tuple(stamp))
                        if (complete := self._pipeline.with_attributes(body, hit)) is not None:
                            hits[body] = complete
        return hits

    def remember(self, hits: Mapping[BodyRef, CacheHit]) -> None:
        """Record the cache entries of bodies, except for files that were changed just now."""
        now = time.time_ns()
        rows = [
            (
                self._pipeline_id,
                *_row_key(body),
                *hit.stamp,
                hit.key,
                hit.n_bytes,
                json.dumps(hit.notes),
            )
            for body, hit in hits.items()
            if now - max(hit.stamp[1:]) > MIN_AGE
        ]
        if rows and self._is_enabled:
            with (
                self._tolerate_database_errors(),
                contextlib.closing(self._database()) as database,
                database,
            ):
                database.executemany(
                    "INSERT OR REPLACE INTO body VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", rows
                )

    def _database(self) -> sqlite3.Connection:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        database = sqlite3.connect(self._path, timeout=_LOCK_TIMEOUT)
        database.execute(_TABLE)
        return database

    @contextlib.contextmanager
    def _tolerate_database_errors(self) -> Generator[None, None, None]:
        """Log errors of the database, which only cost time, and remove a corrupt database."""
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            logger.warning(
                "%s: not usable (%s); unchanged files may be read again", self._path, error
            )
            if isinstance(error, sqlite3.DatabaseError) and not isinstance(
                error, sqlite3.OperationalError
            ):
                with contextlib.suppress(OSError):
                    self._path.unlink()


def _row_key(body: BodyRef) -> tuple[str, str]:
    return os.path.abspath(body.path), body.part or ""
