"""Collections of bodies: sources, cached Signatures, batches."""
