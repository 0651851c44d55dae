"""Read files as bodies: formats, mending, watertight surfaces, denoising, simplification. Deterministic, float64.

Each file format is a module of `formats`, whose docstring tells how to add one.
"""
