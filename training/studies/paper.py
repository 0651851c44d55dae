"""The data of the figures of Rustamov 2010: poses, a change of topology, and the potential on a slice."""

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

_SLICE_RESOLUTION = 300  # cells along the longest side of a slice: finer than the picture shows
_SLICE_PARTS = 4  # in which a slice is computed, to update the progress bar


@dataclass(frozen=True, eq=False)
class PoseCurves:
    """Distributions of interior distances of meshes by class (figure 1)."""

    curves: dict[str, Singles]  # by class, (N, B) histograms of one potential class
    centres: Singles  # (B,) centres of the bins
    within: dict[str, Singles]  # by class, χ² distances between its meshes
    to_others: dict[
        str, Singles
    ]  # by class, χ² distances from its meshes to those of other classes


def pose_curves(dataset: SignatureDataset, classes: Sequence[str], n_bins: int = 64) -> PoseCurves:
    """Compute figure 1 of Rustamov 2010: histograms of one potential class and 64 bins.

    Args:
        dataset: labelled meshes of these classes only.
        classes: names of classes, in the order of the result; classes without meshes are left out.
        n_bins: number of bins B.
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
        within={
            name: distances[np.ix_(own, own)][~np.eye(own.sum(), dtype=bool)]
            for name, own in members.items()
        },
        to_others={name: distances[np.ix_(own, ~own)].ravel() for name, own in members.items()},
    )


@dataclass(frozen=True, eq=False)
class WeldChange:
    """The change of a body by a weld (figure 2)."""

    before: Mesh
    after: Mesh  # with the weld
    n_samples: int  # interior samples, the same in both
    change: Floats  # relative changes of the interior distances between pairs of samples
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
    """Compute figure 2 of Rustamov 2010: interior distances before and after a triangular tube joins two places.

    Args:
        body: body to weld.
        ends: vertices of the weld; if None, two that face each other across a narrow gap, see `facing_vertices`.
        n_eigenpairs: number of eigenpairs of the embedding.
        resolution: voxels along the longest side, with one sample each.
        progress: show a progress bar.

    Raises:
        ValueError: fewer than two samples.
    """
    with tqdm(total=6, desc="steps", disable=not progress) as bar:
        after = weld(body, *(ends or facing_vertices(body)))
        bar.update()
        points = interior_samples(body, resolution)
        bar.update()
        if len(points) < 2:
            raise ValueError(
                f"resolution: expected two interior samples of {body.name}, got {len(points)}. Raise it."
            )
        eigenvalues, distances = [], []
        for mesh in (body, after):
            spectrum = _spectrum(mesh, n_eigenpairs)
            eigenvalues.append(spectrum.eigenvalues)
            bar.update()
            distances.append(pdist(_embedding(mesh, spectrum)(points)))
            bar.update()
    change = np.abs(distances[1] / distances[0] - 1)
    return WeldChange(body, after, len(points), change, (eigenvalues[0], eigenvalues[1]))


@dataclass(frozen=True, eq=False)
class PotentialSlice:
    """The barycentroid potential on a plane through the barycentroid (section 4)."""

    axes: tuple[Floats, Floats]  # (X,) and (Y,) of the slice, length
    values: Floats  # (X, Y) potential, NaN outside the body
    section: Floats  # (S, 2, 2) segments in which the plane cuts the surface
    barycentroid: Floats  # (2,) position on the slice
    least: float  # potential at the barycentroid
    largest: float  # largest potential at the samples
    n_samples: int  # number of interior samples


@one_thread()
def potential_slice(
    body: Mesh, n_eigenpairs: int = 250, resolution: int = 32, *, progress: bool = False
) -> PotentialSlice:
    """Compute the potential on the horizontal plane through the barycentroid of a body.

    Args:
        body: body in the orientation in which it is cut.
        n_eigenpairs: number of eigenpairs of the embedding.
        resolution: voxels along the longest side; the barycentroid is searched near the best of them.
        progress: show a progress bar.
    """
    with tqdm(total=3 + _SLICE_PARTS, desc="steps", disable=not progress) as bar:
        samples = interior_samples(body, resolution)
        x, y, _ = grid_axes(body, _SLICE_RESOLUTION)
        embedding = _embedding(body, _spectrum(body, n_eigenpairs))
        bar.update()
        sample_potentials = np.linalg.norm(embedding(samples), axis=1)
        bar.update()
        best_sample = samples[int(np.argmin(sample_potentials))]
        candidates = _grid_around(body, best_sample, longest_side(body.vertices) / resolution)
        potentials = np.linalg.norm(embedding(candidates), axis=1)
        bar.update()
        centre = candidates[int(np.argmin(potentials))]
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
        least=float(potentials.min()),
        largest=float(sample_potentials.max()),
        n_samples=len(samples),
    )


def _spectrum(mesh: Mesh, n_eigenpairs: int) -> Spectrum:
    return eigenpairs(*laplacian(mesh), n_eigenpairs, positions=mesh.vertices)


def _embedding(mesh: Mesh, spectrum: Spectrum) -> Extension:
    """Return the commute-time embedding: a function from points (P, 3) in the body to (P, K)."""
    roots = np.sqrt(spectrum.eigenvalues)
    return Extension(
        mesh.vertices, mesh.faces, spectrum.eigenfunctions, divisors=roots, accuracy=1e-3
    )


def _grid_around(mesh: Mesh, point: Floats, reach: float) -> Floats:
    """Return the points (P, 3) inside the body of a fine cubic grid around a point, including the point."""
    x, y, z = point[:, None] + reach * np.linspace(-1, 1, 9)
    index = np.nonzero(inside_grid(mesh, (x, y, z)))
    return np.stack([axis[i] for axis, i in zip((x, y, z), index, strict=True)], axis=1)


def _section(mesh: Mesh, height: float) -> Floats:
    """Return the segments (S, 2, 2) in which the plane z = height cuts the surface."""
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    segments = trimesh.intersections.mesh_plane(
        surface, plane_normal=[0, 0, 1], plane_origin=[0, 0, height]
    )
    return np.asarray(segments)[:, :, :2]
