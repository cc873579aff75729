"""The part of scipy.ndimage that Lumisplat calls; SciPy ships no types."""

from typing import Any

import numpy as np
import numpy.typing as npt

def label(input: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.int32], int]: ...
def __getattr__(name: str) -> Any: ...
