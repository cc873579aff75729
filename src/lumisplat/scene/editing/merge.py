"""Joins captures, and changes the degree of their SH."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from lumisplat.constants import SH_DEGREE_MAX
from lumisplat.errors import SceneError
from lumisplat.math.arrays import read_only_view
from lumisplat.scene.checks import check_argument, check_whole, items_of
from lumisplat.scene.gaussians import Gaussians, merge_gaussians

_log = logging.getLogger("lumisplat")


def merge(captures: Iterable[Gaussians]) -> Gaussians:
    """Joins captures in the same coordinates into one, in their order.

    Harmonics of lower degree are filled up with zeros. Normals and materials are kept if all captures have them; a log
    line names those that are not. The comments are those of the first capture.

    Args:
        captures: At least one. `transform` places them first.

    Raises:
        SceneError: There is none, only some are antialiased, or their kernel degrees differ.
    """
    sets: list[Gaussians] = []
    for one in items_of("captures", captures):
        check_argument("merge", one, Gaussians, "a list of Gaussians", ": a scene keeps meshes and captures together")
        sets.append(one)  # pyright: ignore[reportArgumentType]
    if not sets:
        raise SceneError("merge takes at least one capture, got none")
    merged = merge_gaussians(sets)
    lost = sorted({name for one in sets for name in one.arrays()} - merged.arrays().keys())
    if lost:
        _log.warning("merge: not all captures have %s: left out", ", ".join(lost))
    return merged


def limit_sh_degree(gaussians: Gaussians, degree: int, *, pad: bool = False) -> Gaussians:
    """Leaves out the harmonics above a degree, or adds zeros up to it; degree 0 is one colour for all directions.

    The mean of a Gaussian's colour over all directions stays, as harmonics above degree 0 have mean 0 (but for colours
    that are clipped at black).

    Args:
        gaussians: The capture.
        degree: Highest degree that is kept, 0..3.
        pad: Add coefficients of zero to captures of a lower degree: some importers want 45 ``f_rest``, degree 3.

    Returns:
        ``gaussians`` itself if there is nothing to leave out or to add.

    Raises:
        SceneError: ``degree`` is no whole number from 0 to 3.
    """
    check_argument("limit_sh_degree", gaussians, Gaussians, "Gaussians")
    check_whole("degree", degree, 0, SH_DEGREE_MAX)
    missing = (degree + 1) ** 2 - gaussians.sh.shape[1]
    if pad and missing > 0:
        return replace(gaussians, sh=read_only_view(np.pad(gaussians.sh, ((0, 0), (0, missing), (0, 0)))))
    if missing >= 0:
        return gaussians
    # A copy: a view would keep the memory of what is left out.
    return replace(gaussians, sh=read_only_view(gaussians.sh[:, : (degree + 1) ** 2].copy()))
