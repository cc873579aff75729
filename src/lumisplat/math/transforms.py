"""Points and normals under 4x4 matrices."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.floating]


def transform_points(matrices: _Floats, points: _Floats) -> npt.NDArray[np.float64]:
    """Points, shape (V, 3), by a matrix each, or all by one: shape (V or 1, 3 or 4, 4)."""
    return (matrices[:, :3, :3] @ points[:, :, None])[:, :, 0] + matrices[:, :3, 3]


def transform_normals(matrices: _Floats, normals: _Floats) -> npt.NDArray[np.float64]:
    """Normals, shape (V, 3), by a matrix each, or all by one, to any length."""
    # Cofactors carry normals as the inverse transpose does, up to length, and exist for a singular matrix too; where a
    # matrix mirrors they point the other way.
    a, b, c = matrices[:, :3, 0], matrices[:, :3, 1], matrices[:, :3, 2]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    signs = np.where(np.einsum("vi,vi->v", a, cofactors[:, :, 0]) < 0.0, -1.0, 1.0)
    return signs[:, None] * (cofactors @ normals[:, :, None])[:, :, 0]


def is_mirroring(matrices: _Floats) -> bool:
    """Whether most matrices mirror, so that triangles face the other way."""
    return bool(np.median(np.linalg.det(matrices[:, :3, :3])) < 0.0)
