"""Colours of Gaussians from their spherical harmonics (Kerbl et al. 2023)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_DEGREE_MAX
from lumisplat.math.arrays import FloatArray
from lumisplat.math.sh import sh_basis
from lumisplat.scene.gaussians import Gaussians


def colors_along(gaussians: Gaussians, directions: npt.NDArray[np.floating], degree: int = SH_DEGREE_MAX) -> FloatArray:
    """Display-referred colours ``max(SH + 0.5, 0)`` as seen along directions from the eye to the means.

    Args:
        gaussians: The Gaussians.
        directions: Unit vectors in the Gaussians' own space, shape (N, 3).
        degree: Highest degree that is evaluated, 0 to 3.

    Returns:
        Shape (N, 3).
    """
    basis = sh_basis(directions, min(degree, gaussians.sh_degree), np.float32)
    # A product of small matrices for each Gaussian: one pass over its coefficients, which lie side by side.
    sums = (basis[:, None, :] @ gaussians.sh[:, : basis.shape[1]])[:, 0]
    return np.maximum(sums + np.float32(0.5), 0.0)
