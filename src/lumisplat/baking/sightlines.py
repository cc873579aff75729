"""Rays from eyes in free space to Gaussians: what viewers of captures see (docs/method/relighting.md#baking)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.constants.baking import GOLDEN_STEP, SIGHT_REACH
from lumisplat.math.arrays import Doubles, FloatArray, IntArray
from lumisplat.math.transforms import matrices_from_quaternions, transform_points
from lumisplat.scene.scene import SplatInstance


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Rays, world space, R to each of N Gaussians."""

    origins: FloatArray
    """The eyes, (N, R, 3)."""
    directions: FloatArray
    """Unit, (N, R, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class Sightlines:
    """Ways along which eyes may see N Gaussians, D each, world space: rays are drawn from them when they are needed."""

    gaussian: IntArray
    """Which Gaussians of the scene, shape (N,)."""
    means: FloatArray
    """Shape (N, 3)."""
    axes: FloatArray
    """Those of the Gaussians, times standard deviations, in columns, shape (N, 3, 3)."""
    directions: FloatArray
    """From the eye, unit, shape (N, D, 3)."""
    distances: FloatArray
    """Up to which eyes see the Gaussian, scene units, shape (N, D)."""
    shares: FloatArray
    """Of rays along each way and the ways before it, up to 1, shape (N, D)."""

    @classmethod
    def room(cls, gaussians: int, ways: int) -> Sightlines:
        """Room for so many ways to each of so many Gaussians."""
        shapes = (3,), (3, 3), (ways, 3), (ways,), (ways,)
        return cls(np.empty(gaussians, np.int32), *(np.empty((gaussians, *shape), np.float32) for shape in shapes))

    @classmethod
    def of_views(
        cls, instance: SplatInstance, directions: Doubles, weights: Doubles, distances: Doubles, first: int
    ) -> Sightlines:
        """Those of views of an instance's Gaussians: the more rays, the more a view counts and the farther it sees.

        Eyes that are in free space anywhere would be spread evenly along a view, each with as many pixels of the
        Gaussian as it shows; but people look across rooms, and not at the wall beside them.

        Args:
            instance: The Gaussians, in their place.
            directions: From the eye, object space, unit, shape (N, D, 3).
            weights: Of these, shape (N, D).
            distances: Up to which it is seen, scene units, shape (N, D).
            first: Number of the first Gaussian in the scene.
        """
        gaussians = instance.gaussians
        across = weights * distances
        linear = instance.transform[:3, :3]
        axes = matrices_from_quaternions(gaussians.rotations_wxyz.astype(np.float64)) * gaussians.scales[:, None]
        return cls(
            np.arange(first, first + gaussians.count, dtype=np.int32),
            transform_points(instance.transform, gaussians.means.astype(np.float64)).astype(np.float32),
            (linear @ axes).astype(np.float32),
            (directions @ (linear.T / instance.scale)).astype(np.float32),
            distances.astype(np.float32),
            np.cumsum(across / across.sum(axis=1, keepdims=True), axis=1).astype(np.float32),
        )

    def put(self, first: int, some: Sightlines) -> None:
        """Writes those of some Gaussians, from this row on."""
        rows = slice(first, first + len(some.gaussian))
        for name in self.__slots__:
            getattr(self, name)[rows] = getattr(some, name)

    def of(self, rows: npt.NDArray[np.int64]) -> Sightlines:
        """Those of some of the Gaussians."""
        return Sightlines(*(getattr(self, name)[rows] for name in self.__slots__))

    def lines(self, number: int, count: int, seed: int) -> Lines:
        """Rays to each Gaussian, through points drawn from it: those of a round, evenly spread over the ways.

        Eyes are spread along the distance up to which the Gaussian is seen, the farther the more.

        Args:
            number: Of the round, from 0 on: each has other rays.
            count: Of the rays to each Gaussian; the same in all rounds.
            seed: By which, and by the number of the Gaussian, points and distances are drawn.
        """
        even, point = self._draws(number, count, seed)
        wanted = (GOLDEN_STEP * np.arange(number * count, (number + 1) * count) + even[:, :1]) % 1.0
        # With the row added, the shares of all Gaussians ascend, and are searched at once.
        row = np.arange(len(wanted))[:, None]
        below = np.searchsorted((row + self.shares[:, :-1].astype(np.float64)).ravel(), row + wanted)
        way = below - row * (self.shares.shape[1] - 1)
        along = np.take_along_axis(self.directions, way[:, :, None], axis=1).astype(np.float64)
        away = np.take_along_axis(self.distances, way, axis=1) * np.sqrt(even[:, 1:])
        point *= np.minimum(1.0, SIGHT_REACH / np.maximum(np.linalg.norm(point, axis=2, keepdims=True), 1e-12))
        # From the eye; one within the very point that it looks at looks past it.
        towards = away[..., None] * along + point @ np.swapaxes(self.axes, 1, 2)
        length = np.linalg.norm(towards, axis=2, keepdims=True)
        towards = np.where(length > 0.0, towards / np.maximum(length, 1e-300), along)
        eyes = self.means[:, None] - away[..., None] * along
        return Lines(eyes.astype(np.float32), towards.astype(np.float32))

    def _draws(self, number: int, count: int, seed: int) -> tuple[Doubles, Doubles]:
        """Even numbers, the first of a Gaussian the same in all rounds, (N, 1 + R), and normal ones, (N, R, 3)."""
        even, normal = np.empty((len(self.gaussian), 1 + count)), np.empty((len(self.gaussian), count, 3))
        for row, gaussian in enumerate(self.gaussian):
            start, rng = (
                np.random.Generator(np.random.Philox(key=(seed, int(gaussian)), counter=(0, 0, 0, first)))
                for first in (0, 1 + number)
            )
            even[row, 0] = start.random()
            rng.random(out=even[row, 1:])
            rng.standard_normal(out=normal[row])
        return even, normal
