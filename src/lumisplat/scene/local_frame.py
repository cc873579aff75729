"""Local frames: scenes and cameras relative to a local origin and unit, so that float32 can represent them.

Kernels compute in float32 with seven digits: at map coordinates of 5,000,000, neighbouring numbers are 0.5 apart.
Scenes far from zero are therefore moved in float64 before anything becomes float32 (docs/adr/0086-one-local-origin.md).
This module also transforms meshes and Gaussians to world space.
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
"""Largest ratio of the near plane to the size of the scene's largest object. `NEAR_PLANE` is halved until the ratio is
smaller, so that a millimetre-sized scene in metres is not clipped."""

# Local origins (docs/adr/0086-one-local-origin.md)

ORIGIN_GRID = 16.0
"""Step of the grid of local origins, in units of the scene's size; the step is rounded up to a power of two. Positions
keep five digits below the scene's size. A scene around zero keeps its origin, and so does a scene that moves a little.
"""

SIZE_SAMPLE = 4096
"""Largest number of means or vertices from which the size of a capture or mesh is estimated."""

SIZE_TAIL = 0.02
"""Fraction of a capture's sampled means that its bounding box ignores at each end of each axis, as outliers."""

CAMERA_MARGIN = 1.1
"""Scene extent, as in INRIA's trainer, over the largest distance of a camera from the mean camera position."""


class _Box(NamedTuple):
    """Object-space bounding box of a capture (less outliers) or of a mesh, and the nearest point of the origin grid."""

    low: Doubles
    high: Doubles
    middle: Doubles
    """Point of the origin grid nearest to the box's centre, shape (3,): zero unless the box is far from the object's
    origin."""
    is_far: bool


_Asset = TypeVar("_Asset", Gaussians, Mesh)

_CENTERED: WeakKeyDictionary[Gaussians | Mesh, tuple[Gaussians | Mesh, Doubles]] = WeakKeyDictionary()
"""Cache for captures and meshes whose means or vertices are far from zero: a copy stored relative to a point of the
origin grid, and the grid point."""
_BOXES: WeakKeyDictionary[Gaussians | Mesh, _Box] = WeakKeyDictionary()


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """A coordinate system with an origin and a unit: world position p has local coordinates (p - origin) / unit."""

    origin: Doubles
    """World position of the local coordinate origin, shape (3,)."""
    unit: float = 1.0
    """Length of the local unit in scene units."""

    @classmethod
    def of_cameras(cls, cameras: Sequence[Camera], extent: float) -> LocalFrame:
        """Returns the frame around the mean camera position, with a unit in which the cameras' extent is ``extent``.

        Args:
            cameras: At least one camera.
            extent: Wanted `camera_extent` of the cameras in local units. If all cameras are at one position, the unit
                stays 1.
        """
        eyes = np.stack([camera.eye for camera in cameras])
        middle, found = eyes.mean(axis=0), camera_extent(cameras)
        is_coincident = found < COINCIDENT_EXTENT * float(np.abs(eyes).max())
        return cls(middle, 1.0 if is_coincident or found == 0.0 else found / extent)

    @property
    def is_world(self) -> bool:
        """True if the origin is zero and the unit 1, so that local and world coordinates are the same."""
        return self.unit == 1.0 and not self.origin.any()

    def points(self, points: npt.NDArray[np.floating]) -> Doubles:
        """Converts N world positions to local coordinates, ``(p - origin) / unit``, shape (N, 3)."""
        return (np.asarray(points, np.float64) - self.origin) / self.unit

    def camera(self, camera: Camera) -> Camera:
        """Converts a world-space camera to local coordinates."""
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
        """Converts local Gaussians to world space; means that float32 cannot represent get a non-zero ``origin``."""
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
        """Converts a local ``camera_from_local`` pose to ``camera_from_world``, shape (4, 4)."""
        pose = np.array(camera_from_local, np.float64)
        pose[:3, 3] = self.unit * pose[:3, 3] - pose[:3, :3] @ self.origin
        return pose

    def scene(self, scene: Scene) -> Scene:
        """Moves a scene so that this frame's origin becomes zero; lengths keep the world's unit.

        Captures and meshes with coordinates far from zero are stored anew around a grid point; repeated calls return
        the same copy.
        """
        assets = [*(one.gaussians for one in scene.splats), *(one.mesh for one in scene.meshes)]
        if not self.origin.any() and not any(_box(asset).is_far for asset in assets):
            return scene
        splats, meshes = list(scene.splats), list(scene.meshes)
        for number, splat in enumerate(splats):
            gaussians, transform = self._placed(splat.gaussians, splat.transform)
            splats[number] = replace(splat, gaussians=gaussians, world_from_object=transform)
        for number, instance in enumerate(meshes):
            mesh, transform = self._placed(instance.mesh, instance.transform)
            meshes[number] = replace(instance, mesh=mesh, world_from_object=transform)
        return replace(scene, splats=splats, meshes=meshes, lights=[self._moved_light(light) for light in scene.lights])

    def _placed(self, asset: _Asset, world_from_object: Doubles) -> tuple[_Asset, Doubles]:
        """Returns an asset and its object-to-local matrix; assets far from zero are first stored anew around zero."""
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
    """Returns 1.1 times the largest distance of a camera from the mean camera position, scene units."""
    eyes = np.stack([camera.eye for camera in cameras])
    return CAMERA_MARGIN * float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max())


def rendered_frame(scene: Scene) -> tuple[LocalFrame, float]:
    """Returns the local frame in which a scene is rendered, and the default near plane of its cameras.

    The origin is zero unless the scene is far from zero. Otherwise the origin is the point of a grid that is nearest to
    the scene's centre; the grid is so coarse that a scene that moves a little keeps its origin. Small scenes get a
    nearer near plane.
    """
    if not (scene.splats or scene.meshes):
        return LocalFrame(np.zeros(3)), NEAR_PLANE
    middles, sizes = _boxes(scene)
    low, high = (middles - 0.5 * sizes).min(axis=0), (middles + 0.5 * sizes).max(axis=0)
    largest = float(np.linalg.norm(sizes, axis=1).max())
    return LocalFrame(_grid_point(0.5 * (low + high), float((high - low).max()))), default_near(largest)


def default_near(size: float) -> float:
    """Returns the default near plane for a largest object of size ``size``, scene units.

    `NEAR_PLANE` is halved until it is at most a thousandth of the size. Similar sizes, such as those of a capture and
    of its chunks, thus have the same near plane.
    """
    halvings = math.ceil(math.log2(NEAR_PLANE / (NEAR_SHARE * size))) if size > 0.0 else 0
    return NEAR_PLANE * 2.0 ** -max(halvings, 0)


def register_box(gaussians: Gaussians, low: Doubles, high: Doubles) -> None:
    """Gives a part of a capture the whole capture's bounding box, so that all parts share one local origin.

    Args:
        gaussians: Part of a capture.
        low: Smallest coordinates of the whole capture, shape (3,).
        high: Largest coordinates of the whole capture, shape (3,).
    """
    middle = _grid_point(0.5 * (low + high), float((high - low).max()))
    _BOXES[gaussians] = _Box(low, high, middle, bool(middle.any()))


def needed_origin(points: Doubles, width: float) -> Doubles:
    """Returns an origin, shape (3,), relative to which float32 resolves the points; zero if no other origin is needed.

    Args:
        points: Positions, shape (N, 3), float64; positions beyond float32's range are ignored.
        width: Size of the smallest detail to resolve, in the points' unit: a scale of Gaussians, an edge of triangles.
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
    """Returns the grid point nearest to ``middle``; the step is `ORIGIN_GRID` times ``size``, rounded up to 2^k."""
    least = max(ORIGIN_GRID * size, 1e-12 * float(np.abs(middle).max()), 1e-300)
    step = 2.0 ** math.ceil(math.log2(least))
    return np.asarray(np.round(middle / step) * step, np.float64)


def _box(asset: Gaussians | Mesh) -> _Box:
    """Returns the object-space bounding box of a capture (less outliers) or mesh; estimated once and cached."""
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
    """Returns centres and sides, (N, 3) each, of the world-space boxes, less outliers, of a scene's N instances."""
    assets = [*(one.gaussians for one in scene.splats), *(one.mesh for one in scene.meshes)]
    boxes = np.array([_box(asset)[:2] for asset in assets])
    matrices = np.array([one.transform for one in (*scene.splats, *scene.meshes)])[:, :3]
    middles = np.einsum("nij,nj->ni", matrices[:, :, :3], 0.5 * boxes.sum(axis=1)) + matrices[:, :, 3]
    return middles, np.einsum("nij,nj->ni", np.abs(matrices[:, :, :3]), boxes[:, 1] - boxes[:, 0])


ZERO: Doubles = np.zeros(3)
"""The origin of world coordinates, (0, 0, 0)."""

_STRAYS = 0.01
"""Fraction of a caster's Gaussians that its bounding box ignores at each end of each axis, as outliers."""


def placed_mesh(instance: MeshInstance) -> Mesh:
    """Returns an instance's mesh with vertices in world space; if the transform mirrors, triangles are reversed."""
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
    """World-space means, rotations, scales and opacities of Gaussians of one or more instances, float32."""

    means: FloatArray
    """World positions of the N centres minus the caller's origin, shape (N, 3)."""
    rotations_wxyz: FloatArray
    """World-from-Gaussian unit quaternions, shape (N, 4)."""
    scales: FloatArray
    """Standard deviations along the Gaussians' axes in world space, scene units, shape (N, 3)."""
    opacities: FloatArray
    """Opacity at the centre of each Gaussian, 0..1, shape (N,)."""

    @property
    def rotations_xyzw(self) -> FloatArray:
        """World-from-Gaussian unit quaternions in the order of Warp's quaternions, scalar last, shape (N, 4)."""
        return self.rotations_wxyz[:, [1, 2, 3, 0]]


def placed_gaussians(instances: Iterable[SplatInstance], origin: Doubles = ZERO) -> PlacedGaussians:
    """Returns the Gaussians of all instances in world space relative to ``origin``, in order; may be empty."""
    empty = PlacedGaussians(*(np.empty((0, *shape), np.float32) for shape in ((3,), (4,), (3,), ())))
    parts = [empty, *(_in_world(instance, origin) for instance in instances)]
    return PlacedGaussians(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def distance_from_body(points: npt.NDArray[np.floating], gaussians: PlacedGaussians) -> npt.NDArray[np.floating]:
    """Returns the Chebyshev distance (largest component along an axis) of P points from the Gaussians' bounding box.

    Args:
        points: World positions, shape (P, 3).
        gaussians: At least one Gaussian; their box ignores the outermost 1 % of the means at each end of each axis.

    Returns:
        Distances, scene units, 0 inside the box, shape (P,).
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
