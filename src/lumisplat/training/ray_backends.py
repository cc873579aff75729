"""Host pass: draws trained Gaussians by rays, traced or rasterised along them, with gradients; all on the device."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.config.checks import Color
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient
from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.training import LearntSplats
from lumisplat.math.arrays import Doubles
from lumisplat.renderer.film import traced_pixel_kernels
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.gradients.ray_backward import RayBackward, RaySums
from lumisplat.renderer.gradients.ray_pose import pose_of_rays_gradient
from lumisplat.renderer.gradients.unscented_backward import UnscentedBackward
from lumisplat.renderer.raster.binning import binning_of
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.camera_rays import CameraRays
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.unscented.unscented_raster import SplatsOnRays, UnscentedRaster
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.kernel_cache import KernelModule
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene, SplatInstance
from lumisplat.training import optimizer_kernels, weight_kernels
from lumisplat.training.training_raster import ShownSet


class TrainingRays:
    """Traces one Gaussian set, as `TrainingRaster` rasterises one: of any kernel degree, by any camera.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings of unlit, sorted frames of rays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._shown = ShownSet()
        self._scene = DeviceScene(launcher, buffers, config)
        self._rays = CameraRays(launcher, buffers)
        self._tracer = RayTracer(launcher, buffers, config)
        self._backward = RayBackward(launcher, buffers, config)
        self._hits: PrimaryHits
        self._sums: RaySums

    def modules(self) -> list[KernelModule]:
        """As of `TrainingRaster`."""
        plan = FramePlan.of(self._config, Scene())
        modules = [*self._tracer.modules(plan), *self._rays.modules(), *self._scene.modules(plan)]
        return [*modules, traced_pixel_kernels, *self._backward.modules()]

    def place(self, gaussians: Gaussians, learnt: LearntSplats) -> None:
        """As of `TrainingRaster`."""
        self._gaussians, self._learnt = gaussians, learnt

    def draw(self, camera: Camera, sh_degree: int, background: Color) -> PixelData:
        """The pixels of a frame, but for images other than colour and alpha.

        Args:
            camera: Of any kind.
            sh_degree: Of colours.
            background: Display-referred sRGB behind the Gaussians.
        """
        scene, plan = self._shown.of(self._gaussians, sh_degree, self._config)
        self._launcher.stage_ms = {}
        self._scene.sync(scene, camera, plan)
        self.data.means, self.data.sh = self._learnt.means, self._learnt.sh
        self._launcher.run_banded(optimizer_kernels.activate, self._gaussians.count, self._learnt, self.data)
        with self._launcher.stage("refit"):
            self._scene.bvh.refit(scene)
        self._scene.begin_sample(0)
        self._hits = self._tracer.find_hits(self._scene, self._rays.start(self._scene), "camera")
        pixels = PixelBuffers.of(self._buffers, self._scene.image_size).data
        inputs = (*self._scene.image_size, wp.vec3(*background), self._hits.gaussians, pixels)
        self._launcher.run_banded(traced_pixel_kernels.show_rays, self._hits.count, *inputs)
        return pixels

    def backward(self, pixels: PixelData, gradient: PixelGradient) -> GaussianGradient:
        """As of `TrainingRaster`."""
        by_rays = self._backward.start_pixels(self._scene.image_size, self._hits.count, pixels, gradient)
        self._sums = self._backward.begin(self._scene)
        self._backward.add(self._scene, self._hits, by_rays, self._sums)
        return self._sums.gaussians[0]

    def add_largest_weights(self, largest: DeviceArray) -> None:
        """As of `TrainingRaster`."""
        nothing = np.zeros((0, 3), np.float32)  # the derivatives are of no interest
        by_rays = self._backward.start_rays(self._hits.count, nothing, nothing[:, 0])
        sums = replace(self._backward.begin(self._scene), largest=largest)
        self._backward.add(self._scene, self._hits, by_rays, sums)

    def by_pose(self, camera: Camera) -> Doubles:
        """As of `TrainingRaster`."""
        return pose_of_rays_gradient(self._sums.motions, [SplatInstance(self._gaussians)], camera)

    @property
    def data(self) -> GaussianData:
        """As of `TrainingRaster`."""
        return self._scene.assets[0].data


class TrainingUnscented:
    """Rasterises one Gaussian set along rays, as `TrainingRaster` does as ellipses: by any camera but apertures.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings of unlit, sorted frames of ``Projection.UNSCENTED``.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._shown = ShownSet()
        self._scene = DeviceScene(launcher, buffers, config)
        self._binning = binning_of(launcher, buffers)
        self._rays = CameraRays(launcher, buffers)
        self._raster = UnscentedRaster(launcher, buffers, config, self._binning)
        self._backward = UnscentedBackward(launcher, buffers)

    def modules(self) -> list[KernelModule]:
        """As of `TrainingRaster`."""
        modules = self._raster.modules(FramePlan.of(self._config, Scene()))
        return [*modules, *self._rays.modules(), traced_pixel_kernels, *self._backward.modules()]

    def place(self, gaussians: Gaussians, learnt: LearntSplats) -> None:
        """As of `TrainingRaster`."""
        self._gaussians, self._learnt = gaussians, learnt

    def draw(self, camera: Camera, sh_degree: int, background: Color) -> PixelData:
        """The pixels of a frame, but for images other than colour and alpha.

        Args:
            camera: A pinhole or a fisheye.
            sh_degree: Of colours.
            background: Display-referred sRGB behind the Gaussians.
        """
        scene, plan = self._shown.of(self._gaussians, sh_degree, self._config)
        self._launcher.stage_ms = {}
        self._scene.sync(scene, camera, plan)
        self._raster.begin_frame(camera)
        self.data.means, self.data.sh = self._learnt.means, self._learnt.sh
        self._launcher.run_banded(optimizer_kernels.activate, self._gaussians.count, self._learnt, self.data)
        self._scene.begin_sample(0)
        rays = self._rays.start(self._scene)
        self._raster.find_hits(self._scene, rays)
        while not self._binning.finish():
            self._raster.find_hits(self._scene, rays)
        pixels = PixelBuffers.of(self._buffers, self._scene.image_size).data
        inputs = (*self._scene.image_size, wp.vec3(*background), self._met.hits, pixels)
        self._launcher.run_banded(traced_pixel_kernels.show_rays, len(rays.t_max), *inputs)
        return pixels

    def backward(self, pixels: PixelData, gradient: PixelGradient) -> GaussianGradient:
        """As of `TrainingRaster`."""
        by_splat = self._backward.splats(self._scene, self._met, pixels, gradient)
        return self._backward.gaussians(self._scene, self._met, by_splat, 0)

    def add_largest_weights(self, largest: DeviceArray) -> None:
        """As of `TrainingRaster`."""
        run, met, tiles = self._launcher.run_banded, self._met, math.prod(self._scene.tile_grid)
        starts = self._backward.pair_starts(met)
        pairs = self._buffers.get("weights.pairs", wp.float32, met.tiles.items.shape[0])
        lists = (met.splats.data, met.splats.rects, starts, met.tiles.starts, met.tiles.items, met.rays, met.limits)
        run(weight_kernels.find_largest_ray_weights, tiles, self._scene.camera, met.settings, *lists, pairs)
        run(weight_kernels.keep_largest, met.splats.count, starts, pairs, largest)

    def by_pose(self, camera: Camera) -> Doubles:
        """As of `TrainingRaster`."""
        return pose_of_rays_gradient(self._backward.motions(self._met), [SplatInstance(self._gaussians)], camera)

    @property
    def data(self) -> GaussianData:
        """As of `TrainingRaster`."""
        return self._scene.assets[0].data

    @property
    def _met(self) -> SplatsOnRays:
        """What the rays of the last frame have met."""
        assert self._raster.met is not None
        return self._raster.met
