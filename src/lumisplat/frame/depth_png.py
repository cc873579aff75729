"""Depth as a picture that can be measured: 16-bit grey, with its range in the file's text."""

from __future__ import annotations

import os

import numpy as np

from lumisplat.io.images.png import write_gray_png
from lumisplat.math.arrays import FloatArray

_STEPS = 65534
"""Steps from the nearest to the farthest surface: values 1 to 65535; 0 is no surface."""
_FORMULA = "depth = depth_near + (value - 1) / 65534 * (depth_far - depth_near); value 0: no surface"


def depth_range(depth: FloatArray) -> tuple[float, float] | None:
    """The nearest and the farthest depth, scene units; None: there is no surface."""
    surface = depth[np.isfinite(depth)]
    return (float(surface.min()), float(surface.max())) if surface.size else None


def write_depth_png(path: str | os.PathLike[str], depth: FloatArray) -> None:
    """Writes depths as 16-bit grey, linear from the nearest (1) to the farthest surface (65535), 0 where there is none.

    The text chunks ``depth_near``, ``depth_far`` (scene units, along the ray) and ``depth_formula`` say how to read it.

    Args:
        path: The PNG to write. It appears complete or not at all.
        depth: Distances along the rays, shape (H, W); not finite: no surface.

    Raises:
        FormatError: The file cannot be written.
    """
    near, far = depth_range(depth) or (0.0, 0.0)
    hit = np.isfinite(depth)
    share = (np.where(hit, depth, near).astype(np.float64) - near) / max(far - near, np.finfo(np.float32).tiny)
    values = np.where(hit, 1.0 + np.rint(_STEPS * share), 0.0).astype(np.uint16)
    write_gray_png(path, values, {"depth_near": f"{near!r}", "depth_far": f"{far!r}", "depth_formula": _FORMULA})
