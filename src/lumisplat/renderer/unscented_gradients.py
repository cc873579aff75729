"""Derivatives of what a frame that is rasterised along rays shows, from arrays of the host to arrays of the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.gradients.ray_pose import pose_of_rays_gradient
from lumisplat.renderer.gradients.results import SplatGradients, by_background, host_values, set_gradient
from lumisplat.renderer.gradients.unscented_backward import UnscentedBackward
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.unscented.unscented_raster import SplatsOnRays
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class MetFrame:
    """What a frame that is rasterised along rays was drawn from."""

    scene: Scene
    camera: Camera
    met: SplatsOnRays


class UnscentedGradients:
    """Goes back from what the rays of pixels have met.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._buffers = buffers
        self._backward = UnscentedBackward(launcher, buffers)

    def modules(self) -> list[KernelModule]:
        """The kernel modules."""
        return self._backward.modules()

    def of_frame(
        self, scene: DeviceScene, frame: MetFrame, by_color: FloatArray, gradient: PixelGradient, *, pose: bool
    ) -> SplatGradients:
        """Derivatives by what a frame was drawn from.

        Args:
            scene: As it was drawn.
            frame: The frame.
            by_color: Derivatives by its colour, shape (H, W, 3).
            gradient: The same on the device, and those by its alpha.
            pose: Whether to differentiate by the camera's pose, too.
        """
        met = frame.met
        pixels = PixelBuffers.of(self._buffers, scene.image_size).data
        by_splat = self._backward.splats(scene, met, pixels, gradient)
        sets = [
            set_gradient(self._backward.gaussians(scene, met, by_splat, number)) for number in range(len(scene.assets))
        ]
        by_pose = None
        if pose:
            rows = pose_of_rays_gradient(self._backward.motions(met), frame.scene.splats, frame.camera)
            by_pose = np.vstack([rows, np.zeros(4)])
        rects = met.splats.rects.numpy()
        none = np.zeros((0, 2), np.float32)
        return SplatGradients(
            sets=tuple(sets),
            background=by_background(by_color, 1.0 - host_values(pixels.alpha)),
            camera_from_world=by_pose,
            centers=none,
            centers_absolute=none,
            weights=np.where(rects["x0"] < rects["x1"], by_splat.numpy()["weight"], np.float32(0.0)),
        )
