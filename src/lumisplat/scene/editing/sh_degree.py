"""Fewer harmonics: less dependence of colour on direction, and smaller files."""

from __future__ import annotations

from dataclasses import replace

from lumisplat.constants import SH_DEGREE_MAX
from lumisplat.math.arrays import read_only_view
from lumisplat.scene.checks import check_argument, check_whole
from lumisplat.scene.gaussians import Gaussians


def limit_sh_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Leaves out the harmonics above a degree; degree 0 is one colour for all directions.

    The mean of a Gaussian's colour over all directions stays, as harmonics above degree 0 have mean 0 (but for colours
    that are clipped at black).

    Args:
        gaussians: The capture.
        degree: Highest degree that is kept, 0..3.

    Returns:
        ``gaussians`` itself if it has no higher degree.

    Raises:
        SceneError: ``degree`` is no whole number from 0 to 3.
    """
    check_argument("limit_sh_degree", gaussians, Gaussians, "Gaussians")
    check_whole("degree", degree, 0, SH_DEGREE_MAX)
    if gaussians.sh_degree <= degree:
        return gaussians
    # A copy: a view would keep the memory of what is left out.
    return replace(gaussians, sh=read_only_view(gaussians.sh[:, : (degree + 1) ** 2].copy()))
