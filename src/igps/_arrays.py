"""Array types for annotations."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]
Surface = tuple[Floats, Integers]  # vertices (V, 3) and faces (F, 3)
# Element type of arrays in single or double precision
Real = TypeVar("Real", np.float32, np.float64)
