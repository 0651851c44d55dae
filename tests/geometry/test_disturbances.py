"""Each disturbance does what it says, and leaves a checked body."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import shortest_path

from conftest import SHARED, horseshoe
from igps.geometry import disturbances
from igps.geometry.disturbances import (
    DISTURBANCES,
    TUBE_FACES,
    clip,
    facing_vertices,
    hole,
    move,
    noise,
    remesh,
    scale,
    simplified,
    vertex_normals,
    weld,
    weld_gap,
)
from igps.geometry.mesh import Mesh, MeshError, load_mesh


def grooved_ball() -> Mesh:
    """A wide ball with a narrow groove: places face each other, but none is far away along the surface."""
    body = trimesh.creation.icosphere(subdivisions=3)
    z = body.vertices[:, 2:]
    body.vertices *= np.concatenate([2 - 0.5 * np.exp(-((z / 0.12) ** 2))] * 2 + [np.ones_like(z)], axis=1)
    body.vertices *= np.random.default_rng(0).uniform(0.99, 1.01, (len(body.vertices), 1))
    return Mesh(body.vertices, body.faces, name="grooved_ball")


def genus(mesh: Mesh) -> int:
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert surface.is_watertight
    assert surface.is_winding_consistent
    return 1 - surface.euler_number // 2


def paths(mesh: Mesh) -> NDArray[np.float64]:
    """(V, V) shortest paths along edges."""
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    i, j = surface.edges_unique.T
    graph = sparse.coo_matrix((surface.edges_unique_length, (i, j)), shape=(len(mesh.vertices),) * 2)
    return shortest_path(graph.tocsr(), directed=False)


def diagonal(mesh: Mesh) -> float:
    return float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))


def test_weld_adds_a_handle_and_nothing_else() -> None:
    mesh = horseshoe()
    a, b = len(mesh.vertices) - 2, len(mesh.vertices) - 1  # the middles of the two ends
    welded = weld(mesh, a, b)
    assert genus(mesh) == 0
    assert genus(welded) == 1
    np.testing.assert_array_equal(welded.vertices, mesh.vertices)
    assert len(welded.faces) == len(mesh.faces) - 2 + TUBE_FACES
    old = {tuple(face) for face in mesh.faces.tolist()}
    kept, tube = welded.faces[:-TUBE_FACES].tolist(), welded.faces[-TUBE_FACES:]
    removed = old - {tuple(face) for face in kept}
    assert {tuple(face) for face in kept} < old
    assert len(removed) == 2
    assert all(a in face or b in face for face in removed)
    assert set(tube.ravel().tolist()) == {vertex for face in removed for vertex in face}
    # The tube is a solid bridge over the gap: about half of the two triangles' area times the gap.
    assert 0 < welded.volume - mesh.volume < 0.05 * mesh.volume
    assert f"vertices {a} and {b}" in welded.notes[-1]
    # The way from one end to the other is now as long as the gap, no more once around the ring.
    assert paths(mesh)[a, b] > 5
    assert paths(welded)[a, b] < 5 * np.linalg.norm(mesh.vertices[a] - mesh.vertices[b])


def test_weld_takes_the_shortest_tube() -> None:
    mesh = horseshoe(0.15)
    a, b = 3, len(mesh.vertices) - 10
    at = [[face for face in mesh.faces.tolist() if vertex in face] for vertex in (a, b)]
    lengths = [
        sum(float(np.linalg.norm(mesh.vertices[p] - mesh.vertices[q])) for p, q in zip(one, turned, strict=True))
        for one, other in itertools.product(*at)
        for turned in (other[::-1], other[1::-1] + other[:1:-1], [other[0], other[2], other[1]])
    ]
    tube = weld(mesh, a, b).faces[-TUBE_FACES:]
    ends = mesh.vertices[tube[1::2][:, [0, 2]]]
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum() == pytest.approx(min(lengths))


def test_weld_refuses_what_cannot_be_welded(sphere: Mesh) -> None:
    for pair in ((0, len(sphere.vertices)), (-1, 5)):
        with pytest.raises(ValueError, match="expected a vertex index from 0 to 2561"):
            weld(sphere, *pair)
    neighbour = int(sphere.faces[(sphere.faces == 0).any(axis=1)][0].max())
    for other in (0, neighbour):
        with pytest.raises(ValueError, match="more than three edges apart"):
            weld(sphere, 0, other)


@pytest.mark.parametrize(
    ("mesh", "largest_gap", "least_path"),
    [(horseshoe(0.008), 1 / 64, 1 / 4), (horseshoe(0.03), 1 / 32, 1 / 4), (grooved_ball(), 1 / 16, None)],
    ids=["narrow", "wide", "crease"],
)
def test_facing_vertices_are_the_best_of_all_pairs(mesh: Mesh, largest_gap: float, least_path: float | None) -> None:
    a, b = facing_vertices(mesh)
    normals = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    areas = normals.face_normals * normals.area_faces[:, None]
    sums = np.stack([areas[(mesh.faces == i).any(axis=1)].sum(axis=0) for i in range(len(mesh.vertices))])
    unit = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(mesh), unit, atol=1e-12)
    way = mesh.vertices[None, :] - mesh.vertices[:, None]
    gap = np.linalg.norm(way, axis=2) + np.eye(len(way))
    along = paths(mesh)
    facing = np.einsum("ik,ijk->ij", unit, way / gap[..., None]) > 0.5
    allowed = facing & facing.T & (gap <= largest_gap * diagonal(mesh))
    assert allowed.any()
    if least_path is None:
        assert not (allowed & (along >= diagonal(mesh) / 4)).any()
        value = along
    else:
        allowed &= along >= least_path * diagonal(mesh)
        value = along / gap
    assert allowed[a, b]
    assert value[a, b] == pytest.approx(value[allowed].max())


def test_search_lists_every_facing_pair_once_and_best_first() -> None:
    mesh = horseshoe(0.2, n_sections=30, n_around=8)
    largest_gap = 0.3 * diagonal(mesh)
    unit = vertex_normals(mesh)
    way = mesh.vertices[None, :] - mesh.vertices[:, None]
    gap = np.linalg.norm(way, axis=2) + np.eye(len(way))
    facing = np.einsum("ik,ijk->ij", unit, way / gap[..., None]) > 0.5
    allowed = np.triu(facing & facing.T & (gap <= largest_gap))
    assert np.triu(facing & (gap <= largest_gap)).sum() > 2 * allowed.sum()  # many look at what does not look at them
    along = paths(mesh)
    far = np.median(along[allowed])
    for least_path, value in ((None, along), (far, along / gap)):
        found = list(disturbances._GapSearch(mesh).pairs(largest_gap, least_path))
        wanted = allowed & (along >= (least_path or 0))
        assert len(found) == len(set(found)) == wanted.sum()
        assert all(wanted[min(pair), max(pair)] for pair in found)
        values = np.array([value[pair] for pair in found])
        assert (np.diff(values) <= 1e-12).all()


def test_narrow_gaps_come_before_wide_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = horseshoe()
    asked = []

    def none(self: object, largest_gap: float, least_path: float | None = None) -> list[tuple[int, int]]:
        asked.append((largest_gap / diagonal(mesh), least_path and least_path / diagonal(mesh)))
        return []

    monkeypatch.setattr(disturbances._GapSearch, "pairs", none)
    with pytest.raises(MeshError, match="no two places face each other"):
        facing_vertices(mesh)
    assert asked == [(1 / 64, 1 / 4), (1 / 32, 1 / 4), (1 / 16, 1 / 4), (1 / 16, None)]


def test_gap_must_be_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = horseshoe()
    search = disturbances._GapSearch(mesh)
    ends = len(mesh.vertices) - 2, len(mesh.vertices) - 1
    across_the_tube = 20 * 14, 20 * 14 + 7
    assert search.is_clear(*ends)
    assert not search.is_clear(*across_the_tube)
    monkeypatch.setattr(disturbances._GapSearch, "is_clear", lambda self, a, b: False)
    with pytest.raises(MeshError, match="no two places face each other"):
        facing_vertices(mesh)


def test_convex_body_has_no_gap(sphere: Mesh) -> None:
    with pytest.raises(MeshError, match="no two places face each other"):
        weld_gap(sphere)


def test_homer_is_welded_at_the_feet() -> None:
    path = SHARED / "data" / "homer.obj"
    if not path.is_file():
        pytest.skip("the Homer model is not distributed with the project (expected in ../shared/data)")
    mesh = load_mesh(path)
    pair = mesh.vertices[list(facing_vertices(mesh))]
    height = (pair[:, 1] - mesh.vertices[:, 1].min()) / np.ptp(mesh.vertices[:, 1])
    assert (height < 0.1).all()
    assert np.linalg.norm(pair[0] - pair[1]) == pytest.approx(0.0096, abs=5e-4)


def test_noise_moves_along_the_normals(sphere: Mesh) -> None:
    noisy = noise(sphere, 0.01, seed=3)
    radius = np.linalg.norm(noisy.vertices, axis=1)
    np.testing.assert_allclose(noisy.vertices / radius[:, None], sphere.vertices, atol=1e-3)
    assert np.std(radius - 1) == pytest.approx(0.01 * diagonal(sphere), rel=0.05)
    assert abs(np.mean(radius - 1)) < 0.002
    np.testing.assert_array_equal(noisy.vertices, noise(sphere, 0.01, seed=3).vertices)
    assert np.abs(noisy.vertices - noise(sphere, 0.01, seed=4).vertices).max() > 0.01
    with pytest.raises(ValueError, match="amplitude"):
        noise(sphere, 0)


def test_simplified_keeps_the_share(sphere: Mesh) -> None:
    assert len(simplified(sphere, 0.1).vertices) == 256
    with pytest.raises(ValueError, match="share"):
        simplified(sphere, 1.0)


def test_remesh_gives_other_triangles_on_the_same_surface(sphere: Mesh) -> None:
    other = remesh(sphere)
    assert genus(other) == 0
    assert 0.98 * len(sphere.faces) <= len(other.faces) <= len(sphere.faces)
    inner = trimesh.Trimesh(sphere.vertices, sphere.faces, process=False)
    least = np.abs(np.einsum("ij,ij->i", inner.face_normals, inner.triangles_center)).min()
    radius = np.linalg.norm(other.vertices, axis=1)
    assert least - 1e-9 <= radius.min()
    assert radius.max() <= 1 + 1e-9
    nearest = np.linalg.norm(other.vertices[:, None] - sphere.vertices[None], axis=2).min(axis=1)
    assert (nearest > 1e-6).mean() > 0.3
    assert other.volume == pytest.approx(sphere.volume, rel=5e-3)
    assert genus(remesh(weld_gap(horseshoe()))) == 1


def test_hole_is_one_patch_of_the_wanted_area(sphere: Mesh) -> None:
    holed = hole(sphere, 0.05, seed=2)
    assert holed.allow_open
    assert 1 - holed.area / sphere.area == pytest.approx(0.05, abs=1 / len(sphere.faces))
    surface = trimesh.Trimesh(holed.vertices, holed.faces, process=False)
    rim = surface.edges[trimesh.grouping.group_rows(surface.edges_sorted, require_count=1)]
    # One closed rim, at one distance from the middle of the patch: that of a spherical cap of this area, give or take
    # the grain of paths along edges.
    assert len(trimesh.graph.connected_components(rim)) == 1
    middle = -holed.vertices.mean(axis=0)
    angle = np.arccos(holed.vertices @ middle / np.linalg.norm(middle))
    assert angle[np.unique(rim)].max() < 1.35 * np.arccos(1 - 2 * 0.05)
    assert angle.min() > 0.65 * np.arccos(1 - 2 * 0.05)
    with pytest.raises(ValueError, match="share"):
        hole(sphere, 0)


def test_hole_does_not_cut_the_body_in_two() -> None:
    mesh = horseshoe()
    whole = [hole(mesh, 0.3, seed=seed) for seed in range(8)]  # a Mesh of two pieces would have been refused
    lost = np.array([1 - holed.area / mesh.area for holed in whole])
    assert (lost > 0).all()
    assert (lost <= 0.3).all()
    assert (lost < 0.2).any()


def test_clip_takes_a_cap_off_a_ball(sphere: Mesh) -> None:
    pytest.importorskip("manifold3d")
    turned = move(sphere)
    cut = clip(turned, 0.1)
    assert genus(cut) == 0
    height = 0.2
    assert sphere.volume - cut.volume == pytest.approx(np.pi * height**2 * (3 - height) / 3, rel=0.02)
    lost_area = 2 * np.pi * height - np.pi * height * (2 - height)  # a spherical cap, closed by a disc
    assert sphere.area - cut.area == pytest.approx(lost_area, rel=0.05)
    # All that remains is where it was.
    np.testing.assert_allclose(np.linalg.norm(cut.vertices - turned.vertices.mean(axis=0), axis=1).max(), 1, atol=1e-6)


def test_clip_keeps_the_largest_piece() -> None:
    pytest.importorskip("manifold3d")
    ring = horseshoe(0.4)
    x, y, _ = ring.vertices.T
    # Its bend far away from its ends, of which one is thicker.
    stretched = ring.vertices * np.stack([np.where(x < 0, 2.5, 1), 1 + 0 * y, np.where(y > 0, 1.5, 1)], axis=1)
    mesh = Mesh(stretched, ring.faces)
    cut = clip(mesh, 0.8)
    assert cut.vertices[:, 1].min() > 0  # both ends remain; the thinner one is on the other side
    assert cut.vertices[:, 0].max() == pytest.approx(stretched[:, 0].max(), abs=0.05)
    assert 0 < cut.volume < 0.3 * mesh.volume
    with pytest.raises(ValueError, match="share"):
        clip(mesh, 0)


def test_scale_and_motion_keep_the_form(blob: Mesh) -> None:
    larger, moved = scale(blob, 7), move(blob, seed=1)
    np.testing.assert_allclose(larger.vertices, 7 * blob.vertices)
    for mesh in (larger, moved):
        np.testing.assert_array_equal(mesh.faces, blob.faces)
    centred = [mesh.vertices - mesh.vertices.mean(axis=0) for mesh in (blob, moved)]
    np.testing.assert_allclose(centred[1] @ centred[1].T, centred[0] @ centred[0].T, atol=1e-12)
    assert moved.volume == pytest.approx(blob.volume)  # no mirror image
    assert np.abs(centred[1] - centred[0]).max() > 0.1
    offset = moved.vertices.mean(axis=0) - blob.vertices.mean(axis=0)
    assert np.linalg.norm(offset) == pytest.approx(2 * diagonal(blob))
    for factor in (0, np.inf):
        with pytest.raises(ValueError, match="factor"):
            scale(blob, factor)


@pytest.mark.parametrize("name", DISTURBANCES)
def test_every_disturbance_says_what_it_did(name: str) -> None:
    if name == "limb":
        pytest.importorskip("manifold3d")
    mesh = horseshoe()
    before = mesh.vertices.copy(), mesh.faces.copy()
    disturbed = DISTURBANCES[name].apply(mesh)
    assert disturbed.name == mesh.name
    assert len(disturbed.notes) == 1
    assert disturbed.allow_open == (name == "hole")
    changed = len(disturbed.faces) != len(mesh.faces) or not np.allclose(disturbed.vertices, mesh.vertices)
    assert changed
    np.testing.assert_array_equal(mesh.vertices, before[0])
    np.testing.assert_array_equal(mesh.faces, before[1])
