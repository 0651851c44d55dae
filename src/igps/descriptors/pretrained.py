"""Histograms of a body's interior and surface under a metric that was trained on generated shapes."""

from __future__ import annotations

from pathlib import Path

from safetensors.torch import load_file, save_file

from igps.descriptors.multiscale import N_ORIENTED_SAMPLES, N_SAMPLES
from igps.nn.axes import EmbeddedPairCosines, EuclideanDistance, InteriorDistance, PairAxis, PairCosines, Potential
from igps.nn.descriptor import EmbeddedDescriptor, HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histogram import PairHistogram
from igps.nn.levels import LevelHead, TwoLevelHead
from igps.nn.view import SampleKind

PRETRAINED = Path(__file__).with_name("pretrained.safetensors")
"""The parameters of `pretrained`, written by training/pretrain.py."""

# Of `seven_parts`: what bending leaves alone tells bodies, how points lie to each other tells classes
BODY_PARTS, CLASS_PARTS = (0,), (1, 2, 3, 4, 5, 6)


def seven_parts() -> HistogramDescriptor:
    """What `pretrained` sees of a body, of at most 64 eigenpairs.

    By interior distances alone: those of surface samples on two scales; those of interior samples on two scales
    jointly; how interior samples lie to the surface in the embedding of 16 eigenpairs, and surface samples to each
    other in that of 8. With directions in space: how interior samples lie to the surface by interior distance, surface
    samples by Euclidean distance, and surface samples by the distance of the embedding.
    """
    embeddings = {n: SpectralEmbedding(n_eigenpairs=n) for n in (64, 50, 16, 8, 4)}

    def histogram(
        n_eigenpairs: int, *axes: Potential | PairAxis, n: int | None = N_SAMPLES, samples: SampleKind = "interior"
    ) -> PairHistogram:
        return PairHistogram(axes, embeddings[n_eigenpairs], samples, n_samples=n)

    n = N_ORIENTED_SAMPLES
    on_surface = [histogram(k, Potential(4), InteriorDistance(64), n=None, samples="surface") for k in (64, 16)]
    return HistogramDescriptor(
        [
            on_surface,
            histogram(50, InteriorDistance(24, 3.0), InteriorDistance(24, 2.5, embedding=embeddings[4])),
            histogram(16, InteriorDistance(6, 3.0), EmbeddedPairCosines(5), n=n),
            histogram(8, InteriorDistance(6, 3.0), EmbeddedPairCosines(5), n=n, samples="surface"),
            histogram(50, InteriorDistance(6, 3.0), PairCosines(5), n=n),
            histogram(50, EuclideanDistance(6, 1.0), PairCosines(5), n=n, samples="surface"),
            histogram(50, InteriorDistance(8, 3.0), PairCosines(5), n=n, samples="surface"),
        ],
        name="seven_parts",
        source="Rustamov 2007 and 2010; Wahl, Hillenbrand and Hirzinger 2003",
        invariant_to=("motion", "scale"),
    )


def two_levels() -> TwoLevelHead:
    """The head of `pretrained`, not fitted."""
    of_classes = LevelHead(CLASS_PARTS, width=192)
    return TwoLevelHead(of_classes, LevelHead(BODY_PARTS, width=64, shrinkage=0.3))


def pretrained(path: str | Path = PRETRAINED) -> EmbeddedDescriptor:
    """Unit vectors of 256 numbers, in evaluation mode: `seven_parts` under a head that was fitted to generated shapes.

    It needs no label of the shapes that it compares: by the head's distance, other poses of a body come first, then
    other bodies of its class. The model card is in the documentation.

    Args:
        path: of the parameters, as `save_pretrained` wrote them; those that the package ships by default.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it holds other parameters.
    """
    module = EmbeddedDescriptor(
        seven_parts(),
        two_levels(),
        name="pretrained",
        source="seven histograms, fitted to generated shapes",
        invariant_to=("motion", "scale", "pose"),
    )
    try:
        module.load_state_dict({name: tensor.float() for name, tensor in load_file(path).items()})
    except RuntimeError as error:
        raise ValueError(f"{path}: expected the parameters of `pretrained` of this version, got others.") from error
    return module.eval()


def save_pretrained(module: EmbeddedDescriptor, path: str | Path) -> None:
    """Write a fitted `seven_parts` under `two_levels` to a safetensors file, the head in half precision."""
    state = {
        name: (tensor.half() if name.startswith("head.") and tensor.is_floating_point() else tensor).contiguous()
        for name, tensor in module.state_dict().items()
    }
    save_file(state, path)
