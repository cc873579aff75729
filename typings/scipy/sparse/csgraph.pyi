"""The part of scipy.sparse.csgraph that Lumisplat calls; SciPy ships no types."""

from typing import Any

import numpy as np
import numpy.typing as npt

def connected_components(csgraph: Any, directed: bool = True) -> tuple[int, npt.NDArray[np.int32]]: ...
