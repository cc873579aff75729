"""The part of scipy.optimize that Lumisplat calls; SciPy ships no types."""

from typing import Any

import numpy as np
import numpy.typing as npt

def nnls(A: npt.NDArray[np.floating], b: npt.NDArray[np.floating]) -> tuple[npt.NDArray[np.float64], float]: ...
def minimize(*arguments: Any, **options: Any) -> Any: ...
def __getattr__(name: str) -> Any: ...
