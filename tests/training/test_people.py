"""Deformation transfer: individuals of a scanned body in its poses."""

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from training.studies.people import transfer


def test_an_unchanged_surface_takes_the_poses():
    rest, faces = _rod()
    bent = _bend(rest)
    for moved, pose in zip(transfer(rest, [rest, bent], rest, faces), [rest, bent], strict=True):
        np.testing.assert_allclose(_centred(moved), _centred(pose), atol=1e-9)


def test_a_rigid_pose_moves_the_changed_surface_rigidly():
    rest, faces = _rod()
    changed = rest * [1.1, 0.9, 1.2] + 0.05 * np.sin(3 * rest[:, [1, 2, 0]])
    turn = Rotation.from_euler("xyz", [0.3, 1.2, -0.5])
    (moved,) = transfer(rest, [turn.apply(rest) + 5.0], changed, faces)
    np.testing.assert_allclose(_centred(moved), _centred(turn.apply(changed)), atol=1e-9)


def test_the_changed_surface_bends_with_the_pose():
    """A rod made thicker by a tenth is, when bent, close to a thicker rod that was bent by the same map."""
    rest, faces = _rod()
    changed = rest * [1.1, 1.1, 1.0]
    (moved,) = transfer(rest, [_bend(rest)], changed, faces)
    errors = np.linalg.norm(_centred(moved) - _centred(_bend(changed)), axis=1)
    assert errors.max() < 0.02
    assert np.linalg.norm(_centred(moved) - _centred(_bend(rest)), axis=1).max() > 0.04


def _rod() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a rod of radius 0.5 along z."""
    rod = trimesh.creation.icosphere(subdivisions=4)
    return np.asarray(rod.vertices) * [0.5, 0.5, 3.0], np.asarray(rod.faces)


def _bend(points: np.ndarray) -> np.ndarray:
    """Bend the z axis into an arc of radius 4, perpendicular slices staying flat."""
    angles, radii = points[:, 2] / 4.0, 4.0 + points[:, 0]
    return np.stack([radii * np.cos(angles), points[:, 1], radii * np.sin(angles)], axis=1)


def _centred(points: np.ndarray) -> np.ndarray:
    return points - points.mean(axis=0)
