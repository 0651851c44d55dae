"""Which Signature in a cache serves a file, remembered, so that files that did not change are not read again."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import sqlite3
import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from igps.data.cache import SignatureCache
from igps.data.pipeline import CacheHit, SignaturePipeline
from igps.mesh.mending import MENDING_VERSION

logger = logging.getLogger(__name__)

_FILE = "known_files.sqlite"
# Who writes holds it for milliseconds.
_PATIENCE = 30.0
# A file may change again within the grain of its clock: what is so young is not remembered.
_YOUNG = 2 * 10**9
_TABLE = (
    "CREATE TABLE IF NOT EXISTS file (pipeline TEXT, path TEXT, size INTEGER, mtime INTEGER, ctime INTEGER, key TEXT, "
    "bytes INTEGER, notes TEXT, PRIMARY KEY (pipeline, path)) WITHOUT ROWID"
)


@dataclass(frozen=True)
class Known:
    """A Signature that is there.

    Args:
        key: its name in the cache.
        notes: what was done to its mesh.
    """

    key: str
    notes: tuple[str, ...]


class FileStatCache:
    """The files of one pipeline, by path, size and times of change, in a small database beside its cache.

    It may be removed at any time, and where it cannot be read or written, it is done without.
    """

    def __init__(self, pipeline: SignaturePipeline) -> None:
        self._pipeline = pipeline
        self._path = pipeline.cache_dir / _FILE
        told = json.dumps([pipeline.reading.as_dict(), pipeline.config.as_dict(), MENDING_VERSION], sort_keys=True)
        self._name = hashlib.sha256(told.encode()).hexdigest()[:32]

    def ready(self, paths: Sequence[Path]) -> dict[Path, Known]:
        """Those of the files that have not changed since, and whose Signature is there in full."""
        found: dict[Path, Known] = {}
        if not self._path.exists():
            return found
        cache = SignatureCache(self._pipeline.cache_dir)
        with self._dispensable(), contextlib.closing(self._database()) as database:
            for path in paths:
                row = database.execute(
                    "SELECT size, mtime, ctime, key, bytes, notes FROM file WHERE pipeline = ? AND path = ?",
                    (self._name, os.path.abspath(path)),
                ).fetchone()
                if row is None:
                    continue
                with contextlib.suppress(OSError):
                    same = CacheHit.stamp_of(path) == tuple(row[:3])
                    if same and os.stat(cache.path(row[3])).st_size == row[4]:
                        found[path] = Known(row[3], tuple(json.loads(row[5])))
        return found

    def remember(self, served: Mapping[Path, CacheHit]) -> None:
        """Keep what serves these files, but for those that changed just now."""
        now = time.time_ns()
        rows = [
            (self._name, os.path.abspath(path), *one.stamp, one.key, one.n_bytes, json.dumps(one.notes))
            for path, one in served.items()
            if now - max(one.stamp[1:]) > _YOUNG
        ]
        if rows:
            with self._dispensable(), contextlib.closing(self._database()) as database, database:
                database.executemany("INSERT OR REPLACE INTO file VALUES (?, ?, ?, ?, ?, ?, ?, ?)", rows)

    def _database(self) -> sqlite3.Connection:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        database = sqlite3.connect(self._path, timeout=_PATIENCE)
        database.execute(_TABLE)
        return database

    @contextlib.contextmanager
    def _dispensable(self) -> Generator[None, None, None]:
        """What fails of the database is told, and costs no more than what it would have saved."""
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            logger.warning("%s: not usable (%s); files are read again where it would save that", self._path, error)
            if isinstance(error, sqlite3.DatabaseError) and not isinstance(error, sqlite3.OperationalError):
                with contextlib.suppress(OSError):  # no database any more: the next run makes another
                    self._path.unlink()
