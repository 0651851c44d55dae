"""3MF: objects, placed on a build plate by a list of items, in a unit of length.

Not all that a file holds is material. Objects of type "support" are not, and slicers keep in a file of their own which
parts of an object they cut away (negative), and which only change how others are printed (modifiers, blockers).
"""

from __future__ import annotations

import zipfile
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element

import numpy as np

from igps._arrays import Floats, Integers
from igps._text import counted
from igps.fields.meshes import _xml
from igps.mesh.formats import Format
from igps.mesh.limits import check_unpacked
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody, UnitSource, distinct, joined
from igps.mesh.surface import compact

if TYPE_CHECKING:
    import trimesh

_UNITS = {
    "micron": "µm",
    "millimeter": "mm",
    "centimeter": "cm",
    "inch": "in",
    "foot": "ft",
    "meter": "m",
}
_SUPPORT = ("support", "solidsupport")
# What slicers call material and what is cut out of it; all else only changes how a part is printed.
_MATERIAL = ("modelpart", "normal_part", "")
_NEGATIVE = ("negativevolume", "negative_part")
_PRUSA = "metadata/slic3r_pe_model.config"
_ORCA = "metadata/model_settings.config"
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
    kind: str = "model"
    vertices: array[float] = field(default_factory=lambda: array("d"))
    triangles: array[int] = field(default_factory=lambda: array("q"))
    components: list[_Placed] = field(default_factory=list)


@dataclass
class _Roles:
    """What the parts of objects are by the settings of a slicer, in lower case; "" if it does not say."""

    # PrusaSlicer and Slic3r: first and last triangle of each part of an object, and its role
    of_triangles: dict[str, list[tuple[int, int, str]]] = field(default_factory=dict)
    # OrcaSlicer and Bambu Studio: by the numbers of an object and of its component
    of_components: dict[tuple[str, str], str] = field(default_factory=dict)

    @classmethod
    def read(cls, archive: zipfile.ZipFile) -> _Roles:
        roles = cls()
        for info in archive.infolist():
            name = info.filename.lower()
            if name not in (_PRUSA, _ORCA):
                continue
            for element in _xml.parse(archive.read(info)).iter("object"):
                number = element.get("id", "")
                for part in element.iter("part"):
                    component = (number, part.get("id", ""))
                    roles.of_components[component] = part.get("subtype", "").lower()
                roles.of_triangles[number] = [
                    _triangles_of(part) for part in element.iter("volume")
                ]
        return roles


def _triangles_of(volume: Element) -> tuple[int, int, str]:
    """Return the first and the last triangle of a part in the settings of PrusaSlicer, and its role."""
    metadata = {item.get("key"): item.get("value", "") for item in volume.iter("metadata")}
    role = metadata.get("volume_type", "").lower()
    if not role and metadata.get("modifier") == "1":  # Slic3r
        role = "parametermodifier"
    return int(volume.get("firstid", "0")), int(volume.get("lastid", "-1")), role


@dataclass
class _Part:
    """A surface in its place, and what it is; see `_Roles`."""

    vertices: Floats
    faces: Integers
    role: str


class _Model:
    """The objects and items of the members of an archive."""

    def __init__(self, archive: zipfile.ZipFile, main: str) -> None:
        self.unit = ""
        self._roles = _Roles.read(archive)
        self.objects: dict[Key, _Object] = {}
        self.items: list[_Placed] = []
        self.n_not_printed = 0
        self._object = _Object("")
        members = [main]  # grows by the members to which those already read refer
        for self._member in members:
            with archive.open(self._member) as stream:
                _xml.walk(stream, self._start)
            placed = list(self.items)
            for obj in self.objects.values():
                placed += obj.components
            referred = {one.key[0] for one in placed}
            members.extend(sorted(referred - set(members)))

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if name == "vertex":
            place = (float(attributes["x"]), float(attributes["y"]), float(attributes["z"]))
            self._object.vertices.extend(place)
        elif name == "triangle":
            corners = (int(attributes["v1"]), int(attributes["v2"]), int(attributes["v3"]))
            self._object.triangles.extend(corners)
        elif name == "object":
            number = attributes["id"]
            label = attributes.get("name") or attributes.get("partnumber") or f"object {number}"
            self._object = _Object(label, attributes.get("type", "model"))
            self.objects[self._member, number] = self._object
        elif name == "component":
            self._object.components.append(self._placed(attributes))
        elif name == "item" and attributes.get("printable", "1") in ("0", "false"):
            self.n_not_printed += 1
        elif name == "item":
            self.items.append(self._placed(attributes))
        elif name == "model":
            self.unit = self.unit or attributes.get("unit", "")

    def _placed(self, attributes: dict[str, str]) -> _Placed:
        numbers = attributes.get("transform", "1 0 0 0 1 0 0 0 1 0 0 0").split()
        matrix = np.array(numbers, dtype=np.float64).reshape(4, 3)
        member = self._member
        for key, value in attributes.items():
            if key.rpartition(":")[2] == "path":  # in a namespace
                member = value.lstrip("/") or self._member
        key_of_object = (member, attributes["objectid"])
        return _Placed(key_of_object, matrix, attributes.get("partnumber", ""))

    def parts(
        self, placed: _Placed, budget: list[int], depth: int = 0, role: str = ""
    ) -> Iterator[_Part]:
        """Yield the surfaces of an object and of its components, while the bytes left in `budget` suffice."""
        if depth > _MAX_DEPTH:
            raise ValueError("objects that are made of themselves, or nested too deeply")
        obj = self.objects[placed.key]
        budget[0] -= _MIN_BYTES + 8 * (len(obj.vertices) + len(obj.triangles))
        if budget[0] < 0:
            return
        role = "support" if obj.kind in _SUPPORT else role
        number = placed.key[1]
        if obj.triangles:
            corners = np.frombuffer(obj.vertices).reshape(-1, 3)
            vertices = corners @ placed.matrix[:3] + placed.matrix[3]
            faces = np.frombuffer(obj.triangles, dtype=np.int64).reshape(-1, 3)
            if np.linalg.det(placed.matrix[:3]) < 0:  # it mirrors
                faces = faces[:, ::-1]
            faces = faces.copy(order="C")
            ranges = self._roles.of_triangles.get(number) or [(0, len(faces) - 1, role)]
            for first, last, own_role in ranges:
                yield _Part(vertices, faces[first : last + 1], role or own_role)
        for component in obj.components:
            matrix = component.matrix @ placed.matrix[:3]
            matrix[3] += placed.matrix[3]
            own_role = self._roles.of_components.get((number, component.key[1]), "")
            inner = _Placed(component.key, matrix)
            yield from self.parts(inner, budget, depth + 1, role or own_role)


def _material(parts: list[_Part], name: str) -> RawBody | None:
    """Return the material of an object: what is negative is cut away; None if nothing in it is material."""
    solid = [RawBody(part.vertices, part.faces) for part in parts if part.role in _MATERIAL]
    negative = [RawBody(part.vertices, part.faces) for part in parts if part.role in _NEGATIVE]
    if not solid:
        return None
    body = joined(solid)
    notes = []
    n_others = len(parts) - len(solid) - len(negative)
    if n_others:
        others = counted(n_others, "part")
        notes.append(f"left out {others} without material, such as modifiers and supports")
    if negative:
        import trimesh

        operands = [_closed(part, name) for part in (*solid, *negative)]
        whole = trimesh.boolean.union(operands[: len(solid)], engine="manifold")
        cut = trimesh.boolean.difference([whole, *operands[len(solid) :]], engine="manifold")
        body = RawBody(np.asarray(cut.vertices, np.float64), np.asarray(cut.faces, np.int64))
        notes.append(f"cut away {counted(len(negative), 'negative part')}")
    return replace(body, part=name, notes=tuple(notes))


def _closed(part: RawBody, name: str) -> trimesh.Trimesh:
    """Return a part as a closed mesh; a ValueError if it is not closed, as nothing can be cut from it then."""
    import trimesh

    mesh = trimesh.Trimesh(*compact(part.vertices, part.faces), process=True)
    if not mesh.is_volume:
        raise ValueError(
            f"object {name!r} has a negative part, and is not closed; cut it before the export"
        )
    return mesh


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Read the items on the build plate; an item with several components is one body."""
    with zipfile.ZipFile(path) as archive:
        models = [info for info in archive.infolist() if info.filename.lower().endswith(".model")]
        check_unpacked(sum(info.file_size for info in models), path, options.max_unpacked)
        members = {info.filename.lower(): info.filename for info in reversed(models)}
        if not models:
            raise ValueError("no model in it")
        main = members.get("3d/3dmodel.model", models[0].filename)
        model = _Model(archive, main)
    if model.n_not_printed and not model.items:
        raise ValueError("none of its items is to be printed")
    items = model.items
    if not items:
        with_surface = [key for key, obj in model.objects.items() if obj.triangles]
        items = [_Placed(key, np.eye(4, 3)) for key in with_surface]
    budget = [options.max_unpacked]
    parts = [list(model.parts(item, budget)) for item in items]
    check_unpacked(options.max_unpacked - budget[0], path, options.max_unpacked)
    names = distinct(item.name or model.objects[item.key].name for item in items)
    unit = _UNITS.get(model.unit or "millimeter")
    source: UnitSource = "header" if model.unit else "format"
    material = []
    n_left_out = 0
    for name, own in zip(names, parts, strict=True):
        body = _material(own, name)
        if body is not None:
            material.append(replace(body, unit=unit, unit_from=source))
        elif own:
            n_left_out += 1
    if n_left_out and not material:
        raise ValueError(
            "nothing in it is material: all objects are supports, modifiers or negative"
        )
    notes = []
    if n_left_out:
        objects = counted(n_left_out, "object")
        notes.append(f"left out {objects} without material, such as supports")
    if model.n_not_printed:
        notes.append(f"left out {counted(model.n_not_printed, 'item')} not to be printed")
    if material:
        material[0] = replace(material[0], notes=(*material[0].notes, *notes))
    return material


FORMAT = Format("3MF", (".3mf",), read, bodies=("whole", "objects"))
