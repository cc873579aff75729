"""Gaussians inside a box or a sphere."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import finite_numbers
from lumisplat.scene.checks import check_argument, check_positive
from lumisplat.scene.editing.remaining import remaining
from lumisplat.scene.gaussians import Gaussians

Box = tuple[npt.ArrayLike, npt.ArrayLike]
Sphere = tuple[npt.ArrayLike, float]


def crop(
    gaussians: Gaussians, box: Box | None = None, sphere: Sphere | None = None, *, outside: bool = False
) -> Gaussians:
    """Keeps the Gaussians whose means lie in a box, in a sphere, or in both if both are given.

    Args:
        gaussians: The capture.
        box: Two opposite corners in the capture's coordinates, shape (3,) each, in either order.
        sphere: Centre, shape (3,), and radius, above 0, scene units.
        outside: Keep the others instead.

    Returns:
        Those Gaussians, in their order, unchanged; the border belongs to the inside.

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
    return remaining(gaussians, ~inside if outside else inside)


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
