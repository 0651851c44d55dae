"""3MF: a plate of objects, each as often and where its plan says, in a unit of length."""

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

_UNITS = {"micron": "µm", "millimeter": "mm", "centimeter": "cm", "inch": "in", "foot": "ft", "meter": "m"}
# Objects may be made of objects, but not without end.
_DEEPEST = 32
# What an object or a place of one takes at least, bytes.
_PLACE = 100

Key = tuple[str, str]  # of an object: the member of the archive that it stands in, and its number


@dataclass
class _Placed:
    """An object at a place: vertices (V, 3) times `matrix` (4, 3), with a column of ones."""

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
    """Objects and plan of the members of an archive."""

    def __init__(self, archive: zipfile.ZipFile, main: str) -> None:
        self.unit = ""
        self.objects: dict[Key, _Object] = {}
        self.items: list[_Placed] = []
        self._object = _Object("")
        members = [main]  # those that others refer to are added while they are read
        for self._member in members:
            with archive.open(self._member) as stream:
                _xml.walk(stream, self._start)
            referred = {placed.key[0] for one in self.objects.values() for placed in one.components}
            members.extend(sorted((referred | {placed.key[0] for placed in self.items}) - set(members)))

    def _start(self, name: str, of: dict[str, str]) -> None:
        if name == "vertex":
            self._object.vertices.extend((float(of["x"]), float(of["y"]), float(of["z"])))
        elif name == "triangle":
            self._object.triangles.extend((int(of["v1"]), int(of["v2"]), int(of["v3"])))
        elif name == "object":
            label = of.get("name") or of.get("partnumber") or f"object {of['id']}"
            self._object = self.objects[self._member, of["id"]] = _Object(label)
        elif name == "component":
            self._object.components.append(self._placed(of))
        elif name == "item":
            self.items.append(self._placed(of))
        elif name == "model":
            self.unit = self.unit or of.get("unit", "millimeter")

    def _placed(self, of: dict[str, str]) -> _Placed:
        numbers = of.get("transform", "1 0 0 0 1 0 0 0 1 0 0 0").split()
        path = next((value for key, value in of.items() if key.rpartition(":")[2] == "path"), "").lstrip("/")
        matrix = np.array(numbers, dtype=np.float64).reshape(4, 3)
        return _Placed((path or self._member, of["objectid"]), matrix, of.get("partnumber", ""))

    def leaves(self, placed: _Placed, budget: list[int], depth: int = 0) -> Iterator[RawBody]:
        """The surfaces of an object and of all that it is made of; `budget` holds the bytes that are left."""
        if depth > _DEEPEST:
            raise ValueError("objects that are made of themselves, or of others without end")
        one = self.objects[placed.key]
        budget[0] -= _PLACE + 8 * (len(one.vertices) + len(one.triangles))
        if budget[0] < 0:
            return
        if one.triangles:
            vertices = np.frombuffer(one.vertices).reshape(-1, 3) @ placed.matrix[:3] + placed.matrix[3]
            faces = np.frombuffer(one.triangles, dtype=np.int64).reshape(-1, 3)
            mirrored = np.linalg.det(placed.matrix[:3]) < 0
            yield RawBody(vertices, np.ascontiguousarray(faces[:, ::-1]) if mirrored else faces.copy())
        for component in one.components:
            matrix = component.matrix @ placed.matrix[:3]
            matrix[3] += placed.matrix[3]
            yield from self.leaves(_Placed(component.key, matrix), budget, depth + 1)


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """What stands on the plate: the items of the plan, an object made of others as one body."""
    with zipfile.ZipFile(path) as archive:
        models = [one for one in archive.infolist() if one.filename.lower().endswith(".model")]
        check_unpacked(sum(one.file_size for one in models), path, options.max_unpacked)
        names = [one.filename for one in models]
        if not names:
            raise ValueError("no model in it")
        main = next((name for name in names if name.lower() == "3d/3dmodel.model"), names[0])
        model = _Model(archive, main)
    items = model.items or [_Placed(key, np.eye(4, 3)) for key, one in model.objects.items() if one.triangles]
    budget = [options.max_unpacked]
    found = [list(model.leaves(item, budget)) for item in items]
    if budget[0] < 0:
        check_unpacked(options.max_unpacked - budget[0], path, options.max_unpacked)
    names = distinct(item.name or model.objects[item.key].name for item in items)
    parts = [(name, joined(leaves)) for name, leaves in zip(names, found, strict=True) if leaves]
    return [RawBody(body.vertices, body.faces, name, _UNITS.get(model.unit)) for name, body in parts]


FORMAT = Format("3MF", (".3mf",), read, bodies=("whole", "objects"))
