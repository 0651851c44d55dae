"""Histograms of a body's interior and surface under a head that was fitted to generated shapes."""

from pathlib import Path

from safetensors.torch import load_file

from igps.descriptors.multiscale import N_ORIENTED_SAMPLES
from igps.descriptors.pretrained.axial_histogram import AxialHistogram
from igps.descriptors.pretrained.branch_histogram import BranchHistogram
from igps.descriptors.pretrained.piece_histogram import PieceHistogram
from igps.descriptors.pretrained.spectrum_shares import SpectrumShares
from igps.nn.axes import BallRadius, EmbeddedPairCosines, EuclideanDistance, InteriorDistance, PairCosines, Potential
from igps.nn.descriptor import EmbeddedDescriptor, HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.heads.two_level import TwoLevelHead
from igps.nn.heads.wccn import WCCNHead
from igps.nn.histograms.pairs import PairHistogram
from igps.nn.histograms.points import PointHistogram

PRETRAINED = Path(__file__).with_name("pretrained.safetensors")
"""The parameters of `pretrained`, written by training/pretrain.py."""

# Of `pretrained_parts`: what bending leaves alone tells bodies, all others tell classes
BODY_PARTS, CLASS_PARTS = (0, 5, 8), (1, 2, 3, 4, 5, 6, 7)
# Balls are too rough to tell individuals apart
INDIVIDUAL_PARTS = (0, 8)
# Of the body heads: the median distance of training shapes is 0.5
_SCALES = (0.125, 0.21, 0.125)


def pretrained_parts() -> HistogramDescriptor:
    """What `pretrained` sees of a body, of at most 64 eigenpairs.

    By interior distances alone: those of surface samples, and how interior samples lie to the surface in the embedding
    of 16 eigenpairs. With directions in space: how surface samples lie to each other by Euclidean distance, and by that
    of the embedding; and how they lie to the body's principal axes. Of surface samples the balls that touch them from
    both sides, by the potentials of 4 and 16 eigenpairs. By the latter, the body's limbs: how far each reaches, and how
    large and how long the pieces are that remain of the body without its middle. And the eigenvalues alone.
    """
    embeddings = {n: SpectralEmbedding(n_eigenpairs=n) for n in (64, 50, 16, 4)}
    n = N_ORIENTED_SAMPLES
    # 2,000 samples lie 0.022 apart: what is thinner than that is thin
    balls = [BallRadius("inside", 0.022, 0.25), BallRadius("outside", 0.03, 1.5)]
    potentials = [Potential(6, 0.9, embedding=embeddings[4], soft=True), Potential(6, 0.96, soft=True)]
    return HistogramDescriptor(
        [
            PairHistogram([Potential(4), InteriorDistance(64)], embeddings[64], "surface"),
            PairHistogram([InteriorDistance(6, 3.0), EmbeddedPairCosines(5)], embeddings[16], n_samples=n),
            PairHistogram([EuclideanDistance(6, 1.0), PairCosines(5)], embeddings[50], "surface", n_samples=n),
            PairHistogram([InteriorDistance(8, 3.0), PairCosines(5)], embeddings[50], "surface", n_samples=n),
            AxialHistogram(embeddings[16]),
            PointHistogram([*balls, *potentials], embeddings[16]),
            BranchHistogram(embeddings[16], n_samples=n),
            PieceHistogram(embedding=embeddings[16], n_samples=n),
            SpectrumShares(64),
        ],
        name="pretrained_parts",
        source="Rustamov 2007 and 2010; Wahl, Hillenbrand and Hirzinger 2003; Reuter, Wolter and Peinecke 2006; Ma, "
        "Bae, Choi 2012; Skraba et al. 2010",
        invariant_to=("motion", "scale"),
    )


def pretrained_head(*, individuals: bool = True) -> TwoLevelHead:
    """The head of `pretrained`, not fitted; without the level of individuals if not `individuals`."""
    surface, balls, spectrum = BODY_PARTS
    body_heads = [
        WCCNHead([surface], n_directions=90, shrinkage=0.3, lengths=True),
        WCCNHead([balls], n_directions=20, shrinkage=0.3, lengths=True),
        WCCNHead([spectrum], n_directions=60, shrinkage=1.0, lengths=True),
    ]
    individual_head = WCCNHead(INDIVIDUAL_PARTS, n_directions=60, shrinkage=0.3, lengths=True) if individuals else None
    class_head = WCCNHead(CLASS_PARTS, n_directions=150, shrinkage=0.1)
    return TwoLevelHead(class_head, body_heads, scales=_SCALES, individual_head=individual_head)


def pretrained(path: str | Path = PRETRAINED) -> EmbeddedDescriptor:
    """Unit vectors, in evaluation mode: `pretrained_parts` under a head that was fitted to generated shapes.

    It needs no label of the shapes that it compares: by the head's distance, other poses of a body come first, then
    other bodies of its class. The head's `short` makes vectors of 256 numbers of its 1,210. The model card is in the
    documentation. The parameters are those of a file that training/pretrain.py wrote, a FileNotFoundError without one,
    and a ValueError where it holds others.
    """
    module = EmbeddedDescriptor(
        pretrained_parts(),
        pretrained_head(),
        name="pretrained",
        source="nine histograms, fitted to generated shapes",
        invariant_to=("motion", "scale", "pose"),
    )
    try:
        module.load_state_dict({name: tensor.float() for name, tensor in load_file(path).items()})
    except RuntimeError as error:
        raise ValueError(f"{path}: expected the parameters of `pretrained` of this version, got others.") from error
    return module.eval()
