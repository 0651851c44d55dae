from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from bodies import mean_value_coordinates
from conftest import as_mesh
from igps.data.collation import collate
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.nn.axes import InteriorDistance, Potential
from igps.nn.embedding import barycentroid_potential, interior_distance, spectral_embedding
from igps.nn.histograms.pairs import PairHistogram
from igps.signature.laplacian import laplacian
from igps.signature.signature import Samples, SignatureConfig, compute_signature
from igps.spectra import ConvergenceError, eigenpairs

CONFIG = SignatureConfig(
    n_eigenpairs=40, resolution=12, min_samples=0, n_surface_samples=300, accuracy=None
)


def histogram(signature, samples="interior"):
    counted = PairHistogram([Potential(4), InteriorDistance(64)], samples=samples)
    return counted(collate([signature]))[0].numpy()


@pytest.fixture(scope="module")
def signature(blob):
    return compute_signature(blob, CONFIG)


def test_another_default_device_changes_nothing(signature):
    # Eigenpairs by the solver for large meshes
    mesh = as_mesh(trimesh.creation.icosphere(subdivisions=4))
    expected = compute_signature(mesh, CONFIG)
    with torch.device("meta"):  # whose tensors have no numbers to go on with
        found = compute_signature(mesh, CONFIG)
        batch = collate([signature, found])[np.array([False, True])]
    assert_array_equal(found.interior.eigenfunctions, expected.interior.eigenfunctions)
    assert torch.equal(batch.eigenvalues, collate([expected]).eigenvalues)


def test_shapes_types_and_measures(blob, signature):
    n_samples = len(signature.interior)
    assert signature.eigenvalues.shape == (40,)
    assert signature.interior.points.shape == (n_samples, 3)
    assert signature.interior.eigenfunctions.shape == (n_samples, 40)
    assert signature.interior.eigenfunctions.dtype == np.float32
    assert signature.surface.eigenfunctions.shape == (300, 40)
    assert signature.area == pytest.approx(trimesh.Trimesh(blob.vertices, blob.faces).area)
    assert signature.volume == pytest.approx(trimesh.Trimesh(blob.vertices, blob.faces).volume)


def test_distance_and_potential_equal_the_papers_gram_form(blob, signature):
    # Rustamov 2010: d²(p,q) = (w(p) − w(q))ᵀ A (w(p) − w(q)) and U²(p) = w(p)ᵀ A w(p), A the Gram matrix of the GPS.
    spectrum = eigenpairs(*laplacian(blob), 40, positions=blob.vertices)
    gps = spectrum.eigenfunctions / np.sqrt(spectrum.eigenvalues)
    gram = gps @ gps.T
    points = signature.interior.points[::9]
    weights = np.asarray(mean_value_coordinates(blob.vertices, blob.faces, points))
    difference = weights[:, None] - weights[None]
    distance = np.sqrt(
        np.maximum(
            np.einsum("pqi,ij,pqj->pq", difference, gram, difference),
            0,
        )
    )
    potential = np.sqrt(np.einsum("pi,ij,pj->p", weights, gram, weights))

    eigenfunctions = torch.from_numpy(signature.interior.eigenfunctions[::9]).double()
    embedding = spectral_embedding(eigenfunctions, torch.from_numpy(signature.eigenvalues))
    assert_allclose(interior_distance(embedding, embedding), distance, atol=1e-6)
    assert_allclose(barycentroid_potential(embedding), potential, rtol=1e-5)


def test_barycentroid_of_a_ball_is_its_centre_and_of_a_body_its_least_potential(sphere, signature):
    ball = compute_signature(sphere, replace(CONFIG, resolution=11))
    assert_allclose(ball.barycentroid, 0, atol=1e-9)
    embedding = spectral_embedding(
        torch.from_numpy(signature.interior.eigenfunctions),
        torch.from_numpy(signature.eigenvalues),
    )
    least = int(barycentroid_potential(embedding).argmin())
    assert_array_equal(signature.barycentroid, signature.interior.points[least])


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_does_not_matter(blob, signature, scale):
    scaled = compute_signature(Mesh(blob.vertices * scale, blob.faces), CONFIG)
    assert_allclose(scaled.eigenvalues * scale**2, signature.eigenvalues, rtol=1e-7)
    for samples in ("interior", "surface"):
        assert_allclose(histogram(scaled, samples), histogram(signature, samples), atol=1e-5)


def test_grid_symmetries_and_shifts_do_not_matter(blob, signature):
    turn = np.array(
        [[0, -1, 0], [0, 0, 1], [-1, 0, 0]],
        dtype=float,
    )
    moved = compute_signature(
        Mesh(blob.vertices @ turn.T + [10, -200, 3], blob.faces),
        CONFIG,
    )
    for samples in ("interior", "surface"):
        assert_allclose(histogram(moved, samples), histogram(signature, samples), atol=1e-5)


def test_signs_of_eigenfunctions_do_not_matter(signature):
    signs = np.where(np.arange(40) % 3 == 0, -1, 1).astype(np.float32)
    flipped = replace(
        signature,
        interior=Samples(signature.interior.points, signature.interior.eigenfunctions * signs),
        surface=Samples(signature.surface.points, signature.surface.eigenfunctions * signs),
    )
    for samples in ("interior", "surface"):
        assert_allclose(histogram(flipped, samples), histogram(signature, samples), atol=1e-6)


def test_surface_samples_lie_on_the_surface_and_follow_its_area():
    box = trimesh.creation.box((1, 2, 3))
    for _ in range(3):
        box = box.subdivide()
    config = SignatureConfig(n_eigenpairs=10, resolution=8, min_samples=0, n_surface_samples=20_000)
    points = compute_signature(as_mesh(box), config).surface.points
    on_face = np.isclose(
        np.abs(points),
        [0.5, 1.0, 1.5],
        atol=1e-12,
    )
    assert on_face.any(axis=1).all()
    share = on_face[on_face.sum(axis=1) == 1].mean(axis=0)
    assert_allclose(share, np.array([6, 3, 2]) / 11, atol=0.012)


def test_surface_values_are_interpolated_linearly(blob, signature):
    blob = blob.numbered_by_faces()  # on which the signs of eigenfunctions depend
    spectrum = eigenpairs(*laplacian(blob), 40, positions=blob.vertices)
    surface = trimesh.Trimesh(blob.vertices, blob.faces, process=False)
    closest, _, face = trimesh.proximity.closest_point_naive(
        surface,
        signature.surface.points[:20],
    )
    weights = trimesh.triangles.points_to_barycentric(surface.triangles[face], closest)
    expected = np.einsum(
        "pi,pik->pk",
        weights,
        spectrum.eigenfunctions[surface.faces[face]],
    )
    assert_allclose(signature.surface.eigenfunctions[:20], expected, atol=1e-4)


def test_simplified_mesh_gives_a_near_descriptor(sphere):
    config = replace(CONFIG, max_vertices=700)
    small = compute_signature(sphere, config)
    full = compute_signature(sphere, CONFIG)
    assert any("simplified" in note for note in small.notes)
    assert small.eigenvalues[0] == pytest.approx(full.eigenvalues[0], rel=0.02)


def test_robust_backend_and_seed_are_honoured(blob, signature):
    robust = compute_signature(blob, replace(CONFIG, backend="robust"))
    assert not np.array_equal(robust.eigenvalues, signature.eigenvalues)
    assert_allclose(robust.eigenvalues, signature.eigenvalues, rtol=0.05)
    other = compute_signature(blob, replace(CONFIG, seed=1))
    assert not np.array_equal(other.surface.points, signature.surface.points)
    assert_array_equal(compute_signature(blob, CONFIG).surface.points, signature.surface.points)


@pytest.fixture(scope="module")
def needles(blob):
    """The blob with two vertices a billionth of its size apart."""
    vertices = blob.vertices.copy()
    a, b = blob.faces[100, :2]
    vertices[a] = vertices[b] + (vertices[a] - vertices[b]) * 2e-8
    return Mesh(vertices, blob.faces, name="needles")


def limit_residuals(monkeypatch, limit):
    monkeypatch.setattr("igps.signature.signature._MAX_RESIDUAL", limit)
    monkeypatch.setattr("igps.spectra.eigensolver.RESIDUAL_LIMIT", limit)


def test_other_matrices_serve_where_the_cotangent_ones_fail(needles, monkeypatch):
    plain = compute_signature(needles, CONFIG)
    assert 1e-12 < plain.residual < 1e-6
    assert plain.notes == ()
    # What rounding leaves of the cotangent matrices' eigenpairs, by any solver, is far from that of the others'.
    limit = plain.residual / 10
    limit_residuals(monkeypatch, limit)
    signature = compute_signature(needles, CONFIG)
    (note,) = signature.notes
    assert note.startswith("intrinsic-Delaunay matrices were used: ")
    assert f"relative residual above {limit:.1e}" in note
    assert signature.residual < limit
    robust = compute_signature(needles, replace(CONFIG, backend="robust"))
    assert_array_equal(signature.eigenvalues, robust.eigenvalues)
    assert_array_equal(signature.interior.eigenfunctions, robust.interior.eigenfunctions)


def test_a_mesh_that_no_matrices_serve_is_refused(needles, monkeypatch):
    limit_residuals(monkeypatch, 1e-18)
    with pytest.raises(
        ConvergenceError,
        match=r"needles: .* cotangent matrices .* intrinsic-Delaunay ones .*remesh",
    ):
        compute_signature(needles, CONFIG)


def test_a_trimesh_has_the_signature_of_its_mesh(blob, signature):
    surface = trimesh.Trimesh(blob.vertices, blob.faces, process=False)
    found = compute_signature(surface, CONFIG)
    assert_array_equal(found.interior.eigenfunctions, signature.interior.eigenfunctions)
    with pytest.raises(
        TypeError, match=r"expected a Mesh, a trimesh\.Trimesh, .* got builtins\.str"
    ):
        compute_signature("blob.off", CONFIG)


def test_attributes_are_added_to_samples_and_nothing_else_changes(signature):
    samples = signature.interior
    height = samples.points[:, 2]
    away = samples.points - samples.points.mean(axis=0)
    more = samples.with_attributes({"height": height, "away": away})
    more = more.with_attributes({"height": 2 * height})
    assert {values.dtype.name for values in more.attributes.values()} == {"float32"}
    assert_allclose(more.attributes["height"], 2 * height, rtol=1e-6)
    assert_allclose(more.attributes["away"], away, rtol=1e-6)
    assert more.eigenfunctions is samples.eigenfunctions
    assert samples.attributes == {}
    wrong = height.copy()
    wrong[3] = np.nan
    for values, message in (
        (height[:-1], f"for each of {len(samples)} points"),
        (wrong, "1 values that are not"),
    ):
        with pytest.raises(ValueError, match=f"height: expected a finite number.*{message}"):
            samples.with_attributes({"height": values})


def test_too_few_vertices_say_so(blob):
    with pytest.raises(
        MeshError,
        match=r"blob: expected at least 643 vertices for 641 eigenpairs, got 642.*lower n_eigenpairs",
    ):
        compute_signature(blob, replace(CONFIG, n_eigenpairs=641))


@pytest.mark.parametrize(
    "field",
    [
        {"n_eigenpairs": -1},
        {"resolution": 0},
        {"min_samples": -1},
        {"n_surface_samples": 0},
        {"backend": "x"},
        {"backend": None},
        {"max_vertices": 100},
        {"accuracy": 2.0},
        {"attributes": ("x",)},
        {"seed": -1},
    ],
)
def test_bad_configuration_is_named(field):
    with pytest.raises(ValueError, match=next(iter(field))):
        SignatureConfig(**field)


def test_a_signature_is_the_beginning_of_one_with_more(blob):
    """Samples, their order and the eigenvalues; the eigenfunctions but for the sign, which a single one has free."""
    exact = replace(CONFIG, n_eigenpairs=64)
    more = replace(exact, n_eigenpairs=250)
    alone = compute_signature(blob, exact)
    whole = compute_signature(blob, more)
    assert whole.area == alone.area
    assert whole.volume == alone.volume
    assert whole.notes == alone.notes
    assert_allclose(whole.eigenvalues[:64], alone.eigenvalues, rtol=1e-9)
    for one, other in ((whole.interior, alone.interior), (whole.surface, alone.surface)):
        first = one.eigenfunctions[:, :64]
        assert_allclose(one.points, other.points, atol=1e-12)
        signs = np.sign((first * other.eigenfunctions).sum(axis=0))
        assert_allclose(first * signs, other.eigenfunctions, atol=1e-4)


def test_no_number_of_eigenpairs_is_the_usual_one(blob):
    config = SignatureConfig(resolution=6, min_samples=0, n_surface_samples=20)
    assert config.as_dict() == replace(config, n_eigenpairs=250).as_dict()
    assert config.as_dict() == config.resolved().as_dict()
    assert config.as_dict()["n_eigenpairs"] == 250
    assert "least_vertices" not in config.as_dict()
    assert config.with_eigenpairs(50).as_dict() == {
        **config.as_dict(),
        "n_eigenpairs": 64,
        "least_vertices": 252,
    }
    signature = compute_signature(blob, config)
    assert len(signature.eigenvalues) == signature.config.n_eigenpairs == 250


def test_paper_is_the_paper():
    paper = SignatureConfig.paper()
    assert paper.n_eigenpairs == 250
    assert paper.resolution == 32
    assert paper.min_samples == 0
    assert paper.backend == "cotangent"
    assert paper.max_vertices is None


def test_real_model(homer):
    signature = compute_signature(homer, SignatureConfig.paper())
    assert histogram(signature).sum() == pytest.approx(1)
    exact = compute_signature(homer, replace(SignatureConfig.paper(), accuracy=None))
    assert_allclose(histogram(signature), histogram(exact), atol=2e-4)
    # The barycentroid of a standing figure lies in its trunk: between a third and two thirds of its height.
    low = homer.vertices.min(axis=0)
    high = homer.vertices.max(axis=0)
    height = int(np.argmax(high - low))
    assert 1 / 3 < (signature.barycentroid[height] - low[height]) / (high - low)[height] < 2 / 3
