"""Copies of bodies are found among others, from a folder and from an index."""

import ast
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from trimesh.creation import annulus

from commands import run
from igps.cli.commands import COMMANDS
from igps.data.dataset import SignatureDataset
from igps.descriptors import descriptor
from igps.duplicates.calibration import Calibration
from igps.duplicates.compared_surfaces import Surfaces
from igps.duplicates.duplicates import assigned, duplicates
from igps.signature.signature import SignatureConfig
from label_files import write_nifti

PROJECT = Path(__file__).parents[2]
CONFIG = descriptor("pretrained").requirements.apply_to(SignatureConfig())
SAME = {frozenset({"lump.off", "lump.stl"}), frozenset({"bar.off", "bar.ply", "bar.obj"})}


# Corners of three boxes that turn to one side.
BRACKET = (((0, 0, 0), (6, 1, 1)), ((0, 0, 0), (1, 4, 1)), ((5, 0, 0), (6, 1, 3)))


def ball(subdivisions):
    return trimesh.creation.icosphere(subdivisions=subdivisions)


def lump(subdivisions):
    """Without any symmetry."""
    body = ball(subdivisions)
    x, y, z = body.vertices.T
    body.vertices *= (1 + 0.3 * np.sin(2 * x + 1) + 0.2 * np.cos(3 * y) + 0.2 * z * x)[:, None]
    return body


def bar(subdivisions, bend=0.0):
    """Long, and bent by so many radians along its length."""
    body = ball(subdivisions)
    x, y, z = (body.vertices * [3.0, 0.8, 0.5]).T
    if bend:
        angle = x / 6 * bend
        radius = 6 / bend + z
        x = radius * np.sin(angle)
        z = radius * np.cos(angle)
    body.vertices = np.column_stack([x, y, z])
    return body


def copied(body, seed, scale):
    """Scaled, turned, and mirrored."""
    turn = -scale * Rotation.random(random_state=seed).as_matrix()
    return trimesh.Trimesh(
        body.vertices @ turn.T + 5.0,
        body.faces[:, ::-1],
        process=False,
    )


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("bodies") / "meshes"
    root.mkdir()
    lump(3).export(root / "lump.off")
    fine = copied(lump(4), 1, 30.0)
    fine.export(root / "lump.stl")
    bar(3).export(root / "bar.off")
    copied(bar(4), 2, 0.2).export(root / "bar.ply")
    bar(4).export(root / "bar.obj")
    bar(3, bend=1.5).export(root / "bent.off")
    longer = bar(3)
    longer.vertices *= [1.25, 1.0, 1.0]
    longer.export(root / "longer.off")
    return root


@pytest.fixture(scope="module")
def cache(root):
    return root.parent / "cache"


@pytest.fixture
def dataset(root, cache):
    return SignatureDataset(root, CONFIG, cache)


def grouped(groups):
    return set(map(frozenset, groups))


def test_copies_are_grouped_and_neither_poses_nor_siblings(dataset, root):
    found = duplicates(dataset, n_workers=1)
    assert grouped(found.groups) == SAME
    assert found.n_files == 7
    assert found.failures == ()
    assert found.paths == {name: root / name for group in found.groups for name in group}
    # As many pairs as join the groups, and each of one group.
    assert len(found.copies) == 3
    for copy in found.copies:
        assert any({*copy.names} <= group for group in SAME)
        assert copy.distance <= Calibration.load().same.distance
    grades = {frozenset(copy.names): copy.grade for copy in found.copies}
    assert grades.pop(frozenset({"bar.obj", "bar.ply"})) == "same mesh"
    assert set(grades.values()) == {"same at another level of detail"}


def test_pairs_are_graded(tmp_path):
    """A file beside its copy, the mesh turned and scaled, its vertices in another order, or fewer, and a sibling."""
    body = bar(4)
    order = np.random.default_rng(0).permutation(len(body.vertices))
    renumbered = trimesh.Trimesh(
        body.vertices[order],
        np.argsort(order)[body.faces],
        process=False,
    )
    longer = renumbered.copy()
    longer.vertices += np.outer(
        longer.vertices[:, 0] > 0,
        [0.005 * body.area**0.5, 0, 0],
    )
    files = {
        "a.off": body,
        "b.ply": copied(body, 2, 0.2),
        "c.off": renumbered,
        "d.off": bar(3),
        "e.off": longer,
    }
    for name, one in files.items():
        one.export(tmp_path / name)
    shutil.copy(tmp_path / "a.off", tmp_path / "f.off")
    surfaces = Surfaces(SignatureDataset(tmp_path, CONFIG, tmp_path / "cache"))
    level = "same at another level of detail"
    found = [surfaces.grade(0, i) for i in range(1, 6)]
    assert [grade for grade, _ in found] == ["same mesh", "same surface", level, level, "same file"]
    assert max(found[i][1] for i in (0, 1, 4)) < 1e-4
    # One half has moved on by 0.005; laid onto each other, a half of that is left in the middle and at either end.
    assert 0.001 < found[3][1] < 0.005


def test_labels_of_a_volume_are_the_same_mesh_in_any_format_order_of_axes_and_crop(
    tmp_path,
):
    """On another grid they are other bodies, as near as a fraction of a voxel, and never those of another label."""
    nibabel = pytest.importorskip("nibabel", reason="the extra [volumes]")

    def labels(side):
        x, y, z = np.meshgrid(
            *(np.arange(0, n, side) for n in (60, 36, 30)),
            indexing="ij",
        )
        height = z - 12 - (x - 8) * y / 90
        one = ((x - 18) / 14) ** 2 + ((y - 18) / 11) ** 2 + (height / 8) ** 2 < 1
        height = z - 15 + (y - 18) * (x - 39) / 70
        other = ((x - 45) / 9) ** 2 + ((y - 18) / 15) ** 2 + (height / 10) ** 2 < 1
        return np.select([one, other], [1, 2]).astype(np.uint8)

    given = labels(1.0)
    turn = np.zeros((4, 4))
    # Of indices: the first axis runs back, and comes second
    turn[[0, 1, 2, 3], [1, 2, 0, 3]] = [-1, 1, 1, 1]
    turn[0, 3] = len(given) - 1
    inner = given[2:, 1:-1, 3:]
    write_nifti(tmp_path / "given.nii.gz", given)
    nibabel.save(
        nibabel.MGHImage(given, np.eye(4)),
        tmp_path / "mgh.mgz",
    )
    write_nifti(tmp_path / "turned.nii", given[::-1].transpose(2, 0, 1), turn)
    shifted = np.eye(4)
    shifted[:3, 3] = (2, 1, 3)
    write_nifti(tmp_path / "cropped.nii", inner, shifted)
    write_nifti(tmp_path / "sampled.nii", labels(1.4), np.diag([1.4, 1.4, 1.4, 1]))
    dataset = SignatureDataset(tmp_path, CONFIG, tmp_path / "cache")
    found = duplicates(dataset, n_workers=1)
    names = ("given.nii.gz", "mgh.mgz", "turned.nii", "cropped.nii")
    assert grouped(found.groups) == {
        frozenset(f"{name}#{label}" for name in names) for label in (1, 2)
    }
    assert {copy.grade for copy in found.copies} == {"same mesh"}


def test_fine_surfaces_tell_a_part_that_is_a_little_longer(tmp_path):
    """One half moves on by a hundredth: as far as coarse copies are apart, and much farther than fine ones.

    A coarse copy would be near to both, and join them.
    """
    fine = bar(5)
    longer = fine.copy()
    longer.vertices += np.outer(
        fine.vertices[:, 0] > 0,
        [0.01 * fine.area**0.5, 0, 0],
    )
    for name, body in (("one", fine), ("copy", copied(fine, 3, 2.0)), ("longer", longer)):
        body.export(tmp_path / f"{name}.off")
    dataset = SignatureDataset(tmp_path, CONFIG, tmp_path / "cache")
    assert grouped(duplicates(dataset, n_workers=1).groups) == {frozenset({"one.off", "copy.off"})}


def test_a_coarse_copy_does_not_join_what_is_told_apart(tmp_path):
    """It is near enough to both, as coarse as it is, and belongs to the nearer one."""
    fine = bar(5)
    longer = fine.copy()
    longer.vertices += np.outer(
        fine.vertices[:, 0] > 0,
        [0.01 * fine.area**0.5, 0, 0],
    )
    for name, body in (("one", fine), ("longer", longer), ("coarse", copied(bar(3), 3, 2.0))):
        body.export(tmp_path / f"{name}.off")
    dataset = SignatureDataset(tmp_path, CONFIG, tmp_path / "cache")
    coarse, longer_one, one = range(3)
    surfaces = Surfaces(dataset)
    calibration = Calibration.load()
    nearer = surfaces.distance(coarse, one, calibration)
    farther = surfaces.distance(coarse, longer_one, calibration)
    assert nearer < farther < math.inf
    found = duplicates(dataset, n_workers=1)
    assert grouped(found.groups) == {frozenset({"one.off", "coarse.off"})}
    assert [copy.names for copy in found.copies] == [("one.off", "coarse.off")]


def test_each_file_of_a_group_has_one_finer_file_beside_it():
    """Worked by hand: a file joins the nearest finer leader, else the nearest finer file; no pair joins two groups."""
    apart = {(0, 1): 0.1, (1, 2): 0.05, (0, 4): 0.2, (3, 4): 0.1, (1, 4): 0.01, (2, 3): 0.3}

    class Table:
        def coarseness(self, i):
            return float(i != 3) * i

        def distance(self, i, j, calibration):
            return apart.get((min(i, j), max(i, j)), math.inf)

    calibration = Calibration.load()
    found = assigned(
        [0, 1, 2, 3, 4],
        Table(),
        calibration,
    )
    # 3 is as fine as 0 and leads; 2 is the same as 3, which leads, and as 1, which does not.
    assert found == {(0, 1): 0.1, (3, 2): 0.3, (3, 4): 0.1}
    del apart[2, 3]
    found = assigned(
        [0, 1, 2, 3, 4],
        Table(),
        calibration,
    )
    assert found == {(0, 1): 0.1, (1, 2): 0.05, (3, 4): 0.1}


def test_handles_tell_bodies_apart_however_near_they_are(tmp_path):
    """But not where mending may have made them, or closed them."""
    ring = trimesh.creation.torus(1.0, 0.3, 40, 20)
    kept = ~np.isin(
        np.arange(len(ring.faces)),
        ring.vertex_faces[5],
    )
    cut = ring.submesh([kept], append=True, repair=False)
    bodies = {
        "ball": ball(3),
        "cut": cut,
        "ring": ring,
        "turned": copied(ring, 1, 3.0),
    }
    for name, body in bodies.items():
        body.export(tmp_path / f"{name}.off")
    dataset = SignatureDataset(tmp_path, CONFIG, tmp_path / "cache")
    a_ball, a_cut, a_ring, turned = range(4)
    surfaces = Surfaces(dataset)
    calibration = Calibration.load()
    assert any(note.startswith("filled") for note in dataset.mesh(a_cut).notes)
    assert surfaces.limit(a_ball, a_ring, calibration) == 0
    assert surfaces.limit(a_ring, turned, calibration) > 0
    assert surfaces.limit(a_ball, a_cut, calibration) > 0
    assert grouped(duplicates(dataset, n_workers=1).groups) == {
        frozenset({"ring.off", "turned.off", "cut.off"})
    }


def test_washers_with_other_holes_are_no_copies(tmp_path):
    """Washers of 128 vertices with holes 0.5 and 1 % larger: coarseness must not excuse displaced vertices."""
    for name, hole in (("one", 0.5), ("half", 0.5025), ("whole", 0.505)):
        annulus(hole, 1.0, 0.3, sections=32).export(tmp_path / f"{name}.off")
    mirrored = annulus(0.5, 1.0, 0.3, sections=32)
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.5, 0.9]))
    mirrored.apply_transform(turn)
    mirrored.apply_scale([-2, 2, 2])
    mirrored.export(tmp_path / "mirrored.off")
    found = duplicates(SignatureDataset(tmp_path, CONFIG, tmp_path / "cache"), n_workers=1)
    assert grouped(found.groups) == {frozenset({"one.off", "mirrored.off"})}
    assert not any(copy.is_mirrored for copy in found.copies)  # a washer is its own mirror image


def test_a_mirror_image_is_called_so(tmp_path):
    """A bracket of three boxes in a spiral, its copy, and its mirror image."""
    boxes = [trimesh.creation.box(bounds=b) for b in BRACKET]
    bracket = trimesh.boolean.union(boxes, engine="manifold")
    bracket.export(tmp_path / "left.off")
    turned = bracket.copy()
    turned.apply_transform(
        trimesh.transformations.rotation_matrix(
            1.0,
            [1, 2, 3],
        )
    )
    turned.export(tmp_path / "copy.off")
    bracket.apply_scale([-1, 1, 1])
    bracket.export(tmp_path / "right.off")
    found = duplicates(SignatureDataset(tmp_path, CONFIG, tmp_path / "cache"), n_workers=1)
    assert grouped(found.groups) == {frozenset({"left.off", "right.off", "copy.off"})}
    mirrored = [copy.names for copy in found.copies if copy.is_mirrored]
    assert mirrored == [copy.names for copy in found.copies if "right.off" in copy.names]
    assert len(mirrored) == 1


def test_a_small_hole_that_is_a_little_larger_is_another_surface(tmp_path):
    """The hole is larger by 0.5 %; the largest distance is the difference of the radii over √area."""
    one, larger = (annulus(hole, 1.0, 0.3, sections=64) for hole in (0.05, 0.05025))
    for name, body in (("one", one), ("copy", one.subdivide()), ("larger", larger.subdivide())):
        body.export(tmp_path / f"{name}.off")
    surfaces = Surfaces(SignatureDataset(tmp_path, CONFIG, tmp_path / "cache"))
    # in order of names: copy, larger, one
    assert surfaces.grade(2, 0)[0] == "same surface"
    grade, apart = surfaces.grade(2, 1)
    assert grade == "same at another level of detail"
    assert apart == pytest.approx(0.00025 / one.area**0.5, rel=0.05)


def test_coarseness_of_a_ball_falls_with_the_area_of_its_triangles(tmp_path):
    """The middle of its neighbours lies off a vertex by the square of their distance: a quarter with edges of half."""
    for subdivisions in (3, 4, 5):
        ball(subdivisions).export(tmp_path / f"{subdivisions}.off")
    surfaces = Surfaces(SignatureDataset(tmp_path, CONFIG, tmp_path / "cache"))
    coarse, middle, fine = (surfaces.coarseness(i) for i in range(3))
    assert 3 < coarse / middle < 5.3
    assert 3 < middle / fine < 5.3


def test_the_commands(root, cache, tmp_path, capsys):
    options = ["--cache_dir", cache, "--n_workers", 1]
    run("duplicates", root, "--out", tmp_path / "out" / "groups.csv", *options)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-3:-1] == ["group 1: bar.obj  bar.off  bar.ply", "group 2: lump.off  lump.stl"]
    assert lines[-1].startswith("5 of 7 files in 2 groups; on generated bodies, this finds ")
    rows = (tmp_path / "out" / "groups.csv").read_text().splitlines()
    assert rows[0] == "group,name,path"
    assert rows[5] == f"2,lump.stl,{root / 'lump.stl'}"


def test_the_page_runs(tmp_path):
    """Its Python prints the group of the copy; its commands exist."""
    page = (PROJECT / "docs" / "how-to" / "duplicates.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    groups, meaning = done.stdout.splitlines()
    ((one, other),) = ast.literal_eval(groups)
    assert one.endswith("copy.stl") != other.endswith("copy.stl")
    assert "poses of one body" in meaning
    for line in "".join(re.findall(r"```sh\n(.*?)```", page, flags=re.DOTALL)).splitlines():
        program, name, *_ = shlex.split(line)
        assert program == "igps"
        assert name in {command.split()[0] for command in COMMANDS}
