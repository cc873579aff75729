"""Gaussians by their values."""

from __future__ import annotations

import numpy as np

from lumisplat.constants import SH_C0
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.checks import check_argument
from lumisplat.scene.editing.remaining import remaining
from lumisplat.scene.gaussians import Gaussians

Range = tuple[float | None, float | None]
"""Smallest and largest value that is kept; None: no limit."""


def select(
    gaussians: Gaussians,
    *,
    opacity: Range | None = None,
    scale_min: Range | None = None,
    scale_max: Range | None = None,
    x: Range | None = None,
    y: Range | None = None,
    z: Range | None = None,
    red: Range | None = None,
    green: Range | None = None,
    blue: Range | None = None,
    roughness: Range | None = None,
    metallic: Range | None = None,
) -> Gaussians:
    """Keeps the Gaussians whose values lie in all the ranges that are given, such as ``opacity=(0.1, None)``.

    Args:
        gaussians: The capture.
        opacity: 0..1.
        scale_min: The smallest of the three standard deviations, scene units.
        scale_max: The largest of them.
        x: Of the mean, in the capture's coordinates, scene units.
        y: The same.
        z: The same.
        red: Mean colour over all directions, display-referred, 0..1 or a little outside.
        green: The same.
        blue: The same.
        roughness: 0..1, of captures that have it.
        metallic: The same.

    Returns:
        Those Gaussians, in their order, unchanged; both limits of a range belong to it.

    Raises:
        SceneError: A range is no pair of numbers, the capture lacks a value, or no Gaussian is left.
    """
    check_argument("select", gaussians, Gaussians, "Gaussians")
    ranges = {
        "opacity": opacity,
        "scale_min": scale_min,
        "scale_max": scale_max,
        "x": x,
        "y": y,
        "z": z,
        "red": red,
        "green": green,
        "blue": blue,
        "roughness": roughness,
        "metallic": metallic,
    }
    given = {name: _limits(name, limits) for name, limits in ranges.items() if limits is not None}
    if not given:
        raise SceneError("select takes at least one range, such as opacity=(0.1, None)")
    kept = np.ones(gaussians.count, dtype=bool)
    for name, (low, high) in given.items():
        values = _values(gaussians, name)
        kept &= (values >= low) & (values <= high)
    return remaining(gaussians, kept)


def _limits(name: str, limits: object) -> tuple[float, float]:
    try:
        low, high = limits  # pyright: ignore[reportGeneralTypeIssues, reportUnknownVariableType]
        low = -np.inf if low is None else float(low)  # pyright: ignore[reportUnknownArgumentType]
        high = np.inf if high is None else float(high)  # pyright: ignore[reportUnknownArgumentType]
    except (TypeError, ValueError):
        raise SceneError(f"{name} is {limits}, expected its smallest and largest value, None for no limit") from None
    if not low <= high:
        raise SceneError(f"{name} is {limits}, expected the smaller value first")
    return low, high


def _values(gaussians: Gaussians, name: str) -> FloatArray:
    """One number for each Gaussian, shape (N,)."""
    if name in ("x", "y", "z"):
        axis = "xyz".index(name)
        return gaussians.means[:, axis] + gaussians.origin[axis] if any(gaussians.origin) else gaussians.means[:, axis]
    if name in ("red", "green", "blue"):
        channel = ("red", "green", "blue").index(name)
        return gaussians.sh[:, 0, channel] * np.float32(SH_C0) + np.float32(0.5)
    if name == "scale_min":
        return gaussians.scales.min(axis=1)
    if name == "scale_max":
        return gaussians.scales.max(axis=1)
    if name == "opacity":
        return gaussians.opacities
    values: FloatArray | None = getattr(gaussians, name)
    if values is None:
        raise SceneError(f"select cannot go by {name}: the capture has none")
    return values
