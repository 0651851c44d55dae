"""Results on the surface and in the voxels of bodies, in files that 3D Slicer, FreeView and ParaView open."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from igps._arrays import Floats
from igps.mesh.mesh import Mesh
from igps.mesh.raw_body import LabelVoxels


def write_places(
    stem: Path,
    mesh: Mesh,
    values: Mapping[str, Floats],
    voxels: LabelVoxels | None = None,
    inside: Callable[[Floats], Floats] | None = None,
) -> None:
    """Write values on a body, as STEM.ply and STEM.vtk; of a body in the frame of a patient also as STEM.gii.

    Coordinates are those of the body. In the frame of a patient they are RAS in the unit of the body; the headers say
    so, by which 3D Slicer does not take them for LPS. With its voxels, the first of the values is also written as
    STEM.nii.gz, in the grid of the label image: each voxel of the body has the value inside, or that of the nearest
    vertex, others 0.

    Args:
        stem: path without an ending, which is appended.
        mesh: the body.
        values: (V,) numbers by name.
        voxels: of the body, if it was read from a volume.
        inside: returns the values (P,) at points (P, 3) inside the body, if there are such.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    _with_ending(stem, ".ply").write_bytes(_ply(mesh, values))
    _with_ending(stem, ".vtk").write_bytes(_vtk(mesh, values))
    if mesh.frame == "RAS":
        _write_gifti(_with_ending(stem, ".gii"), mesh, values)
    if voxels is not None:
        first = next(iter(values.values()))
        nearest = cKDTree(mesh.vertices)
        of_points = inside or (lambda points: first[nearest.query(points)[1]])
        _write_nifti(_with_ending(stem, ".nii.gz"), mesh, of_points, voxels)


def _with_ending(stem: Path, ending: str) -> Path:
    """Append an ending; `with_suffix` would replace what follows a dot in the name of a body."""
    return stem.with_name(stem.name + ending)


def _comment(mesh: Mesh) -> str:
    """Return how 3D Slicer writes the frame in a header, and the unit of length."""
    frame = "SPACE=RAS" if mesh.frame == "RAS" else "no patient frame"
    return f"{frame}; unit {mesh.unit or 'unknown'}"


def _ply(mesh: Mesh, values: Mapping[str, Floats]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"comment {_comment(mesh)}"]
    lines += [f"element vertex {len(mesh.vertices)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"property float {name}" for name in values]
    lines += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices"]
    lines += ["end_header", ""]
    columns = [("place", "<f8", 3), *((name, "<f4") for name in values)]
    vertices = np.empty(len(mesh.vertices), columns)
    vertices["place"] = mesh.vertices
    for name, numbers in values.items():
        vertices[name] = numbers
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"] = 3
    faces["corners"] = mesh.faces
    return "\n".join(lines).encode() + vertices.tobytes() + faces.tobytes()


def _vtk(mesh: Mesh, values: Mapping[str, Floats]) -> bytes:
    """Return a legacy VTK file, whose binary numbers have the high byte first."""
    n = len(mesh.vertices)
    n_faces = len(mesh.faces)
    corners = np.column_stack([np.full(n_faces, 3), mesh.faces])
    blocks: list[tuple[str, NDArray[Any]]] = [
        (f"DATASET POLYDATA\nPOINTS {n} double", mesh.vertices.astype(">f8")),
        (f"POLYGONS {n_faces} {4 * n_faces}", corners.astype(">i4")),
    ]
    head = f"POINT_DATA {n}\n"
    for name, numbers in values.items():
        blocks.append(
            (f"{head}SCALARS {name} float 1\nLOOKUP_TABLE default", numbers.astype(">f4"))
        )
        head = ""
    content = f"# vtk DataFile Version 3.0\n{_comment(mesh)}\nBINARY\n".encode()
    for title, block in blocks:
        content += f"{title}\n".encode() + block.tobytes() + b"\n"
    return content


def _write_gifti(path: Path, mesh: Mesh, values: Mapping[str, Floats]) -> None:
    import nibabel
    from nibabel.gifti import GiftiCoordSystem, GiftiDataArray, GiftiImage, GiftiMetaData

    scanner = "NIFTI_XFORM_SCANNER_ANAT"
    place = GiftiCoordSystem(scanner, scanner, np.eye(4))
    arrays = [
        GiftiDataArray(mesh.vertices.astype(np.float32), "pointset", coordsys=place),
        GiftiDataArray(mesh.faces.astype(np.int32), "triangle"),
    ]
    for name, numbers in values.items():
        meta = GiftiMetaData(Name=name)
        arrays.append(GiftiDataArray(numbers.astype(np.float32), "shape", meta=meta))
    nibabel.save(GiftiImage(darrays=arrays), path)


def _write_nifti(
    path: Path, mesh: Mesh, of_points: Callable[[Floats], Floats], voxels: LabelVoxels
) -> None:
    import nibabel

    index = np.argwhere(voxels.mask) + voxels.low
    centres = index @ voxels.affine[:3, :3].T + voxels.affine[:3, 3]
    grid = np.zeros(voxels.grid, dtype=np.float32)
    grid[tuple(index.T)] = of_points(centres)
    image = nibabel.Nifti1Image(grid, voxels.affine)
    image.header.set_xyzt_units("mm")
    if mesh.frame is None:  # as in the label image, nothing is said about the patient
        image.header.set_sform(None, 0)
        image.header.set_qform(None, 0)
    nibabel.save(image, path)
