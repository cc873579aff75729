"""Samples camera rays from free space towards Gaussians, and weights the views of a Gaussian."""

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
"""Smallest fraction of a Gaussian's view weight at which its front or back counts as visible. Views of a side that
does not are mirrored to the other."""

BACK_WEIGHT = 0.02
"""Weight of views of a Gaussian's back relative to views of its front; only if the capture stores normals."""

DARK_SIDE_MIN = 1e-3
"""Lower bound of the squared ratio of a side's luminance to that of the Gaussian's brighter side, by which the side's
views are weighted. The darker side is usually the inside of a closed object."""

GOLDEN_STEP = 0.6180339887498949
"""Fractional part of the golden ratio, whose multiples are evenly distributed in 0..1 for any count."""

POINT_REACH = 3.0
"""Largest distance of the points at which sample rays aim, in standard deviations from the Gaussian's mean."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnRays:
    """Rays in world space: R towards each of N Gaussians, one iteration's draw from `SampleRays`."""

    origins: FloatArray
    """Camera positions of R rays towards each of N Gaussians, world space, shape (N, R, 3)."""
    directions: FloatArray
    """Unit directions of R rays towards each of N Gaussians, world space, shape (N, R, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class SampleRays:
    """Distributions of camera rays in world space: D directions towards each of N Gaussians, with probabilities."""

    gaussian: IntArray
    """Index in the scene of each of N Gaussians, shape (N,)."""
    means: FloatArray
    """Means of N Gaussians, world space, shape (N, 3)."""
    axes: FloatArray
    """Axes of N Gaussians times their standard deviations, as columns, world space, shape (N, 3, 3)."""
    directions: FloatArray
    """Unit directions from the camera to each of N Gaussians, D each, world space, shape (N, D, 3)."""
    distances: FloatArray
    """Largest distance from which each of N Gaussians is visible along D directions, scene units, shape (N, D)."""
    cumulative: FloatArray
    """Cumulative probabilities of D directions towards each of N Gaussians, ending at 1, shape (N, D)."""

    @classmethod
    def allocated(cls, gaussians: int, directions_each: int) -> SampleRays:
        """Allocates uninitialised distributions for N = ``gaussians`` and D = ``directions_each``."""
        shapes = (3,), (3, 3), (directions_each, 3), (directions_each,), (directions_each,)
        return cls(np.empty(gaussians, np.int32), *(np.empty((gaussians, *shape), np.float32) for shape in shapes))

    @classmethod
    def of_views(
        cls, instance: SplatInstance, directions: Doubles, weights: Doubles, distances: Doubles, first: int
    ) -> SampleRays:
        """Builds the distributions of a splat instance from the weights and distances of views.

        The probability of a direction is proportional to weight times distance. Cameras anywhere in free space would be
        uniform along a view, and each would show the Gaussian in equally many pixels. The additional factor of the
        distance reflects that people look across rooms rather than at the wall beside them.

        Args:
            instance: The splat instance, with N Gaussians.
            directions: Unit directions of D views each, from the camera to the Gaussian, object space, shape (N, D, 3).
            weights: Weights of the directions, shape (N, D).
            distances: Largest distance from which the Gaussian is visible along each direction, scene units, shape (N,
                D).
            first: Index of the instance's first Gaussian in the scene.
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
        """Overwrites the rows from row ``first`` on with the distributions ``some``, one per row."""
        rows = slice(first, first + len(some.gaussian))
        for name in self.__slots__:
            getattr(self, name)[rows] = getattr(some, name)

    def of(self, rows: npt.NDArray[np.int64]) -> SampleRays:
        """Returns the distributions of the Gaussians whose rows (indices) are given."""
        return SampleRays(*(getattr(self, name)[rows] for name in self.__slots__))

    def draw(self, number: int, count: int, seed: int) -> DrawnRays:
        """Draws rays towards random points of each Gaussian, stratified over its directions.

        The probability density of camera positions along a direction grows linearly with the distance from the
        Gaussian.

        Args:
            number: Number of the iteration, from 0; each iteration draws other rays.
            count: Number of rays to each Gaussian, equal in all iterations.
            seed: Seed of points and distances, combined with the Gaussian's index.
        """
        uniform, points = self._draws(number, count, seed)
        wanted = (GOLDEN_STEP * np.arange(number * count, (number + 1) * count) + uniform[:, :1]) % 1.0
        # Adding the row index makes the probabilities of all Gaussians one ascending array, for a single search.
        row = np.arange(len(wanted))[:, None]
        below = np.searchsorted((row + self.cumulative[:, :-1].astype(np.float64)).ravel(), row + wanted)
        chosen = below - row * (self.cumulative.shape[1] - 1)
        along = np.take_along_axis(self.directions, chosen[:, :, None], axis=1).astype(np.float64)
        away = np.take_along_axis(self.distances, chosen, axis=1) * np.sqrt(uniform[:, 1:])
        points *= np.minimum(1.0, POINT_REACH / np.maximum(np.linalg.norm(points, axis=2, keepdims=True), 1e-12))
        # A camera at the viewed point itself looks along the direction instead.
        to_point = away[..., None] * along + points @ np.swapaxes(self.axes, 1, 2)
        length = np.linalg.norm(to_point, axis=2, keepdims=True)
        to_point = np.where(length > 0.0, to_point / np.maximum(length, 1e-300), along)
        eyes = self.means[:, None] - away[..., None] * along
        return DrawnRays(eyes.astype(np.float32), to_point.astype(np.float32))

    def _draws(self, number: int, count: int, seed: int) -> tuple[Doubles, Doubles]:
        """Returns random numbers for R rays to each of N Gaussians: uniform (N, 1 + R), and normal (N, R, 3).

        The normal ones have mean 0 and variance 1. The first uniform number of a Gaussian is the same in all
        iterations.
        """
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
    """Returns uniform random rotations as unit quaternions, wxyz, shape (count, 4)."""
    rotations = rng.standard_normal((count, 4))
    return rotations / np.linalg.norm(rotations, axis=1, keepdims=True)


def rotated_directions(count: int, rotations: Doubles) -> Doubles:
    """Returns ``count`` evenly spread directions for each of N Gaussians, rotated differently, shape (N, count, 3)."""
    return even_directions(count) @ np.swapaxes(matrices_from_quaternions(rotations), 1, 2)


def plane_normals(gaussians: Gaussians) -> Doubles:
    """Returns the normals of N Gaussians in object space, shape (N, 3).

    Without stored normals, the shortest axes are returned, with arbitrary sign.
    """
    if gaussians.normals is not None:
        return gaussians.normals.astype(np.float64)
    return shortest_axes(gaussians)


def on_visible_sides(directions: Doubles, normals: Doubles, weights: Doubles, front: Flags) -> Doubles:
    """Mirrors directions to the visible side of a Gaussian, if nearly all weight of pilot views is on one side.

    Args:
        directions: Directions to mirror, D for each of N Gaussians, shape (N, D, 3).
        normals: Normals of the Gaussians, shape (N, 3).
        weights: Weights of E pilot views of each Gaussian, shape (N, E).
        front: True for pilot views that show the front, shape (N, E).
    """
    share = weighted_means(weights, front.astype(np.float64))[:, None]
    across = (directions * normals[:, None]).sum(axis=2)
    unseen = ((share < SIDE_MIN) & (across < 0.0)) | ((share > 1.0 - SIDE_MIN) & (across > 0.0))
    mirrored = directions - 2.0 * across[..., None] * normals[:, None]
    return np.where(unseen[..., None], mirrored, directions)


def view_weights(front: Flags, light: Doubles, distance: Doubles, *, has_front: bool) -> Doubles:
    """Returns the weights of D views of each of N Gaussians, shape (N, D).

    A view's weight is proportional to the distance up to which cameras see the Gaussian. If cameras are anywhere in
    free space, their number grows with the squared distance and the Gaussian's pixels shrink by as much, so that each
    distance counts equally. SH cannot show two differently lit sides of a sheet, so the brighter side counts more: the
    darker side is the inside of a closed object, or the outside of a room. If normals are stored, the front counts
    more.

    Args:
        front: True for views that show the front, shape (N, D).
        light: Linear radiance of the views, shape (N, D, 3).
        distance: Distance up to which cameras see the Gaussian, shape (N, D).
        has_front: True if normals are stored, so that the front is the outside.
    """
    weights = np.maximum(distance, 1e-6 * distance.max(initial=1e-30))
    luminance = light @ np.array(LUMINANCE)
    front_light, back_light = (weighted_means(weights * side, luminance) for side in (front, ~front))
    brighter = np.maximum(np.maximum(front_light, back_light), 1e-30)
    of_front = np.maximum(np.square(front_light / brighter), DARK_SIDE_MIN)
    of_back = np.maximum(np.square(back_light / brighter), DARK_SIDE_MIN)
    if has_front:
        of_back *= BACK_WEIGHT
    return weights * np.where(front, of_front[:, None], of_back[:, None])


def weighted_means(weights: Doubles, values: Doubles) -> Doubles:
    """Returns the weighted mean of each of N rows of D values, shape (N, D) to (N,); 0 where all weights are 0."""
    total = weights.sum(axis=1)
    return np.divide((weights * values).sum(axis=1), total, out=np.zeros(len(total)), where=total > 0.0)
