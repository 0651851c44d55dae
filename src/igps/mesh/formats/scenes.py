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
_FAN, _MAX_ITEM = (
    6,
    64,
)  # the mode of fans of triangles; bytes of the largest item of an array, a 4 × 4 matrix
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
    """Read the objects of a glTF scene, in metres."""
    scene = _scene(path)
    for name in scene.get("extensionsRequired", []):
        if name.endswith("_compression") and (name != _DRACO or find_spec("DracoPy") is None):
            raise ValueError(
                f"it is compressed by {name}, which is not supported; export it uncompressed"
            )
    # Trimesh fills arrays without bytes with zeros, and copies an array at each use
    n_bytes = sum(
        _MAX_ITEM * abs(array["count"])
        for array in scene.get("accessors", [])
        if "bufferView" not in array
    )
    for primitive in (item for mesh in scene.get("meshes", []) for item in mesh["primitives"]):
        if primitive.get("mode") == _FAN:  # trimesh would skip it
            raise ValueError(
                "it holds fans of triangles, which are not supported; export it as plain triangles"
            )
        sizes = ((primitive["attributes"].get("POSITION"), 24), (primitive.get("indices"), 8))
        used = [(scene["accessors"][number], size) for number, size in sizes if number is not None]
        n_bytes += sum(size * abs(array["count"]) for array, size in used)
        if any(
            "sparse" in array or array.get("normalized") for array, _ in used
        ):  # trimesh would misread it
            raise ValueError(
                "its coordinates are sparse or normalized, which is not supported; export it uncompressed"
            )
    check_unpacked(n_bytes, path, options.max_unpacked)
    return [replace(body, unit="m") for body in objects(path, options)]


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
