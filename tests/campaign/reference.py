"""An independent reference for the numbers of a mesh: libigl's matrices, a dense eigensolver and NumPy loops."""

from dataclasses import replace
from itertools import combinations_with_replacement

import igl
import numpy as np
import scipy.linalg
import scipy.sparse.linalg
import torch
import trimesh
from numpy.linalg import det, norm
from numpy.typing import NDArray

from igps import PairHistogram, SpectralEmbedding, collate, compute_signature
from igps.descriptors.literature.d2 import D2
from igps.nn.axes import InteriorDistance, Potential

Floats = NDArray[np.float64]
Surface = tuple[Floats, NDArray[np.int64]]

N_CLASSES, N_BINS, REACH = 4, 16, 4.0
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
    batch = collate([signature])
    histograms = _describe(signature)
    for name, value in histograms.items():
        check(
            f"{name} sum",
            bool(np.isfinite(value).all() and abs(value.sum() - 1) < 1e-5),
            f"{value.sum()}",
        )
    batch_area = float(batch.area[0])
    reference, doubtful = distances_histogram(
        batch.surface.points[0].double().numpy() / np.sqrt(batch_area)
    )
    error = np.abs(histograms["d2"] - reference).sum() / 2
    check("d2", error < 1e-5 + doubtful, f"{error:.2g} of the pairs are in other bins")
    if len(signature.interior) > 1:
        reference, doubtful = interior_histogram(
            signature.interior.eigenfunctions / np.sqrt(values)
        )
        error = np.abs(histograms["interior"] - reference).sum() / 2
        check(
            "interior histogram",
            error < 1e-4 + doubtful,
            f"{error:.2g} of the pairs are in other cells",
        )
    _check_motion(mesh, signature, histograms, config, check)
    return doubts, checks


def _check_motion(mesh, signature, histograms, config, check):
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
    for name, value in _describe(moved).items():
        error = np.abs(value - histograms[name]).sum() / 2
        check(f"{name} moved", error < 0.02, f"{error:.2g} of the pairs are in other cells")


def _describe(signature):
    batch = collate([signature])
    histograms = {"d2": D2()(batch)[0].double().numpy()}
    if len(signature.interior) > 1:
        embedding = SpectralEmbedding(n_eigenpairs=len(signature.eigenvalues))
        histogram = PairHistogram(
            [Potential(N_CLASSES), InteriorDistance(N_BINS, REACH)], embedding
        )
        with torch.inference_mode():
            histograms["interior"] = histogram(batch)[0].double().numpy()
    return histograms


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


def mean_values(vertices, faces, points, functions):
    """(P, K) mean value interpolation of functions (V, K), point by point (Ju, Schaefer and Warren 2005)."""
    values = np.empty((len(points), functions.shape[1]))
    for i, point in enumerate(points):
        offset = vertices - point
        distance = norm(offset, axis=1)
        u = (offset / distance[:, None])[faces]
        sides = norm(
            np.roll(u, -1, axis=1) - np.roll(u, -2, axis=1),
            axis=2,
        )
        angles = 2 * np.arcsin(np.clip(sides / 2, 0, 1))
        half = angles.sum(axis=1, keepdims=True) / 2
        sines = np.sin(angles)
        sine_after = np.roll(sines, -1, axis=1)
        sine_before = np.roll(sines, -2, axis=1)
        cosines = 2 * np.sin(half) * np.sin(half - angles) / (sine_after * sine_before) - 1
        signed_sines = np.sign(det(u))[:, None] * np.sqrt(np.clip(1 - cosines**2, 0, None))
        numerators = (
            angles
            - np.roll(cosines, -1, axis=1) * np.roll(angles, -2, axis=1)
            - np.roll(cosines, -2, axis=1) * np.roll(angles, -1, axis=1)
        )
        weights = numerators / (distance[faces] * sine_after * np.roll(signed_sines, -2, axis=1))
        # A face does not count for points in its plane outside the face.
        weights[(np.abs(signed_sines) < 1e-7).any(axis=1)] = 0
        total = np.bincount(faces.ravel(), weights.ravel(), len(vertices))
        values[i] = total @ functions / total.sum()
    return values


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


def distances_histogram(points, n_bins=64, reach=2.0):
    """D2 by a loop, and the share of distances so close to an edge of a bin that their bin depends on rounding."""
    counts = np.zeros(n_bins)
    doubtful = 0
    for i in range(len(points)):
        positions = norm(points[i + 1 :] - points[i], axis=1) * n_bins / reach
        for position in positions:
            counts[min(int(position), n_bins - 1)] += 1
            doubtful += abs(position - round(position)) < 1e-3
    return counts / counts.sum(), doubtful / counts.sum()


def interior_histogram(embedding):
    """The histogram of Rustamov 2010 by loops, and the share of pairs whose class depends on rounding."""
    embedding = np.asarray(embedding, dtype=np.float64)
    level = norm(embedding, axis=1) * N_CLASSES / 1.5
    classes = np.minimum(level.astype(int), N_CLASSES - 1)
    rows = {pair: i for i, pair in enumerate(combinations_with_replacement(range(N_CLASSES), 2))}
    histogram = np.zeros((len(rows), N_BINS))
    for i in range(len(embedding)):
        distances = norm(embedding[i + 1 :] - embedding[i], axis=1)
        positions = np.clip(distances * N_BINS / REACH - 0.5, 0, N_BINS - 1)
        for j, position in enumerate(positions, start=i + 1):
            row = rows[tuple(sorted((classes[i], classes[j])))]
            lower = int(position)
            histogram[row, lower] += 1 - (position - lower)
            if position > lower:
                histogram[row, lower + 1] += position - lower
    near = np.abs(level - np.rint(level)) < 1e-5
    return histogram / histogram.sum(), float(2 * near.mean())
