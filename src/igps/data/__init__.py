"""Many meshes: where they come from, their cached Signatures, batches of them."""
