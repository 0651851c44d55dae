"""3MF: objects, placed on a build plate by a list of items, in a unit of length."""

from __future__ import annotations

import zipfile
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from igps._arrays import Floats
from igps.mesh.formats import _xml
from igps.mesh.formats._format import Format, RawBody, check_unpacked, distinct, joined
from igps.mesh.options import LoadOptions

_UNITS = {
    "micron": "µm",
    "millimeter": "mm",
    "centimeter": "cm",
    "inch": "in",
    "foot": "ft",
    "meter": "m",
}
_MAX_DEPTH = 32  # of objects within objects
_MIN_BYTES = 100  # the least memory that a placed object takes

Key = tuple[str, str]  # of an object: its member of the archive, and its id there


@dataclass
class _Placed:
    """An object in its place; `matrix` (4, 3) maps its vertices, with 1 appended, to the coordinates of its parent."""

    key: Key
    matrix: Floats
    name: str = ""


@dataclass
class _Object:
    name: str
    vertices: array[float] = field(default_factory=lambda: array("d"))
    triangles: array[int] = field(default_factory=lambda: array("q"))
    components: list[_Placed] = field(default_factory=list)


class _Model:
    """The objects and items of the members of an archive."""

    def __init__(self, archive: zipfile.ZipFile, main: str) -> None:
        self.unit = ""
        self.objects: dict[Key, _Object] = {}
        self.items: list[_Placed] = []
        self._object = _Object("")
        members = [main]  # grows by the members to which those already read refer
        for self._member in members:
            with archive.open(self._member) as stream:
                _xml.walk(stream, self._start)
            referred = {placed.key[0] for obj in self.objects.values() for placed in obj.components}
            members.extend(
                sorted((referred | {placed.key[0] for placed in self.items}) - set(members))
            )

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if name == "vertex":
            self._object.vertices.extend(
                (float(attributes["x"]), float(attributes["y"]), float(attributes["z"]))
            )
        elif name == "triangle":
            self._object.triangles.extend(
                (int(attributes["v1"]), int(attributes["v2"]), int(attributes["v3"]))
            )
        elif name == "object":
            number = attributes["id"]
            label = attributes.get("name") or attributes.get("partnumber") or f"object {number}"
            self._object = self.objects[self._member, number] = _Object(label)
        elif name == "component":
            self._object.components.append(self._placed(attributes))
        elif name == "item":
            self.items.append(self._placed(attributes))
        elif name == "model":
            self.unit = self.unit or attributes.get("unit", "millimeter")

    def _placed(self, attributes: dict[str, str]) -> _Placed:
        numbers = attributes.get("transform", "1 0 0 0 1 0 0 0 1 0 0 0").split()
        path = next(
            (value for key, value in attributes.items() if key.rpartition(":")[2] == "path"), ""
        ).lstrip("/")
        matrix = np.array(numbers, dtype=np.float64).reshape(4, 3)
        return _Placed(
            (path or self._member, attributes["objectid"]), matrix, attributes.get("partnumber", "")
        )

    def leaves(self, placed: _Placed, budget: list[int], depth: int = 0) -> Iterator[RawBody]:
        """Yield the surfaces of an object and of its components, while the bytes left in `budget` suffice."""
        if depth > _MAX_DEPTH:
            raise ValueError("objects that are made of themselves, or nested too deeply")
        obj = self.objects[placed.key]
        budget[0] -= _MIN_BYTES + 8 * (len(obj.vertices) + len(obj.triangles))
        if budget[0] < 0:
            return
        if obj.triangles:
            vertices = (
                np.frombuffer(obj.vertices).reshape(-1, 3) @ placed.matrix[:3] + placed.matrix[3]
            )
            faces = np.frombuffer(obj.triangles, dtype=np.int64).reshape(-1, 3)
            is_mirrored = np.linalg.det(placed.matrix[:3]) < 0
            yield RawBody(
                vertices, np.ascontiguousarray(faces[:, ::-1]) if is_mirrored else faces.copy()
            )
        for component in obj.components:
            matrix = component.matrix @ placed.matrix[:3]
            matrix[3] += placed.matrix[3]
            yield from self.leaves(_Placed(component.key, matrix), budget, depth + 1)


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Read the items on the build plate; an item with several components is one body."""
    with zipfile.ZipFile(path) as archive:
        models = [info for info in archive.infolist() if info.filename.lower().endswith(".model")]
        check_unpacked(sum(info.file_size for info in models), path, options.max_unpacked)
        names = [info.filename for info in models]
        if not names:
            raise ValueError("no model in it")
        main = next((name for name in names if name.lower() == "3d/3dmodel.model"), names[0])
        model = _Model(archive, main)
    items = model.items or [
        _Placed(key, np.eye(4, 3)) for key, obj in model.objects.items() if obj.triangles
    ]
    budget = [options.max_unpacked]
    leaves = [list(model.leaves(item, budget)) for item in items]
    check_unpacked(options.max_unpacked - budget[0], path, options.max_unpacked)
    names = distinct(item.name or model.objects[item.key].name for item in items)
    parts = [
        (name, joined(surfaces)) for name, surfaces in zip(names, leaves, strict=True) if surfaces
    ]
    return [
        RawBody(body.vertices, body.faces, name, _UNITS.get(model.unit)) for name, body in parts
    ]


FORMAT = Format("3MF", (".3mf",), read, bodies=("whole", "objects"))
