"""Surfaces of labels, which take time to compute: kept in the cache for all commands that read the same files."""

import json
from typing import Any

from igps.data.cache import Cache, Record
from igps.mesh.raw_body import RawBody

_FIELDS = ("unit", "unit_from", "notes", "frame", "fine_area", "given")


def known_surface(cache: Cache, key: str, part: str | None) -> RawBody | None:
    """Return a surface as it was read, with the name `part`; None if it is not in the cache."""

    def decode(record: Record) -> RawBody:
        fields: dict[str, Any] = {name: json.loads(record.texts[name]) for name in _FIELDS}
        fields["notes"] = tuple(fields["notes"])
        vertices = record.arrays["vertices"]
        faces = record.arrays["faces"]
        return RawBody(vertices, faces, part, denoise=False, **fields)

    return cache.get(key, decode)


def surface_record(raw: RawBody) -> Record:
    """Return the record of a surface that was computed from voxels."""
    fields = {name: getattr(raw, name) for name in _FIELDS}
    fields["given"] = dict(raw.given)
    texts = {name: json.dumps(value) for name, value in fields.items()}
    return Record({"vertices": raw.vertices, "faces": raw.faces}, texts)
