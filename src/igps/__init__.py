"""Interior Global Point Signatures as a PyTorch descriptor (Rustamov 2010).

A mesh becomes a `Signature`: eigenfunctions sampled in its interior and on its surface. Signatures become histograms or
embeddings, which are compared.

Shape letters in all docstrings: V vertices, F faces, K eigenpairs, P samples, C potential classes, B distance bins,
N shapes, Q queries, G gallery, D embedding width.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igps.analysis.inside_objects import inside
    from igps.data.batch import SignatureBatch
    from igps.data.collation import collate
    from igps.data.dataset import SignatureDataset
    from igps.descriptors import descriptor, load
    from igps.descriptors.by_name import describe
    from igps.learning import fit
    from igps.mesh.errors import MeshError
    from igps.mesh.loading import load_mesh
    from igps.mesh.mesh import Mesh
    from igps.mesh.objects import as_mesh
    from igps.mesh.options import LoadOptions
    from igps.nn.descriptor import BodyDescriptor, Descriptor, HistogramDescriptor
    from igps.nn.embedding import SpectralEmbedding
    from igps.nn.histograms.pairs import PairHistogram
    from igps.nn.learner import RetrievalLearner
    from igps.retrieval import retrieval_scores, search
    from igps.shapes import ArticulatedShapes
    from igps.signature.measures import measures
    from igps.signature.signature import SignatureConfig, compute_signature

# A name is imported when it is first used: `import igps` loads no other package, and the command line starts at once.
_MODULES = {
    "ArticulatedShapes": "igps.shapes",
    "BodyDescriptor": "igps.nn.descriptor",
    "Descriptor": "igps.nn.descriptor",
    "HistogramDescriptor": "igps.nn.descriptor",
    "LoadOptions": "igps.mesh.options",
    "Mesh": "igps.mesh.mesh",
    "MeshError": "igps.mesh.errors",
    "PairHistogram": "igps.nn.histograms.pairs",
    "RetrievalLearner": "igps.nn.learner",
    "SignatureBatch": "igps.data.batch",
    "SignatureConfig": "igps.signature.config",
    "SignatureDataset": "igps.data.dataset",
    "SpectralEmbedding": "igps.nn.embedding",
    "as_mesh": "igps.mesh.objects",
    "collate": "igps.data.collation",
    "compute_signature": "igps.signature.signature",
    "describe": "igps.descriptors.by_name",
    "descriptor": "igps.descriptors",
    "fit": "igps.learning",
    "inside": "igps.analysis.inside_objects",
    "load": "igps.descriptors",
    "load_mesh": "igps.mesh.loading",
    "measures": "igps.signature.measures",
    "retrieval_scores": "igps.retrieval",
    "search": "igps.retrieval",
}

__all__ = [
    "ArticulatedShapes",
    "BodyDescriptor",
    "Descriptor",
    "HistogramDescriptor",
    "LoadOptions",
    "Mesh",
    "MeshError",
    "PairHistogram",
    "RetrievalLearner",
    "SignatureBatch",
    "SignatureConfig",
    "SignatureDataset",
    "SpectralEmbedding",
    "as_mesh",
    "collate",
    "compute_signature",
    "describe",
    "descriptor",
    "fit",
    "inside",
    "load",
    "load_mesh",
    "measures",
    "retrieval_scores",
    "search",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
