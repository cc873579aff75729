"""Training backends: each renders the trained Gaussians and returns gradients of the frame, entirely on the device.

Three backends find primary hits: a rasteriser of ellipses, a ray tracer, and a rasteriser that evaluates Gaussians
along camera rays.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.config.checks import Color
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.training import SplatParameters, SplatRecord, SurfaceMaps, TargetImage
from lumisplat.math.arrays import Doubles
from lumisplat.renderer.film import picture_kernels
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.gradients.features import FeatureChannels
from lumisplat.renderer.gradients.pose import PoseSums, pose_gradient, pose_of_rays_gradient
from lumisplat.renderer.gradients.ray_backward import RayBackward, RaySums
from lumisplat.renderer.gradients.splat_backward import SplatBackward
from lumisplat.renderer.gradients.unscented_backward import UnscentedBackward
from lumisplat.renderer.raster.binning import Binning, binning_of, pair_starts
from lumisplat.renderer.raster.mesh_raster import MeshRaster
from lumisplat.renderer.raster.splat_raster import SplatRaster, raster_table
from lumisplat.renderer.raster.unlit_raster import DrawnSplats, UnlitRaster
from lumisplat.renderer.raster.unscented_raster import DrawnRaySplats, UnscentedRaster
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.camera_rays import CameraRays
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.runtime.buffers import Buffers, DeviceArray, assign_table
from lumisplat.runtime.kernel_cache import KernelModule
from lumisplat.runtime.launcher import Launcher, Result
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene, SplatInstance
from lumisplat.training import optimizer_kernels, surface_kernels, weight_kernels
from lumisplat.training.losses import SurfaceLoss


class _Backend(ABC):
    """Base class of the training backends, which render one trained Gaussian set and differentiate the frame.

    Args:
        launcher: Runs the kernels.
        buffers: Owner of the device arrays.
        config: Settings of unlit frames.
        binning: Lists the Gaussians per tile; None if the backend has no such lists.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, config: RenderConfig, binning: Binning | None = None
    ) -> None:
        self._launcher, self._buffers, self._config, self._binning = launcher, buffers, config, binning
        self._scene = DeviceScene(launcher, buffers, config)
        self._synced_for: tuple[Gaussians, int, RenderConfig] | None = None
        self._synced: tuple[Scene, FramePlan]
        """Scene and frame plan of the last frame, reused until Gaussians, SH degree or settings change."""

    def bind(self, gaussians: Gaussians, parameters: SplatParameters) -> None:
        """Sets the Gaussians that later frames draw.

        Args:
            gaussians: Gaussians with as many rows and SH coefficients as the parameters. Later frames overwrite their
                device copy.
            parameters: Parameters whose means and SH coefficients are drawn.
        """
        self._gaussians, self._parameters = gaussians, parameters

    def begin(self, camera: Camera, sh_degree: int, background: Color) -> None:
        """Uploads what changes between frames; the next ``launch`` draws with it.

        Args:
            camera: A camera that the backend can draw.
            sh_degree: SH degree of the colours.
            background: Display-referred sRGB behind the Gaussians.
        """
        self._background = background
        self._sync(camera, sh_degree)
        data, parameters = self.data, self._parameters
        if data.means is not parameters.means or data.sh is not parameters.sh:  # shared without copies
            data.means, data.sh = parameters.means, parameters.sh

    @abstractmethod
    def launch(self) -> PixelData:
        """Draws the frame that ``begin`` has prepared; its pixels are incomplete if ``finish`` then returns False."""

    def finish(self) -> bool:
        """Waits for the frame; False if a list of Gaussians was too short: it is longer in the next ``launch``."""
        return self._binning is None or self._binning.finish()

    @property
    def lengths(self) -> tuple[DeviceArray, DeviceArray]:
        """Lengths of the frame's lists on the device, and their limits: `Binning.totals` and `Binning.limits`."""
        binning = self._binning
        none = self._buffers.get("backend.no_lists", wp.int64, 0)
        return (none, none) if binning is None else (binning.totals, binning.limits)

    def replay(self, name: str, key: object, work: Callable[[], Result]) -> Result:
        """Runs ``work``, which contains ``launch``, by `Launcher.replay`; directly if the backend reads meanwhile.

        ``key`` has the values that change what ``work`` launches, besides scene and lists.
        """
        if self._binning is None:
            return work()
        return self._launcher.replay(name, (self._scene.graph_key, self._binning.growth, key), work)

    def draw(self, camera: Camera, sh_degree: int, background: Color) -> PixelData:
        """Renders colour and alpha of a frame and returns its pixels; the arguments are those of ``begin``."""
        self.begin(camera, sh_degree, background)
        pixels = self.replay("frame", None, self.launch)
        while not self.finish():
            pixels = self.replay("frame", None, self.launch)
        return pixels

    @property
    def data(self) -> GaussianData:
        """Gaussians of the backend's scene on the device; available after the first frame."""
        return self._scene.assets[0].data

    def _sync(self, camera: Camera, sh_degree: int) -> None:
        """Uploads the scene and the camera of a frame."""
        key = self._gaussians, sh_degree, self._config
        if self._synced_for != key:
            scene = Scene([SplatInstance(self._gaussians, sh_degree=sh_degree)])
            self._synced_for, self._synced = key, (scene, FramePlan.of(self._config, scene))
        scene, plan = self._synced
        self._launcher.stage_ms = {}
        self._scene.sync(scene, camera, plan)

    def _activate(self) -> None:
        self._launcher.run_banded(optimizer_kernels.activate, self._gaussians.count, self._parameters, self.data)

    def _pixels_of_rays(self, count: int, hits: GaussianHits) -> PixelData:
        pixels = PixelBuffers.of(self._buffers, self._scene.image_size).data
        inputs = (*self._scene.image_size, wp.vec3(*self._background), hits, pixels)
        self._launcher.run_banded(picture_kernels.store_ray_colors, count, *inputs)
        return pixels


class TrainingRaster(_Backend):
    """Rasterises one Gaussian set as screen-space ellipses.

    Args:
        launcher: Runs the kernels.
        buffers: Owner of the device arrays.
        config: Settings of unlit, sorted raster frames.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        binning = binning_of(launcher, buffers)
        super().__init__(launcher, buffers, config, binning)
        meshes = MeshRaster(launcher, buffers, binning)
        self._splats = SplatRaster(launcher, buffers, config, binning)
        self._unlit = UnlitRaster(
            launcher, buffers, binning=binning, meshes=meshes, splats=self._splats, finds_depth=False
        )
        self._backward = SplatBackward(launcher, buffers)
        self.by_splat: DeviceArray
        """Gradient with respect to the splats of the last frame, ``SplatGradient``; written by ``backward``."""
        self._pose_rows: DeviceArray

    def modules(self) -> list[KernelModule]:
        """Kernel modules that ``draw`` and ``backward`` launch."""
        return [*self._unlit.modules(has_meshes=False), *self._backward.modules()]

    def begin(self, camera: Camera, sh_degree: int, background: Color) -> None:
        """Uploads what changes between frames, as `_Backend.begin`; ``camera`` is a pinhole."""
        if background != self._config.background:
            self._config = replace(self._config, background=background)
            assign_table(self._splats.settings, raster_table(self._config))
        super().begin(camera, sh_degree, background)

    def launch(self) -> PixelData:
        """Draws a frame, as `_Backend.launch`."""
        self._activate()
        self._unlit.launch(self._scene)
        return PixelBuffers.of(self._buffers, self._scene.image_size).data

    def compare_surfaces(
        self, surfaces: SurfaceLoss, pixels: PixelData, target: TargetImage, gradient: PixelGradient
    ) -> SurfaceMaps:
        """Evaluates the depth, normal and smoothness terms of the loss on the last frame.

        Arguments and result are those of `SurfaceLoss.differentiate`.
        """
        return surfaces.differentiate(self._scene, self.drawn, pixels, target, gradient)

    def backward(
        self,
        pixels: PixelData,
        gradient: PixelGradient,
        surfaces: SurfaceLoss | None = None,
        record: SplatRecord | None = None,
    ) -> GaussianGradient:
        """Returns the gradient of the loss with respect to the Gaussians of the last frame.

        Args:
            pixels: Pixels of the last frame.
            gradient: Gradient of the loss with respect to ``pixels``.
            surfaces: Surface terms evaluated for the last frame; None if the loss has none.
            record: Densification statistics, to which the normal gradients of the surface terms are added; None to skip
                them.
        """
        self.by_splats(pixels, gradient)
        by_features = None if surfaces is None else surfaces.backward(self._scene, self.drawn, self.by_splat)
        by_gaussians = self._backward.gaussians(self._scene, self.drawn, self.by_splat, 0)
        if surfaces is not None and by_features is not None:
            surfaces.add_by_features(self._scene, by_features, by_gaussians)
            if record is not None:
                surfaces.add_normal_gradients(self._scene, self.drawn, by_features, record)
        return by_gaussians

    def by_splats(self, pixels: PixelData, gradient: PixelGradient) -> DeviceArray:
        """Returns the gradient of the loss with respect to the splats of the last frame, ``SplatGradient``.

        Elements of splats that were not drawn are undefined.

        Args:
            pixels: Pixels of the last frame.
            gradient: Gradient of the loss with respect to ``pixels``.
        """
        self.by_splat = self._backward.splats(self._scene, self.drawn, pixels, gradient)
        return self.by_splat

    def flatten(self, weight: float, gradient: GaussianGradient) -> None:
        """Adds the gradient of the flatness term to ``gradient``.

        The term is ``weight`` times the mean, over all Gaussians, of the smallest scale of each drawn Gaussian.
        """
        count = self._gaussians.count
        inputs = (weight / count, self.drawn.splats.rects, self.data, gradient)
        self._launcher.run_banded(surface_kernels.flatten, count, *inputs)

    def channels(self) -> FeatureChannels:
        """Returns a renderer that blends further features, such as depths or normals, with the last frame's weights."""
        return FeatureChannels(self._launcher, self._buffers, self._unlit, self._backward)

    def add_largest_weights(self, largest: DeviceArray) -> None:
        """Sets ``largest`` to the maximum of itself and each Gaussian's largest blending weight in the last frame.

        Args:
            largest: Largest weight of each of N Gaussians in earlier frames, shape (N,); updated in place.
        """
        run, drawn, tiles = self._launcher.run_banded, self.drawn, math.prod(self._scene.tile_grid)
        starts = pair_starts(self._launcher, self._buffers, drawn.splats.rects, drawn.tiles.starts)
        pairs = self._buffers.get("weights.pairs", wp.float32, drawn.tiles.items.shape[0])
        lists = (drawn.splats.data, drawn.splats.rects, starts, drawn.tiles.starts, drawn.tiles.items)
        run(weight_kernels.find_largest_weights, tiles, self._scene.camera, drawn.settings, *lists, drawn.meshes, pairs)
        run(weight_kernels.reduce_largest, drawn.splats.count, starts, pairs, largest)

    def sum_pose(self) -> None:
        """Launches what ``by_pose`` needs besides ``backward``."""
        self._pose_rows = self._backward.pose(self._scene, self.drawn, self.by_splat, 0)

    def by_pose(self, camera: Camera) -> Doubles:
        """Returns the gradient of the loss with respect to the upper rows of ``camera_from_world``, shape (3, 4).

        Requires preceding calls of ``backward`` and ``sum_pose``.

        Args:
            camera: Camera of the last frame.
        """
        return pose_gradient(PoseSums.of(self._pose_rows), SplatInstance(self._gaussians), camera)

    @property
    def drawn(self) -> DrawnSplats:
        """Splats and tile lists of the last frame."""
        assert self._unlit.drawn is not None
        return self._unlit.drawn


class TrainingRays(_Backend):
    """Ray traces one Gaussian set, with any kernel degree and any camera model.

    Args:
        launcher: Runs the kernels.
        buffers: Owner of the device arrays.
        config: Settings of unlit, sorted ray-traced frames.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        super().__init__(launcher, buffers, config)
        self._rays = CameraRays(launcher, buffers)
        self._tracer = RayTracer(launcher, buffers, config)
        self._backward = RayBackward(launcher, buffers, config)
        self._hits: PrimaryHits
        self._sums: RaySums

    def modules(self) -> list[KernelModule]:
        """Kernel modules that ``draw`` and ``backward`` launch."""
        plan = FramePlan.of(self._config, Scene())
        modules = [*self._tracer.modules(plan), *self._rays.modules(), *self._scene.modules(plan)]
        return [*modules, picture_kernels.RAYS, *self._backward.modules()]

    def launch(self) -> PixelData:
        """Draws a frame, as `_Backend.launch`."""
        self._activate()
        with self._launcher.stage("refit"):
            self._scene.bvh.refit(self._synced[0])
        self._scene.begin_sample(0)
        self._hits = self._tracer.find_hits(self._scene, self._rays.start(self._scene), "camera")
        return self._pixels_of_rays(self._hits.count, self._hits.gaussians)

    def backward(self, pixels: PixelData, gradient: PixelGradient) -> GaussianGradient:
        """Returns the gradient with respect to the Gaussians of the last frame, as `TrainingRaster.backward`."""
        by_rays = self._backward.start_pixels(self._scene.image_size, self._hits.count, pixels, gradient)
        self._sums = self._backward.begin(self._scene)
        self._backward.add(self._scene, self._hits, by_rays, self._sums)
        return self._sums.gaussians[0]

    def add_largest_weights(self, largest: DeviceArray) -> None:
        """Updates the largest blending weights with the last frame, as `TrainingRaster.add_largest_weights`."""
        nothing = np.zeros((0, 3), np.float32)  # the gradient is not needed
        by_rays = self._backward.start_rays(self._hits.count, nothing, nothing[:, 0])
        sums = replace(self._backward.begin(self._scene), largest=largest)
        self._backward.add(self._scene, self._hits, by_rays, sums)

    def by_pose(self, camera: Camera) -> Doubles:
        """Returns the gradient with respect to the upper rows of ``camera_from_world``, as `TrainingRaster.by_pose`."""
        return pose_of_rays_gradient(self._sums.motions, [SplatInstance(self._gaussians)], camera)


class TrainingUnscented(_Backend):
    """Rasterises one Gaussian set by the unscented transform, for all cameras except those with an aperture.

    Args:
        launcher: Runs the kernels.
        buffers: Owner of the device arrays.
        config: Settings of unlit, sorted frames of ``Projection.UNSCENTED``.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        binning = binning_of(launcher, buffers)
        super().__init__(launcher, buffers, config, binning)
        self._rays = CameraRays(launcher, buffers)
        self._raster = UnscentedRaster(launcher, buffers, config, binning)
        self._backward = UnscentedBackward(launcher, buffers)

    def modules(self) -> list[KernelModule]:
        """Kernel modules that ``draw`` and ``backward`` launch."""
        modules = self._raster.modules(FramePlan.of(self._config, Scene()))
        return [*modules, *self._rays.modules(), picture_kernels.RAYS, *self._backward.modules()]

    def begin(self, camera: Camera, sh_degree: int, background: Color) -> None:
        """Uploads what changes between frames, as `_Backend.begin`; ``camera`` has no aperture."""
        super().begin(camera, sh_degree, background)
        self._raster.begin_frame(camera)
        self._scene.begin_sample(0)

    def replay(self, name: str, key: object, work: Callable[[], Result]) -> Result:
        """Runs ``work`` as `_Backend.replay`; a recorded graph contains the background."""
        return super().replay(name, (key, self._background), work)

    def launch(self) -> PixelData:
        """Draws a frame, as `_Backend.launch`."""
        self._activate()
        rays = self._rays.start(self._scene)
        self._raster.find_hits(self._scene, rays)
        return self._pixels_of_rays(len(rays.t_max), self._last_hits.hits)

    def backward(self, pixels: PixelData, gradient: PixelGradient) -> GaussianGradient:
        """Returns the gradient with respect to the Gaussians of the last frame, as `TrainingRaster.backward`."""
        by_splat = self._backward.splats(self._scene, self._last_hits, pixels, gradient)
        return self._backward.gaussians(self._scene, self._last_hits, by_splat, 0)

    def add_largest_weights(self, largest: DeviceArray) -> None:
        """Updates the largest blending weights with the last frame, as `TrainingRaster.add_largest_weights`."""
        run, hits, tiles = self._launcher.run_banded, self._last_hits, math.prod(self._scene.tile_grid)
        starts = pair_starts(self._launcher, self._buffers, hits.splats.rects, hits.tiles.starts)
        pairs = self._buffers.get("weights.pairs", wp.float32, hits.tiles.items.shape[0])
        lists = (
            hits.splats.data,
            hits.splats.rects,
            starts,
            hits.tiles.starts,
            hits.tiles.items,
            hits.rays,
            hits.limits,
        )
        run(weight_kernels.find_largest_ray_weights, tiles, self._scene.camera, hits.settings, *lists, pairs)
        run(weight_kernels.reduce_largest, hits.splats.count, starts, pairs, largest)

    def by_pose(self, camera: Camera) -> Doubles:
        """Returns the gradient with respect to the upper rows of ``camera_from_world``, as `TrainingRaster.by_pose`."""
        return pose_of_rays_gradient(self._backward.motions(self._last_hits), [SplatInstance(self._gaussians)], camera)

    @property
    def _last_hits(self) -> DrawnRaySplats:
        """Splats in the tile lists of the last frame, which were evaluated along its camera rays."""
        assert self._raster.drawn is not None
        return self._raster.drawn
