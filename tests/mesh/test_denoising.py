"""Noise is told from shape, and goes; shape stays."""

import numpy as np
import pytest
import trimesh
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from training.disturbances import noise
from trimesh.creation import icosphere

from igps.mesh.denoising import Neighbours, is_noisy, noise_and_edge, remove_noise
from igps.mesh.mending import mend, repair_steps
from igps.mesh.mesh import Mesh
from igps.mesh.surface import area_vectors, undirected_edges
from igps.shapes import ArticulatedShapes


def bumpy():
    """A sphere with 2,562 vertices and bumps of about six edge lengths."""
    surface = icosphere(subdivisions=4)
    x, y, z = surface.vertices.T
    bumps = 0.03 * np.sin(12 * x) * np.sin(11 * y + 1) * np.cos(10 * z)
    return Mesh(
        np.asarray(surface.vertices) * (1 + bumps)[:, None],
        np.asarray(surface.faces),
    )


def test_noise_is_found_and_shape_is_not(sphere):
    assert is_noisy(noise(sphere, 0.004, 0).vertices, sphere.faces)
    assert not is_noisy(sphere.vertices, sphere.faces)
    assert not is_noisy(bumpy().vertices, bumpy().faces)


def test_rounding_creases_and_odd_triangles_are_no_noise():
    box = trimesh.creation.box((1, 2, 3)).subdivide_to_size(0.1)
    generator = default_rng(0)
    flat = np.asarray(box.vertices) + generator.normal(0, 1e-7, box.vertices.shape)
    assert not is_noisy(flat, np.asarray(box.faces))
    surface = icosphere(subdivisions=4)
    shifted = np.asarray(surface.vertices) + generator.normal(0, 0.01, surface.vertices.shape)
    shifted /= norm(shifted, axis=1, keepdims=True)
    assert not is_noisy(shifted, np.asarray(surface.faces))


def test_the_rough_half_of_a_body_stays(sphere):
    rough = noise(sphere, 0.004, 0).vertices
    upper = sphere.vertices[:, 2:] > 0.2
    assert not is_noisy(
        np.where(upper, rough, sphere.vertices),
        sphere.faces,
    )


def test_area_and_volume_come_back(sphere):
    noisy = noise(sphere, 0.004, 1)
    assert noisy.area > 1.05 * sphere.area
    smooth = Mesh(remove_noise(noisy.vertices, noisy.faces), noisy.faces)
    assert smooth.area == pytest.approx(sphere.area, rel=0.01)
    assert smooth.volume == pytest.approx(sphere.volume, rel=0.01)
    before = norm(noisy.vertices, axis=1)
    after = np.abs(norm(smooth.vertices, axis=1) - 1)
    assert after.std() < 0.6 * before.std()


@pytest.mark.parametrize("ratio", [0.1, 0.3])
def test_passes_follow_the_noise(ratio):
    """The area, volume and normals of the clean ball come back from noise of several strengths."""
    ball = icosphere(subdivisions=4)
    vertices = np.asarray(ball.vertices)
    faces = np.asarray(ball.faces)
    noise_length = ratio * np.sqrt((ball.edges_unique_length**2).mean())
    lengths = default_rng(0).normal(0, noise_length, len(vertices))
    noisy = vertices * (1 + lengths)[:, None]
    # The noise makes the edges longer.
    assert _noise_over_edge(noisy, faces) == pytest.approx(
        ratio / np.sqrt(1 + 2 * ratio**2), rel=0.08
    )
    assert is_noisy(noisy, faces)
    smooth = Mesh(remove_noise(noisy, faces), faces)
    assert smooth.area == pytest.approx(ball.area, rel=0.008)
    assert smooth.volume == pytest.approx(ball.volume, rel=0.006)
    # In degrees; of the noisy surface from 10 upward.
    normals = smooth.vertices[faces].mean(axis=1)
    cosines = np.einsum(
        "ij,ij->i",
        _unit(area_vectors(smooth.vertices, faces)),
        _unit(normals),
    )
    assert np.degrees(np.arccos(cosines.clip(-1, 1))).mean() < 4.5


@pytest.mark.parametrize(
    ("steps", "sections"),
    [(3, 256), (5, 200)],
)
def test_turned_parts_of_thin_triangles_come_back(steps, sections):
    """Rims of many corners, far apart: noise as wide as a triangle crumples them. The clean part is the oracle."""
    random = default_rng(steps)
    ends = np.cumsum(random.uniform(0.2, 1, steps))
    radii = random.uniform(0.15, 0.5, steps)
    corners = [(r, z) for k, r in enumerate(radii) for z in (ends[k - 1] if k else 0, ends[k])]
    profile = [(0, 0), *corners, (0, ends[-1])]
    turned = trimesh.creation.revolve(np.array(profile), sections=sections)
    part = Mesh(
        np.asarray(turned.vertices),
        np.asarray(turned.faces),
    )
    rough = noise(part, 0.002, seed=steps)
    assert not is_noisy(part.vertices, part.faces)
    assert is_noisy(rough.vertices, rough.faces)
    smooth = Mesh(remove_noise(rough.vertices, rough.faces), part.faces)
    assert abs(smooth.area - part.area) < 0.25 * (rough.area - part.area)
    assert smooth.volume == pytest.approx(part.volume, rel=0.01)
    # Steps between rims stay sharp: no corner has moved farther than the noise moved it.
    moved = norm(smooth.vertices - part.vertices, axis=1)
    by_noise = norm(rough.vertices - part.vertices, axis=1)
    assert np.quantile(moved, 0.95) < np.quantile(by_noise, 0.95)


def test_edges_of_a_box_stay_sharp():
    """The normals of its sides are the oracle, also of the triangles along its edges; smoothing alone rounds those."""
    box = trimesh.creation.box((1, 2, 3)).subdivide_to_size(0.1)
    part = Mesh(
        np.asarray(box.vertices),
        np.asarray(box.faces),
    )
    rough = noise(part, 0.003, seed=2)
    assert is_noisy(rough.vertices, rough.faces)
    smooth = Mesh(remove_noise(rough.vertices, rough.faces), part.faces)
    expected, found = (_unit(area_vectors(mesh.vertices, part.faces)) for mesh in (part, smooth))
    off = np.degrees(
        np.arccos(
            np.clip(
                np.einsum("ij,ij->i", expected, found),
                -1,
                1,
            )
        )
    )
    assert off.mean() < 2
    beside = np.unique(box.face_adjacency[box.face_adjacency_angles > 1])
    assert off[beside].mean() < 5
    assert smooth.area == pytest.approx(part.area, rel=0.005)
    assert smooth.volume == pytest.approx(part.volume, rel=0.002)


def plate_with_holes(seed, longest_edge=None):
    """Long thin triangles between the rims; with shorter edges, slivers."""
    import manifold3d

    random = default_rng(seed)
    plate = manifold3d.Manifold.cube((2, 1, 0.2), True)
    for x in (-0.6, 0, 0.6):
        hole = manifold3d.Manifold.cylinder(
            1,
            random.uniform(0.1, 0.25),
            -1,
            256,
            True,
        )
        plate -= hole.translate((x, random.uniform(-0.2, 0.2), 0))
    drawn = (plate if longest_edge is None else plate.refine_to_length(longest_edge)).to_mesh64()
    return Mesh(
        np.asarray(drawn.vert_properties)[:, :3].copy(),
        np.asarray(drawn.tri_verts).astype(np.int64),
    )


@pytest.mark.parametrize(
    ("seed", "longest_edge"),
    [(0, None), (1, 0.06), (2, 0.06)],
)
def test_plates_with_holes_keep_their_volume(seed, longest_edge):
    """Against the clean plate. Neighbours on a rim lie on one side of a vertex; noise may exceed slivers."""
    part = plate_with_holes(seed, longest_edge)
    rough = noise(part, 0.002, seed)
    assert is_noisy(rough.vertices, rough.faces)
    smooth = Mesh(remove_noise(rough.vertices, rough.faces), part.faces)
    assert smooth.volume == pytest.approx(part.volume, rel=0.03)
    assert abs(smooth.area - part.area) < 0.5 * (rough.area - part.area)


def test_a_fan_of_thousands_of_slivers_does_not_fold_up():
    """Noise is wider than they are, and all meet in one vertex."""
    import manifold3d

    ball = icosphere(subdivisions=5)
    whole = manifold3d.Manifold(
        manifold3d.Mesh64(
            np.array(ball.vertices),
            np.array(ball.faces, dtype=np.uint64),
        )
    )
    cone = manifold3d.Manifold.cylinder(1.2, 0.3, 0, 3000).translate((0, 0, 0.9))
    drawn = (whole + cone).to_mesh64()
    part = Mesh(
        np.asarray(drawn.vert_properties)[:, :3].copy(),
        np.asarray(drawn.tri_verts).astype(np.int64),
    )
    assert np.bincount(part.faces.ravel()).max() > 3000
    rough = noise(part, 0.002, seed=0)
    smooth = Mesh(remove_noise(rough.vertices, rough.faces), part.faces)
    assert smooth.area < rough.area
    assert smooth.volume == pytest.approx(part.volume, rel=0.005)


def test_many_faces_are_filtered_as_few_are(sphere, monkeypatch):
    rough = noise(sphere, 0.004, 2).vertices
    expected = remove_noise(rough, sphere.faces)
    monkeypatch.setattr("igps.mesh.denoising._FACES_AT_ONCE", 100)
    np.testing.assert_allclose(remove_noise(rough, sphere.faces), expected, rtol=1e-12)


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_the_unit_of_length_does_not_matter(scale):
    ring = trimesh.creation.annulus(0.2, 0.5, 1, sections=512)
    part = Mesh(
        np.asarray(ring.vertices),
        np.asarray(ring.faces),
    )
    rough = noise(part, 0.002, seed=1)
    assert not is_noisy(scale * part.vertices, part.faces)
    assert is_noisy(scale * rough.vertices, part.faces)
    assert remove_noise(scale * rough.vertices, part.faces) / scale == pytest.approx(
        remove_noise(rough.vertices, part.faces)
    )


def test_a_knurled_knob_is_no_noise():
    """Teeth go up and down from vertex to vertex as noise does, but their flanks are planes."""
    knob = trimesh.creation.revolve(
        np.array([(0, 0), (1, 0), (1, 1), (0, 1)]),
        sections=600,
    )
    vertices = np.array(knob.vertices)
    tooth = np.rint(np.arctan2(vertices[:, 1], vertices[:, 0]) / (2 * np.pi) * 600).astype(int) % 2
    vertices[:, :2] *= (1 + 0.01 * tooth)[:, None]
    assert not is_noisy(vertices, np.asarray(knob.faces))


def _noise_over_edge(vertices, faces):
    edges, _ = undirected_edges(faces)
    around = Neighbours.of(vertices, edges)
    noise, edge = noise_and_edge(vertices, faces, around)
    return noise / edge


def _unit(vectors):
    return vectors / norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("index", [0, 7])
def test_coarse_bodies_are_told_apart_from_noisy_ones(index):
    """Of about 1,500 vertices, where an edge is long and the surface bends within it."""
    body = ArticulatedShapes(index + 1, 1, seed=2, n_vertices=1500)[index]
    mesh = Mesh(body.vertices, body.faces)
    assert not is_noisy(mesh.vertices, mesh.faces)
    edge = norm(np.diff(mesh.vertices[mesh.faces], axis=1), axis=2).mean()
    assert is_noisy(
        noise(mesh, 0.18 * edge / mesh.diagonal, 0).vertices,
        mesh.faces,
    )


@pytest.mark.parametrize(
    ("share", "expected"),
    [(0.005, True), (0.05, False)],
)
def test_what_is_full_of_holes_is_no_surface_to_look_over(sphere, share, expected):
    rough = noise(sphere, 0.004, 0)
    faces = rough.faces[default_rng(0).random(len(rough.faces)) >= share]
    assert is_noisy(rough.vertices, faces) is expected


def test_boundaries_stay(sphere):
    faces = sphere.faces[sphere.vertices[sphere.faces].mean(axis=1)[:, 2] < 0.5]
    noisy = noise(sphere, 0.004, 1).vertices
    smooth = remove_noise(noisy, faces)
    sides = np.sort(
        np.stack([faces, np.roll(faces, 1, axis=1)], axis=-1).reshape(-1, 2),
        axis=1,
    )
    edges, count = np.unique(sides, axis=0, return_counts=True)
    rim = np.unique(edges[count == 1])
    assert_array_equal(smooth[rim], noisy[rim])
    assert not np.array_equal(smooth, noisy)


def test_mending_smooths_noise_only(sphere):
    noisy = noise(sphere, 0.004, 1)
    mesh = mend(noisy.vertices, noisy.faces)
    assert repair_steps(mesh.notes) == ("smoothed",)
    assert_array_equal(mesh.faces, sphere.faces)
    assert_array_equal(mesh.vertices, remove_noise(noisy.vertices, noisy.faces))
