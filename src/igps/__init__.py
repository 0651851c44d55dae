"""Interior Global Point Signatures as a PyTorch descriptor (Rustamov 2010).

A mesh becomes a `Signature`: eigenfunctions sampled in its interior and on its surface. Signatures become histograms or
embeddings, which are compared.

Shape letters in all docstrings: V vertices, F faces, K eigenpairs, P samples, C potential classes, B distance bins,
N shapes, Q queries, G gallery, D embedding width.
"""

import importlib
from typing import TYPE_CHECKING, Any

from igps.data.batch import SignatureBatch
from igps.data.collation import collate
from igps.data.dataset import SignatureDataset
from igps.descriptors import descriptor, load
from igps.learning import fit
from igps.mesh.errors import MeshError
from igps.mesh.loading import load_mesh
from igps.mesh.mesh import Mesh
from igps.mesh.objects import as_mesh
from igps.mesh.options import LoadOptions
from igps.nn.description import describe
from igps.nn.descriptor import BodyDescriptor, Descriptor, HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.heads.closed_form import KernelHead
from igps.nn.histograms.pairs import PairHistogram
from igps.retrieval import retrieval_scores, search
from igps.shapes import ArticulatedShapes
from igps.signature.signature import SignatureConfig, compute_signature

if TYPE_CHECKING:
    from igps.data.datamodule import SignatureDataModule
    from igps.nn.learner import RetrievalLearner

# Imported on first use, because they import Lightning, which takes seconds.
_LAZY = {"RetrievalLearner": "igps.nn.learner", "SignatureDataModule": "igps.data.datamodule"}

__all__ = [
    "ArticulatedShapes",
    "BodyDescriptor",
    "Descriptor",
    "HistogramDescriptor",
    "KernelHead",
    "LoadOptions",
    "Mesh",
    "MeshError",
    "PairHistogram",
    "RetrievalLearner",
    "SignatureBatch",
    "SignatureConfig",
    "SignatureDataModule",
    "SignatureDataset",
    "SpectralEmbedding",
    "as_mesh",
    "collate",
    "compute_signature",
    "describe",
    "descriptor",
    "fit",
    "load",
    "load_mesh",
    "retrieval_scores",
    "search",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
