"""Several captures as one."""

from __future__ import annotations

import logging
from collections.abc import Iterable

from lumisplat.errors import SceneError
from lumisplat.scene.checks import check_argument, items_of
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
