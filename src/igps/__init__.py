"""Interior Global Point Signatures as a PyTorch descriptor (Rustamov 2010).

A mesh becomes a `Signature` (eigenfunctions sampled in its interior and on its surface), Signatures become histograms
or embeddings, and those are compared.

Shape letters in all docstrings: V vertices, F faces, K eigenpairs, P samples, C potential classes, B distance bins,
N shapes, Q queries, G gallery, D embedding width.
"""

from igps.data.cache import SignatureCache
from igps.data.datamodule import SignatureDataModule
from igps.data.dataset import LabelledSignature, SignatureBatch, SignatureDataset, collate
from igps.geometry.mesh import Mesh, MeshError
from igps.geometry.reading import MeshReading, load_mesh
from igps.geometry.signature import Samples, Signature, SignatureConfig, compute_signature
from igps.geometry.simplification import simplify
from igps.nn.descriptor import CombinedDescriptor, OrientedDescriptor, VolumetricDescriptor
from igps.nn.embedding import SpectralEmbedding, barycentroid_potential, interior_distance, spectral_embedding
from igps.nn.extraction import describe
from igps.nn.fitted import KernelHead, WhitenedHead
from igps.nn.head import CorrectedDistance, MetricHead
from igps.nn.histogram import PairHistogram, pair_histogram
from igps.nn.learner import RetrievalLearner
from igps.nn.oriented import OrientedPairHistogram
from igps.retrieval import RetrievalScores, chi_square, retrieval_scores, search
from igps.shapes import ArticulatedShapes

__all__ = [
    "ArticulatedShapes",
    "CombinedDescriptor",
    "CorrectedDistance",
    "KernelHead",
    "LabelledSignature",
    "Mesh",
    "MeshError",
    "MeshReading",
    "MetricHead",
    "OrientedDescriptor",
    "OrientedPairHistogram",
    "PairHistogram",
    "RetrievalLearner",
    "RetrievalScores",
    "Samples",
    "Signature",
    "SignatureBatch",
    "SignatureCache",
    "SignatureConfig",
    "SignatureDataModule",
    "SignatureDataset",
    "SpectralEmbedding",
    "VolumetricDescriptor",
    "WhitenedHead",
    "barycentroid_potential",
    "chi_square",
    "collate",
    "compute_signature",
    "describe",
    "interior_distance",
    "load_mesh",
    "pair_histogram",
    "retrieval_scores",
    "search",
    "simplify",
    "spectral_embedding",
]
