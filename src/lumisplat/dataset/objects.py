"""Inserts objects into a scene; each object stands on the ground, with free space around it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from lumisplat.config.dataset import DatasetObjects
from lumisplat.dataset.draws import Draws
from lumisplat.dataset.space import Space, level_axes
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, Flags
from lumisplat.math.transforms import axis_rotation, rotation_matrix, transform_points
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

_Instance = TypeVar("_Instance", SplatInstance, MeshInstance)

_POSITIONS = 32
"""Number of random positions that are tested together for one object; see `_BATCHES`."""
_BATCHES = 4
"""Number of times that `_POSITIONS` random positions are tested for an object before it is left out."""
_FOOTPRINT = np.array([(0.0, 0.0), (0.6, 0.0), (-0.6, 0.0), (0.0, 0.6), (0.0, -0.6)])
"""Horizontal offsets of the points at which the ground below an object is measured, in bounding radii."""


@dataclass(frozen=True, eq=False)
class Asset:
    """An object that can be inserted into the views of a data set, in the coordinates of its file."""

    name: str
    """Name of the object's file without its extension."""
    scene: Scene
    """Scene that contains only the object."""
    points: Doubles
    """Mesh vertices and Gaussian means of the object, without stray Gaussians, shape (N, 3)."""
    middle: Doubles
    """Centre of the object's bounding box, shape (3,)."""
    radius: float
    """Radius of the sphere around ``middle`` that contains ``points``."""

    @classmethod
    def of(cls, name: str, loaded: Gaussians | Mesh | Scene) -> Asset:
        """Returns the object that a file contains, without the lights of the file.

        Raises:
            SceneError: The object is empty or has no size.
        """
        if isinstance(loaded, Gaussians):
            loaded = Scene([loaded])
        elif isinstance(loaded, Mesh):
            loaded = Scene(meshes=[loaded])
        scene = replace(loaded, lights=())
        low, high = scene.bulk_bounds()
        parts = [splats.world_means for splats in scene.splats]
        parts += [transform_points(mesh.transform, mesh.mesh.positions) for mesh in scene.meshes]
        points = np.concatenate(parts)
        points = points[((points >= low) & (points <= high)).all(axis=1)]
        middle = (0.5 * (low + high)).astype(np.float32).astype(np.float64)
        radius = float(np.float32(np.linalg.norm(points - middle, axis=1).max())) if len(points) else 0.0
        if not radius > 0.0:
            raise SceneError(f"{name} has no size: it cannot be inserted into a scene")
        return cls(name, scene, points, middle, radius)


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """An object that was inserted into a view, with its position."""

    asset: Asset
    world_from_object: Doubles
    """Similarity transform from the coordinates of the object's file to the world, shape (4, 4)."""
    center: Doubles
    """Centre of the object's bounding sphere, world space, shape (3,)."""
    radius: float

    @property
    def splats(self) -> list[SplatInstance]:
        """Captures of the object in world space."""
        return [self._moved(one) for one in self.asset.scene.splats]

    @property
    def meshes(self) -> list[MeshInstance]:
        """Meshes of the object in world space."""
        return [self._moved(one) for one in self.asset.scene.meshes]

    def _moved(self, instance: _Instance) -> _Instance:
        return replace(instance, world_from_object=self.world_from_object @ instance.transform)


@dataclass(frozen=True)
class Placement:
    """Objects that were inserted into the scene of one view, and the names of the objects that did not fit."""

    placed: tuple[PlacedObject, ...] = ()
    left_out: tuple[str, ...] = ()
    """Names of objects that could not be inserted, because no free position was found."""


class ObjectPlacer:
    """Places objects at random in a scene.

    Args:
        config: Number, size and orientation of objects.
        assets: Objects to choose from.
        space: Extent, ground and free space of the scene.
    """

    def __init__(self, config: DatasetObjects, assets: list[Asset], space: Space) -> None:
        self._config, self._assets, self._space = config, assets, space

    def place(self, draws: Draws) -> Placement:
        """Chooses the objects of a view at random, and places one after the other in the scene."""
        if not self._assets:
            return Placement()
        placed: list[PlacedObject] = []
        left_out: list[str] = []
        for _ in range(draws.whole(self._config.count)):
            asset = self._assets[draws.below(len(self._assets))]
            found = self._place(asset, placed, draws)
            if found is None:
                left_out.append(asset.name)
            else:
                placed.append(found)
        return Placement(tuple(placed), tuple(left_out))

    def _place(self, asset: Asset, others: list[PlacedObject], draws: Draws) -> PlacedObject | None:
        """Places one object at random on the ground; returns None if no free position is found."""
        scale, rotation = self._scale(asset, draws), self._rotation(asset, draws)
        linear, radius, up = scale * rotation, scale * asset.radius, self._space.up
        foot = float(np.einsum("ni,i->n", asset.points - asset.middle, linear.T @ up).min())
        for points in draws.units(_BATCHES, _POSITIONS, 3):  # draws all positions of a batch, whichever is used
            center = self._free_center(points, radius, foot, others)
            if center is not None:
                matrix = np.eye(4)
                matrix[:3, :3] = linear
                matrix[:3, 3] = center - linear @ asset.middle
                return PlacedObject(asset, matrix, center, radius)
        return None

    def _free_center(self, units: Doubles, radius: float, foot: float, others: list[PlacedObject]) -> Doubles | None:
        """Returns the first of N candidate centres with both level ground and free space for an object, else None.

        Args:
            units: Candidate positions in the scene's box, as fractions 0..1 of the box, shape (N, 3). Their heights are
                replaced, so that the object stands on the ground.
            radius: Radius of the object's bounding sphere.
            foot: Height of the object's lowest point relative to the centre, below 0.
            others: Objects that are already placed.
        """
        space = self._space
        starts = space.low + units * (space.high - space.low)
        across = np.stack(level_axes(space.up))
        under = starts[:, None] + radius * (_FOOTPRINT @ across)
        heights = space.ground_heights(under.reshape(-1, 3)).reshape(len(starts), -1)
        is_usable: Flags = np.asarray(np.isfinite(heights).all(axis=1))
        heights = np.where(is_usable[:, None], heights, 0.0)
        is_usable &= heights.max(axis=1) - heights.min(axis=1) <= 2.0 * radius * self._config.unevenness
        centers = starts + (heights.max(axis=1) - foot - starts @ space.up)[:, None] * space.up
        for other in others:
            is_usable &= np.linalg.norm(centers - other.center, axis=1) >= radius + other.radius
        rows = np.flatnonzero(is_usable)
        if not rows.size:
            return None
        free = rows[space.hemispheres_free(centers[rows], np.full(rows.size, radius))]
        return centers[free[0]] if free.size else None

    def _scale(self, asset: Asset, draws: Draws) -> float:
        """Returns a random scale for an object: a factor on its own size, or its size relative to the scene."""
        scale, size = draws.factor(self._config.scale), draws.factor(self._config.size)
        return scale if self._config.own_size else 0.5 * size * self._space.diagonal / asset.radius

    def _rotation(self, asset: Asset, draws: Draws) -> Doubles:
        """Returns a random rotation for an object, shape (3, 3): about up for upright objects, else any rotation."""
        u1, u2, u3 = draws.units(3)
        if not self._config.upright:
            return rotation_matrix(uniform_quaternion(u1, u2, u3))
        upright = rotation_matrix(self._space.scene.upright_wxyz) @ rotation_matrix(asset.scene.upright_wxyz).T
        return axis_rotation(self._space.up, 2.0 * math.pi * u2) @ upright


def uniform_quaternion(u1: float, u2: float, u3: float) -> Doubles:
    """Maps three uniform random numbers of 0..1 to a uniformly distributed random rotation (Shoemake 1992).

    Returns:
        A unit quaternion, scalar first, shape (4,).
    """
    r1, r2 = math.sqrt(1.0 - u1), math.sqrt(u1)
    a, b = 2.0 * math.pi * u2, 2.0 * math.pi * u3
    return np.array([r2 * math.cos(b), r1 * math.sin(a), r1 * math.cos(a), r2 * math.sin(b)])
