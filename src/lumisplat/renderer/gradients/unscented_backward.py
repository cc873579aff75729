"""Backward pass of ``Projection.UNSCENTED``, from gradients at pixels to gradients of Gaussians and pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lumisplat.constants import TILE_BANDS_PER_THREAD
from lumisplat.device.gaussian.hit_gradient import RayMotion
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient, RaySplatGradient
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.gradients import ray_splat_backward_kernels as kernels
from lumisplat.renderer.gradients.arrays import (
    SplatGradients,
    by_background,
    gradient_of_asset,
    host_values,
    set_gradient,
)
from lumisplat.renderer.gradients.pose import pose_of_rays_gradient
from lumisplat.renderer.raster.binning import pair_starts
from lumisplat.renderer.raster.unscented_raster import DrawnRaySplats
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class UnscentedFrame:
    """Inputs of a frame of ``Projection.UNSCENTED``, and the Gaussians that its pixel rays hit."""

    scene: Scene
    camera: Camera
    drawn: DrawnRaySplats


class UnscentedBackward:
    """Computes gradients of the Gaussians that pixel rays hit, from gradients at the pixels.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    def modules(self) -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels.BLOCKS if self._launcher.is_parallel else kernels.TILES, kernels]

    def of_frame(
        self, scene: DeviceScene, frame: UnscentedFrame, by_color: FloatArray, gradient: PixelGradient, *, pose: bool
    ) -> SplatGradients:
        """Returns the gradients with respect to the inputs of a frame.

        Args:
            scene: The scene on the device, as it was drawn.
            frame: The frame.
            by_color: Gradients with respect to the colour of the frame, shape (H, W, 3).
            gradient: Gradients with respect to colour and alpha of the frame, on the device.
            pose: Whether to differentiate with respect to the camera pose, too.
        """
        drawn = frame.drawn
        pixels = PixelBuffers.of(self._buffers, scene.image_size).data
        by_splat = self.splats(scene, drawn, pixels, gradient)
        sets = [set_gradient(self.gaussians(scene, drawn, by_splat, number)) for number in range(len(scene.assets))]
        by_pose = None
        if pose:
            rows = pose_of_rays_gradient(self.motions(drawn), frame.scene.splats, frame.camera)
            by_pose = np.vstack([rows, np.zeros(4)])
        rects = drawn.splats.rects.numpy()
        none = np.zeros((0, 2), np.float32)
        return SplatGradients(
            sets=tuple(sets),
            background=by_background(by_color, 1.0 - host_values(pixels.alpha)),
            camera_from_world=by_pose,
            centers=none,
            centers_absolute=none,
            weights=np.where(rects["x0"] < rects["x1"], by_splat.numpy()["weight"], np.float32(0.0)),
        )

    def splats(
        self, scene: DeviceScene, drawn: DrawnRaySplats, pixels: PixelData, gradient: PixelGradient
    ) -> DeviceArray:
        """Returns the gradients (``RaySplatGradient``) of all Gaussians of a frame.

        Args:
            scene: The scene on the device, as it was drawn.
            drawn: The Gaussians that the pixel rays hit.
            pixels: Colours and alphas of the pixels.
            gradient: Gradients with respect to the colours and alphas of the pixels.
        """
        run, get, tiles = self._launcher.run_banded, self._buffers.get, math.prod(scene.tile_grid)
        count = drawn.splats.count
        starts = pair_starts(self._launcher, self._buffers, drawn.splats.rects, drawn.tiles.starts)
        pairs = get("backward.ray_pairs", RaySplatGradient, drawn.tiles.items.shape[0])
        lists = (drawn.splats.data, drawn.splats.rects, starts, drawn.tiles.starts, drawn.tiles.items)
        inputs = (scene.camera, drawn.settings, *lists, drawn.rays, drawn.limits, pixels, gradient, pairs)
        with self._launcher.stage("backward: pixels"):
            if self._launcher.is_parallel:
                self._launcher.run_blocks(kernels.backward_blocks, tiles, *inputs)
            else:
                bands = TILE_BANDS_PER_THREAD * self._launcher.threads
                run(kernels.backward_tiles, tiles, *inputs, bands=bands)
        sums = get("backward.ray_splats", RaySplatGradient, count)
        with self._launcher.stage("backward: splats"):
            run(kernels.add_records, count, starts, pairs, sums)
        return sums

    def gaussians(
        self, scene: DeviceScene, drawn: DrawnRaySplats, by_splat: DeviceArray, number: int
    ) -> GaussianGradient:
        """Returns the gradients of the Gaussians of an asset; 0 for Gaussians that no ray hits.

        Args:
            scene: As for ``splats``.
            drawn: As for ``splats``.
            by_splat: Result of ``splats``.
            number: Index of the asset in the scene.
        """
        asset = scene.assets[number]
        out = gradient_of_asset(self._buffers, asset, number)
        data = (asset.instance_ids, asset.data, drawn.splats.data, drawn.splats.rects, by_splat)
        motions = self._buffers.get("backward.motions", RayMotion, drawn.splats.count)
        inputs = (scene.camera, drawn.settings, scene.splat_instances, *data, motions, out)
        with self._launcher.stage("backward: Gaussians"):
            self._launcher.run_banded(kernels.backward_ray_gaussians, asset.gaussians.count, *inputs)
        return out

    def motions(self, drawn: DrawnRaySplats) -> DeviceArray:
        """Returns gradients (``RayMotion``), one per Gaussian, with respect to rigid motions of the rays that hit it.

        The result is valid after ``gaussians`` has run for all assets.

        Args:
            drawn: As for ``splats``.
        """
        return self._buffers.get("backward.motions", RayMotion, drawn.splats.count)
