"""Scenes and CAD files: GLB, glTF, COLLADA, 3DXML and XAML, STEP. An object is what stands at a place of the scene."""

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
from igps.mesh.formats._trimesh import Beside, objects
from igps.mesh.limits import check_memory
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions
from igps.mesh.surface import signed_volume

# How far triangles may be from a curved face, over the length of its edges, and the angle between two, radians.
_DEFLECTION, _ANGLE = 0.005, 0.2
_DRACO = "KHR_draco_mesh_compression"  # which trimesh unpacks where DracoPy is installed
_FAN, _LARGEST_ITEM = 6, 64  # a mode of primitives; bytes of a matrix of 4 x 4
_CONVERT = (
    "import sys, cascadio; cascadio.step_to_glb(*sys.argv[1:], "
    f"tol_linear={_DEFLECTION}, tol_relative=True, tol_angular={_ANGLE}, merge_primitives=True)"
)


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            check_unpacked(sum(one.file_size for one in archive.infolist()), path, options.max_unpacked)
    return objects(path, options)


def read_gltf(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The objects of a glTF scene, which is in metres."""
    scene = _scene(path)
    for name in scene.get("extensionsRequired", []):
        if name.endswith("_compression") and (name != _DRACO or find_spec("DracoPy") is None):
            raise ValueError(f"it is compressed by {name}, which is not read; export it uncompressed")
    # Of an array without bytes trimesh makes zeros, and for every use of one a copy
    n_bytes = sum(_LARGEST_ITEM * abs(one["count"]) for one in scene.get("accessors", []) if "bufferView" not in one)
    for primitive in (one for mesh in scene.get("meshes", []) for one in mesh["primitives"]):
        if primitive.get("mode") == _FAN:  # which trimesh passes over
            raise ValueError("it holds fans of triangles, which are not read; export it as plain triangles")
        used = ((primitive["attributes"].get("POSITION"), 24), (primitive.get("indices"), 8))
        arrays = [scene["accessors"][number] for number, _ in used if number is not None]
        n_bytes += sum(size * abs(scene["accessors"][number]["count"]) for number, size in used if number is not None)
        if any("sparse" in one or one.get("normalized") for one in arrays):  # trimesh reads other numbers
            raise ValueError("its coordinates are sparse or normalized, which is not read; export it uncompressed")
    check_unpacked(n_bytes, path, options.max_unpacked)
    return [replace(body, unit="m") for body in objects(path, options)]


def _scene(path: Path) -> dict[str, Any]:
    """What a file of glTF says of its numbers: all of a .gltf, the first chunk of a .glb."""
    with path.open("rb") as file:
        head = file.read(20)
        is_binary = head.startswith(b"glTF")
        found = json.loads(file.read(int.from_bytes(head[12:16], "little")) if is_binary else head + file.read())
    return dict(found)


def _buffers(path: Path, options: LoadOptions) -> list[Path]:
    """The files that hold the numbers of a glTF scene."""
    if path.suffix.lower() != ".gltf":
        return []
    check_memory(path)
    names = [one.get("uri", "data:") for one in _scene(path).get("buffers", [])]
    return [Beside(path.parent).place(name) for name in names if not name.startswith("data:")]


def read_step(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The solids of a STEP file, in millimetres, each with the name of the part that it belongs to."""
    solids, names = [], []
    for body in objects(path, options, _converted(path), file_type="glb", merge_primitives=True):
        found = pieces(body)
        if any(signed_volume(one.vertices, one.faces) <= 0 for one in found):  # one is the wall of a hollow
            found = [body]
        solids += found
        names += [str(body.part)] * len(found)
    named = zip(solids, distinct(names), strict=True)
    return [replace(solid, vertices=1000 * solid.vertices, part=name, unit="mm") for solid, name in named]


def _converted(path: Path) -> bytes:
    """The glTF scene of a STEP file, made in a process of its own: OpenCASCADE crashes on some damaged files."""
    import cascadio  # noqa: F401  # to report a missing module as such

    with tempfile.TemporaryDirectory() as folder:
        step, scene = Path(folder) / "x.step", Path(folder) / "x.glb"
        shutil.copyfile(path, step)
        subprocess.run([sys.executable, "-c", _CONVERT, str(step), str(scene)], capture_output=True, check=False)
        if not scene.is_file():
            raise MeshError(f"{path}: OpenCASCADE finds no solid in it. Check that it is complete, or export it again.")
        return scene.read_bytes()


GLTF = Format("glTF", (".glb", ".gltf"), read_gltf, bodies=("whole", "objects"), beside=_buffers)
STEP = Format("STEP", (".step", ".stp"), read_step, bodies=("whole", "objects"), extra="cad")
OTHERS = Format(
    "COLLADA, 3DXML or XAML", (".dae", ".zae", ".3dxml", ".xaml"), read, bodies=("whole", "objects"), extra="formats"
)
