"""The pictures of concepts.md, after the figures of Rustamov (2010).

python -m docs.concepts pose ROOT --classes '[armadillo, cup, ant]'
python -m docs.concepts topology MESH --weld_at '[A, B]'
python -m docs.concepts potential MESH
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from docs.benchmarks.weld import TUBE_FACES, facing_vertices, weld
from jsonargparse import auto_cli
from scipy.spatial.distance import pdist
from training.generated import usable_shapes

import igps
from igps._arrays import Floats, Integers
from igps._threads import one_thread
from igps.cli import errors_as_messages
from igps.mesh.surface import longest_side
from igps.nn.axes import InteriorDistance
from igps.nn.description import describe
from igps.report.drawing import GREY, PALETTE, new_figure, paint
from igps.retrieval import chi_square
from igps.signature.laplacian import laplacian
from igps.signature.mean_value import Extension
from igps.signature.voxels import grid_axes, inside_grid, interior_samples
from igps.spectra import Spectrum, eigenpairs

N_EIGENPAIRS = 250
RESOLUTION = 32  # voxels along the longest side
SLICE_RESOLUTION = 300  # cells along the longest side of a slice: finer than the picture shows
ORANGE = (0.84, 0.37, 0.0)
STYLES = ("-", "--", "-.", ":")
DPI = 100
# Reported by Rustamov 2010 for Homer with welded feet: change in percent, and the share of pairs that change less.
REPORTED = ((3, "99.6 %"), (14, "all"))


def pose(
    root: Path,
    classes: list[str] | None = None,
    out: Path = Path("pose.png"),
    config: igps.SignatureConfig | None = None,
    cache_dir: Path | None = None,
) -> None:
    """Draw the distribution of interior distances of every mesh of some classes (figure 1).

    Histograms have one potential class and 64 bins. There is one curve for each mesh, and one colour for each class.
    Poses of the same body have similar curves, other bodies different ones. The median chi-square distances within and
    between classes are printed.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        classes: classes to draw; by default all.
        out: the picture, a PNG file.
        config: what the signatures hold.
        cache_dir: folder of cached signatures; by default the user's cache directory.
    """
    config = config or igps.SignatureConfig(n_eigenpairs=N_EIGENPAIRS)
    dataset = igps.SignatureDataset(root, config, cache_dir)
    known = dataset.classes
    classes = classes or list(known)
    unknown = [name for name in classes if name not in known]
    if unknown:
        raise ValueError(f"classes: {root} has no class {unknown[0]}. It has {', '.join(known)}.")
    chosen = [i for i, label in enumerate(dataset.bodies.labels or ()) if label in classes]
    dataset = usable_shapes(dataset.subset(chosen))
    axis = InteriorDistance(64)
    embedding = igps.SpectralEmbedding(n_eigenpairs=config.n_eigenpairs)
    descriptor = igps.HistogramDescriptor(igps.PairHistogram([axis], embedding))
    histograms = describe(dataset, descriptor, progress=True)[:, 0]
    distances = chi_square(histograms, histograms).numpy()
    labels = np.array(dataset.bodies.labels)
    centres = axis.centres.start.numpy()

    figure = new_figure(7.5, 4.2)
    axes = figure.add_subplot()
    print("class, meshes, median chi-square distance within the class and to others")
    for i, name in enumerate(classes):
        own = labels == name
        curves = 100 * histograms[torch.from_numpy(own)].numpy().T
        style = STYLES[i % len(STYLES)]
        colour = PALETTE[i % len(PALETTE)]
        lines = axes.plot(centres, curves, style, color=colour, linewidth=0.8, alpha=0.8)
        lines[0].set_label(f"{name} ({own.sum()} bodies)")
        is_pair = np.triu(np.outer(own, own), 1)
        within = median(distances[is_pair])
        to_others = median(distances[np.outer(own, ~own)])
        print(f"{name} {own.sum()} {within} {to_others}")
    axes.set(xlim=(0, float(2 * centres[-1] - centres[-2])))
    axes.set_ylim(bottom=0)
    axes.set_xlabel("interior distance d̂ (commute time, no unit); the last bin counts all beyond")
    axes.set_ylabel(f"pairs of interior points in a bin of {centres[1] - centres[0]:.3g} (%)")
    axes.set_title("One curve a body: all pairs of points of its interior by their distance")
    axes.grid(color="#DDDDDD", linewidth=0.6)
    legend = axes.legend(frameon=False, title="class")
    for handle in legend.get_lines():
        handle.set(linewidth=2, alpha=1)
    save(figure, out)


def median(values: Floats) -> str:
    """Format the median of numbers; "-" if there are none."""
    return f"{np.median(values):.3f}" if values.size else "-"


@one_thread()
def topology(
    mesh: Path,
    weld_at: tuple[int, int] | None = None,
    out: Path = Path("topology.png"),
    n_eigenpairs: int = N_EIGENPAIRS,
    resolution: int = RESOLUTION,
) -> None:
    """Weld two places of a body, and draw how its interior distances change (figure 2).

    The weld is a triangular tube between two vertices, which adds one to the genus. Distances between the same interior
    samples are compared before and after the weld.

    Args:
        mesh: the body.
        weld_at: indices of the two vertices, from 0; by default two that face each other across a narrow gap and are
            far apart along the surface.
        out: the picture, a PNG file.
        n_eigenpairs: eigenpairs of the embedding; 250 in the paper.
        resolution: voxels along the longest side, with one sample each; 32 in the paper.
    """
    before = igps.load_mesh(mesh)
    a, b = weld_at or facing_vertices(before)
    after = weld(before, a, b)
    points = interior_samples(before, resolution)
    distances = []
    print(after.notes[-1])
    for body in (before, after):
        spectrum = spectrum_of(body, n_eigenpairs)
        distances.append(pdist(commute_time(body, spectrum)(points)))
        first = ", ".join(f"{value:.4g}" for value in spectrum.eigenvalues[:3])
        print(f"genus {body.genus}, first eigenvalues {first}")
    change = 100 * np.abs(distances[1] / distances[0] - 1)
    print(f"{len(points)} interior samples, {len(change)} pairs, {n_eigenpairs} eigenpairs")
    for limit in (3, 10, 14):
        share = 100 * np.mean(change < limit)
        print(f"changed by less than {limit} %: {share:.1f} % of the pairs")
    print(f"largest change: {change.max():.1f} %")

    figure = new_figure(9.4, 3.9)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.7, 1, 1))
    draw_change(left, change)
    figure.legend(loc="outside lower left", frameon=False, fontsize=8)
    tube = after.faces[-TUBE_FACES:]
    turned = upright(before.vertices)
    paint(middle, turned, before.faces, GREY)
    place = turned[np.unique(tube), :2].mean(axis=0)
    middle.plot(*place, "o", markersize=16, markerfacecolor="none", color=ORANGE, mew=1.6)
    middle.set_title("the body; circled: the weld", fontsize=9)
    draw_tube(right, after, tube)
    save(figure, out)


def draw_change(panel: Any, change: Floats) -> None:
    """Draw the distribution of changes in percent, beside the figures of the paper."""
    end = max(np.ceil(change.max()), REPORTED[-1][0] + 1)
    weights = np.full(len(change), 100 / len(change))
    panel.hist(change, bins=np.linspace(0, end, 61), weights=weights, color=PALETTE[1])
    for (value, reported), style in zip(REPORTED, ("--", ":"), strict=True):
        share = 100 * np.mean(change < value)
        label = f"{value} %: {share:.1f} % of the pairs are left of this line (Rustamov 2010, for Homer: {reported})"
        panel.axvline(value, color="black", linestyle=style, linewidth=1.2, label=label)
    panel.set(yscale="log", xlim=(0, end))
    panel.set_xlabel("change of the interior distance, |after − before| / before (%)")
    panel.set_ylabel("pairs of interior points (%)")
    panel.set_title(f"{len(change):,} pairs, largest change {change.max():.0f} %")


def draw_tube(panel: Any, welded: igps.Mesh, tube: Integers) -> None:
    """Draw the surroundings of the tube as seen from outside the body; the tube lies across the picture."""
    first = welded.vertices[tube[:, 0]].mean(axis=0)
    last = welded.vertices[tube[:, 2]].mean(axis=0)
    middle = (first + last) / 2
    across = (last - first) / np.linalg.norm(last - first)
    away = middle - welded.vertices.mean(axis=0)
    away -= (away @ across) * across
    away /= np.linalg.norm(away)
    frame = np.stack([across, np.cross(away, across), away], axis=1)
    points = (welded.vertices - middle) @ frame
    reach = 2.5 * np.linalg.norm(points[np.unique(tube)], axis=1).max()
    paint(panel, points, welded.faces, GREY)
    for both_sides in (tube, tube[:, ::-1]):
        paint(panel, points, both_sides, ORANGE)
    panel.set(xlim=(-reach, reach), ylim=(-reach, reach))
    # The ends of the three edges along the tube.
    edges = welded.vertices[tube[1::2, 0]] - welded.vertices[tube[1::2, 2]]
    share = np.linalg.norm(edges, axis=1).mean() / longest_side(welded.vertices)
    title = f"the tube (orange, {TUBE_FACES} triangles),\n{share:.1%} of the body's extent"
    panel.set_title(title, fontsize=9)


@dataclass(frozen=True, eq=False)
class PotentialSlice:
    """The barycentroid potential on a plane through the barycentroid (section 4)."""

    axes: tuple[Floats, Floats]  # (X,) and (Y,) of the slice, length
    values: Floats  # (X, Y) potential, NaN outside the body
    section: Floats  # (S, 2, 2) segments in which the plane cuts the surface
    barycentroid: Floats  # (2,) position on the slice


def potential(
    mesh: Path,
    out: Path = Path("potential.png"),
    n_eigenpairs: int = N_EIGENPAIRS,
    resolution: int = RESOLUTION,
) -> None:
    """Draw the barycentroid potential of a body on a plane through its barycentroid (section 4).

    The plane is spanned by the two longest principal axes of the vertices.

    Args:
        mesh: the body.
        out: the picture, a PNG file.
        n_eigenpairs: eigenpairs of the embedding; 250 in the paper.
        resolution: voxels along the longest side; the barycentroid is searched near the best of them; 32 in the paper.
    """
    given = igps.load_mesh(mesh)
    body = igps.Mesh(upright(given.vertices), given.faces, name=given.name)
    found = potential_slice(body, n_eigenpairs, resolution)
    least = float(np.nanmin(found.values))
    largest = float(np.nanmax(found.values))
    print(f"potential {least:.4f} at the barycentroid, up to {largest:.4f} on the plane")
    draw_potential(found, out)


@one_thread()
def potential_slice(body: igps.Mesh, n_eigenpairs: int, resolution: int) -> PotentialSlice:
    """Compute the potential on the horizontal plane through the barycentroid of a body."""
    embedding = commute_time(body, spectrum_of(body, n_eigenpairs))
    samples = interior_samples(body, resolution)
    best = samples[np.linalg.norm(embedding(samples), axis=1).argmin()]
    # The points inside the body of a fine grid around the best sample.
    reach = longest_side(body.vertices) / resolution
    fine_axes = best[:, None] + reach * np.linspace(-1, 1, 9)
    near = np.stack(np.meshgrid(*fine_axes, indexing="ij"), axis=-1)
    candidates = near[inside_grid(body, tuple(fine_axes))]
    centre = candidates[np.linalg.norm(embedding(candidates), axis=1).argmin()]
    x, y, _ = grid_axes(body, SLICE_RESOLUTION)
    inside = inside_grid(body, (x, y, centre[2:]))[:, :, 0]
    i, j = np.nonzero(inside)
    points = np.stack([x[i], y[j], np.full(len(i), centre[2])], axis=1)
    values = np.full(inside.shape, np.nan)
    values[i, j] = np.linalg.norm(embedding(points), axis=1)
    surface = trimesh.Trimesh(body.vertices, body.faces, process=False)
    segments = trimesh.intersections.mesh_plane(surface, [0, 0, 1], [0, 0, centre[2]])
    return PotentialSlice((x, y), values, np.asarray(segments)[:, :, :2], centre[:2])


def draw_potential(found: PotentialSlice, out: Path) -> None:
    """Draw the barycentroid potential on a plane through a body."""
    from matplotlib.collections import LineCollection
    from matplotlib.ticker import MaxNLocator

    x, y = found.axes
    low = found.section.min(axis=(0, 1))
    high = found.section.max(axis=(0, 1))
    extent = (high - low).max()
    margin = 0.04 * extent
    width, height = 5 * (high - low) / extent
    figure = new_figure(max(width, 2.6) + 2.2, max(height, 2) + 1.6)
    panel = figure.add_subplot(aspect="equal")
    levels = MaxNLocator(16).tick_values(np.nanmin(found.values), np.nanmax(found.values))
    inside = np.ma.masked_invalid(found.values.T)
    filled = panel.contourf(x, y, inside, levels=levels, cmap="cividis")
    panel.contour(x, y, inside, levels=levels, colors="white", linewidths=0.5)
    panel.add_collection(LineCollection(list(found.section), colors="black", linewidths=1.2))
    star = {"markersize": 14, "color": "white", "markeredgecolor": "black", "linestyle": "none"}
    panel.plot(*found.barycentroid, "*", label="barycentroid", **star)
    panel.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    panel.set_xlabel("length (unit of the mesh)")
    panel.set_ylabel("length (unit of the mesh)")
    step = levels[1] - levels[0]
    panel.set_title(f"Slice through the barycentroid;\na white line every {step:.2g}", fontsize=10)
    figure.colorbar(filled, ax=panel, label="barycentroid potential U (no unit)")
    figure.legend(loc="outside lower center", frameon=False)
    save(figure, out)


def spectrum_of(mesh: igps.Mesh, n_eigenpairs: int) -> Spectrum:
    """Return the eigenpairs of the surface."""
    stiffness, mass = laplacian(mesh)
    return eigenpairs(stiffness, mass, n_eigenpairs, positions=mesh.vertices)


def commute_time(mesh: igps.Mesh, spectrum: Spectrum) -> Extension:
    """Return the commute-time embedding: a function from points (P, 3) in the body to (P, K)."""
    roots = np.sqrt(spectrum.eigenvalues)
    functions = spectrum.eigenfunctions
    return Extension(mesh.vertices, mesh.faces, functions, divisors=roots, accuracy=1e-3)


def upright(vertices: Floats) -> Floats:
    """Rotate vertices (V, 3): the longest principal axis up, the next right, their largest components positive."""
    axes = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2]
    up, right = (axis * np.sign(axis[np.argmax(np.abs(axis))]) for axis in axes[:2])
    return vertices @ np.stack([right, up, np.cross(right, up)], axis=1)


def save(figure: Any, out: Path) -> None:
    """Save a picture, and print its path."""
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=DPI)
    print(f"written to {out}")


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli([pose, topology, potential])
