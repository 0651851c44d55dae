"""Eigenpairs of sparse symmetric matrices, with a proof that none is missing.

The package knows nothing of meshes: stiffness and mass are plain arrays, from any library. Each module imports only
from those before it in this list: checks, products, ordering, tree, pivots, fronts, multifrontal, basis, krylov,
lanczos, eigensolver.
"""

from igps.spectra._lanczos import ConvergenceError
from igps.spectra.eigensolver import Spectrum, eigenpairs

__all__ = ["ConvergenceError", "Spectrum", "eigenpairs"]
