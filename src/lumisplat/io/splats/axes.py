"""Mirrored axes of a capture: positions, rotations and spherical harmonics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumisplat.io.splats.columns import SplatColumns

SH_ODD_AXES = ("", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
"""Axes in which each SH basis function up to degree 3 is odd, from its polynomial: degree 3, m = -3 is y (3x^2 - y^2),
which is odd in y alone. Mirroring an odd axis changes the sign of the coefficient."""


def mirror_axes(columns: SplatColumns, signs: tuple[int, int, int]) -> SplatColumns:
    """The same Gaussians in a frame whose axes are multiplied by ``signs``.

    With S = diag(signs), a rotation R becomes S R S, whose quaternion is (w, sy sz x, sx sz y, sx sy z), because the
    axis of a rotation is a pseudovector.

    Args:
        columns: Any Gaussians.
        signs: +1 or -1 for x, y and z.
    """
    sx, sy, sz = signs
    axes = np.array(signs, dtype=np.float32)
    sign_of = dict(zip("xyz", signs, strict=True))
    odd = [int(np.prod([sign_of[axis] for axis in odd_axes])) for odd_axes in SH_ODD_AXES]
    sh_signs = np.array(odd[: columns.sh.shape[1]], dtype=np.float32)
    return replace(
        columns,
        means=columns.means * axes,
        rotations_wxyz=columns.rotations_wxyz * np.array([1, sy * sz, sx * sz, sx * sy], dtype=np.float32),
        sh=columns.sh * sh_signs[:, None],
        normals=None if columns.normals is None else columns.normals * axes,
    )
