"""Graded shapes: two levels of labels, one surface a body, and meshes that need no mending."""

import pickle
import re

import numpy as np
import pytest
import trimesh
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from scipy.spatial.distance import pdist
from training.shapes import GradedShapes, body_of
from training.shapes.bodies import draw_body, draw_pose
from training.shapes.kinds import KINDS, LOOK_ALIKE_FAMILIES, LOOK_ALIKE_TEMPLATES, body_classes
from training.shapes.plates import MACHINES, SHEETS, Plate, machine, sheet
from training.shapes.springs import Helix
from training.shapes.templates import TEMPLATES

from igps.data.sources import find_bodies
from igps.mesh.loading import load_mesh
from igps.mesh.options import LoadOptions
from igps.shapes import ArticulatedShapes
from igps.shapes.benchmark import off_text

CLASSES = body_classes(0)
# The named classes that bend, and one class of each kind.
FIRST = {one.name.split("-")[0]: i for i, one in reversed(list(enumerate(CLASSES)))}
COUNTS = [(3614, 7224), (2924, 5844)]
SUM = 6960.694254095106
N_VERTICES = (1500, 2500)
BENDING = [
    "biped",
    "octopus",
    "snake",
    "hand",
    "star",
    "beast",
    "chain",
    "serpent",
    "sheet",
    "coil",
]


def drawn(kind, number=0):
    body = draw_body(
        CLASSES[FIRST[kind]],
        [2, number],
        [0, number],
    )
    return draw_pose(body, default_rng([1, number]), 3000)


@pytest.fixture(scope="module")
def poses():
    return {kind: drawn(kind) for kind in FIRST}


@pytest.fixture(scope="module")
def shapes():
    return GradedShapes(2, 2, 2, seed=2, n_vertices=N_VERTICES)


@pytest.fixture(scope="module")
def made(shapes):
    return list(shapes)


def test_every_family_gives_bodies_and_poses(poses):
    assert set(poses) == set(TEMPLATES) | set(KINDS)
    for kind, pose in poses.items():
        surface = trimesh.Trimesh(pose.bent, pose.faces, process=False)
        assert surface.is_watertight, kind
        assert surface.is_winding_consistent, kind
        assert surface.volume > 0.01, kind
        assert surface.body_count == 1, kind


def test_a_pose_is_nearly_isometric_to_the_surface_at_rest(poses):
    area = []
    volume = []
    for pose in poses.values():
        rest = trimesh.Trimesh(pose.rest, pose.faces, process=False)
        bent = trimesh.Trimesh(pose.bent, pose.faces, process=False)
        area.append(abs(bent.area / rest.area - 1))
        volume.append(abs(bent.volume / rest.volume - 1))
    assert np.median(area) < 0.01
    assert np.median(volume) < 0.01
    assert max(area) < 0.05
    assert max(volume) < 0.06


def test_animals_bend_and_things_do_not(poses):
    """The greatest change of a distance between two vertices, over the body's extent."""

    def change(pose):
        some = default_rng(0).choice(
            len(pose.rest),
            300,
            replace=False,
        )
        rest = pdist(pose.rest[some])
        bent = pdist(pose.bent[some])
        return float(np.abs(rest - bent).max() / rest.max())

    for kind in ("mug", "chair", "vessel", "table", "stack", "machine"):
        assert_array_equal(poses[kind].bent, poses[kind].rest)
    changes = [change(poses[kind]) for kind in BENDING]
    assert min(changes) > 0.005  # some poses are nearly at rest
    assert np.median(changes) > 0.15


def test_every_sheet_has_the_holes_that_its_name_tells():
    """Of every outline, also of those whose middle is a disc; each hole is a handle."""
    for outline in SHEETS:
        without, *others = (sheet(default_rng(3), outline, n).genus for n in (0, 1, 2, 4))
        assert others == [without + 1, without + 2, without + 4]
    stars = [one for one in CLASSES if re.match("sheet-star-(?!0-)", one.name)]
    assert len(stars) == 3
    for i, star in enumerate(stars):
        draw_body(star, [0, i], [1, i])  # its surface has that genus, or there is none


def test_a_body_that_cannot_be_made_is_tried_once(monkeypatch):
    tried = []

    def impossible(*arguments):
        tried.append(arguments)
        raise ValueError("no sound body")

    monkeypatch.setattr("training.shapes.benchmark.draw_body", impossible)
    shapes = GradedShapes(1, 2, 3)
    for pose in range(3):
        with pytest.raises(ValueError, match=rf"biped/00/0{pose} could not be made: no sound body"):
            shapes[pose]
    assert len(tried) == 1
    with pytest.raises(ValueError, match="biped/01"):
        shapes[4]
    assert len(tried) == 2


def test_shapes_are_read_without_mending(made, tmp_path):
    for shape in made:
        path = tmp_path / "shape.off"
        path.write_text(off_text(shape.vertices, shape.faces))
        mesh = load_mesh(path, LoadOptions(mend="never"))
        assert mesh.notes == ()  # not turned inside out either
        assert mesh.genus == shape.genus
        assert 0.66 * N_VERTICES[0] <= len(shape.vertices) <= 1.34 * N_VERTICES[1]


def test_poses_differ_in_triangles_and_bodies_in_compactness(made):
    """Area^1.5 over volume does not change with motion, scale or bending, and does with the body."""
    assert len({len(shape.vertices) for shape in made}) > 5
    compactness = {}
    for shape in made:
        surface = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
        compactness.setdefault(shape.body, []).append(np.log(surface.area**1.5 / surface.volume))
    within = max(np.ptp(values) for values in compactness.values())
    bodies = np.array([np.mean(values) for values in compactness.values()])
    between = np.abs(bodies[::2] - bodies[1::2])  # two bodies of each class
    assert within < 0.1, (within, between)
    assert max(between) > 0.1


def test_same_seed_same_arrays_other_seed_others(made):
    """A shape depends neither on those made before nor on how many classes, bodies and poses there are."""
    more = GradedShapes(5, 4, 7, seed=2, n_vertices=N_VERTICES)
    again = more[more.names.index(made[7].name)]
    assert_array_equal(again.vertices, made[7].vertices)
    assert_array_equal(again.faces, made[7].faces)
    other = GradedShapes(2, 2, 2, seed=3, n_vertices=N_VERTICES)[4]
    assert not np.array_equal(other.vertices, made[4].vertices)


def test_both_levels_are_labels(shapes, made):
    assert len(shapes) == len(made) == 8
    assert shapes.names[:4] == ["biped/00/00", "biped/00/01", "biped/01/00", "biped/01/01"]
    for i, shape in enumerate(made):
        assert shape.name == shapes.names[i]
        assert shape.label == shapes.labels[i] == shape.name.split("/")[0]
        assert shape.body == body_of(shape.name) == shape.name.rsplit("/", 1)[0]
    assert shapes[-1].name == "quadruped/01/01"
    with pytest.raises(IndexError, match="8"):
        shapes[8]


def test_the_look_alikes_can_be_left_out():
    assert set(LOOK_ALIKE_TEMPLATES) == set(TEMPLATES)
    assert set(LOOK_ALIKE_FAMILIES) < set(KINDS)
    with_them = GradedShapes(200)
    without = GradedShapes(200, look_alikes=False)
    assert with_them.class_names[:12] == list(TEMPLATES)
    assert len(set(with_them.class_names)) == len(set(without.class_names)) == 200
    left = {name.split("-")[0] for name in without.class_names}
    assert left == set(KINDS) - set(LOOK_ALIKE_FAMILIES)
    # What a name tells besides its number is not repeated.
    assert len({name.rsplit("-", 1)[0] for name in without.class_names}) == 200
    assert GradedShapes(30).class_names == with_them.class_names[:30]


def test_the_other_generator_is_as_it_was():
    """Tests and figures rest on its shapes: sums of coordinates as they were at first."""
    shapes = ArticulatedShapes(n_classes=8, n_per_class=2)
    assert [(len(shapes[i].vertices), len(shapes[i].faces)) for i in (0, 13)] == COUNTS
    assert np.abs(shapes[0].vertices).sum() == pytest.approx(SUM, rel=1e-9)


def test_write_makes_folders_of_classes_and_bodies(tmp_path):
    shapes = GradedShapes(
        1,
        2,
        2,
        seed=4,
        n_vertices=(1600, 2000),
    )
    shapes.write(tmp_path, n_workers=2)
    files = find_bodies(tmp_path)
    assert files.names == tuple(f"{name}.off" for name in shapes.names)
    assert files.labels == tuple(shapes.labels)
    bodies = [body_of(name) for name in files.names]
    assert bodies == ["biped/00", "biped/00", "biped/01", "biped/01"]
    read = trimesh.load(files.paths[3], process=False)
    assert_array_equal(read.vertices, shapes[3].vertices)

    before = [path.read_bytes() for path in files.paths]
    times = [path.stat().st_mtime_ns for path in files.paths]
    files.paths[1].unlink()
    shapes.write(tmp_path)
    assert [path.read_bytes() for path in files.paths] == before
    assert files.paths[0].stat().st_mtime_ns == times[0]
    assert files.paths[1].stat().st_mtime_ns > times[1]
    with pytest.raises(ValueError, match="root="):
        GradedShapes(1, 2, 2, seed=5, n_vertices=(1600, 2000)).write(tmp_path)


def test_it_travels_to_other_processes(shapes, made):
    again = pickle.loads(pickle.dumps(shapes))
    assert repr(again) == repr(shapes)
    assert_array_equal(again[7].vertices, made[7].vertices)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n_classes", 0),
        ("n_classes", 100_000),
        ("n_bodies", 0),
        ("n_poses", 0),
        ("seed", -1),
        ("n_vertices", (100, 200)),
        ("n_vertices", (4000, 3000)),
    ],
)
def test_arguments_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=name):
        GradedShapes(**{name: value})


def counted_volume(solid):
    """By counting random points of the solid's box, made somewhat larger."""
    low, high = solid.box()
    low = low - 0.05
    high = high + 0.05
    points = default_rng(0).uniform(low, high, (300_000, 3))
    inside = solid.distance(*points.T) < 0.0
    assert (points[inside] >= solid.box()[0] - 1e-6).all()
    assert (points[inside] <= solid.box()[1] + 1e-6).all()
    return float(np.prod(high - low) * inside.mean())


def test_a_plate_has_its_volume():
    """A stadium with a round hole; the rounded rim takes off little."""
    plate = Plate(
        ((-0.5, 0.0, 0.5, 0.0, 0.4, 0.4),),
        ((0.2, 0.0, 0.2),),
        0.2,
    )
    area = 0.8 + np.pi * 0.4**2 - np.pi * 0.2**2
    assert plate.genus == 1
    assert 0.94 * area * 0.2 < counted_volume(plate) < area * 0.2


def test_a_helix_has_its_volume():
    """By Pappus: the cross-section times the length of the wire, and half a ball at either end."""
    helix = Helix(0.5, 0.4, 2.5, 0.12)
    length = 2.5 * np.hypot(2 * np.pi * 0.5, 0.4)
    expected = np.pi * 0.12**2 * length + 4 / 3 * np.pi * 0.12**3
    assert counted_volume(helix) == pytest.approx(expected, rel=0.03)


def test_a_machine_part_with_an_ear_has_a_hole():
    for kind in MACHINES:
        for extra in ("plain", "collar", "shaft", "ear", "pins"):
            part = machine(default_rng(0), kind, extra, 3)
            assert part.genus >= (extra == "ear"), (kind, extra)
