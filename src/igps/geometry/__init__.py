"""One mesh at a time: from a file to its Signature. Deterministic, float64."""
