"""Each damage is what its description says."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from training.studies import damages as damage
from training.studies.damages import DAMAGES

from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import area_vectors
from igps.mesh.winding import winding_number


def area(vertices: np.ndarray, faces: np.ndarray) -> float:
    return float(np.linalg.norm(area_vectors(vertices, faces), axis=1).sum())


def n_parts(vertices: np.ndarray, faces: np.ndarray) -> int:
    start, end = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    graph = sparse.coo_array((np.ones(len(start)), (start, end)), shape=(len(vertices),) * 2)
    return int(connected_components(graph)[0])


@pytest.mark.parametrize("name", sorted(DAMAGES))
def test_same_seed_same_damage_and_no_body_is_left(blob: Mesh, name: str) -> None:
    before = blob.vertices.copy()
    vertices, faces = DAMAGES[name].apply(blob, 5)
    again = DAMAGES[name].apply(blob, 5)
    np.testing.assert_array_equal(vertices, again[0])
    np.testing.assert_array_equal(faces, again[1])
    np.testing.assert_array_equal(blob.vertices, before)
    if name != "noise":
        with pytest.raises(MeshError):
            Mesh(vertices, faces)
    if name != "halves":
        assert not np.array_equal(vertices, DAMAGES[name].apply(blob, 6)[0]) or not np.array_equal(
            faces, DAMAGES[name].apply(blob, 6)[1]
        )


def test_holes(sphere: Mesh) -> None:
    vertices, faces = damage.holes(sphere, seed=1)
    assert area(vertices, faces) == pytest.approx(0.98 * sphere.area, rel=2e-3)
    surface = trimesh.Trimesh(vertices, faces, process=False)
    assert len(surface.outline().entities) == 3


def test_soup(blob: Mesh) -> None:
    vertices, faces = damage.soup(blob, seed=1)
    assert len(vertices) == 3 * len(blob.faces) == faces.size
    np.testing.assert_array_equal(vertices, vertices.astype(np.float32))
    assert area(vertices, faces) == pytest.approx(blob.area, rel=1e-6)


def test_turned(blob: Mesh) -> None:
    vertices, faces = damage.turned(blob, seed=1)
    along = np.einsum(
        "ij,ij->i", area_vectors(vertices, faces), area_vectors(blob.vertices, blob.faces)
    )
    assert (along < 0).mean() == pytest.approx(1 / 3, abs=1e-3)


def test_fins(blob: Mesh) -> None:
    vertices, faces = damage.fins(blob, seed=1)
    doubled = round(0.01 * len(blob.faces))
    assert len(faces) == len(blob.faces) + 30 + doubled
    assert len(np.unique(np.sort(faces, axis=1), axis=0)) == len(blob.faces) + 30
    assert len(vertices) == len(blob.vertices) + 30


def test_parts(blob: Mesh) -> None:
    vertices, faces = damage.parts(blob, seed=1)
    assert n_parts(vertices, faces) == 3
    extra = vertices[len(blob.vertices) :]
    inside = winding_number(blob.vertices, blob.faces, extra) > 0.5
    assert inside[: len(extra) // 2].all()
    assert not inside[len(extra) // 2 :].any()
    speck = area(vertices, faces[len(blob.faces) + (len(faces) - len(blob.faces)) // 2 :])
    assert speck == pytest.approx(1e-3 * blob.area, rel=0.05)


def test_halves(blob: Mesh) -> None:
    vertices, faces = damage.halves(blob)
    assert n_parts(vertices, faces) == 2
    surface = trimesh.Trimesh(vertices, faces, process=False)
    pieces = surface.split(only_watertight=True)
    assert len(pieces) == 2
    # They overlap by 2 % of the diagonal, times about a cross section.
    common = sum(piece.volume for piece in pieces) - blob.volume
    diagonal = np.linalg.norm(np.ptp(blob.vertices, axis=0))
    axis = np.linalg.eigh(np.cov(blob.vertices.T))[1][:, -1]
    section = body_section(blob, axis)
    assert common == pytest.approx(0.02 * diagonal * section, rel=0.05)


def body_section(mesh: Mesh, axis: np.ndarray) -> float:
    """Area of the cross section at the centre, which is seen whole from there."""
    centre = mesh.vertices.mean(axis=0)
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    segments = trimesh.intersections.mesh_plane(surface, axis, centre) - centre
    return float(np.linalg.norm(np.cross(segments[:, 0], segments[:, 1]), axis=1).sum() / 2)


def test_noise(sphere: Mesh) -> None:
    vertices, faces = damage.noise(sphere, seed=1)
    np.testing.assert_array_equal(faces, sphere.faces)
    moved = np.linalg.norm(vertices, axis=1) - 1
    assert moved.std() == pytest.approx(0.002 * 2 * np.sqrt(3), rel=0.05)
