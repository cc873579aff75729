"""Chooses the rays along which Gaussians are viewed, from free space, and their weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.constants import LUMINANCE
from lumisplat.math.arrays import Doubles, Flags, FloatArray, IntArray
from lumisplat.math.sh import even_directions
from lumisplat.math.transforms import matrices_from_quaternions, transform_points
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.normals import shortest_axes
from lumisplat.scene.scene import SplatInstance

SIDE_MIN = 0.05
"""Share of what counts below which a side is not looked at any further: the other one gets all directions."""

BACK_SHARE = 0.02
"""How much views of the back of Gaussians count whose normals are known, relative to those of their front."""

DARK_SIDE_MIN = 1e-3
"""Least factor of views of a side that is dark, where the other one is lit: it is the inside of something closed."""

GOLDEN_STEP = 0.6180339887498949
"""Fraction of the golden ratio: its multiples are spread evenly, however many there are."""

POINT_REACH = 3.0
"""Standard deviations from the middle of a Gaussian up to which rays look at it, of those seen together."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnRays:
    """Rays, world space, R to each of N Gaussians."""

    origins: FloatArray
    """The eyes, (N, R, 3)."""
    directions: FloatArray
    """Unit, (N, R, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class SampleRays:
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
    def allocated(cls, gaussians: int, directions_each: int) -> SampleRays:
        """Room for so many ways to each of so many Gaussians."""
        shapes = (3,), (3, 3), (directions_each, 3), (directions_each,), (directions_each,)
        return cls(np.empty(gaussians, np.int32), *(np.empty((gaussians, *shape), np.float32) for shape in shapes))

    @classmethod
    def of_views(
        cls, instance: SplatInstance, directions: Doubles, weights: Doubles, distances: Doubles, first: int
    ) -> SampleRays:
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

    def put(self, first: int, some: SampleRays) -> None:
        """Writes those of some Gaussians, from this row on."""
        rows = slice(first, first + len(some.gaussian))
        for name in self.__slots__:
            getattr(self, name)[rows] = getattr(some, name)

    def of(self, rows: npt.NDArray[np.int64]) -> SampleRays:
        """Those of some of the Gaussians."""
        return SampleRays(*(getattr(self, name)[rows] for name in self.__slots__))

    def draw(self, number: int, count: int, seed: int) -> DrawnRays:
        """Rays to each Gaussian, through points drawn from it: those of a round, evenly spread over the ways.

        Eyes are spread along the distance up to which the Gaussian is seen, the farther the more.

        Args:
            number: Of the round, from 0 on: each has other rays.
            count: Of the rays to each Gaussian; the same in all rounds.
            seed: By which, and by the number of the Gaussian, points and distances are drawn.
        """
        uniform, points = self._draws(number, count, seed)
        wanted = (GOLDEN_STEP * np.arange(number * count, (number + 1) * count) + uniform[:, :1]) % 1.0
        # With the row added, the shares of all Gaussians ascend, and are searched at once.
        row = np.arange(len(wanted))[:, None]
        below = np.searchsorted((row + self.shares[:, :-1].astype(np.float64)).ravel(), row + wanted)
        chosen = below - row * (self.shares.shape[1] - 1)
        along = np.take_along_axis(self.directions, chosen[:, :, None], axis=1).astype(np.float64)
        away = np.take_along_axis(self.distances, chosen, axis=1) * np.sqrt(uniform[:, 1:])
        points *= np.minimum(1.0, POINT_REACH / np.maximum(np.linalg.norm(points, axis=2, keepdims=True), 1e-12))
        # From the eye; one within the very point that it looks at looks past it.
        to_point = away[..., None] * along + points @ np.swapaxes(self.axes, 1, 2)
        length = np.linalg.norm(to_point, axis=2, keepdims=True)
        to_point = np.where(length > 0.0, to_point / np.maximum(length, 1e-300), along)
        eyes = self.means[:, None] - away[..., None] * along
        return DrawnRays(eyes.astype(np.float32), to_point.astype(np.float32))

    def _draws(self, number: int, count: int, seed: int) -> tuple[Doubles, Doubles]:
        """Even numbers, the first of a Gaussian the same in all rounds, (N, 1 + R), and normal ones, (N, R, 3)."""
        uniform, normal = np.empty((len(self.gaussian), 1 + count)), np.empty((len(self.gaussian), count, 3))
        for row, gaussian in enumerate(self.gaussian):
            start, rng = (
                np.random.Generator(np.random.Philox(key=(seed, int(gaussian)), counter=(0, 0, 0, first)))
                for first in (0, 1 + number)
            )
            uniform[row, 0] = start.random()
            rng.random(out=uniform[row, 1:])
            rng.standard_normal(out=normal[row])
        return uniform, normal


def random_rotations(count: int, rng: np.random.Generator) -> Doubles:
    """Rotations, uniform, as unit quaternions, wxyz, shape (count, 4)."""
    rotations = rng.standard_normal((count, 4))
    return rotations / np.linalg.norm(rotations, axis=1, keepdims=True)


def rotated_directions(count: int, rotations: Doubles) -> Doubles:
    """Even directions, turned for each Gaussian, so that neighbours are seen from others: shape (N, count, 3)."""
    return even_directions(count) @ np.swapaxes(matrices_from_quaternions(rotations), 1, 2)


def plane_normals(gaussians: Gaussians) -> Doubles:
    """Normals, object space, shape (N, 3): those that are stored, else the smallest axes, of either sign."""
    if gaussians.normals is not None:
        return gaussians.normals.astype(np.float64)
    return shortest_axes(gaussians)


def on_visible_sides(directions: Doubles, normals: Doubles, weights: Doubles, front: Flags) -> Doubles:
    """Directions, mirrored at the planes of the Gaussians onto the side that alone counts, where one does.

    Args:
        directions: To be looked along, shape (N, D, 3).
        normals: Of the planes, shape (N, 3).
        weights: Of views that have been looked at already, shape (N, E).
        front: Which of those show the front, shape (N, E).
    """
    share = side_means(weights, front.astype(np.float64))[:, None]
    across = (directions * normals[:, None]).sum(axis=2)
    unseen = ((share < SIDE_MIN) & (across < 0.0)) | ((share > 1.0 - SIDE_MIN) & (across > 0.0))
    mirrored = directions - 2.0 * across[..., None] * normals[:, None]
    return np.where(unseen[..., None], mirrored, directions)


def view_weights(front: Flags, light: Doubles, distance: Doubles, *, has_front: bool) -> Doubles:
    """How much views count, shape (N, D).

    The share of all pixels that show a Gaussian from a direction, if eyes are anywhere in free space, is as the
    distance up to which they see it: there are more of them farther away, by its square, but it is smaller to them by
    as much. Harmonics cannot show two sides of a sheet that are lit differently. So the side counts that is lit: the
    other one is the inside of something closed, or the outside of a room. And of Gaussians with normals, their front.

    Args:
        front: Whether the front is seen, shape (N, D).
        light: Linear radiance, shape (N, D, 3).
        distance: Up to which it is seen, shape (N, D).
        has_front: Whether the front is the outside.
    """
    weights = np.maximum(distance, 1e-6 * distance.max(initial=1e-30))
    luminance = light @ np.array(LUMINANCE)
    front_light, back_light = (side_means(weights * side, luminance) for side in (front, ~front))
    brighter = np.maximum(np.maximum(front_light, back_light), 1e-30)
    of_front = np.maximum(np.square(front_light / brighter), DARK_SIDE_MIN)
    of_back = np.maximum(np.square(back_light / brighter), DARK_SIDE_MIN)
    if has_front:
        of_back *= BACK_SHARE
    return weights * np.where(front, of_front[:, None], of_back[:, None])


def side_means(weights: Doubles, values: Doubles) -> Doubles:
    """Weighted means over directions, shape (N, D) to (N,); 0 where nothing counts."""
    total = weights.sum(axis=1)
    return np.divide((weights * values).sum(axis=1), total, out=np.zeros(len(total)), where=total > 0.0)
