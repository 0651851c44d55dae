"""Each disturbance does what it says, and leaves a checked body."""

import numpy as np
import pytest
import trimesh
from docs.benchmarks.robustness import DISTURBANCES
from docs.benchmarks.weld import weld_gap
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from training.disturbances import clip, hole, move, noise, remesh, scale, simplified

from conftest import as_trimesh, horseshoe, surface_genus
from igps.mesh.mesh import Mesh


def test_noise_moves_along_the_normals(sphere):
    noisy = noise(sphere, 0.01, seed=3)
    radius = norm(noisy.vertices, axis=1)
    assert_allclose(noisy.vertices / radius[:, None], sphere.vertices, atol=1e-3)
    assert np.std(radius - 1) == pytest.approx(0.01 * sphere.diagonal, rel=0.05)
    assert abs(np.mean(radius - 1)) < 0.002
    assert_array_equal(noisy.vertices, noise(sphere, 0.01, seed=3).vertices)
    assert np.abs(noisy.vertices - noise(sphere, 0.01, seed=4).vertices).max() > 0.01
    with pytest.raises(ValueError, match="amplitude"):
        noise(sphere, 0)


def test_simplified_keeps_the_share(sphere):
    assert len(simplified(sphere, 0.1).vertices) == 256
    with pytest.raises(ValueError, match="share"):
        simplified(sphere, 1.0)


def test_remesh_gives_other_triangles_on_the_same_surface(sphere):
    other = remesh(sphere)
    assert surface_genus(other) == 0
    assert 0.98 * len(sphere.faces) <= len(other.faces) <= len(sphere.faces)
    inner = as_trimesh(sphere)
    least = np.abs(np.einsum("ij,ij->i", inner.face_normals, inner.triangles_center)).min()
    radius = norm(other.vertices, axis=1)
    assert least - 1e-9 <= radius.min()
    assert radius.max() <= 1 + 1e-9
    nearest = norm(other.vertices[:, None] - sphere.vertices[None], axis=2).min(axis=1)
    assert (nearest > 1e-6).mean() > 0.3
    assert other.volume == pytest.approx(sphere.volume, rel=5e-3)
    assert surface_genus(remesh(weld_gap(horseshoe()))) == 1


def test_hole_is_one_patch_of_the_wanted_area(sphere):
    holed = hole(sphere, 0.05, seed=2)
    assert holed.allow_open
    assert 1 - holed.area / sphere.area == pytest.approx(0.05, abs=1 / len(sphere.faces))
    surface = as_trimesh(holed)
    rim = surface.edges[trimesh.grouping.group_rows(surface.edges_sorted, require_count=1)]
    # One closed rim, at one distance from the middle of the patch: that of a spherical cap of this area, give or take
    # the grain of paths along edges.
    assert len(trimesh.graph.connected_components(rim)) == 1
    middle = -holed.vertices.mean(axis=0)
    angle = np.arccos(holed.vertices @ middle / norm(middle))
    assert angle[np.unique(rim)].max() < 1.35 * np.arccos(1 - 2 * 0.05)
    assert angle.min() > 0.65 * np.arccos(1 - 2 * 0.05)
    with pytest.raises(ValueError, match="share"):
        hole(sphere, 0)


def test_clip_takes_a_cap_off_a_ball(sphere):
    turned = move(sphere)
    cut = clip(turned, 0.1)
    assert surface_genus(cut) == 0
    height = 0.2
    lost_volume = np.pi * height**2 * (3 - height) / 3
    assert sphere.volume - cut.volume == pytest.approx(lost_volume, rel=0.02)
    # A spherical cap, closed by a disc
    lost_area = 2 * np.pi * height - np.pi * height * (2 - height)
    assert sphere.area - cut.area == pytest.approx(lost_area, rel=0.05)
    # All that remains is where it was.
    radius = norm(
        cut.vertices - turned.vertices.mean(axis=0),
        axis=1,
    )
    assert_allclose(radius.max(), 1, atol=1e-6)


def test_clip_keeps_the_largest_piece():
    ring = horseshoe(0.4)
    x, y, _ = ring.vertices.T
    # Its bend far away from its ends, of which one is thicker.
    stretched = ring.vertices.copy()
    stretched[x < 0, 0] *= 2.5
    stretched[y > 0, 2] *= 1.5
    mesh = Mesh(stretched, ring.faces)
    cut = clip(mesh, 0.8)
    assert cut.vertices[:, 1].min() > 0  # both ends remain; the thinner one is on the other side
    found = cut.vertices[:, 0].max()
    expected = pytest.approx(
        stretched[:, 0].max(),
        abs=0.05,
    )
    assert found == expected
    assert 0 < cut.volume < 0.3 * mesh.volume
    with pytest.raises(ValueError, match="share"):
        clip(mesh, 0)


def test_scale_and_motion_keep_the_form(blob):
    larger = scale(blob, 7)
    moved = move(blob, seed=1)
    assert_allclose(larger.vertices, 7 * blob.vertices)
    for mesh in (larger, moved):
        assert_array_equal(mesh.faces, blob.faces)
    before = blob.vertices - blob.vertices.mean(axis=0)
    after = moved.vertices - moved.vertices.mean(axis=0)
    assert_allclose(after @ after.T, before @ before.T, atol=1e-12)
    assert moved.volume == pytest.approx(blob.volume)  # no mirror image
    assert np.abs(after - before).max() > 0.1
    offset = moved.vertices.mean(axis=0) - blob.vertices.mean(axis=0)
    assert norm(offset) == pytest.approx(2 * blob.diagonal)
    for factor in (0, np.inf):
        with pytest.raises(ValueError, match="factor"):
            scale(blob, factor)


@pytest.mark.parametrize("name", DISTURBANCES)
def test_every_disturbance_says_what_it_did(name):
    mesh = horseshoe()
    before = mesh.vertices.copy(), mesh.faces.copy()
    disturbed = DISTURBANCES[name].apply(mesh)
    assert disturbed.name == mesh.name
    assert len(disturbed.notes) == 1
    assert disturbed.allow_open == (name == "hole")
    has_others = not np.array_equal(disturbed.faces, mesh.faces)
    assert has_others or not np.array_equal(disturbed.vertices, mesh.vertices)
    assert_array_equal(mesh.vertices, before[0])
    assert_array_equal(mesh.faces, before[1])
