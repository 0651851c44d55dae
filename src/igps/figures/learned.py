"""What a descriptor has learned, against where it started."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

from igps.figures import _figure
from igps.nn.bins import OrderedCentres
from igps.nn.descriptor import OrientedDescriptor, VolumetricDescriptor
from igps.nn.embedding import SpectralEmbedding, spectral_weights
from igps.nn.histogram import PairHistogram
from igps.nn.oriented import OrientedPairHistogram


def learned_layout(descriptor: nn.Module, path: str | Path) -> None:
    """Save a picture of the bin and class centres and of the spectral filter g(λ·area), learned and as they started.

    Args:
        descriptor: a `VolumetricDescriptor` or an `OrientedDescriptor`, or a `CombinedDescriptor` of such, which are
            drawn one a row.
        path: of the picture, such as layout.png.

    Raises:
        ValueError: a descriptor of other parts.
        ImportError: matplotlib is not installed.
    """
    parts = [part for part in descriptor.modules() if isinstance(part, VolumetricDescriptor | OrientedDescriptor)]
    rows = [(part.embedding, _centres(part.histogram)) for part in parts]
    known = all(isinstance(embedding, SpectralEmbedding | None) and centres for embedding, centres in rows)
    if not rows or not known:
        raise ValueError("descriptor: expected one made of the embeddings and histograms of this library.")
    n_columns = 1 + max(len(centres) for _, centres in rows)
    figure = _figure(4 * n_columns, 3.2 * len(rows))
    grid = figure.subplots(len(rows), n_columns, squeeze=False)
    for panels, (embedding, centres) in zip(grid, rows, strict=True):
        if isinstance(embedding, SpectralEmbedding):
            _filter(panels[0], embedding)
        else:
            panels[0].set_axis_off()
        for panel, (title, bins) in zip(panels[1:], centres.items(), strict=False):
            panel.plot(bins.start, bins.start, color="#888888", linestyle="--", label="start")
            panel.plot(bins.start, bins().detach(), color="#D55E00", marker=".", markersize=3, label="learned")
            panel.set(xlabel="centre at the start", ylabel="centre", title=title)
            panel.legend(frameon=False)
        for panel in panels[1 + len(centres) :]:
            panel.set_axis_off()
    figure.savefig(path, dpi=150)


def _filter(panel: Any, embedding: SpectralEmbedding) -> None:
    x = torch.logspace(0.5, 3.6, 200, dtype=torch.float64)
    area = torch.ones((), dtype=torch.float64)
    start = spectral_weights(x, area, embedding.kind, embedding.time)
    panel.loglog(x, start, color="#888888", linestyle="--", label="start")
    panel.loglog(x, embedding.weights(x, area).detach(), color="#0072B2", label="learned")
    panel.set(xlabel="eigenvalue × area", ylabel="weight of the eigenfunction g", title="spectral filter")
    panel.legend(frameon=False)


def _centres(histogram: nn.Module) -> dict[str, OrderedCentres]:
    if isinstance(histogram, OrientedPairHistogram):
        return {
            "bins of distance": histogram.distance_centres,
            "bins of the cosine to the line": histogram.towards_centres,
            "bins of the cosine between directions": histogram.between_centres,
        }
    if not isinstance(histogram, PairHistogram):
        return {}
    found = {
        "bins of interior distance": histogram.distance_centres,
        "classes of barycentroid potential": histogram.potential_centres,
    }
    for name, centres in histogram.attribute_centres.items():
        assert isinstance(centres, OrderedCentres)
        found[f"classes of {name}"] = centres
    if histogram.euclidean_centres is not None:
        found["bins of the second distance"] = histogram.euclidean_centres
    return found


def transfer_curve(curve: Mapping[int, Sequence[float]], plain: float, path: str | Path) -> None:
    """Save a picture of the first tier against the number of generated classes that a metric was fitted to.

    Args:
        curve: FT, fractions, of several draws by the number of classes.
        plain: FT of the plain distance.
        path: of the picture.

    Raises:
        ImportError: matplotlib is not installed.
    """
    figure = _figure(4.5, 3.2)
    axes = figure.subplots()
    counts = sorted(curve)
    means = [100 * sum(curve[n]) / len(curve[n]) for n in counts]
    axes.axhline(100 * plain, color="#888888", linestyle="--", label="plain distance")
    axes.plot(counts, means, color="#0072B2", label="pretrained, mean of the draws")
    for n in counts:
        axes.plot([n] * len(curve[n]), [100 * value for value in curve[n]], ".", color="#0072B2")
    axes.set(xscale="log", xlabel="generated classes fitted to", ylabel="first tier (percent)")
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.minorticks_off()
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)
