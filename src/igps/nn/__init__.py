"""From Signatures to histograms and embeddings: differentiable, batched, on any device."""

from igps.nn.classifier import Classifier
from igps.nn.description import fit_centres

__all__ = ["Classifier", "fit_centres"]
