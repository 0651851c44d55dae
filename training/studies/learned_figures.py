"""Pictures of the learned parameters of a descriptor, compared with their initial values."""

from pathlib import Path
from typing import Any

import torch

from igps.nn.axes.centres import OrderedCentres
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding, spectral_weights
from igps.nn.histograms.pairs import PairHistogram
from igps.report.drawing import new_figure


def learned_layout(descriptor: HistogramDescriptor, path: str | Path) -> None:
    """Save a picture of bin centres, class centres and the spectral filter g(λ·area), as learned and as initialised.

    Args:
        descriptor: descriptor whose histograms of pairs are drawn, one in a row; other histograms learn nothing.
        path: path of the picture, such as layout.png.
    """
    histograms = [x for part in descriptor.parts for x in part if isinstance(x, PairHistogram)]
    rows = [(histogram.embedding, _centres(histogram)) for histogram in histograms]
    n_columns = 1 + max(len(centres) for _, centres in rows)
    figure = new_figure(4 * n_columns, 3.2 * len(rows))
    grid = figure.subplots(len(rows), n_columns, squeeze=False)
    for panels, (embedding, centres) in zip(grid, rows, strict=True):
        if isinstance(embedding, SpectralEmbedding):
            _filter(panels[0], embedding)
        else:
            panels[0].set_axis_off()
        for panel, (title, bins) in zip(panels[1:], centres.items(), strict=False):
            panel.plot(bins.start, bins.start, color="#888888", linestyle="--", label="start")
            panel.plot(
                bins.start,
                bins().detach(),
                color="#D55E00",
                marker=".",
                markersize=3,
                label="learned",
            )
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
    panel.set(
        xlabel="eigenvalue × area", ylabel="weight of the eigenfunction g", title="spectral filter"
    )
    panel.legend(frameon=False)


def _centres(histogram: PairHistogram) -> dict[str, OrderedCentres]:
    """Return the centres along the axes of a histogram, by the names of axis and parameter."""
    return {
        f"{type(axis).__name__}: {name}": module
        for axis in histogram.axes
        for name, module in axis.named_modules()
        if isinstance(module, OrderedCentres)
    }
