"""Real spherical harmonics of captures, and the colours that they give (Kerbl et al. 2023; INRIA's order and signs)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_C0, SH_DEGREE_MAX
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.gaussians import Gaussians

# Square roots of 3/4; of 15/4, 5/16, 15/16; of 35/32, 105/4, 21/32, 7/16, 105/16; all over pi.
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def sh_basis(directions: npt.NDArray[np.floating], degree: int) -> npt.NDArray[np.floating]:
    """Values of the ``(degree + 1)^2`` harmonics, with the sign (-1)^m of Condon and Shortley.

    Args:
        directions: Unit vectors, shape (N, 3).
        degree: 0 to 3.

    Returns:
        Shape (K, N), a harmonic a row, of the directions' type.
    """
    x, y, z = directions.T
    bands = [[np.full_like(x, SH_C0)]]
    if degree >= 1:
        bands.append([-_C1 * y, _C1 * z, -_C1 * x])
    if degree >= 2:
        a, b, c = _C2
        bands.append([a * x * y, -a * y * z, b * (3.0 * z * z - 1.0), -a * x * z, c * (x * x - y * y)])
    if degree >= SH_DEGREE_MAX:
        a, b, c, d, e = _C3
        wide = 5.0 * z * z - 1.0
        bands.append(
            [
                -a * y * (3.0 * x * x - y * y),
                b * x * y * z,
                -c * y * wide,
                d * z * (wide - 2.0),
                -c * x * wide,
                e * z * (x * x - y * y),
                -a * x * (x * x - 3.0 * y * y),
            ]
        )
    return np.array([value for band in bands for value in band])


def colors_along(gaussians: Gaussians, directions: npt.NDArray[np.floating], degree: int = SH_DEGREE_MAX) -> FloatArray:
    """Display-referred colours ``max(SH + 0.5, 0)`` as seen along directions from the eye to the means.

    Args:
        gaussians: The Gaussians.
        directions: Unit vectors in the Gaussians' own space, shape (N, 3).
        degree: Highest degree that counts, 0 to 3.

    Returns:
        Shape (N, 3).
    """
    basis = sh_basis(directions.astype(np.float32), min(degree, gaussians.sh_degree))
    # A product of small matrices for each Gaussian: one pass over its coefficients, which lie side by side.
    sums = (basis.T[:, None, :] @ gaussians.sh[:, : len(basis)])[:, 0]
    return np.maximum(sums + np.float32(0.5), 0.0)
