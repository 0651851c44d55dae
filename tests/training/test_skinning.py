"""Dual quaternions against rotation matrices, and what bending leaves as it was."""

import numpy as np
import trimesh
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from training.shapes.kinds import KINDS
from training.shapes.rigging import bones_at_rest, limb_rig
from training.shapes.rods import Binding, Rig, Rod, bend, rod_motions
from training.shapes.templates import TEMPLATES


def cylinder(length, radius):
    """A round bar along z from 0, of triangles much smaller than it is thick."""
    outline = [
        (0, 0),
        *((radius, z) for z in np.linspace(0, length, 121)),
        (0, length),
    ]
    return trimesh.creation.revolve(outline, sections=48)


def straight_rod(length, radius, n=61):
    along = np.linspace(0.0, length, n)
    points = np.stack(
        [0 * along, 0 * along, along],
        axis=1,
    )
    sides = np.tile(np.eye(3)[:, :2], (n, 1, 1))
    return Rod(
        -1,
        0.0,
        points,
        along,
        np.full(n, radius),
        np.full(n, radius),
        sides,
    )


def bent_bar(turns):
    bar = cylinder(3.0, 0.2)
    rod = straight_rod(3.0, 0.2, len(turns))
    rig = Rig((rod,), np.zeros(1, dtype=np.int64))
    binding = Binding(
        np.ones((len(bar.vertices), 1)),
        bar.vertices[:, 2:3],
    )
    vertices = bend(
        bar.vertices,
        rig,
        binding,
        rod_motions(rig, [turns]),
    )
    return bar, trimesh.Trimesh(vertices, bar.faces, process=False)


def test_one_element_that_turns_carries_everything_rigidly():
    turns = np.zeros((61, 3))
    turns[0] = (0.3, -1.1, 0.4)
    bar, moved_bar = bent_bar(turns)
    expected = Rotation.from_rotvec(turns[0]).apply(bar.vertices)
    assert_allclose(moved_bar.vertices, expected, atol=1e-12)


def test_a_bent_bar_is_a_piece_of_a_torus():
    """Bent evenly by an angle: area and volume stay (Pappus), and the far end is turned by that angle."""
    degrees = 130.0
    turns = np.zeros((61, 3))
    turns[1:60, 0] = np.radians(degrees) / 59
    bar, bent = bent_bar(turns)
    assert abs(bent.area / bar.area - 1) < 2e-3
    assert abs(bent.volume / bar.volume - 1) < 2e-3
    cap = bar.vertices[:, 2] == 3.0
    end = bent.vertices[cap] - bent.vertices[cap].mean(axis=0)
    flat = bar.vertices[cap] - bar.vertices[cap].mean(axis=0)
    turned = Rotation.from_rotvec([np.radians(degrees), 0, 0])
    assert_allclose(end, turned.apply(flat), atol=1e-9)


def test_a_hinge_keeps_lengths_near_both_bones():
    """Two bones and weights that go over between them: away from the joint every edge keeps its length."""
    bar = cylinder(3.0, 0.2)
    z = bar.vertices[:, 2]
    shape = np.zeros(1), np.ones(1), np.ones(1), np.zeros((1, 3, 2))
    first = Rod(-1, 0.0, np.zeros((1, 3)), *shape)
    second = Rod(
        0,
        0.0,
        np.array([[0, 0, 1.5]]),
        *shape,
    )
    rig = Rig((first, second), np.arange(2))
    share = np.clip((z - 1.2) / 0.6, 0.0, 1.0)
    binding = Binding(
        np.stack([1 - share, share], axis=1),
        np.zeros((len(z), 2)),
    )
    motions = rod_motions(
        rig,
        [np.zeros((1, 3)), np.array([[1.2, 0.0, 0.0]])],
    )
    bent = bend(bar.vertices, rig, binding, motions)
    edges = bar.edges_unique
    outside = edges[(np.abs(z[edges] - 1.5) > 0.31).all(axis=1)]
    assert len(outside) > 1000
    before = np.linalg.norm(
        np.diff(bar.vertices[outside], axis=1),
        axis=2,
    )
    after = np.linalg.norm(
        np.diff(bent[outside], axis=1),
        axis=2,
    )
    assert_allclose(after, before, rtol=1e-9)
    top = z > 1.85
    joint = np.array([0, 0, 1.5])
    expected = Rotation.from_rotvec([1.2, 0, 0]).apply(bar.vertices[top] - joint) + joint
    assert_allclose(bent[top], expected, atol=1e-12)


def test_trunks_bend_and_frames_do_not():
    """A wheel without limbs has no joint at all; the trunk of a four-legged animal is a rod, its legs too."""
    wheel = KINDS["wheel"].build(
        np.random.default_rng(0),
        4,
        3,
        "none",
        "plain",
    )
    for rod in limb_rig(bones_at_rest(wheel, {})).rods:
        assert len(rod.arc_lengths) == 1
    rods = limb_rig(bones_at_rest(TEMPLATES["quadruped"](), {})).rods
    assert len(rods[0].joints) == 1  # the spine
    knees = [rod for rod in rods if len(rod.joints) == 2 and not rod.joints[1].is_root]
    assert len(knees) >= 4
    for rod in knees:
        assert np.degrees(rod.joints[1].high - rod.joints[1].low).max() > 90.0
