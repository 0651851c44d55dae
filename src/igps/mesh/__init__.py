"""A file becomes bodies: reading, mending, watertight surfaces, denoising, simplification. Deterministic, float64."""
