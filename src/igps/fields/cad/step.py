"""STEP files of solids, which OpenCASCADE cuts into triangles."""

import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from igps.mesh.errors import MeshError
from igps.mesh.formats import Format
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody, distinct, pieces
from igps.mesh.surface import signed_volume

# Tolerances of the triangulation of curved faces: distance as a share of the edge length, and angle in radians.
_DEFLECTION, _ANGLE = 0.005, 0.2
_CONVERT = (
    "import sys, cascadio; cascadio.step_to_glb(*sys.argv[1:], "
    f"tol_linear={_DEFLECTION}, tol_relative=True, tol_angular={_ANGLE}, merge_primitives=True)"
)


def read_step(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Read the solids of a STEP file, in millimetres, each named after its part."""
    from igps.fields.meshes._trimesh import objects

    solids = []
    names = []
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
        replace(solid, vertices=1000 * solid.vertices, part=name, unit="mm", unit_from="header")
        for solid, name in named
    ]


def _converted(path: Path) -> bytes:
    """Convert a STEP file to binary glTF, in another process because OpenCASCADE crashes on some damaged files."""
    import cascadio  # noqa: F401  # raises ImportError in this process if missing

    with tempfile.TemporaryDirectory() as folder:
        step = Path(folder) / "x.step"
        scene = Path(folder) / "x.glb"
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


FORMAT = Format("STEP", (".step", ".stp"), read_step, bodies=("whole", "objects"), extra="cad")
