"""Selection of Gaussians by their values, by a box or a sphere, and removal of floaters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from lumisplat.constants import SH_C0
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray, finite_numbers
from lumisplat.scene.checks import check_argument, check_positive, check_whole
from lumisplat.scene.gaussians import Gaussians

FLOATER_NEIGHBOURS = 4
"""Default number of other Gaussians that must be near a Gaussian for `remove_floaters` to keep it."""

FLOATER_REACH = 3.0
"""Default radius within which `remove_floaters` counts other Gaussians. Unit: the Gaussian's largest scale, or the
capture's median largest scale if that is more. At 3 scales the visible footprint of a Gaussian about ends."""

Range = tuple[float | None, float | None]
"""Smallest and largest value of Gaussians to keep, both included; None: no limit on this side."""

Box = tuple[npt.ArrayLike, npt.ArrayLike]
Sphere = tuple[npt.ArrayLike, float]

_BLOCK = 2**16
"""Number of Gaussians whose neighbours `remove_floaters` searches between two progress reports."""


def _remaining(gaussians: Gaussians, kept: npt.NDArray[np.bool_]) -> Gaussians:
    """Returns the Gaussians that the mask ``kept``, shape (N,), selects; ``gaussians`` itself if all are selected.

    Raises:
        SceneError: No Gaussian is selected; the message states the capture's bounds.
    """
    if kept.all():
        return gaussians
    if not kept.any():
        low, high = gaussians.bounds()
        bounds = "({:.4g}, {:.4g}, {:.4g}) to ({:.4g}, {:.4g}, {:.4g})".format(*low, *high)
        raise SceneError(f"no Gaussian of {gaussians.count:,} is left; their means lie within {bounds}")
    return gaussians.subset(kept)


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
    """Keeps the Gaussians whose values lie in all given ranges, such as ``opacity=(0.1, None)``.

    Args:
        gaussians: Capture.
        opacity: Opacity, 0..1.
        scale_min: Smallest of the three standard deviations, scene units.
        scale_max: Largest of the three standard deviations, scene units.
        x: X coordinate of the mean plus the capture's ``origin``, scene units.
        y: Y coordinate of the mean plus the capture's ``origin``, scene units.
        z: Z coordinate of the mean plus the capture's ``origin``, scene units.
        red: Mean colour over all directions, display-referred, 0..1 or slightly outside.
        green: Mean colour, as for red.
        blue: Mean colour, as for red.
        roughness: Roughness, 0..1, for captures that store it.
        metallic: Metalness, 0..1, for captures that store it.

    Returns:
        The selected Gaussians, unchanged, in their order; ranges include both limits.

    Raises:
        SceneError: A range is no pair of numbers, the capture does not store a value, or no Gaussian is left.
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
    return _remaining(gaussians, kept)


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
    """Returns the quantity ``name``, such as ``"opacity"`` or ``"x"`` (see `select`), of each of N Gaussians, (N,)."""
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
        raise SceneError(f"select cannot use {name}: the capture has none")
    return values


def crop(
    gaussians: Gaussians, box: Box | None = None, sphere: Sphere | None = None, *, outside: bool = False
) -> Gaussians:
    """Keeps the Gaussians whose means lie in a box, in a sphere, or in both if both are given.

    Args:
        gaussians: Capture.
        box: Two opposite corners, shape (3,) each, in either order, in coordinates that include the capture's
            ``origin``.
        sphere: Centre, in the same coordinates, shape (3,), and radius, above 0, scene units.
        outside: Keep the Gaussians outside instead.

    Returns:
        The selected Gaussians, unchanged, in their order; the border belongs to the inside.

    Raises:
        SceneError: Neither box nor sphere is given, one is malformed, or no Gaussian is left.
    """
    check_argument("crop", gaussians, Gaussians, "Gaussians")
    if box is None and sphere is None:
        raise SceneError("crop takes a box or a sphere: box=(corner, corner), sphere=(centre, radius)")
    inside = np.ones(gaussians.count, dtype=bool)
    if box is not None:
        corners = _pair("box", box, "two corners of three numbers")
        first, second = (_point("box", corner) - gaussians.origin for corner in corners)
        low, high = np.minimum(first, second), np.maximum(first, second)
        inside &= ((gaussians.means >= low) & (gaussians.means <= high)).all(axis=1)
    if sphere is not None:
        center, radius = _pair("sphere", sphere, "a centre of three numbers and a radius")
        size = finite_numbers(radius, ())
        check_positive("the radius of sphere", radius if size is None else size.item())
        assert size is not None
        offset = gaussians.means - (_point("sphere", center) - gaussians.origin)
        inside &= np.einsum("ij,ij->i", offset, offset) <= size.item() ** 2
    return _remaining(gaussians, ~inside if outside else inside)


def _pair(name: str, value: object, expected: str) -> tuple[npt.ArrayLike, npt.ArrayLike]:
    try:
        first, second = value  # pyright: ignore[reportGeneralTypeIssues, reportUnknownVariableType]
    except (TypeError, ValueError):
        raise SceneError(f"{name} is {value}, expected {expected}") from None
    return first, second  # pyright: ignore[reportUnknownVariableType]


def _point(name: str, value: npt.ArrayLike) -> npt.NDArray[np.float64]:
    numbers = finite_numbers(value, (3,))
    if numbers is None:
        raise SceneError(f"{name} has the point {value}, expected three finite numbers")
    return numbers


def remove_floaters(
    gaussians: Gaussians,
    neighbours: int = FLOATER_NEIGHBOURS,
    reach: float = FLOATER_REACH,
    *,
    progress: Callable[[float], None] | None = None,
) -> Gaussians:
    """Removes isolated Gaussians: those with fewer than ``neighbours`` other Gaussians around them.

    Another Gaussian counts if its mean is within ``reach`` times the Gaussian's largest scale, or within ``reach``
    times the capture's median largest scale if that is more. Thus wide Gaussians of a distant background, which are far
    from each other, are kept. A clump of more than ``neighbours`` floaters is kept, too: use `crop` and `select` to
    remove it.

    Args:
        gaussians: Capture.
        neighbours: Smallest number of other Gaussians around a Gaussian that is kept, 1 or more.
        reach: Distance within which others count, in the scales named above, above 0.
        progress: Called with the fraction done, 0..1.

    Returns:
        The remaining Gaussians, unchanged, in their order.

    Raises:
        SceneError: An argument is out of range, or no Gaussian is left.
    """
    check_argument("remove_floaters", gaussians, Gaussians, "Gaussians")
    check_whole("neighbours", neighbours, 1, 1_000_000)
    check_positive("reach", reach)
    largest = gaussians.scales.max(axis=1)
    typical = np.float32(np.median(largest))
    radii = np.float32(reach) * np.maximum(largest, typical)
    tree, floating = cKDTree(gaussians.means), np.empty(gaussians.count, np.bool_)
    for start in range(0, gaussians.count, _BLOCK):
        rows = slice(start, start + _BLOCK)
        # The nearest neighbour of a Gaussian is itself; missing neighbours are infinitely far away.
        distance, _ = tree.query(gaussians.means[rows], k=[neighbours + 1])
        floating[rows] = distance[:, 0] > radii[rows]
        if progress:
            progress(min(start + _BLOCK, gaussians.count) / gaussians.count)
    return _remaining(gaussians, ~floating)
