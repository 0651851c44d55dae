import numpy as np
import pytest
import trimesh
from matplotlib.image import imread
from numpy.linalg import norm
from scipy.spatial.transform import Rotation

from conftest import as_mesh
from igps.mesh.loading import load_mesh
from igps.mesh.mesh import Mesh
from igps.report import drawing
from igps.report.views import common_views, draw_view
from label_files import write_nifti

SimpleITK = pytest.importorskip("SimpleITK")

CENTRE = np.array([30.0, -40.0, 200.0])
MARKS = {
    "L": [-1.0, 0, 0],
    "A": [0, 1.0, 0],
    "S": [0, 0, 1.0],
}
ORIENTATIONS = {
    "RAS": np.eye(3),
    "LAS": np.diag([-1.0, 1, 1]),
    "LPS": np.diag([-1.0, -1, 1]),
    "oblique": Rotation.from_euler("xyz", [25, -15, 30], degrees=True).as_matrix(),
    "sagittal": np.array([[0, 0, -1.0], [1.0, 0, 0], [0, -1.0, 0]]),
}


def marked_ball(axes, toward):
    """Return voxels of a ball with a knob towards a side in RAS, on a grid with these axes, and the affine."""
    affine = np.eye(4)
    affine[:3, :3] = 1.5 * axes
    affine[:3, 3] = CENTRE - affine[:3, :3] @ [19.5, 19.5, 19.5]
    index = np.stack(np.indices((40, 40, 40)), axis=-1)
    world = index @ affine[:3, :3].T + affine[:3, 3]
    ball = norm(world - CENTRE, axis=-1) < 15
    knob = norm(world - CENTRE - 17 * np.array(toward), axis=-1) < 6
    return (ball | knob).astype(np.uint8), affine


def write(path, voxels, affine):
    if path.name.endswith(".nii.gz"):
        write_nifti(path, voxels, affine)
        return
    image = SimpleITK.GetImageFromArray(voxels.T)
    to_lps = np.diag([-1.0, -1, 1]) @ affine[:3, :3] / 1.5
    image.SetSpacing([1.5] * 3)
    image.SetDirection(to_lps.ravel().tolist())
    image.SetOrigin((affine[:3, 3] * [-1, -1, 1]).tolist())
    SimpleITK.WriteImage(image, str(path))


def nearest_letter(view, point):
    """Return the letter at the edge, or towards the viewer, to which a point lies from the centre."""
    right, up, toward = (point - CENTRE) @ view.axes
    side = {"from the left": "L", "from the right": "R", "from the front": "A", "from behind": "P"}
    at_viewer = {**side, "from above": "S", "from below": "I"}[view.title]
    far = dict(zip("LRAPSI", "RLPAIS", strict=True))[at_viewer]
    sizes = {at_viewer: toward, far: -toward}
    for letter, size in zip(
        view.letters,
        (-right, right, -up, up),
        strict=True,
    ):
        sizes[letter] = size
    assert sorted(sizes) == list("AILPRS")
    return max(sizes, key=lambda letter: sizes[letter])


@pytest.mark.parametrize(
    ("orientation", "ending", "letter"),
    [
        *((orientation, "nii.gz", "L") for orientation in ORIENTATIONS),
        *(("oblique", ending, letter) for ending in ("nrrd", "mha") for letter in MARKS),
    ],
)
def test_a_mark_is_at_its_letter_in_every_view(tmp_path, orientation, ending, letter):
    path = tmp_path / f"body.{ending}"
    write(path, *marked_ball(ORIENTATIONS[orientation], MARKS[letter]))
    views, (vertices,) = common_views([load_mesh(path)])
    farthest = vertices[norm(vertices - CENTRE, axis=1).argmax()]
    assert len(views) == 6
    assert {nearest_letter(view, farthest) for view in views} == {letter}


def test_pixels_of_a_mark_on_the_left_are_at_the_letter_l(tmp_path):
    path = tmp_path / "body.nii.gz"
    write(path, *marked_ball(ORIENTATIONS["LPS"], MARKS["L"]))
    mesh = load_mesh(path)
    views, (vertices,) = common_views([mesh])
    is_mark = mesh.vertices[:, 0] < CENTRE[0] - 14
    colours = np.where(
        is_mark[:, None],
        [1.0, 0, 0],
        [0, 0, 1.0],
    )
    for view in views[0], views[2]:  # from the front, and from behind
        figure = drawing.new_figure(3, 3)
        axes = figure.add_subplot()
        draw_view(axes, view, mesh, vertices, colours)
        drawing.save_figure(figure, tmp_path / "view.png", dpi=100)
        pixels = imread(tmp_path / "view.png")[..., :3]
        is_red = (pixels[..., 0] > 0.3) & (pixels[..., 2] < 0.1)
        is_blue = (pixels[..., 2] > 0.3) & (pixels[..., 0] < 0.1)
        offset = np.nonzero(is_red)[1].mean() - np.nonzero(is_blue)[1].mean()
        (letter,) = [text for text in axes.texts if text.get_text() == "L"]
        assert offset * (letter.get_position()[0] - 0.5) > 0
        assert abs(offset) > 50


@pytest.mark.parametrize(
    ("header", "frame"),
    [("space: left-posterior-superior", "RAS"), ("space: 3D-right-handed", None)],
)
def test_a_frame_is_claimed_only_where_the_file_has_one(tmp_path, header, frame):
    voxels, affine = marked_ball(np.eye(3), MARKS["L"])
    path = tmp_path / "body.nrrd"
    write(path, voxels, affine)
    content = path.read_bytes().replace(b"space: left-posterior-superior", header.encode())
    path.write_bytes(content)
    assert load_mesh(path).frame == frame
    write_nifti(tmp_path / "body.nii", voxels, None)
    assert load_mesh(tmp_path / "body.nii").frame is None


def test_bodies_without_a_frame_are_turned_onto_the_first_and_not_mirrored():
    body = trimesh.creation.icosphere(subdivisions=4)
    body.vertices *= [3.0, 2.0, 1.0]
    body.vertices += 0.9 * np.exp(-np.square(body.vertices - [2.0, 1.0, 0.5]).sum(axis=1))[:, None]
    first = as_mesh(body)
    turn = Rotation.from_euler("xyz", [100, 40, -70], degrees=True).as_matrix()
    turned = Mesh(
        first.vertices @ turn.T + [5.0, -3, 2],
        first.faces,
    )
    mirrored = Mesh(
        turned.vertices * [-1, 1, 1],
        turned.faces[:, ::-1],
    )
    views, (own, moved, other) = common_views([first, turned, mirrored])
    assert [view.title for view in views] == [f"view {number}" for number in range(1, 7)]
    for view in views:
        assert view.letters == ()
    np.testing.assert_allclose(moved, own, atol=0.02)
    assert norm(other - own, axis=1).max() > 0.3
    motion = np.linalg.lstsq(
        mirrored.vertices - mirrored.vertices.mean(axis=0),
        other,
        rcond=None,
    )
    assert np.linalg.det(motion[0]) > 0


def test_titles_leave_out_the_folders_that_all_share():
    names = ["/data/a/s1.nii.gz#liver", "/data/b/s1.nii.gz#liver"]
    assert drawing.titles_of(names) == ["a/s1.nii.gz#liver", "b/s1.nii.gz#liver"]
    assert drawing.titles_of(names[:1]) == ["s1.nii.gz#liver"]
