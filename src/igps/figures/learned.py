"""What a descriptor has learned, against where it started."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from igps.figures import _figure
from igps.nn.bins import OrderedCentres
from igps.nn.descriptor import VolumetricDescriptor
from igps.nn.embedding import SpectralEmbedding, spectral_weights
from igps.nn.histogram import PairHistogram


def learned_layout(descriptor: VolumetricDescriptor, path: str | Path) -> None:
    """Save a picture of the bin and class centres and of the spectral filter g(λ·area), learned and as they started.

    Args:
        descriptor: with a `SpectralEmbedding` and a `PairHistogram`.
        path: of the picture, such as layout.png.

    Raises:
        ValueError: a descriptor of other parts.
        ImportError: matplotlib is not installed.
    """
    if not isinstance(descriptor.embedding, SpectralEmbedding) or not isinstance(descriptor.histogram, PairHistogram):
        raise ValueError("descriptor: expected one made of a SpectralEmbedding and a PairHistogram.")
    axes_of = _centres(descriptor.histogram)
    figure = _figure(4 * (len(axes_of) + 1), 3.2)
    panels = figure.subplots(1, len(axes_of) + 1)
    x = torch.logspace(0.5, 3.6, 200, dtype=torch.float64)
    area = torch.ones((), dtype=torch.float64)
    learned = descriptor.embedding.weights(x, area).detach()
    start = spectral_weights(x, area, descriptor.embedding.kind, descriptor.embedding.time)
    panels[0].loglog(x, start, color="#888888", linestyle="--", label="start")
    panels[0].loglog(x, learned, color="#0072B2", label="learned")
    panels[0].set(xlabel="eigenvalue × area", ylabel="weight of the eigenfunction g", title="spectral filter")
    panels[0].legend(frameon=False)
    for panel, (title, centres) in zip(panels[1:], axes_of.items(), strict=True):
        values = centres().detach()
        panel.plot(centres.start, centres.start, color="#888888", linestyle="--", label="start")
        panel.plot(centres.start, values, color="#D55E00", marker=".", markersize=3, label="learned")
        panel.set(xlabel="centre at the start", ylabel="centre", title=title)
        panel.legend(frameon=False)
    figure.savefig(path, dpi=150)


def _centres(histogram: PairHistogram) -> dict[str, OrderedCentres]:
    found = {
        "bins of interior distance": histogram.distance_centres,
        "classes of barycentroid potential": histogram.potential_centres,
    }
    for name, centres in histogram.attribute_centres.items():
        assert isinstance(centres, OrderedCentres)
        found[f"classes of {name}"] = centres
    if histogram.euclidean_centres is not None:
        found["bins of Euclidean distance / √area"] = histogram.euclidean_centres
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
