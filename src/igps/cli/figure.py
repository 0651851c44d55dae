"""`igps figure pose`, `igps figure topology` and `igps figure potential`: the figures of Rustamov 2010."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from igps.cli.reading import labelled_meshes, signatures
from igps.data.sources import MeshFiles
from igps.geometry.coordinates import extend
from igps.geometry.laplacian import laplacian
from igps.geometry.mesh import Mesh
from igps.geometry.reading import MeshReading, load_mesh
from igps.geometry.voxels import grid_axes, inside_grid, interior_samples
from igps.geometry.weld import facing_vertices
from igps.geometry.weld import weld as weld_at
from igps.linalg import Spectrum, eigenpairs
from igps.nn.descriptor import VolumetricDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.extraction import describe
from igps.nn.histogram import PairHistogram
from igps.retrieval import chi_square

# Cells along the longest side of a slice: finer than the picture can show.
_SLICE_RESOLUTION = 300


def pose(root: Path, classes: list[str] | None = None, out: Path = Path("pose.png"), **reading: Any) -> None:
    """Draw the distribution of interior distances of every mesh of some classes (Rustamov 2010, figure 1).

    One potential class, 64 bins, one curve a mesh, one colour a class: the poses of one body lie together, other bodies
    apart. Prints the median chi-square distance between meshes of a class, and from them to those of the others.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        classes: which to draw; all if not given.
        out: the picture, a PNG file.
    """
    files = labelled_meshes(root)
    known = sorted(set(files.labels or ()))
    classes = classes or known
    unknown = [name for name in classes if name not in known]
    if unknown:
        raise ValueError(f"classes: {root} has no class {unknown[0]}. It has {', '.join(known)}.")
    dataset, failures = signatures(_of_classes(files, classes), **reading)
    layout = PairHistogram(n_classes=1, n_bins=64)
    histograms = describe(dataset, VolumetricDescriptor(SpectralEmbedding(), layout), progress=True)[:, 0]
    labels = np.array(dataset.files.labels)
    classes = [name for name in classes if name in labels]

    from igps.figures.paper import pose_histograms

    pose_histograms(
        {name: histograms[torch.from_numpy(labels == name)].numpy() for name in classes},
        layout.distance_centres.start.numpy(),
        out,
    )
    distances = chi_square(histograms, histograms).numpy()
    width = max(len(name) for name in classes)
    print(f"{'class':<{width}}  meshes  within  to others   median chi-square distance of the curves")
    for name in classes:
        own = labels == name
        within = distances[np.ix_(own, own)][~np.eye(own.sum(), dtype=bool)]
        print(f"{name:<{width}}  {own.sum():>6}  {_median(within)}  {_median(distances[np.ix_(own, ~own)]):>9}")
    if failures:
        print(f"{len(failures)} meshes could not be used.")
    print(f"written to {out}")


def topology(
    mesh: Path,
    weld: list[int] | None = None,
    out: Path = Path("topology.png"),
    n_eigenpairs: int = 250,
    resolution: int = 32,
    repair: bool = False,
) -> None:
    """Weld two places of a body, and draw how its interior distances change (Rustamov 2010, figure 2).

    The weld is a triangular tube between two vertices, which adds one to the genus. The distances are those between the
    same interior samples before and after.

    Args:
        mesh: the body.
        weld: indices of the two vertices, from 0; if not given, two that face each other across a narrow gap and are
            far apart along the surface.
        out: the picture, a PNG file.
        n_eigenpairs: eigenpairs of the embedding; 250 in the paper.
        resolution: voxels along the longest side, one sample each; 32 in the paper.
        repair: weld vertices, drop degenerate, duplicate and unused elements, and orient the faces of the mesh
    """
    if weld is not None and len(weld) != 2:
        raise ValueError(f"weld: expected the indices of two vertices, got {len(weld)}.")
    before = load_mesh(mesh, MeshReading(repair=repair))
    a, b = weld or facing_vertices(before)
    after = weld_at(before, a, b)
    points = interior_samples(before, resolution)
    if len(points) < 2:
        raise ValueError(f"resolution: one interior sample of {mesh} makes no pair. Raise it.")
    eigenvalues, distances = [], []
    for body in (before, after):
        spectrum = _spectrum(body, n_eigenpairs)
        eigenvalues.append(spectrum.eigenvalues)
        distances.append(pdist(_embed(body, spectrum, points)))
    change = np.abs(distances[1] / distances[0] - 1)

    from igps.figures.paper import weld_change

    weld_change(before, after, change, out)
    print(after.notes[-1])
    print(f"genus {before.genus} before, {after.genus} after")
    print(f"{len(points)} interior samples, {len(change)} pairs, {n_eigenpairs} eigenpairs")
    for limit, reported in ((3, "99.6 %"), (10, None), (14, "all")):
        beside = f" (Rustamov 2010, for Homer: {reported})" if reported else ""
        print(f"changed by less than {limit:>2} %: {100 * np.mean(change < limit / 100):.1f} % of the pairs{beside}")
    print(f"largest change: {100 * change.max():.1f} % (Rustamov 2010, for Homer: at most 14 %)")
    for when, values in zip(("before", "after"), eigenvalues, strict=True):
        print(f"first eigenvalues {when}: " + ", ".join(f"{value:.4g}" for value in values[:3]))
    print(f"written to {out}")


def potential(
    mesh: Path,
    out: Path = Path("potential.png"),
    n_eigenpairs: int = 250,
    resolution: int = 32,
    repair: bool = False,
) -> None:
    """Draw the barycentroid potential of a body on a plane through its barycentroid (Rustamov 2010, section 4).

    The plane is spanned by the two longest principal axes of the vertices.

    Args:
        mesh: the body.
        out: the picture, a PNG file.
        n_eigenpairs: eigenpairs of the embedding; 250 in the paper.
        resolution: voxels along the longest side, near the best of which the barycentroid is searched; 32 in the paper.
        repair: weld vertices, drop degenerate, duplicate and unused elements, and orient the faces of the mesh
    """
    from igps.figures.paper import potential_slice, upright

    body = load_mesh(mesh, MeshReading(repair=repair))
    body = Mesh(upright(body.vertices), body.faces, name=body.name)
    samples = interior_samples(body, resolution)
    x, y, _ = grid_axes(body, _SLICE_RESOLUTION)
    spectrum = _spectrum(body, n_eigenpairs)
    of_samples = np.linalg.norm(_embed(body, spectrum, samples), axis=1)
    coarse = samples[int(np.argmin(of_samples))]
    around = _around(body, coarse, np.ptp(body.vertices, axis=0).max() / resolution)
    of_around = np.linalg.norm(_embed(body, spectrum, around), axis=1)
    centre = around[int(np.argmin(of_around))]
    inside = inside_grid(body, (x, y, centre[2:]))[:, :, 0]
    i, j = np.nonzero(inside)
    points = np.stack([x[i], y[j], np.full(len(i), centre[2])], axis=1)
    values = np.full(inside.shape, np.nan)
    values[i, j] = np.linalg.norm(_embed(body, spectrum, points), axis=1)
    potential_slice((x, y), values, _section(body, centre[2]), centre[:2], out)
    print(f"{len(samples)} interior samples, {n_eigenpairs} eigenpairs")
    print(f"potential {of_around.min():.4f} at the barycentroid, up to {of_samples.max():.4f} at the samples")
    print(f"written to {out}")


def _of_classes(files: MeshFiles, classes: list[str]) -> MeshFiles:
    labels = files.labels or ()
    chosen = [i for i, label in enumerate(labels) if label in classes]
    return MeshFiles(
        tuple(files.paths[i] for i in chosen),
        tuple(files.names[i] for i in chosen),
        tuple(labels[i] for i in chosen),
    )


def _median(values: NDArray[np.float32]) -> str:
    return f"{np.median(values):6.3f}" if values.size else f"{'-':>6}"


def _spectrum(mesh: Mesh, n_eigenpairs: int) -> Spectrum:
    return eigenpairs(*laplacian(mesh), n_eigenpairs, positions=mesh.vertices)


def _embed(mesh: Mesh, spectrum: Spectrum, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, K) commute-time embedding of points in the body."""
    values = extend(mesh.vertices, mesh.faces, spectrum.eigenfunctions, points, accuracy=1e-3)
    return values / np.sqrt(spectrum.eigenvalues)


def _around(mesh: Mesh, point: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """Points of a fine cubic grid around a point in the body, those inside: (P, 3), with the point itself."""
    x, y, z = point[:, None] + reach * np.linspace(-1, 1, 9)
    index = np.nonzero(inside_grid(mesh, (x, y, z)))
    return np.stack([axis[i] for axis, i in zip((x, y, z), index, strict=True)], axis=1)


def _section(mesh: Mesh, height: float) -> NDArray[np.float64]:
    """(S, 2, 2) segments in which the plane z = height cuts the surface."""
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    segments = trimesh.intersections.mesh_plane(surface, plane_normal=[0, 0, 1], plane_origin=[0, 0, height])
    return np.asarray(segments)[:, :, :2]
