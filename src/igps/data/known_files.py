"""Digests of files that are known already, so that unchanged files are not read again to find their Signatures."""

import contextlib
import logging
import os
import sqlite3
import time
from collections.abc import Generator, Iterable
from pathlib import Path

from igps.data.keys import file_digest
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

    def digests(self, paths: Iterable[Path]) -> dict[Path, bytes]:
        """Return the digests of files, which are read only if they are new or have changed.

        Files that cannot be read are left out.
        """
        unique = dict.fromkeys(paths)
        found = self._unchanged(unique)
        rows = []
        for path in unique:
            if path in found:
                continue
            with contextlib.suppress(OSError):
                stamp = stat_key(path)  # before the content: a later change gives another stamp
                found[path] = file_digest(path)
                rows.append((os.path.abspath(path), *stamp, found[path]))
        self._remember(rows)
        return found

    def _unchanged(self, paths: Iterable[Path]) -> dict[Path, bytes]:
        found: dict[Path, bytes] = {}
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
                        found[path] = digest
        return found

    def _remember(self, rows: Iterable[tuple[str, int, int, int, bytes]]) -> None:
        """Record digests, except for files that were changed just now."""
        now = time.time_ns()
        old = [row for row in rows if now - max(row[2:4]) > MIN_AGE]
        if not old:
            return
        with self._tolerate_errors(), contextlib.closing(self._database()) as database, database:
            database.executemany("INSERT OR REPLACE INTO file VALUES (?, ?, ?, ?, ?)", old)

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
