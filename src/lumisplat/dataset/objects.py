"""Objects that are put into a scene: each on its ground, with room around it."""

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
"""Places that are tried for an object at once."""
_BATCHES = 4
"""How often."""
_FOOTPRINT = np.array([(0.0, 0.0), (0.6, 0.0), (-0.6, 0.0), (0.0, 0.6), (0.0, -0.6)])
"""Where the ground below an object is looked for, in radii of its sphere."""


@dataclass(frozen=True, eq=False)
class Asset:
    """An object, before it is placed."""

    name: str
    """Of its file, without the extension."""
    scene: Scene
    """It alone, in its own coordinates."""
    points: Doubles
    """Its surface, without stray Gaussians, shape (N, 3)."""
    middle: Doubles
    """Of its box, shape (3,)."""
    radius: float
    """Of the sphere around that."""

    @classmethod
    def of(cls, name: str, loaded: Gaussians | Mesh | Scene) -> Asset:
        """From what a file holds; its lights are left out.

        Raises:
            SceneError: There is nothing to see, or it has no size.
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
            raise SceneError(f"{name} has no size: it cannot be put into a scene")
        return cls(name, scene, points, middle, radius)


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """An object in a scene."""

    asset: Asset
    world_from_object: Doubles
    """Similarity, shape (4, 4)."""
    center: Doubles
    """Of its sphere, world space, shape (3,)."""
    radius: float

    @property
    def splats(self) -> list[SplatInstance]:
        """Its captures, in the scene."""
        return [self._moved(one) for one in self.asset.scene.splats]

    @property
    def meshes(self) -> list[MeshInstance]:
        """Its meshes, in the scene."""
        return [self._moved(one) for one in self.asset.scene.meshes]

    def _moved(self, instance: _Instance) -> _Instance:
        return replace(instance, world_from_object=self.world_from_object @ instance.transform)


@dataclass(frozen=True)
class Placement:
    """The objects of a view."""

    placed: tuple[PlacedObject, ...] = ()
    left_out: tuple[str, ...] = ()
    """Names of those that found no room."""


class ObjectPlacer:
    """Puts objects into a scene.

    Args:
        config: How many, and how.
        assets: Those to choose from.
        space: The scene.
    """

    def __init__(self, config: DatasetObjects, assets: list[Asset], space: Space) -> None:
        self._config, self._assets, self._space = config, assets, space

    def place(self, draws: Draws) -> Placement:
        """The objects of a view; the larger ones of each draw have no advantage: who comes first has the room."""
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
        """An object somewhere on the ground; None: there is no room."""
        scale, rotation = self._scale(asset, draws), self._rotation(asset, draws)
        linear, radius, up = scale * rotation, scale * asset.radius, self._space.up
        foot = float(np.einsum("ni,i->n", asset.points - asset.middle, linear.T @ up).min())
        for points in draws.units(_BATCHES, _POSITIONS, 3):  # all of them are drawn, whichever is taken
            center = self._free_center(points, radius, foot, others)
            if center is not None:
                matrix = np.eye(4)
                matrix[:3, :3] = linear
                matrix[:3, 3] = center - linear @ asset.middle
                return PlacedObject(asset, matrix, center, radius)
        return None

    def _free_center(self, units: Doubles, radius: float, foot: float, others: list[PlacedObject]) -> Doubles | None:
        """The first of some places on the ground that has room, as the centre of the object's sphere.

        Args:
            units: Places in the scene's box, 0..1, shape (N, 3).
            radius: Of the sphere.
            foot: Height of the lowest point of the object above the centre, below 0.
            others: What stands already.
        """
        space = self._space
        starts = space.low + units * (space.high - space.low)
        across = np.stack(level_axes(space.up))
        under = starts[:, None] + radius * (_FOOTPRINT @ across)
        heights = space.ground_heights(under.reshape(-1, 3)).reshape(len(starts), -1)
        good: Flags = np.asarray(np.isfinite(heights).all(axis=1))
        heights = np.where(good[:, None], heights, 0.0)
        good &= heights.max(axis=1) - heights.min(axis=1) <= 2.0 * radius * self._config.unevenness
        centers = starts + (heights.max(axis=1) - foot - starts @ space.up)[:, None] * space.up
        for other in others:
            good &= np.linalg.norm(centers - other.center, axis=1) >= radius + other.radius
        rows = np.flatnonzero(good)
        if not rows.size:
            return None
        free = rows[space.hemispheres_free(centers[rows], np.full(rows.size, radius))]
        return centers[free[0]] if free.size else None

    def _scale(self, asset: Asset, draws: Draws) -> float:
        """Its size, and how much larger that makes it."""
        own, wanted = draws.factor(self._config.scale), draws.factor(self._config.size)
        return own if self._config.own_size else 0.5 * wanted * self._space.diagonal / asset.radius

    def _rotation(self, asset: Asset, draws: Draws) -> Doubles:
        """A rotation, shape (3, 3)."""
        share, first, second = draws.units(3)
        if not self._config.upright:
            return rotation_matrix(uniform_quaternion(share, first, second))
        upright = rotation_matrix(self._space.scene.upright_wxyz) @ rotation_matrix(asset.scene.upright_wxyz).T
        return axis_rotation(self._space.up, 2.0 * math.pi * first) @ upright


def uniform_quaternion(share: float, first: float, second: float) -> Doubles:
    """A rotation from three numbers that are spread evenly from 0 to 1; all are as likely (Shoemake 1992).

    Returns:
        A unit quaternion, scalar first, shape (4,).
    """
    one, other = math.sqrt(1.0 - share), math.sqrt(share)
    a, b = 2.0 * math.pi * first, 2.0 * math.pi * second
    return np.array([other * math.cos(b), one * math.sin(a), one * math.cos(a), other * math.sin(b)])
