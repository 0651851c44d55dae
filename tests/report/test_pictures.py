from pathlib import Path

import numpy as np
import pytest
import trimesh

from conftest import as_mesh, horseshoe
from igps.data.dataset import SignatureDataset
from igps.mesh.errors import MeshError
from igps.report import pictures
from igps.report.pictures import (
    fitting_vertices,
    surface_of,
    surfaces_of,
)
from igps.signature.signature import SignatureConfig, compute_signature

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=400)


def egg():
    surface = trimesh.creation.icosphere(subdivisions=3)
    surface.vertices *= [1.0, 0.7, 2.5]
    return surface


def test_a_surface_keeps_the_form_with_few_vertices():
    """The closed form of an ellipsoid: its axes, longest up, and its volume."""
    mesh = as_mesh(egg())
    one = surface_of(mesh, compute_signature(mesh, CONFIG), 150)
    assert 100 < len(one.vertices) <= 150
    points = one.vertices / 65535
    np.testing.assert_allclose(np.ptp(points, axis=0), [1.0 / 2.5, 1.0, 0.7 / 2.5], rtol=0.06)
    body = trimesh.Trimesh(points, one.faces, process=False)
    assert body.is_watertight
    assert body.volume == pytest.approx(
        np.pi / 6 * 0.4 * 0.28, rel=0.06
    )  # positive: not a mirror image
    assert one.n_vertices == 642
    assert one.n_faces == 1280
    assert one.volume == pytest.approx(4 / 3 * np.pi * 1.75, rel=0.02)


def test_the_potential_is_that_of_the_nearest_samples():
    """Against a loop; and on an egg it is least around the middle and largest at the ends."""
    mesh = as_mesh(egg())
    signature = compute_signature(mesh, CONFIG)
    one = surface_of(mesh, signature, 1000)
    heights = one.vertices[:, 1] / 65535 - 0.5
    potential = one.potential / 255
    assert potential[np.abs(heights) > 0.45].min() > 0.7
    assert potential[np.abs(heights) < 0.1].max() < 0.3
    assert potential.min() == 0
    assert potential.max() == 1
    low, high = one.potential_range
    for vertex in range(
        0, len(mesh.vertices), 50
    ):  # small enough: the vertices are those of the mesh
        away = np.linalg.norm(
            signature.surface.points - mesh.vertices[vertex],
            axis=1,
        )
        total = weights = 0.0
        for sample in np.argsort(away)[:4]:
            phi = signature.surface.eigenfunctions[sample].astype(float)
            weight = 1 / (away[sample] + 1e-6 * mesh.diagonal)
            total += weight * np.sqrt(sum(phi**2 / signature.eigenvalues))
            weights += weight
        assert low + potential[vertex] * (high - low) == pytest.approx(
            total / weights, abs=(high - low) / 400
        )


def test_turned_and_moved_bodies_look_alike():
    mesh = horseshoe()
    turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(1).uniform(size=3))[
        :3, :3
    ]
    other = as_mesh(
        trimesh.Trimesh(
            3 * mesh.vertices @ turn.T + [5, 1, 2],
            mesh.faces,
            process=False,
        )
    )
    one, two = (
        surface_of(
            body,
            compute_signature(body, CONFIG),
            1000,
        )
        for body in (mesh, other)
    )
    np.testing.assert_allclose(one.vertices / 65535, two.vertices / 65535, atol=2e-3)


def test_a_surface_of_too_many_vertices_for_the_page_is_told(monkeypatch):
    monkeypatch.setattr(pictures, "_STEPS", 100)
    mesh = as_mesh(egg())
    with pytest.raises(MeshError, match="too many handles"):
        surface_of(mesh, compute_signature(mesh, CONFIG), 150)


def test_surfaces_of_the_cache_follow_their_files(tmp_path, caplog):
    """Made once, and again where the file changed; one that cannot be read has none."""
    files = [tmp_path / f"{i}.off" for i in range(3)]
    for i, file in enumerate(files):
        surface = egg()
        surface.vertices *= [1, 1, 1 - 0.1 * i]
        surface.export(file)

    def found():
        dataset = SignatureDataset(files, CONFIG, tmp_path / "cache")
        return {Path(name).name: one for name, one in surfaces_of(dataset, n_workers=1).items()}

    def stamps():
        files = (tmp_path / "cache" / "pictures").rglob("*.safetensors")
        return {file: file.stat().st_mtime_ns for file in files}

    first = found()
    assert list(first) == ["0.off", "1.off", "2.off"]
    kept = stamps()
    again = found()
    assert len(kept) == 3
    assert stamps() == kept
    for name, one in first.items():
        assert one.packed() == again[name].packed()
        for field in ("potential_range", "n_vertices", "n_faces", "area", "volume", "unit"):
            assert getattr(one, field) == getattr(again[name], field)

    changed = egg()
    changed.vertices *= [1, 1, 0.5]
    changed.export(files[0])
    files[1].unlink()
    files[2].write_text("no mesh")
    second = found()
    assert list(second) == ["0.off"]
    assert second["0.off"].volume == pytest.approx(changed.volume)
    assert "1.off: no picture" in caplog.text
    assert "2.off: no picture" in caplog.text


def test_many_shapes_share_the_room():
    assert fitting_vertices(0) == fitting_vertices(400) == 1200
    assert 150 < fitting_vertices(2000) < 500
    for n in (1, 400, 1000, 5000):
        assert n * fitting_vertices(n) * 19 * 4 / 3 < 21e6
    assert fitting_vertices(10**6) == 150


def test_a_body_of_a_patient_has_its_left_on_the_right_of_the_page():
    body = trimesh.creation.icosphere(subdivisions=3)
    body.vertices[body.vertices[:, 0] < -0.9] *= 1.5  # in RAS this is the left
    mesh = as_mesh(body).annotated(unit="mm", frame="RAS")
    signature = compute_signature(mesh, SignatureConfig(n_eigenpairs=8, resolution=6))
    surface = surface_of(mesh, signature, 300)
    assert surface.frame == "RAS"
    points = surface.vertices / 65535
    from_centre = points - np.median(points, axis=0)
    x, y, z = from_centre[np.linalg.norm(from_centre, axis=1).argmax()]
    assert x > np.hypot(y, z)
