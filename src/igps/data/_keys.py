"""What the names of Signatures in the cache are made of."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions
from igps.signature.signature import SignatureConfig


def stamp_of(path: Path) -> tuple[int, int, int]:
    """Bytes of a file, and when its content and its name or rights were last changed, in nanoseconds."""
    found = os.stat(path)
    return found.st_size, found.st_mtime_ns, found.st_ctime_ns


@dataclass(frozen=True)
class BodyFile:
    """What a key needs to know of a file."""

    stamp: tuple[int, int, int]  # see `stamp_of`
    digest: bytes  # of its content

    @staticmethod
    def of(path: Path) -> BodyFile:
        """What is known of a file; a MeshError where it cannot be read."""
        try:
            return BodyFile(stamp_of(path), content_digest(path))
        except OSError as error:
            raise MeshError(f"{path}: cannot be read ({error.strerror}). Check the path.") from error


def content_digest(path: Path) -> bytes:
    """Of what is in a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


def digest(words: Sequence[object]) -> str:
    return hashlib.sha256(json.dumps(words).encode()).hexdigest()


@lru_cache
def parameters(
    suffix: str, part: str | None, reading: LoadOptions, config: SignatureConfig, versions: tuple[int, int | None]
) -> bytes:
    """What a key depends on beside the content of the file, the same for thousands of files."""
    algorithm, mending = versions
    how = {"suffix": suffix, "part": part, "reading": reading.as_dict(), "mending_version": mending}
    return json.dumps([how, {**config.as_dict(), "algorithm_version": algorithm}], sort_keys=True).encode()
