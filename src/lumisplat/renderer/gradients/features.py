"""Renders arbitrary features of Gaussians, such as depths and normals, in raster frames, and computes gradients.

The kernels that render frames are reused. Rendering replaces the colour and normal of splats by six features at a time;
the backward pass replaces the colour of splats by three features at a time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.device.structs.raster import Splat
from lumisplat.device.structs.rays import EXTRA_FIELDS, GaussianHits
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.renderer.gradients import feature_kernels as kernels
from lumisplat.renderer.gradients.arrays import SetGradient, SplatGradients
from lumisplat.renderer.gradients.splat_backward import SplatBackward
from lumisplat.renderer.raster.unlit_raster import DrawnSplats, UnlitRaster
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.camera_rays import ray_count
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene, SplatInstance


@dataclass(frozen=True, slots=True)
class RenderedFeatures:
    """Features of Gaussians, C each, after blending over the pixels of a frame."""

    of_splats: DeviceArray
    """C features of each of N splats, shape (N, C)."""
    of_pixels: DeviceArray
    """Blended sums of C features at each pixel, shape (H * W, C)."""

    @property
    def count(self) -> int:
        """Number of features of each Gaussian, C."""
        return self.of_splats.shape[1]


class FeatureChannels:
    """Renders features of the splats of a frame, and computes gradients with respect to the features.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        raster: The rasteriser that has drawn the frame.
        backward: Computes splat gradients from pixel gradients.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, raster: UnlitRaster, backward: SplatBackward) -> None:
        self._launcher, self._buffers, self._raster, self._backward = launcher, buffers, raster, backward

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def render(self, scene: DeviceScene, drawn: DrawnSplats, features: FloatArray | DeviceArray) -> RenderedFeatures:
        """Blends features of splats over the pixels, with the weights that blend colours.

        Args:
            scene: The scene on the device, as it was drawn.
            drawn: The splats of the frame.
            features: C features of each of the scene's N Gaussians, shape (N, C).
        """
        pixels, columns = math.prod(scene.image_size), features.shape[1]
        rendered = RenderedFeatures(
            self._upload("features.splats", features),
            self._buffers.get("features.pixels", wp.float32, (pixels, columns)),
        )
        sums = self._buffers.struct("features.sums", GaussianHits, ray_count(*scene.image_size), EXTRA_FIELDS)
        for first in range(0, columns, 6):
            self._raster.sum_splats(scene, self._with_features(drawn, rendered, first), sums)
            self._launcher.run_banded(kernels.store_sums, pixels, scene.camera, sums, first, rendered.of_pixels)
        return rendered

    def backward(
        self,
        scene: DeviceScene,
        drawn: DrawnSplats,
        rendered: RenderedFeatures,
        by_pixels: FloatArray | DeviceArray,
        by_splat: DeviceArray,
    ) -> DeviceArray:
        """Returns gradients with respect to C features of N Gaussians, (N, C); also adds gradients to ``by_splat``.

        Args:
            scene: As for ``render``.
            drawn: As for ``render``.
            rendered: The rendered features.
            by_pixels: Gradients of the loss with respect to the blended sums at the pixels, shape (H * W, C).
            by_splat: Gradients with respect to the shapes of the splats, to which this pass adds.
        """
        count, get, run = by_pixels.shape[0], self._buffers.get, self._launcher.run_banded
        given = self._upload("features.by_pixels", by_pixels)
        pixels, gradient = PixelData(), PixelGradient()
        pixels.color, gradient.color = (
            get(f"features.{name}", wp.vec3, count) for name in ("pixel_sums", "by_pixel_sums")
        )
        pixels.alpha = gradient.alpha = get("features.no_alpha", wp.float32, count)
        pixels.alpha.fill_(0.0)
        by_features = get("features.by_splats", wp.float32, rendered.of_splats.shape)
        for first in range(0, rendered.count, 3):
            run(kernels.take_three, count, rendered.of_pixels, first, pixels.color)
            run(kernels.take_three, count, given, first, gradient.color)
            showing = self._with_features(drawn, rendered, first)
            part = self._backward.splats(scene, showing, pixels, gradient, name="features.gradients")
            run(kernels.add_gradients, drawn.splats.count, part, first, by_splat, by_features)
        return by_features[: drawn.splats.count]

    def _with_features(self, drawn: DrawnSplats, rendered: RenderedFeatures, first: int) -> DrawnSplats:
        """Returns the drawn splats with features ``first`` to ``first + 5`` as their colours and normals."""
        splats = self._buffers.get("features.drawn_splats", Splat, drawn.splats.count)
        inputs = (rendered.of_splats, first, drawn.splats.rects, drawn.splats.data, splats)
        self._launcher.run_banded(kernels.replace_colors, drawn.splats.count, *inputs)
        return replace(drawn, splats=replace(drawn.splats, data=splats), tiles=replace(drawn.tiles, splats=splats))

    def _upload(self, name: str, values: FloatArray | DeviceArray) -> DeviceArray:
        if isinstance(values, wp.array):
            return values
        array = self._buffers.get(name, wp.float32, (max(len(values), 1), values.shape[1]))
        if values.size:
            array.assign(values)
        return array


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceFeatures:
    """Depths and normals of the Gaussians of a scene, as features for ``DifferentiableRenderer.render_features``.

    The normal is the shortest axis of the Gaussian. For flat Gaussians it is the surface normal. Unlike the normal of
    the max-density plane, the shortest axis does not depend on the scales, so a loss on normals rotates Gaussians and
    changes nothing else::

        renderer.render(scene, camera)
        surface = ls.gradients.SurfaceFeatures.of(scene, camera)
        sums = renderer.render_features(surface.values)  # weighted sums of depth, and of normals
        gradients = renderer.gradients(by_color, dL_dfeatures=by_sums)
        gradients = surface.backward(gradients)  # adds the chain rule through depths and normals
    """

    scene: Scene
    camera: Camera
    values: FloatArray
    """Four features of each of the scene's N Gaussians, instance by instance, shape (N, 4): view depth of the mean in
    scene units, and world-space unit normal facing the eye."""

    @classmethod
    def of(cls, scene: Scene, camera: Camera) -> SurfaceFeatures:
        """Computes the depths and normals of a scene's Gaussians for a camera.

        Args:
            scene: The scene.
            camera: A pinhole camera.
        """
        parts = [np.column_stack([_depths(s, camera), _normals(s, camera) @ _rotation(s).T]) for s in scene.splats]
        values = np.concatenate(parts) if parts else np.zeros((0, 4))
        return cls(scene, camera, values.astype(np.float32))

    def backward(self, gradients: SplatGradients, first: int = 0) -> SplatGradients:
        """Adds the gradients of means, rotations and camera pose that the gradients of depths and normals cause.

        Depths depend on means and pose, normals on rotations. Where a normal flips or another axis becomes the
        shortest, the normal jumps, and the jump has no gradient.

        Args:
            gradients: Result of ``DifferentiableRenderer.gradients`` with ``dL_dfeatures``.
            first: Column of the rendered features that holds the depths; the next three columns hold the normals.
        """
        assert gradients.features is not None, "call gradients with dL_dfeatures first"
        by_values = gradients.features[:, first : first + 4].astype(np.float64)
        numbers: dict[int, int] = {}
        sets, pose, begin = list(gradients.sets), np.zeros((4, 4)), 0
        for instance in self.scene.splats:
            number = numbers.setdefault(id(instance.gaussians), len(numbers))
            by_depth, by_normal = np.split(by_values[begin : begin + instance.gaussians.count], [1], axis=1)
            begin += instance.gaussians.count
            sets[number] = _added(sets[number], instance, self.camera, by_depth, by_normal)
            pose[2, :3] += by_depth[:, 0] @ instance.world_means
            pose[2, 3] += by_depth.sum()
        total = None if gradients.camera_from_world is None else gradients.camera_from_world + pose
        return replace(gradients, sets=tuple(sets), camera_from_world=total)


def _depths(instance: SplatInstance, camera: Camera) -> Doubles:
    """Returns the view depth of each of an instance's N means, scene units, shape (N,)."""
    return instance.world_means @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]


def _rotation(instance: SplatInstance) -> Doubles:
    """Returns the rotation of an instance from object to world space, shape (3, 3)."""
    return instance.transform[:3, :3] / instance.scale


def _normals(instance: SplatInstance, camera: Camera) -> Doubles:
    """Returns the shortest axis of each of an instance's N Gaussians, facing the eye, in object space, shape (N, 3)."""
    gaussians = instance.gaussians
    axes = matrices_from_quaternions(gaussians.rotations_wxyz)
    shortest = np.argmin(gaussians.scales, axis=1)
    normals = np.take_along_axis(axes, shortest[:, None, None], axis=2)[:, :, 0]
    to_eye = (camera.eye - instance.world_means) @ _rotation(instance)
    return np.where(np.sum(normals * to_eye, axis=1, keepdims=True) < 0.0, -normals, normals)


def _added(
    gradient: SetGradient, instance: SplatInstance, camera: Camera, by_depth: Doubles, by_normal: Doubles
) -> SetGradient:
    """Adds gradients of an instance's N depths, (N, 1), and N world normals, (N, 3), to those of its Gaussian set."""
    by_mean = by_depth * (camera.camera_from_world[2, :3] @ instance.transform[:3, :3])
    by_rotation_vector = np.cross(_normals(instance, camera), by_normal @ _rotation(instance))
    by_rotation = _by_quaternion(instance.gaussians, by_rotation_vector)
    return replace(
        gradient,
        means=(gradient.means + by_mean).astype(np.float32),
        rotations_wxyz=(gradient.rotations_wxyz + by_rotation).astype(np.float32),
    )


def _by_quaternion(gaussians: Gaussians, by_rotation_vector: Doubles) -> Doubles:
    """Converts gradients ``t`` of small object-space rotations of N Gaussians to gradients of their quaternions ``q``.

    The result has shape (N, 4). A small rotation ``w`` moves ``q`` by half of ``(0, w) q``, so the gradient is
    ``2 (0, t) q``.
    """
    w, v = np.split(gaussians.rotations_wxyz.astype(np.float64), [1], axis=1)
    scalar = -np.sum(by_rotation_vector * v, axis=1, keepdims=True)
    return 2.0 * np.concatenate([scalar, w * by_rotation_vector + np.cross(by_rotation_vector, v)], axis=1)
