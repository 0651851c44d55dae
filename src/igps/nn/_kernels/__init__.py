"""Counts of pairs and features of samples: PyTorch for gradients and other devices, Numba for the CPU."""
