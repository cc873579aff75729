"""Local frames: scenes and cameras about an origin of their own, and in another unit, so that float32 can hold them.

Kernels compute in float32, which holds seven digits: at map coordinates of 5,000,000 it is 0.5 apart. What is far from
zero is therefore moved, in float64, before anything becomes float32 (docs/adr/0086-one-local-origin.md).
Meshes and Gaussians are also moved to world space here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar, cast
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from lumisplat.constants import COINCIDENT_EXTENT, NEAR_PLANE, ORIGIN_LOSS, ORIGIN_MESH_WIDTH, SCALE_MIN
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.transforms import multiply_quaternions, quaternions_from_matrices, transform_points
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, PlacedLight
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

NEAR_SHARE = 1e-3
"""View depth in front of which nothing is drawn, as a share of a scene's size, where that is less than `NEAR_PLANE`: a
scene of millimetres, in metres, is not cut away."""

# Local origins (docs/adr/0086-one-local-origin.md)

ORIGIN_GRID = 16.0
"""Step of the grid of origins of what is rendered, in sizes of the scene, rounded up to a power of two: positions have
five digits below the size of the scene, and what stands around zero, or moves a little, keeps its origin."""

SIZE_SAMPLE = 4096
"""Points of an asset, at most, that tell its size where that need not be exact."""

SIZE_TAIL = 0.02
"""Share of them at each end of each axis that counts as strays."""

CAMERA_MARGIN = 1.1
"""By how much a scene is taken to be larger than the sphere of its cameras, as INRIA's trainer does."""


class _Box(NamedTuple):
    """Where an asset is in its own space."""

    low: Doubles
    high: Doubles
    middle: Doubles
    """The point of a grid next to its middle, shape (3,): zero unless the asset is far from it."""
    is_far: bool


_Asset = TypeVar("_Asset", Gaussians, Mesh)

_CENTERED: WeakKeyDictionary[Gaussians | Mesh, tuple[Gaussians | Mesh, Doubles]] = WeakKeyDictionary()
"""Of assets that are far from their own zero: the same about a middle, and where that is."""
_BOXES: WeakKeyDictionary[Gaussians | Mesh, _Box] = WeakKeyDictionary()


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """An origin and a unit: a point p of the world is (p - origin) / unit here."""

    origin: Doubles
    """World position of the frame's zero, shape (3,)."""
    unit: float = 1.0
    """Length of the frame's unit, scene units."""

    @classmethod
    def of_cameras(cls, cameras: Sequence[Camera], extent: float) -> LocalFrame:
        """Returns the frame about the middle of cameras in which they are so far apart.

        Args:
            cameras: At least one.
            extent: What `camera_extent` is to be in the frame. Cameras in one place say nothing of a unit: it stays.
        """
        eyes = np.stack([camera.eye for camera in cameras])
        middle, found = eyes.mean(axis=0), camera_extent(cameras)
        is_one_place = found < COINCIDENT_EXTENT * float(np.abs(eyes).max())
        return cls(middle, 1.0 if is_one_place or found == 0.0 else found / extent)

    @property
    def is_world(self) -> bool:
        """Whether it is the world's own frame."""
        return self.unit == 1.0 and not self.origin.any()

    def points(self, points: npt.NDArray[np.floating]) -> Doubles:
        """Returns world positions in this frame, shape (N, 3)."""
        return (np.asarray(points, np.float64) - self.origin) / self.unit

    def camera(self, camera: Camera) -> Camera:
        """Returns a camera of the world in this frame."""
        if self.is_world:
            return camera
        end = camera.camera_from_world_end
        focal = self.unit if camera.model is CameraModel.ORTHOGRAPHIC else 1.0
        return replace(
            camera,
            camera_from_world=self._pose(camera.camera_from_world),
            camera_from_world_end=None if end is None else self._pose(end),
            near=camera.near if camera.near == NEAR_PLANE else camera.near / self.unit,
            aperture=camera.aperture / self.unit,
            focus_distance=camera.focus_distance / self.unit,
            fx=camera.fx * focal,
            fy=camera.fy * focal,
        )

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Returns Gaussians of this frame in the world, about an origin where float32 needs one."""
        means = self.unit * gaussians.means.astype(np.float64) + self.origin
        scales = (self.unit * gaussians.scales.astype(np.float64)).astype(np.float32)
        origin = needed_origin(means, float(np.median(scales)))
        return replace(
            gaussians,
            means=(means - origin).astype(np.float32),
            scales=np.maximum(scales, np.float32(SCALE_MIN)),
            origin=tuple(origin.tolist()),
        )

    def world_pose(self, camera_from_local: Doubles) -> Doubles:
        """Returns ``camera_from_world``, shape (4, 4), of a pose in this frame."""
        pose = np.array(camera_from_local, np.float64)
        pose[:3, 3] = self.unit * pose[:3, 3] - pose[:3, :3] @ self.origin
        return pose

    def scene(self, scene: Scene) -> Scene:
        """Returns a scene of the world about this frame's origin, whose unit is that of the world.

        Assets that are themselves far from their zero are about a middle of their own, the same in each call.
        """
        assets = [*(one.gaussians for one in scene.splats), *(one.mesh for one in scene.meshes)]
        if not self.origin.any() and not any(_box(asset).is_far for asset in assets):
            return scene
        splats, meshes = list(scene.splats), list(scene.meshes)
        for number, splat in enumerate(splats):
            gaussians, place = self._placed(splat.gaussians, splat.transform)
            splats[number] = replace(splat, gaussians=gaussians, world_from_object=place)
        for number, instance in enumerate(meshes):
            mesh, place = self._placed(instance.mesh, instance.transform)
            meshes[number] = replace(instance, mesh=mesh, world_from_object=place)
        return replace(scene, splats=splats, meshes=meshes, lights=[self._moved_light(light) for light in scene.lights])

    def _placed(self, asset: _Asset, world_from_object: Doubles) -> tuple[_Asset, Doubles]:
        """Returns an asset about its middle, and where that is in this frame."""
        matrix = world_from_object.copy()
        middle = _box(asset).middle
        if middle.any():
            centered = _CENTERED.get(asset)
            if centered is None:
                name = "means" if isinstance(asset, Gaussians) else "positions"
                points = (getattr(asset, name) - middle).astype(np.float32)
                centered = _CENTERED[asset] = replace(asset, **{name: points}), middle
            asset = cast("_Asset", centered[0])
            matrix[:3, 3] += matrix[:3, :3] @ middle
        matrix[:3, 3] -= self.origin
        return asset, matrix

    def _moved_light(self, light: Light) -> Light:
        if isinstance(light, PlacedLight):
            return replace(light, position=tuple((np.asarray(light.position) - self.origin).tolist()))
        return light

    def _pose(self, camera_from_world: Doubles) -> Doubles:
        pose = camera_from_world.copy()
        pose[:3, 3] = (pose[:3, 3] + pose[:3, :3] @ self.origin) / self.unit
        return pose


def camera_extent(cameras: Sequence[Camera]) -> float:
    """Returns 1.1 times the largest distance of a camera from the mean of their positions, scene units."""
    eyes = np.stack([camera.eye for camera in cameras])
    return CAMERA_MARGIN * float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max())


def rendered_frame(scene: Scene) -> tuple[LocalFrame, float]:
    """Returns the frame in which a scene is rendered, and the near plane of its cameras unless they say another.

    The origin is zero of the world unless the scene is far from it: then it is the point next to the scene's middle of
    a grid so coarse that scenes around zero, and those that move, keep theirs. Small scenes are not hidden behind the
    near plane.
    """
    if not (scene.splats or scene.meshes):
        return LocalFrame(np.zeros(3)), NEAR_PLANE
    middles, sizes = _boxes(scene)
    low, high = (middles - 0.5 * sizes).min(axis=0), (middles + 0.5 * sizes).max(axis=0)
    largest = float(np.linalg.norm(sizes, axis=1).max())
    return LocalFrame(_grid_point(0.5 * (low + high), float((high - low).max()))), default_near(largest)


def default_near(size: float) -> float:
    """Returns the near plane of cameras that do not say theirs, by the size of the largest asset, scene units.

    It is the default halved so often that it is a thousandth of the size or less: sizes that are nearly the same, as
    those of a capture and of its blocks, have the same near plane.
    """
    halvings = math.ceil(math.log2(NEAR_PLANE / (NEAR_SHARE * size))) if size > 0.0 else 0
    return NEAR_PLANE * 2.0 ** -max(halvings, 0)


def note_box(gaussians: Gaussians, low: Doubles, high: Doubles) -> None:
    """Tells the box of the capture that Gaussians are a part of: all parts are rendered in one frame, as it is.

    Args:
        gaussians: Some of a capture's.
        low: Least coordinates of all of it, shape (3,).
        high: Largest ones.
    """
    middle = _grid_point(0.5 * (low + high), float((high - low).max()))
    _BOXES[gaussians] = _Box(low, high, middle, bool(middle.any()))


def needed_origin(points: Doubles, width: float) -> Doubles:
    """Returns an origin for points that float32 cannot hold about zero, shape (3,); zero where it can.

    Args:
        points: Positions, shape (N, 3), float64; those beyond float32 do not count.
        width: Size of what is to be told apart, in the unit of the points: a scale of Gaussians, an edge of triangles.
    """
    points = points[:: -(-len(points) // SIZE_SAMPLE)]
    points = points[(np.abs(points) <= np.finfo(np.float32).max).all(axis=1)]
    if not len(points):
        return np.zeros(3)
    middle = np.median(points, axis=0)
    if not np.abs(middle).max() * np.finfo(np.float32).eps > ORIGIN_LOSS * width:
        return np.zeros(3)
    low, high = np.quantile(points, (SIZE_TAIL, 1.0 - SIZE_TAIL), axis=0)
    step = 10.0 ** math.floor(math.log10(max(float((high - low).max()), width, 1e-300)))
    return np.asarray(np.round(middle / step) * step, np.float64)


def _grid_point(middle: Doubles, size: float) -> Doubles:
    """Returns the nearest point of a grid whose step is `ORIGIN_GRID` sizes, rounded up to a power of two."""
    least = max(ORIGIN_GRID * size, 1e-12 * float(np.abs(middle).max()), 1e-300)
    step = 2.0 ** math.ceil(math.log2(least))
    return np.asarray(np.round(middle / step) * step, np.float64)


def _box(asset: Gaussians | Mesh) -> _Box:
    """Returns an asset's box, found once from a few thousand of its points; strays do not count."""
    found = _BOXES.get(asset)
    if found is None:
        points = asset.means if isinstance(asset, Gaussians) else asset.positions
        every = -(-len(points) // SIZE_SAMPLE)
        points = points[::every].astype(np.float64)
        if isinstance(asset, Mesh):
            low, high = points.min(axis=0), points.max(axis=0)
        else:
            width = float(np.median(asset.scales[::every].max(axis=1)))
            low, high = np.quantile(points, (SIZE_TAIL, 1.0 - SIZE_TAIL), axis=0)
            low, high = low - width, high + width
        middle = _grid_point(0.5 * (low + high), float((high - low).max()))
        found = _BOXES[asset] = _Box(low, high, middle, bool(middle.any()))
    return found


def _boxes(scene: Scene) -> tuple[Doubles, Doubles]:
    """Returns middles and sides of world boxes that most of each instance lies in, shape (N, 3) each."""
    assets = [*(one.gaussians for one in scene.splats), *(one.mesh for one in scene.meshes)]
    boxes = np.array([_box(asset)[:2] for asset in assets])
    matrices = np.array([one.transform for one in (*scene.splats, *scene.meshes)])[:, :3]
    middles = np.einsum("nij,nj->ni", matrices[:, :, :3], 0.5 * boxes.sum(axis=1)) + matrices[:, :, 3]
    return middles, np.einsum("nij,nj->ni", np.abs(matrices[:, :, :3]), boxes[:, 1] - boxes[:, 0])


ZERO: Doubles = np.zeros(3)
"""Zero of the world, as an origin."""

_STRAYS = 0.01
"""Share of a body's means on each side that its box leaves out."""


def placed_mesh(instance: MeshInstance) -> Mesh:
    """The mesh of an instance in world space; a mirrored one is wound the other way round."""
    mesh, linear = instance.mesh, instance.transform[:3, :3]
    if np.array_equal(instance.transform, np.eye(4)):
        return mesh
    flipped = np.linalg.det(linear) < 0.0
    positions = transform_points(instance.transform, mesh.positions)
    origin = needed_origin(positions, ORIGIN_MESH_WIDTH * float(np.ptp(positions, axis=0).max()))
    return replace(
        mesh,
        positions=(positions - origin).astype(np.float32),
        origin=tuple(origin.tolist()),
        normals=None if mesh.normals is None else (mesh.normals @ np.linalg.inv(linear)).astype(np.float32),
        indices=mesh.indices[:, ::-1] if flipped else mesh.indices,
    )


class PlacedGaussians(NamedTuple):
    """Gaussians in world space, as float32."""

    means: FloatArray
    """Shape (N, 3)."""
    rotations_wxyz: FloatArray
    """World from Gaussian, unit quaternions, shape (N, 4)."""
    scales: FloatArray
    """Standard deviations, shape (N, 3)."""
    opacities: FloatArray
    """0..1, shape (N,)."""

    @property
    def rotations_xyzw(self) -> FloatArray:
        """The rotations in the order of Warp's quaternions, shape (N, 4)."""
        return self.rotations_wxyz[:, [1, 2, 3, 0]]


def placed_gaussians(instances: Iterable[SplatInstance], origin: Doubles = ZERO) -> PlacedGaussians:
    """The Gaussians of all instances, in order, in world space about an origin; empty if there is no instance."""
    empty = PlacedGaussians(*(np.empty((0, *shape), np.float32) for shape in ((3,), (4,), (3,), ())))
    parts = [empty, *(_in_world(instance, origin) for instance in instances)]
    return PlacedGaussians(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def distance_from_body(points: npt.NDArray[np.floating], gaussians: PlacedGaussians) -> npt.NDArray[np.floating]:
    """How far points are from the box of a body along x, y or z, whichever is farthest; 0 within.

    Args:
        points: World space, shape (P, 3).
        gaussians: The body, at least one Gaussian. A hundredth of the means on each side does not count: strays.

    Returns:
        Scene units, shape (P,).
    """
    low, high = np.quantile(gaussians.means, (_STRAYS, 1.0 - _STRAYS), axis=0)
    return np.maximum(np.maximum(low - points, points - high), 0.0).max(axis=1, initial=0.0)


def _in_world(instance: SplatInstance, origin: Doubles) -> PlacedGaussians:
    gaussians, matrix, scale = instance.gaussians, instance.transform, instance.scale
    if np.array_equal(matrix, np.eye(4)) and not origin.any():
        return PlacedGaussians(gaussians.means, gaussians.rotations_wxyz, gaussians.scales, gaussians.opacities)
    world_from_object = quaternions_from_matrices(matrix[None, :3, :3] / scale)[0]
    return PlacedGaussians(
        (instance.world_means - origin).astype(np.float32),
        multiply_quaternions(world_from_object, gaussians.rotations_wxyz).astype(np.float32),
        (gaussians.scales * scale).astype(np.float32),
        gaussians.opacities,
    )
