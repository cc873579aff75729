"""Points and normals under 4x4 matrices."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles

_Floats = npt.NDArray[np.floating]


def transform_points(matrix: Doubles, points: _Floats) -> Doubles:
    """Points, shape (V, 3), under one affine transform, shape (3 or 4, 4)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def transform_points_each(matrices: _Floats, points: _Floats) -> Doubles:
    """Points, shape (V, 3), each under its own affine transform, shape (V or 1, 3 or 4, 4)."""
    return (matrices[:, :3, :3] @ points[:, :, None])[:, :, 0] + matrices[:, :3, 3]


def transform_normals_each(matrices: _Floats, normals: _Floats) -> Doubles:
    """Normals, shape (V, 3), each under its own transform, shape (V or 1, 3 or 4, 4). The results have any length."""
    # Cofactors transform normals as the inverse transpose does, up to length, and exist for singular matrices too.
    # Where a matrix mirrors, the cofactors flip the normal.
    a, b, c = matrices[:, :3, 0], matrices[:, :3, 1], matrices[:, :3, 2]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    signs = np.where(np.einsum("vi,vi->v", a, cofactors[:, :, 0]) < 0.0, -1.0, 1.0)
    return signs[:, None] * (cofactors @ normals[:, :, None])[:, :, 0]


def is_mirroring(matrices: _Floats) -> bool:
    """Whether most matrices mirror, so that triangles wind the other way round."""
    return bool(np.median(np.linalg.det(matrices[:, :3, :3])) < 0.0)
