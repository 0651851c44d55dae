"""From Signatures to histograms and embeddings: differentiable, batched, on any device."""
