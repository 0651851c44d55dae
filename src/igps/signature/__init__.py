"""From a mesh to its Signature: Laplacian, voxels, mean value coordinates, attributes. Deterministic, in float64."""
