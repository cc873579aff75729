"""The part of scipy.sparse.linalg that Lumisplat calls; SciPy ships no types."""

from typing import Any

import numpy as np
import numpy.typing as npt

def cg(A: Any, b: npt.NDArray[np.floating], *arguments: Any, **options: Any) -> tuple[npt.NDArray[np.float64], int]: ...
def __getattr__(name: str) -> Any: ...
