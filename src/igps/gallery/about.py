"""Metadata of a gallery: columns, and the parameters of its descriptions, which must be equal to compare them."""

import contextlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torch import Tensor

from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import fingerprint, name_of
from igps.mesh.options import LoadOptions
from igps.nn.descriptor import Descriptor
from igps.signature.signature import SignatureConfig

_SOURCE_LOCATION = re.compile(r", /\S+\.rs:.*")  # at the end of LanceDB's error messages

KNOWN: dict[str, type] = {
    "id": str,
    "name": str,
    "class": str,
    "file": str,
    "part": str,
    "checksum": str,
    "bytes": int,
    "modified": int,
    "area": float,
    "volume": float,
    "unit": str,
    "thumbnail": bytes,
}
"""Names and types of the columns that every gallery has, beside the description."""

MANIFEST = "manifest.json"
"""File by which an index of version 0.2.0 is recognised."""

Row = Mapping[str, Any]
Batch = tuple[Tensor, Sequence[Row]]
"""Descriptions (N, ...) and their rows: the columns `KNOWN`, and further ones of text or numbers."""


def about_of(
    config: SignatureConfig, reading: LoadOptions, descriptor: str | Descriptor
) -> dict[str, Any]:
    """Return the name and checksum of a descriptor, the parameters of the Signatures and the options of reading."""
    signature = {**asdict(config), "algorithm_version": SignatureConfig.ALGORITHM_VERSION}
    return {
        "descriptor": name_of(descriptor),
        "model": fingerprint(descriptor_of(descriptor)),
        "signature": {**signature, "attributes": list(config.attributes)},
        "reading": reading.as_dict(),
        "names": reading.names and os.path.abspath(reading.names),
    }


def check_alike(path: str | Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Raise a ValueError that names the first difference between the metadata of a gallery and those expected."""
    known = _flat(found)
    for name, value in _flat(json.loads(json.dumps(dict(wanted)))).items():
        if known.get(name) != value:
            raise ValueError(
                f"{path}: expected a gallery with {name} {_short(value)}, got {_short(known.get(name))}. Use the "
                "parameters of the gallery, or build another gallery."
            )


def _flat(about: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten nested dictionaries; keys are joined by a dot."""
    inner = {
        f"{name}.{k}": v
        for name, value in about.items()
        if isinstance(value, dict)
        for k, v in value.items()
    }
    return {
        **{name: value for name, value in about.items() if not isinstance(value, dict)},
        **inner,
    }


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 80 else f"{text[:77]}..."


@contextlib.contextmanager
def engine_errors_as(sentence: str) -> Iterator[None]:
    """Raise errors of LanceDB as a ValueError with a sentence, followed by the first line of the original message."""
    try:
        yield
    except (ValueError, RuntimeError, OSError, KeyError, TypeError, IndexError) as error:
        reason = (
            _SOURCE_LOCATION.sub("", str(error).splitlines()[0])[:200]
            if str(error)
            else type(error).__name__
        )
        raise ValueError(f"{sentence} ({reason}).") from error


def is_gallery(path: str | Path) -> bool:
    """Return whether a folder is a gallery, or an index of version 0.2.0, which `open_table` refuses."""
    return any((Path(path) / name).exists() for name in ("bodies.lance", MANIFEST))


def tables() -> Any:
    """Import the module that needs LanceDB."""
    from igps.gallery import _table

    return _table


def open_table(path: str | Path, version: int | None = None) -> Any:
    """Open the table of a gallery. Raise a ValueError for an index of version 0.2.0, which has other Signatures."""
    if not tables().exists(Path(path)) and (Path(path) / MANIFEST).exists():
        raise ValueError(
            f"{path}: an index of version 0.2.0, of other signatures. Build a gallery in a new folder."
        )
    return tables().BodyTable(path, version)
