"""The part of scipy.spatial that Lumisplat calls; SciPy ships no types."""

from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.floating]

class cKDTree:
    def __init__(self, data: _Floats) -> None: ...
    def query(
        self, x: _Floats, k: int | Iterable[int] = ..., workers: int = ...
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.intp]]: ...
    def query_pairs(self, r: float, *, output_type: Literal["ndarray"]) -> npt.NDArray[np.intp]: ...
    def sparse_distance_matrix(
        self, other: cKDTree, max_distance: float, *, output_type: Literal["ndarray"]
    ) -> npt.NDArray[Any]: ...
