"""Generated shapes: sound meshes, a stable benchmark, files that resume."""

from collections import Counter

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_array_equal
from training.shapes.polygons import Prism
from training.shapes.ring import Ring
from training.shapes.templates import TEMPLATES

from igps.shapes import ArticulatedShapes
from igps.shapes.solids import Arc, Box, Cone

DEFAULTS = ["biped", "quadruped", "octopus", "spider", "hand", "snake", "plier", "mug"]


@pytest.fixture(scope="module")
def default_shapes():
    """Three shapes of each of the eight default classes."""
    return list(ArticulatedShapes(n_per_class=3))


@pytest.fixture(scope="module")
def all_shapes(default_shapes):
    """These, and one of each of the other four classes."""
    shapes = ArticulatedShapes(n_classes=12, n_per_class=1, seed=3, templates=TEMPLATES)
    return default_shapes + [shapes[i] for i in range(8, 12)]


def surface_of(shape):
    return trimesh.Trimesh(
        shape.vertices,
        shape.faces,
        process=False,
    )


def directed_edges(faces):
    edges = []
    for a, b, c in faces.tolist():
        edges += [(a, b), (b, c), (c, a)]
    return edges


def test_each_directed_edge_occurs_once_with_its_opposite(all_shapes):
    for shape in all_shapes:
        count = Counter(directed_edges(shape.faces))
        assert set(count.values()) == {1}, shape.name
        opposite = {(b, a) for a, b in count}
        assert opposite == set(count), shape.name


def test_the_faces_at_each_vertex_form_one_fan(all_shapes):
    for shape in all_shapes:
        after = [{} for _ in shape.vertices]
        for a, b, c in shape.faces.tolist():
            after[a][b] = c
            after[b][c] = a
            after[c][a] = b
        for fan in after:
            start = next(iter(fan))
            around = [start]
            while fan[around[-1]] != start:
                around.append(fan[around[-1]])
            assert len(around) == len(fan) >= 3, shape.name


def test_one_component_of_the_recorded_genus(all_shapes):
    for shape in all_shapes:
        surface = surface_of(shape)
        assert surface.body_count == 1, shape.name
        assert surface.euler_number == 2 - 2 * shape.genus, shape.name


def test_genus_of_known_objects():
    shapes = ArticulatedShapes(n_classes=10, n_per_class=1, templates=TEMPLATES)
    for name, genus in (("biped", 0), ("mug", 1), ("glasses", 2)):
        assert shapes[shapes.class_names.index(name)].genus == genus


def test_arrays_and_triangles_are_sane(all_shapes):
    for shape in all_shapes:
        assert shape.vertices.dtype == np.float64
        assert shape.faces.dtype == np.int64
        assert len(np.unique(shape.vertices, axis=0)) == len(shape.vertices)
        assert 1800 <= len(shape.vertices) <= 4200, shape.name
        surface = surface_of(shape)
        assert surface.volume > 0.05, shape.name
        angles = surface.face_angles
        assert np.degrees(angles.min()) > 5.0, shape.name
        assert np.degrees(np.percentile(angles, 1)) > 20.0, shape.name


def test_same_seed_same_arrays_other_seed_others(default_shapes):
    for i in (0, 4, 23):
        again = ArticulatedShapes(n_per_class=3)[i]
        assert_array_equal(again.vertices, default_shapes[i].vertices)
        assert_array_equal(again.faces, default_shapes[i].faces)
    other = ArticulatedShapes(n_per_class=3, seed=1)[0]
    assert not np.array_equal(
        other.vertices,
        default_shapes[0].vertices,
    )


def test_a_shape_does_not_depend_on_the_others(all_shapes):
    """Neither on those made before nor on how many there are: class 10 of 11 or 12, shape 0 of 1 or 4."""
    alone = ArticulatedShapes(11, n_per_class=4, seed=3, templates=TEMPLATES)[10 * 4]
    among = all_shapes[24 + 2]
    assert alone.name == among.name
    assert_array_equal(alone.vertices, among.vertices)
    assert_array_equal(alone.faces, among.faces)


def test_shapes_of_a_class_differ(default_shapes):
    """In more than the rigid motion: their areas and volumes differ too."""
    for start in range(0, 24, 3):
        compactness = []
        for shape in default_shapes[start : start + 3]:
            surface = surface_of(shape)
            compactness.append(surface.volume / surface.area**1.5)
        assert np.ptp(compactness) > 1e-3 * np.mean(compactness), default_shapes[start].name


def test_resolution_follows_n_vertices():
    for n_vertices in (1200, 6000):
        shape = ArticulatedShapes(n_per_class=1, n_vertices=n_vertices)[7]
        assert 0.6 <= len(shape.vertices) / n_vertices <= 1.4


def distance_histogram(shape):
    """D2 (Osada, Funkhouser, Chazelle and Dobkin 2002): distances of random surface points, over the area's root."""
    mesh = surface_of(shape)
    points, _ = trimesh.sample.sample_surface(mesh, 800, seed=0)
    apart = points[:400, None] - points[None, 400:]
    distances = np.linalg.norm(apart, axis=2)
    distances /= np.sqrt(mesh.area)
    counts, _ = np.histogram(distances, 32, (0.0, 1.6))
    return counts / distances.size


def test_shapes_of_a_class_are_closer_than_others(default_shapes):
    histograms = np.array([distance_histogram(shape) for shape in default_shapes])
    apart = np.abs(histograms[:, None] - histograms[None]).sum(axis=2)
    labels = np.array([shape.label for shape in default_shapes])
    same = labels[:, None] == labels[None]
    within = apart[same & ~np.eye(len(labels), dtype=bool)].mean()
    assert within < 0.6 * apart[~same].mean()


def test_names_and_labels():
    shapes = ArticulatedShapes(n_per_class=2)
    assert shapes.class_names == DEFAULTS
    assert len(shapes) == len(shapes.labels) == len(shapes.names) == 16
    assert shapes.labels[:4] == ["biped", "biped", "quadruped", "quadruped"]
    assert shapes.names[:3] == ["biped/00", "biped/01", "quadruped/00"]
    last = shapes[-1]
    assert last.label == "mug"
    assert last.name == "mug/01"
    more = ArticulatedShapes(n_classes=12, templates=TEMPLATES)
    assert more.class_names[:8] == DEFAULTS


def test_arguments_out_of_range_are_named():
    for index in (16, -17):
        with pytest.raises(IndexError, match=str(index)):
            ArticulatedShapes(n_per_class=2)[index]
    wrong = {"n_classes": 9, "n_per_class": 0, "seed": -1, "n_vertices": 10}
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=name):
            ArticulatedShapes(**{name: value})


def test_write_gives_the_same_meshes_and_resumes(tmp_path):
    shapes = ArticulatedShapes(n_classes=2, n_per_class=2, n_vertices=1500)
    shapes.write(tmp_path)
    files = sorted(tmp_path.rglob("*.off"))
    names = [file.relative_to(tmp_path).as_posix() for file in files]
    assert names == [f"{name}.off" for name in shapes.names]
    read = trimesh.load(files[3], process=False)
    assert_array_equal(read.vertices, shapes[3].vertices)
    assert_array_equal(read.faces, shapes[3].faces)

    before = [file.read_bytes() for file in files]
    times = [file.stat().st_mtime_ns for file in files]
    files[0].unlink()
    files[1].unlink()
    shapes.write(tmp_path)
    written = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    assert written == [*files, tmp_path / "shapes.json"]
    assert [file.read_bytes() for file in files] == before
    is_kept = [file.stat().st_mtime_ns == time for file, time in zip(files, times, strict=True)]
    assert is_kept == [False, False, True, True]


def test_write_refuses_a_folder_of_other_shapes(tmp_path):
    ArticulatedShapes(n_classes=1, n_per_class=1, n_vertices=1000).write(tmp_path)
    with pytest.raises(ValueError, match="root="):
        ArticulatedShapes(n_classes=1, n_per_class=1, n_vertices=1000, seed=1).write(tmp_path)


POINTS = np.random.default_rng(0).uniform(
    -1.5,
    1.5,
    (400, 3),
)


def nearest_sphere(centres, radii):
    to_centres = POINTS[:, None] - centres[None]
    distances = np.linalg.norm(to_centres, axis=2)
    return (distances - radii).min(axis=1)


def swept(solid):
    """The distance to a union of very many balls along the solid's centre line."""
    t = np.linspace(0.0, 1.0, 4001)
    zero = np.zeros_like(t)
    match solid:
        case Cone(length, start, end):
            line = np.column_stack([zero, zero, t * length])
            return nearest_sphere(line, start + t * (end - start))
        case Arc(bend, angle, start, end):
            turn = t * angle
            height = bend * (1 - np.cos(turn))
            length = bend * np.sin(turn)
            line = np.column_stack([zero, height, length])
            radii = start + t * (end - start)
            return nearest_sphere(line, radii)
        case Ring(radius, tube, side):
            turn = 2 * np.pi * t
            x = radius * np.cos(turn)
            z = radius * np.sin(turn)
            bows = np.column_stack([x, zero, z + np.sign(z) * side])
            right = np.column_stack([zero + radius, zero, (2 * t - 1) * side])
            left = right * [-1, 1, 1]
            return nearest_sphere(
                np.concatenate([bows, right, left]),
                np.full(1, tube),
            )
    raise AssertionError(solid)


@pytest.mark.parametrize(
    "solid",
    [
        Cone(0.9, 0.3, 0.1),
        Arc(0.6, 2.2, 0.15, 0.15),
        Ring(0.5, 0.2),
        Ring(0.4, 0.1, 0.3),
    ],
)
def test_distance_to_swept_solids(solid):
    outside = swept(solid) > 0.0
    found = solid.distance(*POINTS.T)[outside]
    expected = swept(solid)[outside]
    np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize(
    "solid",
    [
        Box((1.0, 0.6, 1.6), 0.1),
        Prism(4, 0.9, 0.5, 0.05),
    ],
)
def test_flat_solids_have_their_volume(solid):
    """Of a box and of a square prism, by counting points; the rounding takes off little."""
    points = np.random.default_rng(1).uniform(
        -1.0,
        1.0,
        (400_000, 3),
    )
    volume = 8.0 * np.mean(solid.distance(*points.T) < 0.0)
    expected = 0.96 if isinstance(solid, Box) else 2.0 * 0.9**2 * 0.5
    assert 0.94 * expected < volume < 1.01 * expected
