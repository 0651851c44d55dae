"""Identities: the content of files, the key of a Signature, and the keys of all that is made from it.

The key of a Signature is the hash of everything that it depends on: the content of its files, the number of a label or
the name of another body, the load options, the configuration, and the versions of mending and of the algorithm. What is
made from a Signature (an attribute, a transformed Signature, a description) has the hash of that key and of its own
parameters as key, see `derived_key`. Plain numbers are made from the surface, whose key has no configuration.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from igps.mesh.loading import BodyRef
from igps.mesh.mending import MENDING_VERSION
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.signature.config import SignatureConfig


@dataclass(frozen=True)
class Content:
    """The content of a body: of its file and of the files that are read with it, or of its mesh in memory."""

    digest: bytes
    nameless: bytes | None = None  # the digest without a table of names; None if there is no table

    @staticmethod
    def of_files(digests: Mapping[Path, bytes], names: Sequence[Path] = ()) -> "Content":
        """Return the content of a file and its companions, by their digests; `names` only name the bodies."""
        own = [digest for path, digest in digests.items() if path not in names]
        nameless = _joint(own) if len(own) < len(digests) else None
        return Content(_joint([*digests.values()]), nameless)

    @staticmethod
    def of_mesh(mesh: Mesh) -> "Content":
        """Return the content of a mesh in memory."""
        facts = repr((mesh.unit, mesh.notes, dict(mesh.given))).encode()
        arrays = (mesh.vertices.tobytes(), mesh.faces.tobytes())
        return Content(b"".join(_hash(part) for part in (*arrays, facts)))


def content_digest(*files: Path) -> bytes:
    """Return a digest of the content of a file and of the companion files that are read with it."""
    return Content.of_files({file: file_digest(file) for file in files}).digest


def file_digest(path: Path) -> bytes:
    """Return the SHA-256 of a file; raise an OSError if it cannot be read."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


def signature_key(
    content: Content, body: BodyRef, reading: LoadOptions, config: SignatureConfig | None
) -> str:
    """Return the key of the Signature of a body; without a configuration, of its surface as it was read."""
    # The suffix selects the reader: the same lines in .pdb.gz and .pqr.gz are different molecules
    name = body.path.name.lower()
    suffix = ".pqr.gz" if name.endswith(".pqr.gz") else Path(name).suffix
    if body.number is None:
        parameters = _parameters(suffix, body.part, None, reading, config)
        return _hash(parameters + content.digest).hex()
    # Whatever the body is called: other names of labels compute nothing anew
    parameters = _parameters(suffix, None, body.number, reading, config)
    return _hash(parameters + (content.nameless or content.digest)).hex()


def derived_key(kind: str, key: str, *parameters: object) -> str:
    """Return the key of what is made from a Signature or surface: of the kind, its key, and the parameters."""
    return _hash(json.dumps([kind, key, *parameters]).encode()).hex()


@lru_cache
def _parameters(
    suffix: str,
    part: str | None,
    number: str | None,
    reading: LoadOptions,
    config: SignatureConfig | None,
) -> bytes:
    """Return the part of a key that is not the content; remembered, because thousands of files share it."""
    # With the version of the algorithm
    parameters = SignatureConfig.ALGORITHM_VERSION if config is None else config.as_dict()
    fields = {
        "suffix": suffix,
        "part": part,
        "number": number,
        "reading": reading.as_dict(),
        "mending": MENDING_VERSION,
        "config": parameters,
    }
    return json.dumps(fields, sort_keys=True).encode()


def _joint(digests: Sequence[bytes]) -> bytes:
    return digests[0] if len(digests) == 1 else _hash(b"".join(digests))


def _hash(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()
