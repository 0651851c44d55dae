"""Interior Global Point Signatures as a PyTorch descriptor (Rustamov 2010).

A mesh becomes a `Signature` (eigenfunctions sampled in its interior and on its surface), Signatures become histograms
or embeddings, and those are compared.

Shape letters in all docstrings: V vertices, F faces, K eigenpairs, P samples, C potential classes, B distance bins,
N shapes, Q queries, G gallery, D embedding width.
"""

from igps.data.cache import SignatureCache
from igps.data.dataset import LabelledSignature, SignatureBatch, SignatureDataset, collate
from igps.data.shapes import ArticulatedShapes
from igps.geometry.mesh import Mesh, MeshError, load_mesh, simplify
from igps.geometry.signature import Samples, Signature, SignatureConfig, compute_signature
from igps.nn.descriptor import VolumetricDescriptor
from igps.nn.embedding import SpectralEmbedding, barycentroid_potential, commute_time_embedding, interior_distance
from igps.nn.extraction import describe
from igps.nn.histogram import PairHistogram, pair_histogram
from igps.retrieval import RetrievalScores, chi_square, retrieval_scores, search

__all__ = [
    "ArticulatedShapes",
    "LabelledSignature",
    "Mesh",
    "MeshError",
    "PairHistogram",
    "RetrievalScores",
    "Samples",
    "Signature",
    "SignatureBatch",
    "SignatureCache",
    "SignatureConfig",
    "SignatureDataset",
    "SpectralEmbedding",
    "VolumetricDescriptor",
    "barycentroid_potential",
    "chi_square",
    "collate",
    "commute_time_embedding",
    "compute_signature",
    "describe",
    "interior_distance",
    "load_mesh",
    "pair_histogram",
    "retrieval_scores",
    "search",
    "simplify",
]
