"""A file becomes bodies: reading, mending, watertight surfaces, denoising, simplification. Deterministic, float64.

Formats lie in `formats`, one module each; to add one, see there.
"""
