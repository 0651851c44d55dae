"""Counts of samples and pairs, and what is found at samples: torch for gradients and devices, Numba for the CPU."""
