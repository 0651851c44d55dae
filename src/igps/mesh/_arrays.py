"""Kinds of arrays."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]
Surface = tuple[Floats, Integers]
"""Vertices (V, 3) and faces (F, 3)."""
