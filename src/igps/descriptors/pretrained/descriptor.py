"""The descriptor `pretrained`: nine histograms of a body under a head that was fitted to generated shapes."""

from pathlib import Path

from safetensors.torch import load_file

from igps.descriptors.multiscale import N_ORIENTED_SAMPLES
from igps.descriptors.pretrained.axial_histogram import AxialHistogram
from igps.descriptors.pretrained.branch_histogram import BranchHistogram
from igps.descriptors.pretrained.piece_histogram import PieceHistogram
from igps.descriptors.pretrained.spectrum_shares import SpectrumShares
from igps.nn.axes import (
    BallRadius,
    EmbeddedPairCosines,
    EuclideanDistance,
    InteriorDistance,
    PairCosines,
    Potential,
)
from igps.nn.descriptor import EmbeddedDescriptor, HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.heads.two_level import TwoLevelHead
from igps.nn.heads.wccn import WCCNHead
from igps.nn.histograms.pairs import PairHistogram
from igps.nn.histograms.points import PointHistogram

PRETRAINED = Path(__file__).with_name("pretrained.safetensors")
"""The file of the parameters of `pretrained`."""

# Indices into `pretrained_parts`. Body heads use parts that bending leaves as they are.
BODY_PARTS = (0, 8)
CLASS_PARTS = (1, 2, 3, 4, 5, 6, 7)
# Scales of the body heads, in units in which the median distance between training shapes is 0.5
_SCALES = (0.13, 0.14)
# Eigenvalues and the volume are more exact than distances between samples.
_EXPONENTS = (0.25, 0.75)


def pretrained_parts() -> HistogramDescriptor:
    """Return the histograms of `pretrained`, from at most 90 eigenpairs, as one descriptor with nine parts.

    0. Interior distances between surface samples.
    1. Interior distances between interior samples, with directions to the surface in the embedding of 16 eigenpairs.
    2. Euclidean distances between surface samples, with directions in space.
    3. Interior distances between surface samples, with directions in space.
    4. Positions of surface samples about the principal axes of the body.
    5. Radii of the balls that touch the surface from both sides, by the potentials of 4 and 16 eigenpairs.
    6. Lengths of the limbs, by the potential of 16 eigenpairs.
    7. Sizes and lengths of the pieces of the body without its middle, by the same potential.
    8. Eigenvalues in units of the volume.
    """
    embeddings = {n: SpectralEmbedding(n_eigenpairs=n) for n in (64, 50, 16, 4)}
    n = N_ORIENTED_SAMPLES
    # The spacing of 2,000 samples is 0.022 √area. Thinner parts all belong to the first class.
    balls = [BallRadius("inside", 0.022, 0.25), BallRadius("outside", 0.03, 1.5)]
    potentials = [
        Potential(6, 0.9, embedding=embeddings[4], soft=True),
        Potential(6, 0.96, soft=True),
    ]
    return HistogramDescriptor(
        [
            PairHistogram([Potential(4), InteriorDistance(64)], embeddings[64], "surface"),
            PairHistogram(
                [InteriorDistance(6, 3.0), EmbeddedPairCosines(5)], embeddings[16], n_samples=n
            ),
            PairHistogram(
                [EuclideanDistance(6, 1.0), PairCosines(5)], embeddings[50], "surface", n_samples=n
            ),
            PairHistogram(
                [InteriorDistance(8, 3.0), PairCosines(5)], embeddings[50], "surface", n_samples=n
            ),
            AxialHistogram(embeddings[16]),
            PointHistogram([*balls, *potentials], embeddings[16]),
            BranchHistogram(embeddings[16], n_samples=n),
            PieceHistogram(embedding=embeddings[16], n_samples=n),
            SpectrumShares(90),
        ],
        name="pretrained_parts",
        source="Rustamov 2007 and 2010; Wahl, Hillenbrand and Hirzinger 2003; Reuter, Wolter and Peinecke 2006; Ma, "
        "Bae, Choi 2012; Skraba et al. 2010",
        invariant_to=("motion", "scale"),
    )


def pretrained_head() -> TwoLevelHead:
    """Return the unfitted head of `pretrained`."""
    surface, spectrum = BODY_PARTS
    body_heads = [
        WCCNHead([surface], n_directions=60, shrinkage=0.3, lengths=True),
        WCCNHead([spectrum], n_directions=90, shrinkage=1.0, lengths=True),
    ]
    class_head = WCCNHead(CLASS_PARTS, n_directions=150, shrinkage=0.1)
    return TwoLevelHead(class_head, body_heads, scales=_SCALES, exponents=_EXPONENTS, share=0.2)


def pretrained(path: str | Path = PRETRAINED) -> EmbeddedDescriptor:
    """Return the histograms of `pretrained_parts` under a head that was fitted to generated shapes, in evaluation mode.

    Descriptions are unit vectors of 1,068 numbers, which the head's `shorten` reduces to 256. By the distance of the
    head, other poses of a body come first, then other bodies of its class. No labels are needed for the shapes that are
    compared. The model card is in the documentation.

    Args:
        path: the file of parameters.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file holds the parameters of another descriptor or version.
    """
    module = EmbeddedDescriptor(
        pretrained_parts(),
        pretrained_head(),
        name="pretrained",
        source="nine histograms, fitted to generated shapes",
        invariant_to=("motion", "scale", "pose"),
    )
    state = {name: tensor.float() for name, tensor in load_file(path).items()}
    try:
        module.load_state_dict(state)
    except RuntimeError as error:
        raise ValueError(
            f"{path}: expected the parameters of `pretrained` of this version, got others."
        ) from error
    return module.eval()
