"""Local frames: scenes and cameras about an origin of their own, and in another unit, so that float32 can hold them.

Kernels compute in float32, which holds seven digits: at map coordinates of 5,000,000 it is 0.5 apart. What is far from
zero is therefore moved, in float64, before anything becomes float32 (docs/adr/0086-one-local-origin.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from lumisplat.constants import NEAR_PLANE, NEAR_SHARE, ORIGIN_GRID, ORIGIN_LOSS, SIZE_SAMPLE, SIZE_TAIL
from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightPoint, LightRect, LightSphere, LightSpot
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene

_BOXES: WeakKeyDictionary[Gaussians | Mesh, tuple[Doubles, Doubles]] = WeakKeyDictionary()
"""Of assets: the corners of their boxes."""


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """An origin and a unit: a point p of the world is (p - origin) / unit here."""

    origin: Doubles
    """World position of the frame's zero, shape (3,)."""
    unit: float = 1.0
    """Length of the frame's unit, scene units."""

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
            near=camera.near / self.unit,
            aperture=camera.aperture / self.unit,
            focus_distance=camera.focus_distance / self.unit,
            fx=camera.fx * focal,
            fy=camera.fy * focal,
        )

    def world_pose(self, camera_from_local: Doubles) -> Doubles:
        """Returns ``camera_from_world``, shape (4, 4), of a pose in this frame."""
        pose = np.array(camera_from_local, np.float64)
        pose[:3, 3] = self.unit * pose[:3, 3] - pose[:3, :3] @ self.origin
        return pose

    def scene(self, scene: Scene) -> Scene:
        """Returns a scene of the world about this frame's origin, whose unit is that of the world."""
        if not self.origin.any():
            return scene
        return replace(
            scene,
            splats=tuple(replace(one, world_from_object=self._place(one.transform)) for one in scene.splats),
            meshes=tuple(replace(one, world_from_object=self._place(one.transform)) for one in scene.meshes),
            lights=tuple(self._moved_light(light) for light in scene.lights),
        )

    def _place(self, world_from_object: Doubles) -> Doubles:
        matrix = world_from_object.copy()
        matrix[:3, 3] -= self.origin
        return matrix

    def _moved_light(self, light: Light) -> Light:
        if isinstance(light, LightPoint | LightSpot | LightSphere | LightRect):
            return replace(light, position=tuple((np.asarray(light.position) - self.origin).tolist()))
        return light

    def _pose(self, camera_from_world: Doubles) -> Doubles:
        pose = camera_from_world.copy()
        pose[:3, 3] = (pose[:3, 3] + pose[:3, :3] @ self.origin) / self.unit
        return pose


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
    middle = 0.5 * (low + high)
    least = max(ORIGIN_GRID * float((high - low).max()), 1e-12 * float(np.abs(middle).max()), 1e-300)
    step = 2.0 ** math.ceil(math.log2(least))
    largest = float(np.linalg.norm(sizes, axis=1).max())
    near = min(NEAR_SHARE * largest, NEAR_PLANE) if largest > 0.0 else NEAR_PLANE
    return LocalFrame(np.asarray(np.round(middle / step) * step, np.float64)), near


def needed_origin(points: Doubles, width: float) -> Doubles:
    """Returns an origin for points that float32 cannot hold about zero, shape (3,); zero where it can.

    Args:
        points: Positions, shape (N, 3), float64.
        width: Size of what is to be told apart, in the unit of the points: a scale of Gaussians, an edge of triangles.
    """
    middle = np.median(points[:: -(-len(points) // SIZE_SAMPLE)], axis=0)
    if np.abs(middle).max() * np.finfo(np.float32).eps <= ORIGIN_LOSS * width:
        return np.zeros(3)
    spread = float(np.ptp(points, axis=0).max())
    step = 10.0 ** math.floor(math.log10(max(spread, width)))
    return np.round(middle / step) * step


def _boxes(scene: Scene) -> tuple[Doubles, Doubles]:
    """Returns middles and sides of world boxes that most of each instance lies in, shape (N, 3) each."""
    assets = [*(one.gaussians for one in scene.splats), *(one.mesh for one in scene.meshes)]
    for asset in assets:
        if asset not in _BOXES:
            _BOXES[asset] = _asset_box(asset)
    boxes = np.array([_BOXES[asset] for asset in assets])
    matrices = np.array([one.transform for one in (*scene.splats, *scene.meshes)])[:, :3]
    middles = np.einsum("nij,nj->ni", matrices[:, :, :3], 0.5 * boxes.sum(axis=1)) + matrices[:, :, 3]
    return middles, np.einsum("nij,nj->ni", np.abs(matrices[:, :, :3]), boxes[:, 1] - boxes[:, 0])


def _asset_box(asset: Gaussians | Mesh) -> tuple[Doubles, Doubles]:
    """Returns corners of an asset's box, in its own space, from a few thousand of its points; strays do not count."""
    points = asset.means if isinstance(asset, Gaussians) else asset.positions
    every = -(-len(points) // SIZE_SAMPLE)
    points = points[::every].astype(np.float64)
    if isinstance(asset, Mesh):
        return points.min(axis=0), points.max(axis=0)
    low, high = np.quantile(points, (SIZE_TAIL, 1.0 - SIZE_TAIL), axis=0)
    width = float(np.median(asset.scales[::every].max(axis=1)))
    return low - width, high + width
