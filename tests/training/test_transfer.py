"""Deformation transfer: individuals of a scanned body in its poses."""

import re

import numpy as np
import pytest
import trimesh
from docs.benchmarks.transfer import people, transfer
from scipy.spatial.transform import Rotation


def test_a_rigid_pose_moves_the_changed_surface_rigidly():
    rest, faces = _rod()
    changed = rest * [1.1, 0.9, 1.2] + 0.05 * np.sin(3 * rest[:, [1, 2, 0]])
    turn = Rotation.from_euler("xyz", [0.3, 1.2, -0.5])
    (moved,) = transfer(
        rest,
        [turn.apply(rest) + 5.0],
        changed,
        faces,
    )
    np.testing.assert_allclose(_centred(moved), _centred(turn.apply(changed)), atol=1e-9)


def test_the_changed_surface_bends_with_the_pose():
    """A rod made thicker by a tenth is, when bent, close to a thicker rod that was bent by the same map."""
    rest, faces = _rod()
    changed = rest * [1.1, 1.1, 1.0]
    (moved,) = transfer(rest, [_bend(rest)], changed, faces)
    errors = np.linalg.norm(
        _centred(moved) - _centred(_bend(changed)),
        axis=1,
    )
    changes = np.linalg.norm(
        _centred(moved) - _centred(_bend(rest)),
        axis=1,
    )
    assert errors.max() < 0.02
    assert changes.max() > 0.04


def test_individuals_in_rigid_poses_are_found(tmp_path, capsys):
    """Rigid poses do not change the spectrum, so that each individual is nearest to itself."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    for pose in range(3):
        path = tmp_path / "bodies" / "ball" / f"{pose}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        turned = ball.vertices * [1.0, 1.2, 1.5] @ Rotation.from_euler("x", pose).as_matrix()
        trimesh.Trimesh(turned, ball.faces, process=False).export(path)
    cache = tmp_path / "cache"
    how = {"n_individuals": 4, "cache_dir": cache, "n_workers": 1}
    people(tmp_path / "bodies", tmp_path / "made", ["shape_dna"], **how)
    assert "ball shape_dna: NN 100.0 FT 100.0" in capsys.readouterr().out
    assert len(list((tmp_path / "made").rglob("*.off"))) == 4 * 3
    ball.invert()
    ball.export(path)
    with pytest.raises(ValueError, match=re.escape(f"data: expected the faces of 0.off in {path}")):
        people(tmp_path / "bodies", tmp_path / "made")


def _rod():
    """Vertices and faces of a rod of radius 0.5 along z."""
    rod = trimesh.creation.icosphere(subdivisions=4)
    return np.asarray(rod.vertices) * [0.5, 0.5, 3.0], np.asarray(rod.faces)


def _bend(points):
    """Bend the z axis into an arc of radius 4, perpendicular slices staying flat."""
    angles = points[:, 2] / 4.0
    radii = 4.0 + points[:, 0]
    return np.stack(
        [radii * np.cos(angles), points[:, 1], radii * np.sin(angles)],
        axis=1,
    )


def _centred(points):
    return points - points.mean(axis=0)
