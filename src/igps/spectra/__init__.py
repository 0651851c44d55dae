"""Eigenpairs of sparse symmetric matrices, with a proof that none is missing.

The room knows nothing of meshes: a stiffness and a mass from any library go in as plain arrays. Each module uses only
those before it: checks, products, ordering, tree, pivots, fronts, multifrontal, basis, krylov, lanczos, eigensolver.
"""

from igps.spectra._lanczos import ConvergenceError
from igps.spectra.eigensolver import Spectrum, eigenpairs

__all__ = ["ConvergenceError", "Spectrum", "eigenpairs"]
