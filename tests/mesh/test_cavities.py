"""Bodies with cavities: balls in balls and boxes in boxes, whose areas, volumes and insides are known."""

import numpy as np
import pytest
import torch
import trimesh
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from scipy import ndimage

from igps import (
    LoadOptions,
    Mesh,
    MeshError,
    SignatureConfig,
    collate,
    compute_signature,
    descriptor,
    load_mesh,
)
from igps.descriptors.interior import interior
from igps.fields.volumes.label_surface import voxel_surface
from igps.mesh.loading import refined
from igps.mesh.mending import mend, repair_steps
from igps.mesh.simplification import simplify
from igps.mesh.surface import signed_volume
from igps.signature.voxels import interior_samples
from label_files import write_nifti

BALL = trimesh.creation.icosphere(subdivisions=3)
Surface = tuple[np.ndarray, np.ndarray]


def joined(*parts):
    starts = np.cumsum(
        [
            0,
            *(len(vertices) for vertices, _ in parts),
        ]
    )
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def ball(radius, at=0.0, *, inwards=False):
    faces = np.asarray(BALL.faces)
    return BALL.vertices * radius + [at, 0, 0], faces[:, ::-1] if inwards else faces


def test_a_cavity_that_is_turned_inwards_is_part_of_the_body_as_it_is():
    hollow = mend(
        *joined(ball(1), ball(0.5, inwards=True)),
        cavities="keep",
    )
    assert hollow.notes == ()
    expected = pytest.approx(
        (1 - 0.5**3) * BALL.volume,
        rel=1e-12,
    )
    assert hollow.volume == expected
    expected = pytest.approx(
        (1 + 0.5**2) * BALL.area,
        rel=1e-12,
    )
    assert hollow.area == expected
    assert hollow.genus == 0


@pytest.mark.parametrize("inwards", [False, True])
def test_filled_it_is_the_ball(inwards):
    full = mend(*joined(ball(1), ball(0.5, inwards=inwards)))
    assert_array_equal(full.vertices, BALL.vertices)
    assert_array_equal(full.faces, BALL.faces)


def test_a_hidden_part_that_is_turned_outwards_is_turned_for_a_cavity_and_kept_once():
    surface = joined(
        ball(1),
        ball(0.5),
        ball(0.2),
        ball(0.1, 0.75),
    )
    hollow = mend(*surface, cavities="keep")
    expected = pytest.approx(
        (1 - 0.5**3 - 0.1**3) * BALL.volume,
        rel=1e-12,
    )
    assert hollow.volume == expected
    assert hollow.notes == (
        "turned the surface of a cavity towards the inside",
        "turned the surface of a cavity towards the inside",
        "dropped 1 part hidden inside",
    )
    assert repair_steps(hollow.notes) == ("welded",)


@pytest.mark.parametrize("inwards", [False, True])
def test_a_cavity_is_one_though_the_outer_surface_is_inside_out(inwards):
    hollow = mend(
        *joined(ball(1, inwards=True), ball(0.5, inwards=inwards)),
        cavities="keep",
    )
    expected = pytest.approx(
        (1 - 0.5**3) * BALL.volume,
        rel=1e-12,
    )
    assert hollow.volume == expected


@pytest.mark.parametrize(
    "other",
    [
        ball(0.5),
        ball(0.5, 3.0, inwards=True),
        ball(0.5, 0.8, inwards=True),
        joined(
            ball(0.5, inwards=True),
            ball(0.2, inwards=True),
        ),
    ],
    ids=["turned outwards", "outside", "across", "in another"],
)
def test_what_is_no_cavity_is_refused(other):
    with pytest.raises(
        MeshError, match=r"closed surfaces bounds no cavity: .*--mend auto, or without cavities"
    ):
        Mesh(*joined(ball(1), other), cavities=True)
    with pytest.raises(MeshError, match="connected components"):
        Mesh(*joined(ball(1), other))


def test_samples_lie_in_the_wall_and_on_all_surfaces():
    hollow = Mesh(
        *joined(ball(1), ball(0.7, inwards=True)),
        cavities=True,
    )
    radii = norm(interior_samples(hollow, 32, 1000), axis=1)
    assert radii.min() > 0.69
    assert radii.max() < 1
    signature = compute_signature(
        hollow, SignatureConfig(n_eigenpairs=30, attributes=("surface_direction", "depth"))
    )
    on_cavity = norm(signature.surface.points, axis=1) < 0.85
    assert on_cavity.mean() == pytest.approx(0.49 / 1.49, abs=0.01)
    # Normals of the body point into its cavity, and its depth is that of the wall.
    radial = (signature.surface.attributes["surface_direction"] * signature.surface.points).sum(
        axis=1
    )
    assert radial[on_cavity].max() < 0 < radial[~on_cavity].min()
    assert signature.interior.attributes["depth"].max() * np.sqrt(hollow.area) == pytest.approx(
        0.15, abs=0.02
    )


def test_eigenfunctions_of_the_outside_go_on_through_the_wall():
    """The first three of a ball extend to linear functions in the wall: the sum of squares is 3 |x|² / 4π."""
    config = SignatureConfig(n_eigenpairs=30, accuracy=None)
    hollow = compute_signature(
        Mesh(
            *joined(ball(1), ball(0.7, inwards=True)),
            cavities=True,
        ),
        config,
    )
    full = compute_signature(Mesh(*ball(1)), config)
    assert_allclose(hollow.eigenvalues, full.eigenvalues, rtol=1e-6)
    for samples in (hollow.interior, hollow.surface):
        squares = np.square(samples.eigenfunctions[:, :3]).sum(axis=1) * 4 * np.pi / 3
        assert_allclose(squares, np.square(samples.points).sum(axis=1), rtol=0.03)


def test_the_outer_surface_has_vertices_enough_whatever_the_cavity_has():
    box = trimesh.creation.box((4, 4, 4))
    surface = joined(
        (np.asarray(box.vertices), np.asarray(box.faces)),
        ball(1, inwards=True),
    )
    hollow = refined(mend(*surface, cavities="keep"), LoadOptions(), 100)
    assert hollow.outer()[1].sum() >= 100
    assert hollow.volume == pytest.approx(64 - BALL.volume, rel=1e-9)
    assert simplify(hollow, 700).cavities


def test_a_file_is_read_with_its_cavities_where_they_are_kept(tmp_path):
    vertices, faces = joined(ball(1), ball(0.5, inwards=True))
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "hollow.off")
    kept = load_mesh(tmp_path / "hollow.off", LoadOptions(cavities="keep"))
    expected = pytest.approx(
        (1 - 0.5**3) * BALL.volume,
        rel=1e-6,
    )
    assert kept.volume == expected
    assert load_mesh(tmp_path / "hollow.off").volume == pytest.approx(BALL.volume, rel=1e-6)
    assert LoadOptions(cavities="keep").as_dict() == {**LoadOptions().as_dict(), "cavities": "keep"}
    with pytest.raises(ValueError, match="cavities: expected one of fill, keep, got 'leave'"):
        LoadOptions(cavities="leave")


def test_a_label_keeps_its_cavities():
    radius = norm(
        np.indices((40, 40, 40)) - 19.5,
        axis=0,
    )
    mask = (radius < 16) & (radius > 7)
    mask[19, 19, 4] = False  # a voxel of noise is no cavity
    vertices, faces, notes = voxel_surface(mask, cavities=True)
    hollow = Mesh(vertices, faces, cavities=True)
    assert hollow.volume == pytest.approx(np.count_nonzero(mask), rel=0.01)
    expected = pytest.approx(
        4 * np.pi * (16**2 + 7**2),
        rel=0.04,
    )
    assert hollow.area == expected
    full = voxel_surface(mask)
    assert signed_volume(*full[:2]) == pytest.approx(np.count_nonzero(radius < 16), rel=0.01)
    assert notes != full[2]


def test_a_cavity_behind_a_wall_with_gaps_is_noted():
    """As of a wall thinner than a voxel. A closed wall, and a cup, get no note."""
    offset = np.indices((40, 40, 40)) - 19.7
    radius = norm(offset, axis=0)
    thin = np.abs(radius - 14) < 0.45
    closed = np.abs(radius - 14) < 0.75
    assert ndimage.label(np.pad(~thin, 1, constant_values=True))[1] == 1  # the cavity is open
    assert [
        ("gaps of up to two voxels" in note) for note in voxel_surface(thin, cavities=True)[2]
    ] == [True]
    for mask in (closed, (radius < 14) & (radius > 11) & (offset[2] < 3)):
        assert voxel_surface(mask, cavities=True)[2] == ()


def test_labels_of_a_file_have_walls_cores_and_rings(tmp_path):
    """A ball with a core that is another label, as a kidney with a cyst, and a ring around both."""
    x, y, z = np.meshgrid(
        np.arange(57) - 28, np.arange(57) - 28, 1.5 * np.arange(28) - 20.25, indexing="ij"
    )
    radius = np.sqrt(x**2 + y**2 + z**2)
    labels = np.select(
        [
            radius < 8,
            radius < 15,
            (np.hypot(x, y) - 22) ** 2 + z**2 < 5**2,
        ],
        [2, 1, 3],
    )
    for name, of in (("x", labels), ("full", labels * (labels != 2) + (labels == 2))):
        write_nifti(tmp_path / f"{name}.nii", of.astype(np.uint8), np.diag([1.0, 1, 1.5, 1]))
    ball = load_mesh(tmp_path / "full.nii", part="1")
    expected = {
        "1": 4 / 3 * np.pi * (15**3 - 8**3),
        "2": 4 / 3 * np.pi * 8**3,
        "3": 2 * np.pi**2 * 22 * 5**2,
    }
    for part, volume in expected.items():
        kept = load_mesh(tmp_path / "x.nii", LoadOptions(cavities="keep"), part=part)
        filled = load_mesh(tmp_path / "x.nii", part=part)
        assert kept.volume == pytest.approx(
            volume, rel=0.04
        )  # as well as voxels of this size tell it
        assert kept.volume == pytest.approx(
            1.5 * np.count_nonzero(labels == int(part)),
            rel=1e-3,
        )
        assert filled.genus == (part == "3")
        of = ball if part == "1" else kept
        assert_array_equal(filled.vertices, of.vertices)
        assert_array_equal(filled.faces, of.faces)
    wall = load_mesh(tmp_path / "x.nii", LoadOptions(cavities="keep"), part="1")
    assert wall.area == pytest.approx(
        4 * np.pi * (15**2 + 8**2),
        rel=0.03,
    )
    signature = compute_signature(wall, SignatureConfig(n_eigenpairs=30))
    from_middle = norm(
        signature.interior.points - [28, 28, 20.25],
        axis=1,
    )
    assert from_middle.min() > 7
    assert from_middle.max() < 16
    assert signature.volume == pytest.approx(wall.volume)


def test_a_piece_of_a_label_in_its_cavity_is_told():
    """A seed in its shell was left out without a word."""
    radius = norm(
        np.indices((41, 41, 41)) - 20.0,
        axis=0,
    )
    shell = (radius > 14) & (radius < 18)
    seed = radius < 8
    vertices, faces, notes = voxel_surface(shell | seed, cavities=True)
    assert Mesh(vertices, faces, cavities=True).volume == pytest.approx(
        np.count_nonzero(shell), rel=1e-3
    )
    n = np.count_nonzero(seed)
    assert notes == (f"in a cavity: filled holes: {n:,} voxels, {n:,}",)


def test_the_larger_the_cavity_the_farther_from_the_ball():
    bodies = [Mesh(*ball(1))]
    bodies += [
        Mesh(
            *joined(ball(1), ball(radius, inwards=True)),
            cavities=True,
        )
        for radius in (0.2, 0.5, 0.8)
    ]
    names = ("depth", "electrostatic_potential", "surface_direction")
    config = SignatureConfig(n_eigenpairs=90, resolution=16, min_samples=500, attributes=names)
    batches = [collate([compute_signature(body, config)]) for body in bodies]
    for module in (interior(64), descriptor("rich"), descriptor("pretrained")):
        descriptions = torch.cat([module(batch) for batch in batches])
        distances = module.distances(descriptions[:1], descriptions)[0]
        assert bool((distances.diff() > 0).all()), (module.name, distances)


def test_of_two_cavities_that_meet_at_a_vertex_both_are_turned_inwards():
    tip = int(np.argmax(BALL.vertices[:, 0]))
    one = (BALL.vertices - BALL.vertices[tip]) * 0.25  # reaches from the left to the origin
    other = one * [-0.8, 0.8, 0.8]  # its mirror image, smaller
    inwards = BALL.faces[:, ::-1]

    def hollow(second):
        vertices, faces = joined(
            (BALL.vertices, BALL.faces),
            (one, inwards),
            (other, second),
        )
        n = len(BALL.vertices)
        last = np.delete(np.arange(3 * n), 2 * n + tip)  # the vertex that is there twice
        number = np.searchsorted(last, np.arange(3 * n))
        number[2 * n + tip] = n + tip
        return Mesh(vertices[last], number[faces], cavities=True)

    volume = (1 - 0.25**3 - 0.2**3) * BALL.volume
    assert hollow(BALL.faces).volume == pytest.approx(
        volume, rel=1e-12
    )  # the mirror has turned them
    with pytest.raises(MeshError, match="bounds no cavity: it is oriented outward"):
        hollow(inwards)
