"""Digests of files that are known already, so that unchanged files are not read again to find their Signatures."""

import contextlib
import logging
import os
import sqlite3
import time
from collections.abc import Generator, Iterable
from pathlib import Path

from igps.data.keys import FileDigest
from igps.mesh.formats import stat_key

logger = logging.getLogger(__name__)

_FILE = "known_files.sqlite"
_LOCK_TIMEOUT = 30.0  # seconds; a writer holds the lock of the database for milliseconds
# Nanoseconds; a file that was changed more recently may change again without a new time stamp
MIN_AGE = 2 * 10**9
_TABLE = (
    "CREATE TABLE IF NOT EXISTS file (path TEXT PRIMARY KEY, size INTEGER, mtime INTEGER, "
    "ctime INTEGER, digest BLOB) WITHOUT ROWID"
)
_QUERY = "SELECT size, mtime, ctime, digest FROM file WHERE path = ?"


class KnownFiles:
    """Digests of files by path, size and times of change, in a database in the directory of the cache.

    The database may be removed at any time. If it cannot be read or written, a warning is logged and nothing fails.
    """

    def __init__(self, cache_dir: Path) -> None:
        self._path = cache_dir / _FILE

    def digests(self, paths: Iterable[Path]) -> dict[Path, FileDigest]:
        """Return the digests of files, which are read only if they are new or have changed.

        Files that cannot be read are left out.
        """
        unique = dict.fromkeys(paths)
        found = self._unchanged(unique)
        new = {}
        for path in unique:
            if path not in found:
                with contextlib.suppress(OSError):
                    new[path] = FileDigest.of(path)
        self._remember(new.values())
        return found | new

    def _unchanged(self, paths: Iterable[Path]) -> dict[Path, FileDigest]:
        found: dict[Path, FileDigest] = {}
        if not self._path.exists():
            return found
        with self._tolerate_errors(), contextlib.closing(self._database()) as database:
            for path in paths:
                row = database.execute(_QUERY, (os.path.abspath(path),)).fetchone()
                if row is None:
                    continue
                *stamp, digest = row
                with contextlib.suppress(OSError):
                    if stat_key(path) == tuple(stamp):
                        found[path] = FileDigest(path, stat_key(path), digest)
        return found

    def _remember(self, files: Iterable[FileDigest]) -> None:
        """Record digests, except for files that were changed just now."""
        now = time.time_ns()
        rows = [
            (os.path.abspath(file.path), *file.stamp, file.digest)
            for file in files
            if now - max(file.stamp[1:]) > MIN_AGE
        ]
        if not rows:
            return
        with self._tolerate_errors(), contextlib.closing(self._database()) as database, database:
            database.executemany("INSERT OR REPLACE INTO file VALUES (?, ?, ?, ?, ?)", rows)

    def _database(self) -> sqlite3.Connection:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        database = sqlite3.connect(self._path, timeout=_LOCK_TIMEOUT)
        database.execute(_TABLE)
        return database

    @contextlib.contextmanager
    def _tolerate_errors(self) -> Generator[None, None, None]:
        """Log errors of the database, which only cost time, and remove a corrupt database."""
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            message = "%s: not usable (%s); unchanged files may be read again"
            logger.warning(message, self._path, error)
            is_corrupt = isinstance(error, sqlite3.DatabaseError)
            if is_corrupt and not isinstance(error, sqlite3.OperationalError):
                with contextlib.suppress(OSError):
                    self._path.unlink()
