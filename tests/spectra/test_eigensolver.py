"""The eigensolver against dense solvers, closed forms and invariances."""

import igl
import lapy
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from problems import cotangent_problem, torus
from scipy import sparse
from scipy.linalg import eigh
from trimesh.creation import icosphere

from conftest import torch_threads
from igps.mesh.mesh import Mesh
from igps.signature.laplacian import laplacian
from igps.spectra import ConvergenceError, eigenpairs, eigensolver


@pytest.fixture(scope="module")
def torus_problem():
    return cotangent_problem(torus())


@pytest.fixture(scope="module")
def torus_oracle(torus_problem):
    stiffness, mass, _ = torus_problem
    return eigh(stiffness.toarray(), np.diag(mass))


def assert_pairs(spectrum, problem, tolerance=1e-07):
    stiffness, mass, _ = problem
    values = spectrum.eigenvalues
    functions = spectrum.eigenfunctions
    assert np.all(np.diff(values) >= 0)
    residual = stiffness @ functions - mass[:, None] * functions * values
    lengths = np.linalg.norm(
        residual / np.sqrt(mass)[:, None],
        axis=0,
    )
    assert (lengths / values).max() <= 2 * tolerance
    products = functions.T @ (mass[:, None] * functions)
    assert_allclose(products, np.eye(len(values)), atol=1e-10)
    assert np.abs(mass @ functions).max() < 1e-9 * np.sqrt(mass.sum())


@pytest.mark.parametrize(
    "n_eigenpairs",
    [1, 100, 280],
)
def test_agrees_with_a_dense_solver(n_eigenpairs, torus_problem, torus_oracle):
    stiffness, mass, positions = torus_problem
    spectrum = eigenpairs(stiffness, mass, n_eigenpairs, positions=positions)
    assert_allclose(spectrum.eigenvalues, torus_oracle[0][1 : n_eigenpairs + 1], rtol=1e-10)
    assert_pairs(spectrum, torus_problem)


def test_sphere_has_multiplets_of_odd_size():
    """l(l + 1) with multiplicity 2l + 1 on the unit sphere; the last multiplet is cut."""
    mesh = icosphere(subdivisions=4)
    problem = cotangent_problem(mesh)
    spectrum = eigenpairs(
        problem[0],
        problem[1],
        110,
        positions=problem[2],
    )
    degree = np.repeat(np.arange(1, 11), 2 * np.arange(1, 11) + 1)[:110]
    assert_allclose(spectrum.eigenvalues, degree * (degree + 1), rtol=0.045)
    assert_pairs(spectrum, problem)


def copies_of_a_patch(n_copies, side):
    """Identical square grids tied to one vertex: almost every eigenvalue has multiplicity n_copies − 1."""
    path = sparse.diags_array(
        [np.ones(side - 1), np.ones(side - 1)],
        offsets=[-1, 1],
    )
    identity = sparse.eye_array(side)
    grid = sparse.kron(path, identity)
    grid += sparse.kron(identity, path)
    copies = sparse.coo_array(
        sparse.kron(
            sparse.eye_array(n_copies),
            grid,
        )
    )
    tips = 1 + side**2 * np.arange(n_copies)
    hub = np.zeros_like(tips)
    sources, targets = copies.coords
    rows = np.r_[sources + 1, hub, tips]
    columns = np.r_[targets + 1, tips, hub]
    n_vertices = 1 + n_copies * side**2
    adjacency = sparse.csr_array(
        (np.ones(len(rows)), (rows, columns)), shape=(n_vertices, n_vertices)
    )
    degrees = sparse.diags_array(adjacency.sum(axis=1))
    stiffness = sparse.csr_array(degrees - adjacency)
    mass = np.ones(n_vertices)
    positions = np.zeros((n_vertices, 3))
    return stiffness, mass, positions


def test_multiplets_larger_than_the_block():
    problem = copies_of_a_patch(n_copies=40, side=5)
    values = np.linalg.eigvalsh(problem[0].toarray())
    assert np.ptp(values[1:40]) < 1e-12 < 1e-3 < values[40] - values[39]
    for n_eigenpairs in (38, 39, 60, 100):
        spectrum = eigenpairs(
            problem[0],
            problem[1],
            n_eigenpairs,
        )
        assert_allclose(spectrum.eigenvalues, values[1 : n_eigenpairs + 1], rtol=1e-10)
        assert_pairs(spectrum, problem)


def test_more_copies_than_distinct_eigenvalues():
    """Four distinct eigenvalues fill most of the space: the Krylov space of the start block is soon exhausted."""
    problem = copies_of_a_patch(n_copies=300, side=2)
    values = np.linalg.eigvalsh(problem[0].toarray())
    spectrum = eigenpairs(problem[0], problem[1], 299)
    assert_allclose(spectrum.eigenvalues, values[1:300], rtol=1e-10)
    assert_pairs(spectrum, problem)


def test_threads_change_no_bit(many_cores, monkeypatch):
    """10,242 vertices: two pieces of the basis, two subtrees; and a team, though the result is small."""
    sphere = icosphere(subdivisions=5)
    sphere.vertices *= 1, 0.8, 0.6
    stiffness, mass, positions = cotangent_problem(sphere)
    monkeypatch.setattr("igps.spectra._lanczos.MIN_TEAM_RESULT", 0)
    spectra = []
    for n_threads in (1, 2, 5):
        with torch_threads(n_threads):
            spectra.append(eigenpairs(stiffness, mass, 20, positions=positions))
    assert_pairs(spectra[0], (stiffness, mass, positions))
    for other in spectra[1:]:
        assert_array_equal(other.eigenvalues, spectra[0].eigenvalues)
        assert_array_equal(other.eigenfunctions, spectra[0].eigenfunctions)


def test_eigenvalues_are_the_quotients_of_their_vectors(torus_problem):
    stiffness, mass, positions = torus_problem
    spectrum = eigenpairs(stiffness, mass, 100, positions=positions, tolerance=1e-3)
    functions = spectrum.eigenfunctions
    quotients = np.einsum("vk,vk->k", functions, stiffness @ functions)
    assert_allclose(spectrum.eigenvalues, quotients, rtol=1e-13)


def test_a_large_basis_gives_its_place_to_the_eigenvectors(
    torus_problem, torus_oracle, monkeypatch
):
    stiffness, mass, positions = torus_problem
    monkeypatch.setattr("igps.spectra._basis.MAX_SINGLE_ENTRIES", 1000)
    spectrum = eigenpairs(stiffness, mass, 130, positions=positions)
    assert_allclose(spectrum.eigenvalues, torus_oracle[0][1:131], rtol=1e-10)
    assert_pairs(spectrum, torus_problem)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_of_the_coordinates(scale, torus_problem):
    stiffness, mass, positions = torus_problem
    one = eigenpairs(stiffness, mass, 50, positions=positions)
    other = eigenpairs(
        stiffness,
        mass * scale**2,
        50,
        positions=positions * scale,
    )
    assert_allclose(other.eigenvalues * scale**2, one.eigenvalues, rtol=1e-10)
    assert_pairs(
        other,
        (stiffness, mass * scale**2, positions),
    )


def test_same_seed_same_bits_other_seed_same_space(torus_problem):
    stiffness, mass, positions = torus_problem
    one, again, other = (
        eigenpairs(stiffness, mass, 40, positions=positions, seed=seed) for seed in (0, 0, 1)
    )
    assert_array_equal(one.eigenfunctions, again.eigenfunctions)
    assert not np.array_equal(one.eigenfunctions, other.eigenfunctions)
    assert_allclose(one.eigenvalues, other.eigenvalues, rtol=1e-10)


def test_positions_change_only_the_work(torus_problem):
    stiffness, mass, positions = torus_problem
    with_positions = eigenpairs(stiffness, mass, 60, positions=positions)
    without = eigenpairs(stiffness, mass, 60)
    assert_allclose(without.eigenvalues, with_positions.eigenvalues, rtol=1e-10)


@pytest.mark.parametrize("n_vertices", [4, 12])
def test_tiny_meshes(n_vertices):
    tetrahedron = trimesh.Trimesh(
        np.eye(4)[:, :3],
        [
            [0, 1, 2],
            [0, 3, 1],
            [1, 3, 2],
            [2, 3, 0],
        ],
    )
    problem = cotangent_problem(tetrahedron if n_vertices == 4 else trimesh.creation.icosahedron())
    spectrum = eigenpairs(*problem[:2], n_vertices - 2)
    values = eigh(
        problem[0].toarray(),
        np.diag(problem[1]),
        eigvals_only=True,
    )
    assert_allclose(spectrum.eigenvalues, values[1:-1], rtol=1e-10)
    assert_pairs(spectrum, problem)


def test_flat_triangles_with_huge_cotangents():
    mesh = torus(jitter=0.0)
    squashed = np.random.default_rng(3).choice(
        len(mesh.faces),
        40,
        replace=False,
    )
    for a, b, c in mesh.faces[squashed]:
        aside = 1e-5 * (mesh.vertices[a] - mesh.vertices[b])
        mesh.vertices[a] = (mesh.vertices[b] + mesh.vertices[c]) / 2 + aside
    problem = cotangent_problem(
        trimesh.Trimesh(
            mesh.vertices,
            mesh.faces,
            process=False,
        )
    )
    assert abs(problem[0]).max() > 1e3
    spectrum = eigenpairs(
        problem[0],
        problem[1],
        80,
        positions=problem[2],
    )
    values = eigh(
        problem[0].toarray(),
        np.diag(problem[1]),
        eigvals_only=True,
    )
    assert_allclose(spectrum.eigenvalues, values[1:81], rtol=1e-7)


def fail(*arguments):
    raise ConvergenceError("on purpose")


def test_falls_back_to_arpack_with_a_warning(torus_problem, monkeypatch, caplog):
    stiffness, mass, positions = torus_problem
    expected = eigenpairs(stiffness, mass, 30, positions=positions)
    monkeypatch.setattr(eigensolver, "lanczos", fail)
    spectrum = eigenpairs(stiffness, mass, 30, positions=positions)
    assert_allclose(spectrum.eigenvalues, expected.eigenvalues, rtol=1e-10)
    assert_pairs(spectrum, torus_problem)
    assert "falling back to ARPACK: on purpose" in caplog.text


def test_incomplete_or_wrong_pairs_are_not_returned(torus_problem, monkeypatch):
    """Whoever found them."""
    stiffness, mass, _ = torus_problem
    right = eigenpairs(stiffness, mass, 30 + eigensolver.N_GUARDS)
    found = [
        np.delete(right.eigenvalues, 4),
        np.delete(right.eigenfunctions, 4, axis=1),
    ]
    monkeypatch.setattr(eigensolver, "lanczos", fail)
    monkeypatch.setattr(eigensolver, "_arpack", lambda *arguments: found)
    with pytest.raises(ConvergenceError, match="found 30 of 31"):
        eigenpairs(stiffness, mass, 30)
    noise = np.random.default_rng(0).normal(size=right.eigenfunctions.shape)
    found = [right.eigenvalues, np.linalg.qr(noise)[0]]
    with pytest.raises(ConvergenceError, match="30 of eigenpairs 1 to 30 have a relative residual"):
        eigenpairs(stiffness, mass, 30)


@pytest.mark.parametrize("n_eigenpairs", [60, 300])  # Lanczos, and the dense solver
def test_the_residual_is_that_of_the_worst_pair(n_eigenpairs, torus_problem):
    stiffness, mass, positions = torus_problem
    spectrum = eigenpairs(stiffness, mass, n_eigenpairs, positions=positions, tolerance=1e-4)
    values = spectrum.eigenvalues
    functions = spectrum.eigenfunctions
    defect = stiffness @ functions - mass[:, None] * functions * values
    expected = np.linalg.norm(defect / np.sqrt(mass)[:, None], axis=0) / values
    assert spectrum.residual == pytest.approx(
        expected.max(),
        rel=1e-2,
        abs=1e-12,
    )
    assert 0 < spectrum.residual < 1e-4


@pytest.mark.parametrize(
    "pack",
    [
        sparse.diags_array,
        lambda mass: sparse.csc_matrix(np.diag(mass)),
    ],
)
def test_mass_may_be_a_diagonal_matrix(pack, torus_problem):
    stiffness, mass, positions = torus_problem
    of_vector = eigenpairs(stiffness, mass, 20, positions=positions)
    of_matrix = eigenpairs(
        stiffness,
        pack(mass),
        20,
        positions=positions,
    )
    assert_array_equal(of_matrix.eigenfunctions, of_vector.eigenfunctions)
    assert_array_equal(of_matrix.mass, mass)


def test_takes_the_matrices_of_other_libraries():
    """LaPy's and libigl's, as they give them; LaPy solves with them as the oracle."""
    mesh = torus(32, 16)
    vertices = np.array(mesh.vertices)
    faces = np.array(mesh.faces)
    solver = lapy.Solver(
        lapy.TriaMesh(vertices, faces),
        lump=True,
        use_cholmod=False,
    )
    values = solver.eigs(25)[0][1:]
    of_lapy = eigenpairs(solver.stiffness, solver.mass, 24)
    # LaPy computes in single precision
    assert_allclose(of_lapy.eigenvalues, values, rtol=1e-5)
    of_igl = eigenpairs(
        -igl.cotmatrix(vertices, faces),
        igl.massmatrix(vertices, faces, 0),
        24,
    )
    assert_allclose(of_igl.eigenvalues, values, rtol=1e-5)


@pytest.mark.parametrize(
    ("length", "usable"),
    [(400, True), (8000, False)],
)
def test_rounding_excuses_only_a_small_residual(length, usable):
    """A needle's cotangents: what rounding allows grows with the square of its length, what is accepted does not."""
    needle = trimesh.creation.cylinder(0.2, length, sections=300)
    stiffness, mass = laplacian(Mesh(needle.vertices, needle.faces))
    if usable:
        assert 1e-6 < eigenpairs(stiffness, mass, 50, tolerance=1e-6).residual < 1e-4
    else:
        with pytest.raises(ConvergenceError, match=r"relative residual above 1.0e-04"):
            eigenpairs(stiffness, mass, 50, tolerance=1e-6)


def test_arguments_are_left_alone(torus_problem):
    stiffness, mass, positions = (array.copy() for array in torus_problem)
    spectrum = eigenpairs(stiffness, mass, 20, positions=positions)
    assert (stiffness != torus_problem[0]).nnz == 0
    assert_array_equal(mass, torus_problem[1])
    assert_array_equal(positions, torus_problem[2])
    assert not np.shares_memory(spectrum.mass, mass)


def test_two_components_are_counted_at_any_scale():
    one = icosphere(subdivisions=2)
    two = trimesh.util.concatenate(
        [
            one,
            one.copy().apply_translation([3, 0, 0]),
        ]
    )
    for scale in (1e-6, 1, 1e6):
        stiffness, mass, _ = cotangent_problem(two)
        with pytest.raises(ValueError, match="expected 1 connected component, got 2"):
            eigenpairs(stiffness, mass * scale**2, 10)


def test_components_tied_by_rounding_alone_are_counted():
    stiffness, mass, _ = cotangent_problem(icosphere(subdivisions=1))
    both = sparse.lil_array(sparse.block_diag([stiffness, stiffness]))
    both[0, len(mass)] = both[len(mass), 0] = -1e-17
    with pytest.raises(ValueError, match="expected 1 connected component, got 2"):
        eigenpairs(
            sparse.csr_array(both),
            np.r_[mass, mass],
            10,
        )


def test_what_is_refused(torus_problem):
    stiffness, mass, positions = torus_problem
    n_vertices = len(mass)

    def changed(value):
        return np.where(
            np.arange(n_vertices) == 3,
            value,
            mass,
        )

    broken = stiffness.copy()
    broken.data[5] = np.nan
    lopsided = stiffness.copy()
    lopsided[0, lopsided.indices[1]] += 0.1
    with pytest.raises(ValueError, match="n_eigenpairs: expected at least 1, got 0"):
        eigenpairs(stiffness, mass, 0)
    with pytest.raises(ValueError, match=r"n_eigenpairs: expected a whole number, got 2\.5\."):
        eigenpairs(stiffness, mass, 2.5)
    with pytest.raises(ValueError, match="Compute fewer eigenpairs"):
        eigenpairs(stiffness, mass, n_vertices - 1)
    with pytest.raises(ValueError, match="stiffness: expected finite entries"):
        eigenpairs(broken, mass, 5)
    for bad in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="mass: expected finite entries > 0"):
            eigenpairs(stiffness, changed(bad), 5)
    with pytest.raises(ValueError, match="stiffness: expected a symmetric matrix"):
        eigenpairs(lopsided, mass, 5)
    with pytest.raises(ValueError, match="sum to zero"):
        eigenpairs(stiffness + sparse.diags_array(mass), mass, 5)
    with pytest.raises(ValueError, match="scipy sparse"):
        eigenpairs(stiffness.toarray(), mass, 5)
    with pytest.raises(ValueError, match=r"expected \(V, V\) and \(V,\), got"):
        eigenpairs(stiffness, mass[1:], 5)
    with pytest.raises(ValueError, match="positions"):
        eigenpairs(
            stiffness,
            mass,
            5,
            positions=positions[1:],
        )
    with pytest.raises(ValueError, match="Pass -stiffness"):
        eigenpairs(-stiffness, mass, 5)
    with pytest.raises(ValueError, match=r"not diagonal\. Lump it"):
        eigenpairs(stiffness, abs(stiffness), 5)
    with pytest.raises(ValueError, match="not diagonal"):
        eigenpairs(
            stiffness,
            sparse.diags_array(mass).tocsr()[:, :-1],
            5,
        )
