"""Scenes: GLB and glTF. An object is a node of the scene with a geometry."""

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from igps.mesh.formats import Format
from igps.mesh.limits import check_memory, check_unpacked
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody

_DRACO = "KHR_draco_mesh_compression"  # trimesh decompresses it if DracoPy is installed
_INSTANCES = "EXT_mesh_gpu_instancing"
# Required extensions that leave the geometry as it is, or only store it as smaller integers.
_OF_MATERIALS = ("KHR_materials_", "KHR_texture_", "EXT_texture_")
_HARMLESS = ("KHR_lights_punctual", "KHR_mesh_quantization", "KHR_xmp_json_ld")
_FAN = 6  # the mode of fans of triangles
_MAX_ITEM = 64  # bytes of the largest item of an array, a 4 × 4 matrix


def read_gltf(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Read the objects of a glTF scene, in metres. An object is a node, with all its materials."""
    from igps.fields.meshes._trimesh import objects

    scene = _scene(path)
    _check_extensions(scene)
    _check_poses(scene)
    check_unpacked(_array_bytes(scene), path, options.max_unpacked)
    bodies = objects(path, options)
    return [replace(body, unit="m") for body in bodies]


def _check_extensions(scene: dict[str, Any]) -> None:
    """Raise a ValueError if a glTF scene requires an extension that may change its geometry and is not known here."""
    for name in scene.get("extensionsRequired", []):
        if name == _DRACO and find_spec("DracoPy") is not None:
            continue
        if name in _HARMLESS or name.startswith(_OF_MATERIALS):
            continue
        kind = "compressed by" if name.endswith("_compression") else "made with"
        raise ValueError(f"it is {kind} {name}, which is not supported; export it without")


def _check_poses(scene: dict[str, Any]) -> None:
    """Raise a ValueError for skins, morph targets and instances, which move or copy vertices; trimesh ignores them."""
    remedy = "apply it in the program that made the file, and export again"
    meshes = scene.get("meshes", [])
    for node in scene.get("nodes", []):
        if "mesh" not in node:
            continue
        if "skin" in node:
            raise ValueError(f"a skin deforms it, which is not supported; {remedy}")
        if _INSTANCES in node.get("extensions", {}):
            raise ValueError(f"{_INSTANCES} copies parts of it, which is not supported; {remedy}")
        mesh = meshes[node["mesh"]]
        weights = node.get("weights", mesh.get("weights", []))
        if any(weights) and any(item.get("targets") for item in mesh["primitives"]):
            raise ValueError(
                f"weights of morph targets deform it, which is not supported; {remedy}"
            )


def _array_bytes(scene: dict[str, Any]) -> int:
    """Return the bytes of the arrays of a scene as trimesh will hold them; a ValueError for those it would misread.

    Trimesh fills arrays without bytes with zeros, and copies an array at each use.
    """
    accessors = scene.get("accessors", [])
    n_bytes = 0
    for array in accessors:
        if "bufferView" not in array:
            n_bytes += _MAX_ITEM * abs(array["count"])
    primitives = [item for mesh in scene.get("meshes", []) for item in mesh["primitives"]]
    for primitive in primitives:
        if primitive.get("mode") == _FAN:  # trimesh would skip it
            raise ValueError(
                "it holds fans of triangles, which are not supported; export it as plain triangles"
            )
        sizes = ((primitive["attributes"].get("POSITION"), 24), (primitive.get("indices"), 8))
        for number, size in sizes:
            if number is None:
                continue
            array = accessors[number]
            n_bytes += size * abs(array["count"])
            if "sparse" in array or array.get("normalized"):
                raise ValueError(
                    "its coordinates are sparse or normalized, which is not supported; export it uncompressed"
                )
    return n_bytes


def _scene(path: Path) -> dict[str, Any]:
    """Parse the JSON of a glTF file: all of a .gltf, or the first chunk of a .glb."""
    with path.open("rb") as file:
        head = file.read(20)

        if head.startswith(b"glTF"):
            n_bytes = int.from_bytes(head[12:16], "little")
            text = file.read(n_bytes)
        else:
            text = head + file.read()
    return dict(json.loads(text))


def _buffers(path: Path, options: LoadOptions) -> list[Path]:
    """Return the files beside a glTF scene that hold its arrays."""
    if path.suffix.lower() != ".gltf":
        return []
    from igps.fields.meshes._trimesh import FolderResolver

    check_memory(path)
    names = [buffer.get("uri", "data:") for buffer in _scene(path).get("buffers", [])]
    return [
        FolderResolver(path.parent).path(name) for name in names if not name.startswith("data:")
    ]


FORMAT = Format("glTF", (".glb", ".gltf"), read_gltf, bodies=("whole", "objects"), beside=_buffers)
