"""How the descriptions of a gallery were made. Only descriptions that were made alike can be compared."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import fingerprint, name_of
from igps.mesh.options import LoadOptions
from igps.nn.descriptor import Descriptor
from igps.signature.signature import SignatureConfig


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
        "names": reading.names_anywhere,
    }


def check_alike(path: str | Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Raise a ValueError that names the first difference between the metadata of a gallery and those expected."""
    known = _flat(found)
    as_stored = json.loads(json.dumps(dict(wanted)))
    for name, value in _flat(as_stored).items():
        if known.get(name) != value:
            raise ValueError(
                f"{path}: expected a gallery with {name} {_short(value)}, got {_short(known.get(name))}. Use the "
                "parameters of the gallery, or build another gallery."
            )


def _flat(about: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten nested dictionaries; keys are joined by a dot."""
    flat: dict[str, Any] = {}
    for name, value in about.items():
        if isinstance(value, dict):
            flat |= {f"{name}.{key}": inner for key, inner in value.items()}
        else:
            flat[name] = value
    return flat


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 80 else f"{text[:77]}..."
