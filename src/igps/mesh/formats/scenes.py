"""Scenes and CAD files: GLB, glTF, COLLADA, 3DXML, XAML and STEP. An object is a node of the scene with a geometry."""

import json
import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from igps.mesh.formats._format import Format, RawBody, check_unpacked, distinct, pieces
from igps.mesh.formats._trimesh import FolderResolver, objects
from igps.mesh.limits import check_memory
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions
from igps.mesh.surface import signed_volume

# Tolerances of the triangulation of curved faces: distance as a share of the edge length, and angle in radians.
_DEFLECTION, _ANGLE = 0.005, 0.2
_DRACO = "KHR_draco_mesh_compression"  # trimesh decompresses it if DracoPy is installed
_INSTANCES = "EXT_mesh_gpu_instancing"
# Required extensions that leave the geometry as it is, or only store it as smaller integers.
_OF_MATERIALS = ("KHR_materials_", "KHR_texture_", "EXT_texture_")
_HARMLESS = ("KHR_lights_punctual", "KHR_mesh_quantization", "KHR_xmp_json_ld")
_FAN = 6  # the mode of fans of triangles
_MAX_ITEM = 64  # bytes of the largest item of an array, a 4 × 4 matrix
_CONVERT = (
    "import sys, cascadio; cascadio.step_to_glb(*sys.argv[1:], "
    f"tol_linear={_DEFLECTION}, tol_relative=True, tol_angular={_ANGLE}, merge_primitives=True)"
)


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            check_unpacked(
                sum(info.file_size for info in archive.infolist()), path, options.max_unpacked
            )
    return objects(path, options)


def read_gltf(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Read the objects of a glTF scene, in metres. An object is a node, with all its materials."""
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
        is_binary = head.startswith(b"glTF")
        text = file.read(int.from_bytes(head[12:16], "little")) if is_binary else head + file.read()
    return dict(json.loads(text))


def _buffers(path: Path, options: LoadOptions) -> list[Path]:
    """Return the files beside a glTF scene that hold its arrays."""
    if path.suffix.lower() != ".gltf":
        return []
    check_memory(path)
    names = [buffer.get("uri", "data:") for buffer in _scene(path).get("buffers", [])]
    return [
        FolderResolver(path.parent).path(name) for name in names if not name.startswith("data:")
    ]


def read_step(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Read the solids of a STEP file, in millimetres, each named after its part."""
    solids, names = [], []
    for body in objects(path, options, _converted(path), file_type="glb", merge_primitives=True):
        components = pieces(body)
        if any(
            signed_volume(piece.vertices, piece.faces) <= 0 for piece in components
        ):  # the wall of a cavity
            components = [body]
        solids += components
        names += [str(body.part)] * len(components)
    named = zip(solids, distinct(names), strict=True)
    return [
        replace(solid, vertices=1000 * solid.vertices, part=name, unit="mm")
        for solid, name in named
    ]


def _converted(path: Path) -> bytes:
    """Convert a STEP file to binary glTF, in another process because OpenCASCADE crashes on some damaged files."""
    import cascadio  # noqa: F401  # raises ImportError in this process if missing

    with tempfile.TemporaryDirectory() as folder:
        step, scene = Path(folder) / "x.step", Path(folder) / "x.glb"
        shutil.copyfile(path, step)
        subprocess.run(
            [sys.executable, "-c", _CONVERT, str(step), str(scene)],
            capture_output=True,
            check=False,
        )
        if not scene.is_file():
            raise MeshError(
                f"{path}: OpenCASCADE finds no solid in it. Check that it is complete, or export it again."
            )
        return scene.read_bytes()


GLTF = Format("glTF", (".glb", ".gltf"), read_gltf, bodies=("whole", "objects"), beside=_buffers)
STEP = Format("STEP", (".step", ".stp"), read_step, bodies=("whole", "objects"), extra="cad")
_SUFFIXES = (".dae", ".zae", ".3dxml", ".xaml")
OTHERS = Format(
    "COLLADA, 3DXML or XAML", _SUFFIXES, read, bodies=("whole", "objects"), extra="formats"
)
