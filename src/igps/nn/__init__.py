"""From Signatures to histograms and embeddings: differentiable, batched, on any device."""

from igps.nn.classifier import Classifier

__all__ = ["Classifier"]
