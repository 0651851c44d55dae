"""An independent reference for the numbers of a mesh: libigl's matrices, a dense eigensolver and NumPy loops."""

import sys
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import scipy.linalg
import scipy.sparse.linalg
import trimesh
from numpy.linalg import det
from numpy.typing import NDArray

from igps import compute_signature

sys.path.append(str(Path(__file__).parents[1]))
from loops import mean_values

Floats = NDArray[np.float64]
Surface = tuple[Floats, NDArray[np.int64]]

# Smallest ratio of twice the area of a face to its longest side squared. The library mollifies thinner faces and libigl
# does not; rounding errors of the cotangents of thin faces differ between formulas.
_MIN_ASPECT = 1e-5
_ROUNDING = 1e-9
# Largest number of vertices for the dense eigensolver
_MAX_DENSE = 500
# Number of samples at which the extension is checked
_N_CHECKED = 25


def confirm(mesh, signature, written, config, suffix):
    """Compare a signature with the reference.

    Args:
        mesh: the mesh as read.
        signature: of the mesh.
        written: the arrays in the file; None if the file was broken or the mesh repaired afterwards.
        config: of the signature.
        suffix: of the file.

    Returns:
        Sentences about numbers that are not confirmed, and the names of the confirmed numbers.
    """
    doubts = []
    checks = []

    def check(name, is_confirmed, doubt=""):
        if is_confirmed:
            checks.append(name)
        else:
            doubts.append(f"{name}: {doubt}")

    vertices, faces, scale = _in_unit_scale(mesh)
    if written is not None and suffix != ".stl":  # STL files repeat the vertices of each face
        check("arrays", *_same_arrays(mesh, written, single=suffix == ".glb"))
    check("topology", *_is_surface(vertices, faces, mesh.allow_open))
    area, volume = _area_and_volume(vertices, faces)
    for name, value, unit, power in (
        ("area", signature.area, area, 2),
        ("volume", signature.volume, volume, 3),
    ):
        expected = _scaled(unit, scale, power)
        rounding = 1e-12 * area / unit if unit > 0 else np.inf
        check(
            name, _close(value, expected, _ROUNDING + rounding), f"{value!r}, expected {expected!r}"
        )
    values = signature.eigenvalues
    in_unit = np.array([_scaled(value, scale, 2) for value in values])
    check(
        "finite",
        all(
            np.isfinite(x).all()
            for x in (values, signature.interior.eigenfunctions, signature.surface.eigenfunctions)
        ),
        "eigenvalues or eigenfunctions are not",
    )
    check(
        "ascending",
        bool((np.diff(values) >= 0).all() and values[0] > 0),
        f"{values}",
    )
    well_shaped = bool(_thinness(vertices, faces).min() > _MIN_ASPECT)
    functions = None
    if well_shaped:
        expected, functions = eigenpairs(vertices, faces, config.n_eigenpairs + 1)
        error = np.abs(in_unit / expected[: config.n_eigenpairs] - 1).max()
        check("eigenvalues", error < 1e-5, f"relative error {error:.2g}")
    closed = trimesh.Trimesh(vertices, faces, process=False).is_watertight
    if closed:
        check(
            "interior samples",
            *_samples_confirmed(mesh, signature, vertices, faces, config.resolution),
        )
    if functions is not None and expected[-1] / expected[-2] > 1 + 1e-3:
        # The accuracy holds inside closed surfaces. Next to openings, only the closed form reaches it.
        exact = signature if closed else compute_signature(mesh, replace(config, accuracy=None))
        checked = np.linspace(
            0, len(exact.interior) - 1, min(_N_CHECKED, len(exact.interior))
        ).astype(int)
        potential = np.square(exact.interior.eigenfunctions[checked].astype(np.float64)) @ (
            1 / values
        )
        points = (exact.interior.points[checked] - _centre(mesh)) / scale
        extended = mean_values(vertices, faces, points, functions[:, :-1])
        reference = np.square(extended) @ (1 / expected[:-1])
        error = np.abs(potential - reference).max() / np.abs(reference).max()
        check("extension", error < 1e-3, f"the potential of a sample is off by {error:.2g}")
    _check_motion(mesh, signature, config, check)
    return doubts, checks


def _check_motion(mesh, signature, config, check):
    """Check that a quarter turn, which maps the grid to itself, and a shift leave the numbers as they are."""
    turn = np.array(
        [
            [0.0, -1.0, 0.0],
            [0.0, 0.0, -1.0],
            [1.0, 0.0, 0.0],
        ]
    )
    centred = mesh.vertices - _centre(mesh)
    shift = np.ptp(mesh.vertices, axis=0).max() * np.array([0.37, -0.61, 0.23])
    moved_mesh = replace(mesh, vertices=centred @ turn.T + shift)
    moved = compute_signature(moved_mesh, config)
    for name in ("area", "volume"):
        before = getattr(signature, name)
        after = getattr(moved, name)
        check(f"{name} moved", _close(before, after, 1e-6), f"{before!r} and {after!r}")
    error = np.abs(moved.eigenvalues / signature.eigenvalues - 1).max()
    # The cotangents of thin faces are differences of squares, whose rounding errors change with a shift.
    check("eigenvalues moved", error < 1e-4, f"relative difference {error:.2g}")


def _centre(mesh):
    return (mesh.vertices.min(axis=0) / 2 + mesh.vertices.max(axis=0) / 2).astype(np.float64)


def _in_unit_scale(mesh):
    centred = mesh.vertices - _centre(mesh)
    scale = float(np.abs(centred).max())
    return centred / scale, np.asarray(mesh.faces), scale


def _scaled(value, scale, power):
    """value · scale ** power, without overflow of the power itself."""
    with np.errstate(all="ignore"):
        for _ in range(power):
            value = float(np.float64(value) * scale)
    return value


def _close(value, expected, tolerance):
    return bool(
        np.isfinite(value) and value > 0 and abs(value - expected) <= tolerance * abs(expected)
    )


def _same_arrays(mesh, written, single):
    vertices, faces = written
    if single:
        vertices = vertices.astype(np.float32).astype(np.float64)
    if mesh.vertices.shape != vertices.shape or mesh.faces.shape != faces.shape:
        return (
            False,
            f"{len(mesh.vertices)} vertices and {len(mesh.faces)} faces of {len(vertices)} and {len(faces)}",
        )
    same_faces = np.array_equal(mesh.faces, faces) or np.array_equal(mesh.faces, faces[:, ::-1])
    return bool(np.array_equal(mesh.vertices, vertices) and same_faces), "other than those written"


def _is_surface(vertices, faces, allow_open):
    """Whether a surface is closed (unless it may be open), connected and oriented, without edges of three faces."""
    surface = trimesh.Trimesh(vertices, faces, process=False)
    edges, count = np.unique(
        np.sort(surface.edges, axis=1),
        axis=0,
        return_counts=True,
    )
    n_components = (
        trimesh.graph.connected_component_labels(edges, node_count=len(vertices)).max() + 1
    )
    is_surface = (
        (surface.is_watertight or allow_open)
        and surface.is_winding_consistent
        and count.max() <= 2
        and n_components == 1
        and len(np.unique(faces)) == len(vertices)
    )
    return bool(
        is_surface
    ), f"trimesh finds {n_components} components and an edge of {count.max()} faces"


def _area_and_volume(vertices, faces):
    area = float(igl.doublearea(vertices, faces).sum() / 2)
    corners = (vertices - vertices.mean(axis=0))[faces]
    return area, float(det(corners).sum() / 6)


def _thinness(vertices, faces):
    lengths = igl.edge_lengths(vertices, faces)
    return np.asarray(igl.doublearea(vertices, faces) / np.square(lengths).max(axis=1))


def eigenpairs(vertices, faces, n_eigenpairs):
    """Eigenpairs (K,) and (V, K) of libigl's cotangent stiffness and mixed Voronoi mass, without the zero mode.

    They are computed by a dense solver, or for larger surfaces by ARPACK with a shift below the spectrum.
    """
    stiffness = -igl.cotmatrix(vertices, faces)
    mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    root = scipy.sparse.diags(1 / np.sqrt(mass))
    symmetric = (root @ stiffness @ root).tocsc()
    if len(vertices) <= _MAX_DENSE:
        values, vectors = scipy.linalg.eigh(symmetric.toarray(), subset_by_index=[1, n_eigenpairs])
    else:
        start = np.sqrt(mass) * (1 + vertices[:, 0] ** 2 + vertices[:, 1])
        values, vectors = scipy.sparse.linalg.eigsh(
            symmetric, n_eigenpairs + 1, sigma=-0.1 / mass.sum(), v0=start
        )
        order = np.argsort(values)[1:]
        values = values[order]
        vectors = vectors[:, order]
    return values, root @ vectors


def _samples_confirmed(mesh, signature, vertices, faces, resolution):
    """Whether the samples are the cell centres of winding number above one half, except for centres on the surface."""
    low = vertices.min(axis=0)
    high = vertices.max(axis=0)
    cell = (high - low).max() / resolution
    counts = np.maximum(np.ceil((high - low) / cell - 1e-6), 1).astype(int)
    axes = [
        (low[i] + high[i]) / 2 + (np.arange(n) - (n - 1) / 2) * cell for i, n in enumerate(counts)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    winding = igl.winding_number(vertices, faces, grid)
    squared, *_ = igl.point_mesh_squared_distance(grid, vertices, faces)
    is_off_surface = np.sqrt(squared) > 1e-6 * cell
    certain = grid[(winding > 0.5) & is_off_surface]
    possible = grid[(winding > 0.5) | ~is_off_surface]
    scale = np.abs(mesh.vertices - _centre(mesh)).max()
    points = (signature.interior.points - _centre(mesh)) / scale

    def cells(centres):
        return {
            tuple(index)
            for index in np.rint((centres - [axis[0] for axis in axes]) / cell).astype(int)
        }

    missing = cells(certain) - cells(points)
    outside = cells(points) - cells(possible)
    return (
        not missing and not outside,
        f"{len(missing)} missing, {len(outside)} not inside, of {len(points)}",
    )
