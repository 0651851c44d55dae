"""A body becomes a Signature: Laplacian, voxels, mean value coordinates, attributes. Deterministic, float64."""
