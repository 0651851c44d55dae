"""What the figures of Rustamov 2010 show: poses, a change of topology, and the potential on a slice."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from scipy.spatial.distance import pdist
from tqdm import tqdm

from igps._arrays import Floats, Singles
from igps._threads import one_thread
from igps.data.dataset import SignatureDataset
from igps.mesh.mesh import Mesh
from igps.mesh.surface import longest_side
from igps.nn.axes import InteriorDistance
from igps.nn.description import describe
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram
from igps.retrieval import chi_square
from igps.signature.laplacian import laplacian
from igps.signature.mean_value import Extension
from igps.signature.voxels import grid_axes, inside_grid, interior_samples
from igps.spectra import Spectrum, eigenpairs
from training.studies.weld import facing_vertices, weld

# Cells along the longest side of a slice: finer than a picture can show.
_SLICE_RESOLUTION = 300
# In which it is computed, so that a bar moves
_SLICE_PARTS = 4


@dataclass(frozen=True, eq=False)
class PoseCurves:
    """The distribution of interior distances of every mesh of some classes (figure 1)."""

    curves: dict[str, Singles]  # by class, (N, B) histograms of one potential class
    centres: Singles  # (B,) of the bins
    within: dict[str, Singles]  # by class, the χ² distances between two of its meshes
    to_others: dict[str, Singles]  # by class, those from its meshes to the meshes of the other classes


def pose_curves(dataset: SignatureDataset, classes: Sequence[str], n_bins: int = 64) -> PoseCurves:
    """Rustamov 2010, figure 1: one potential class, 64 bins.

    Args:
        dataset: labelled meshes, of these classes alone.
        classes: in the order of the result; those without a mesh are left out.
        n_bins: B.
    """
    axis = InteriorDistance(n_bins)
    histogram = PairHistogram([axis], SpectralEmbedding(n_eigenpairs=dataset.config.n_eigenpairs))
    histograms = describe(dataset, HistogramDescriptor(histogram), progress=True)[:, 0]
    labels = np.array(dataset.bodies.labels)
    distances = chi_square(histograms, histograms).numpy()
    members = {name: labels == name for name in classes if name in labels}
    return PoseCurves(
        curves={name: histograms[torch.from_numpy(own)].numpy() for name, own in members.items()},
        centres=axis.centres.start.numpy(),
        within={name: distances[np.ix_(own, own)][~np.eye(own.sum(), dtype=bool)] for name, own in members.items()},
        to_others={name: distances[np.ix_(own, ~own)].ravel() for name, own in members.items()},
    )


@dataclass(frozen=True, eq=False)
class WeldChange:
    """What a weld does to a body (figure 2)."""

    before: Mesh
    after: Mesh  # with the weld
    n_samples: int  # interior samples, the same in both
    change: Floats  # of each pair of them, the relative change of its interior distance
    eigenvalues: tuple[Floats, Floats]  # (K,) before and after, 1/length²


@one_thread()
def weld_change(
    body: Mesh,
    ends: tuple[int, int] | None = None,
    n_eigenpairs: int = 250,
    resolution: int = 32,
    *,
    progress: bool = False,
) -> WeldChange:
    """Rustamov 2010, figure 2: interior distances before and after two places are joined by a triangular tube.

    Args:
        body: to be welded.
        ends: vertices of the weld; two that face each other across a narrow gap if None, see `facing_vertices`.
        n_eigenpairs: of the embedding.
        resolution: voxels along the longest side, one sample each.
        progress: show a bar.

    Raises:
        ValueError: fewer than two samples.
    """
    with tqdm(total=6, desc="steps", disable=not progress) as bar:
        after = weld(body, *(ends or facing_vertices(body)))
        bar.update()
        points = interior_samples(body, resolution)
        bar.update()
        if len(points) < 2:
            raise ValueError(f"resolution: one interior sample of {body.name} makes no pair. Raise it.")
        eigenvalues, distances = [], []
        for one in (body, after):
            spectrum = _spectrum(one, n_eigenpairs)
            eigenvalues.append(spectrum.eigenvalues)
            bar.update()
            distances.append(pdist(_embedding(one, spectrum)(points)))
            bar.update()
    change = np.abs(distances[1] / distances[0] - 1)
    return WeldChange(body, after, len(points), change, (eigenvalues[0], eigenvalues[1]))


@dataclass(frozen=True, eq=False)
class PotentialSlice:
    """The barycentroid potential on a plane through the barycentroid (section 4)."""

    axes: tuple[Floats, Floats]  # (X,) and (Y,) of the slice, length
    values: Floats  # (X, Y) potential, NaN outside the body
    section: Floats  # (S, 2, 2) segments in which the plane cuts the surface
    barycentroid: Floats  # (2,) on the slice
    least: float  # potential at the barycentroid
    largest: float  # potential at the samples
    n_samples: int  # interior samples, near the best of which the barycentroid was searched


@one_thread()
def potential_slice(
    body: Mesh, n_eigenpairs: int = 250, resolution: int = 32, *, progress: bool = False
) -> PotentialSlice:
    """The potential on the horizontal plane through the barycentroid of a body.

    Args:
        body: turned as it is to be cut.
        n_eigenpairs: of the embedding.
        resolution: voxels along the longest side, near the best of which the barycentroid is searched.
        progress: show a bar.
    """
    with tqdm(total=3 + _SLICE_PARTS, desc="steps", disable=not progress) as bar:
        samples = interior_samples(body, resolution)
        x, y, _ = grid_axes(body, _SLICE_RESOLUTION)
        embedding = _embedding(body, _spectrum(body, n_eigenpairs))
        bar.update()
        of_samples = np.linalg.norm(embedding(samples), axis=1)
        bar.update()
        coarse = samples[int(np.argmin(of_samples))]
        around = _around(body, coarse, longest_side(body.vertices) / resolution)
        of_around = np.linalg.norm(embedding(around), axis=1)
        bar.update()
        centre = around[int(np.argmin(of_around))]
        inside = inside_grid(body, (x, y, centre[2:]))[:, :, 0]
        i, j = np.nonzero(inside)
        points = np.stack([x[i], y[j], np.full(len(i), centre[2])], axis=1)
        values = np.full(inside.shape, np.nan)
        for part in np.array_split(np.arange(len(points)), _SLICE_PARTS):
            values[i[part], j[part]] = np.linalg.norm(embedding(points[part]), axis=1)
            bar.update()
    return PotentialSlice(
        axes=(x, y),
        values=values,
        section=_section(body, centre[2]),
        barycentroid=centre[:2],
        least=float(of_around.min()),
        largest=float(of_samples.max()),
        n_samples=len(samples),
    )


def _spectrum(mesh: Mesh, n_eigenpairs: int) -> Spectrum:
    return eigenpairs(*laplacian(mesh), n_eigenpairs, positions=mesh.vertices)


def _embedding(mesh: Mesh, spectrum: Spectrum) -> Extension:
    """Of points (P, 3) in the body: their commute-time embedding (P, K)."""
    roots = np.sqrt(spectrum.eigenvalues)
    return Extension(mesh.vertices, mesh.faces, spectrum.eigenfunctions, divisors=roots, accuracy=1e-3)


def _around(mesh: Mesh, point: Floats, reach: float) -> Floats:
    """Points of a fine cubic grid around a point in the body, those inside: (P, 3), with the point itself."""
    x, y, z = point[:, None] + reach * np.linspace(-1, 1, 9)
    index = np.nonzero(inside_grid(mesh, (x, y, z)))
    return np.stack([axis[i] for axis, i in zip((x, y, z), index, strict=True)], axis=1)


def _section(mesh: Mesh, height: float) -> Floats:
    """(S, 2, 2) segments in which the plane z = height cuts the surface."""
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    segments = trimesh.intersections.mesh_plane(surface, plane_normal=[0, 0, 1], plane_origin=[0, 0, height])
    return np.asarray(segments)[:, :, :2]
