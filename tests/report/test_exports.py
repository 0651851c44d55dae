"""Exported results, read by nibabel, SimpleITK, trimesh and VTK."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from test_views import CENTRE, ORIENTATIONS, marked_ball, write

from igps.mesh.loading import load_mesh, read_surface
from igps.mesh.mesh import Mesh
from igps.mesh.surface import vertex_normals
from igps.report.exports import write_places

nibabel = pytest.importorskip("nibabel")
SimpleITK = pytest.importorskip("SimpleITK")

MARK = [-1.0, 0, 0]  # RAS: the patient's left


@pytest.fixture(params=["RAS", "LPS", "oblique"])
def exported(request, tmp_path):
    """A label image, its body, and the values of its vertices: how far they lie to the left."""
    write(tmp_path / "labels.nii.gz", *marked_ball(ORIENTATIONS[request.param], MARK))
    raw = read_surface(tmp_path / "labels.nii.gz")
    assert raw.voxels is not None
    mesh = load_mesh(tmp_path / "labels.nii.gz")
    values = CENTRE[0] - mesh.vertices[:, 0] + 50
    write_places(tmp_path / "out" / "body", mesh, {"value": values}, raw.voxels())
    return tmp_path, mesh, values


def test_voxels_have_the_grid_of_the_label_image(exported):
    folder, mesh, values = exported
    labels = SimpleITK.ReadImage(str(folder / "labels.nii.gz"))
    found = SimpleITK.ReadImage(str(folder / "out" / "body.nii.gz"))
    assert found.GetSize() == labels.GetSize()
    for read in ("GetSpacing", "GetOrigin", "GetDirection"):
        assert_allclose(getattr(found, read)(), getattr(labels, read)(), atol=1e-4)
    numbers = SimpleITK.GetArrayFromImage(found)
    assert ((numbers > 0) == (SimpleITK.GetArrayFromImage(labels) > 0)).all()
    inside = mesh.vertices - 1.5 * vertex_normals(mesh.vertices, mesh.faces)  # one voxel
    index = [found.TransformPhysicalPointToIndex(p) for p in (inside * [-1, -1, 1]).tolist()]
    errors = np.array([found[i] for i in index]) - values  # mm to the left
    assert np.abs(errors).max() < 3.0  # two voxels: one inwards, one between centres and vertices
    assert abs(errors.mean()) < 0.5  # a grid that is shifted by one voxel has 1.5
    assert_allclose(nibabel.load(folder / "out" / "body.nii.gz").get_fdata(), numbers.T)


def test_surfaces_are_in_ras(exported):
    folder, mesh, values = exported
    image = nibabel.load(folder / "out" / "body.gii")
    points, faces, shape = (array.data for array in image.darrays)
    assert_allclose(points, mesh.vertices, atol=1e-4)
    assert_array_equal(faces, mesh.faces)
    assert_allclose(shape, values, rtol=1e-6)
    assert image.darrays[0].coordsys.dataspace == 1  # scanner
    ply = trimesh.load(folder / "out" / "body.ply", process=False)
    assert_allclose(ply.vertices, mesh.vertices)
    assert_array_equal(ply.faces, mesh.faces)
    assert_allclose(ply.metadata["_ply_raw"]["vertex"]["data"]["value"], values, 1e-6)
    for name in ("body.ply", "body.vtk"):
        assert b"SPACE=RAS" in (folder / "out" / name).read_bytes()[:200]


def test_vtk_reads_the_surface_and_its_values(exported):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    folder, mesh, values = exported
    for reader, name in ((vtk.vtkPolyDataReader(), "vtk"), (vtk.vtkPLYReader(), "ply")):
        reader.SetFileName(str(folder / "out" / f"body.{name}"))
        reader.Update()
        surface = reader.GetOutput()
        points = vtk_to_numpy(surface.GetPoints().GetData())
        assert_allclose(points, mesh.vertices, atol=1e-4)
        assert surface.GetNumberOfPolys() == len(mesh.faces)
        if name == "vtk":
            found = vtk_to_numpy(surface.GetPointData().GetArray("value"))
            assert_allclose(found, values, rtol=1e-6)


def test_nothing_is_claimed_about_a_body_without_a_frame(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=2)
    write_places(
        tmp_path / "s.1",
        Mesh(ball.vertices, ball.faces),
        {"value": np.ones(162)},
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s.1.ply", "s.1.vtk"]
    assert b"RAS" not in (tmp_path / "s.1.ply").read_bytes()[:200]
