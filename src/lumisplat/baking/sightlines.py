"""Rays from eyes in free space to Gaussians: what viewers of captures see (docs/method/relighting.md#baking)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.constants.baking import GOLDEN_STEP, SIGHT_REACH
from lumisplat.math.arrays import Doubles, FloatArray, IntArray
from lumisplat.math.rotations import matrices_from_quaternions
from lumisplat.math.transforms import transform_points
from lumisplat.scene.scene import SplatInstance

Draws = tuple[np.random.Generator, np.random.Generator]
"""Generators of numbers of rays, and of points."""


@dataclass(frozen=True, slots=True, eq=False)
class Sightlines:
    """Rays from where an eye may be, world space, some to each of N Gaussians."""

    gaussian: IntArray
    """Which Gaussians of the scene, shape (N,)."""
    origins: FloatArray
    """The eyes, (N, R, 3)."""
    directions: FloatArray
    """Unit, (N, R, 3)."""

    @classmethod
    def room(cls, gaussians: int, rays: int) -> Sightlines:
        """Room for so many rays to each of so many Gaussians."""
        shape = (gaussians, rays, 3)
        return cls(np.empty(gaussians, np.int32), np.empty(shape, np.float32), np.empty(shape, np.float32))

    def put(self, first: int, some: Sightlines) -> None:
        """Writes those of some Gaussians, from this row on."""
        rows = slice(first, first + len(some.gaussian))
        self.gaussian[rows], self.origins[rows], self.directions[rows] = some.gaussian, some.origins, some.directions

    def of(self, rows: npt.NDArray[np.int64] | slice) -> Sightlines:
        """Those to some of the Gaussians."""
        return Sightlines(self.gaussian[rows], self.origins[rows], self.directions[rows])


def sightlines(
    instance: SplatInstance,
    directions: Doubles,
    weights: Doubles,
    distances: Doubles,
    *,
    first: int,
    count: int,
    draws: Draws,
) -> Sightlines:
    """Some rays to each Gaussian, from eyes that see its middle, through a point drawn from it.

    From views that count more come more of them. Eyes are spread along the distance up to which the Gaussian is seen,
    the farther the more: those that are in free space anywhere would be spread evenly, each with as many pixels of it
    as it shows, but people look across rooms, and not at the wall beside them.

    Args:
        instance: The Gaussians, in their place.
        directions: From the eye, object space, unit, shape (N, D, 3).
        weights: Of these, shape (N, D).
        distances: Up to which it is seen, scene units, shape (N, D).
        first: Number of the first Gaussian in the scene.
        count: Rays of each Gaussian.
        draws: Each draws Gaussian by Gaussian, so that a set may come in parts.
    """
    gaussians = instance.gaussians
    total = gaussians.count
    across = weights * distances
    shares = np.cumsum(across / across.sum(axis=1, keepdims=True), axis=1)
    numbers = draws[0].random((total, count, 2))
    # Any first few of them are spread evenly over the views.
    wanted = (GOLDEN_STEP * np.arange(count) + numbers[:, :1, 0]) % 1.0
    view = (wanted[:, :, None] > shares[:, None, :-1]).sum(axis=2)
    along = np.take_along_axis(directions, view[:, :, None], axis=1)
    away = np.take_along_axis(distances, view, axis=1) * np.sqrt(numbers[..., 1]) / instance.scale
    point = draws[1].standard_normal((total, count, 3))
    point *= np.minimum(1.0, SIGHT_REACH / np.maximum(np.linalg.norm(point, axis=2, keepdims=True), 1e-12))
    axes = matrices_from_quaternions(gaussians.rotations_wxyz.astype(np.float64))
    means = gaussians.means[:, None].astype(np.float64)
    place = means + (point * gaussians.scales[:, None]) @ np.swapaxes(axes, 1, 2)
    eyes = transform_points(instance.transform, (means - away[:, :, None] * along).reshape(-1, 3))
    ways = transform_points(instance.transform, place.reshape(-1, 3)) - eyes
    length = np.linalg.norm(ways, axis=1, keepdims=True)
    # An eye within the very point that it looks at looks past it.
    ahead = along.reshape(-1, 3) @ (instance.transform[:3, :3] / instance.scale).T
    ways = np.where(length > 0.0, ways / np.maximum(length, 1e-300), ahead)
    shape = (total, count, 3)
    return Sightlines(
        np.arange(first, first + total, dtype=np.int32),
        eyes.reshape(shape).astype(np.float32),
        ways.reshape(shape).astype(np.float32),
    )
