"""Host pass: frames of the Gaussians that are learnt, and their derivatives; all of it stays on the device."""

from __future__ import annotations

import math
from dataclasses import replace

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.config.checks import Color
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient
from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.training import LearntSplats, Photograph, SplatRecord, SurfaceMaps
from lumisplat.math.arrays import Doubles
from lumisplat.renderer.gradients.feature_channels import FeatureChannels
from lumisplat.renderer.gradients.splat_backward import SplatBackward
from lumisplat.renderer.raster.binning import binning_of
from lumisplat.renderer.raster.mesh_raster import MeshRaster
from lumisplat.renderer.raster.splat_raster import SplatRaster, raster_table
from lumisplat.renderer.raster.unlit_raster import DrawnSplats, UnlitRaster
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.splat_gradients import pose_gradient
from lumisplat.runtime.buffers import Buffers, DeviceArray, assign_table
from lumisplat.runtime.kernel_cache import KernelModule
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene, SplatInstance
from lumisplat.training import optimizer_kernels, surface_kernels, weight_kernels
from lumisplat.training.geometry_regularizers import SurfaceLoss


class ShownSet:
    """Scene and plan of the frames of one set: those of the frame before, unless something about them has changed."""

    def __init__(self) -> None:
        self._known: tuple[Gaussians, int, RenderConfig] | None = None
        self._shown: tuple[Scene, FramePlan]

    def of(self, gaussians: Gaussians, sh_degree: int, config: RenderConfig) -> tuple[Scene, FramePlan]:
        """Returns the scene of a set, shown up to a degree of SH, and how it is rendered with settings."""
        if self._known != (gaussians, sh_degree, config):
            scene = Scene([SplatInstance(gaussians, sh_degree=sh_degree)])
            self._known, self._shown = (gaussians, sh_degree, config), (scene, FramePlan.of(config, scene))
        return self._shown


class TrainingRaster:
    """Draws one Gaussian set, whose means and harmonics are those that are learnt.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings of unlit, sorted raster frames.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._config = config
        self._scene = DeviceScene(launcher, buffers, config)
        binning = binning_of(launcher, buffers)
        meshes = MeshRaster(launcher, buffers, binning)
        self._splats = SplatRaster(launcher, buffers, config, binning)
        self._unlit = UnlitRaster(
            launcher, buffers, binning=binning, meshes=meshes, splats=self._splats, finds_depth=False
        )
        self._backward = SplatBackward(launcher, buffers)
        self._launcher, self._buffers, self._shown = launcher, buffers, ShownSet()
        self.by_splat: DeviceArray
        """Derivatives by the splats of the last frame, ``SplatGradient``; written by ``backward``."""

    def modules(self) -> list[KernelModule]:
        """The kernel modules of frames and their derivatives."""
        return [*self._unlit.modules(has_meshes=False), *self._backward.modules()]

    def place(self, gaussians: Gaussians, learnt: LearntSplats) -> None:
        """Draws other Gaussians from now on.

        Args:
            gaussians: As many as are learnt, with as many harmonics. What is drawn later is written to its arrays.
            learnt: Has their means and harmonics.
        """
        self._gaussians, self._learnt = gaussians, learnt
        self._is_placed = True

    def draw(self, camera: Camera, sh_degree: int, background: Color) -> PixelData:
        """The pixels of a frame.

        Args:
            camera: A pinhole.
            sh_degree: Of colours.
            background: Display-referred sRGB behind the Gaussians.
        """
        if background != self._config.background:
            self._config = replace(self._config, background=background)
            assign_table(self._splats.settings, raster_table(self._config))
        scene, plan = self._shown.of(self._gaussians, sh_degree, self._config)
        self._launcher.stage_ms = {}
        self._scene.sync(scene, camera, plan)
        if self._is_placed:  # in place of copies in each step; no pass of training reads the scene's table of sets
            self.data.means, self.data.sh = self._learnt.means, self._learnt.sh
            self._is_placed = False
        self._launcher.run_banded(optimizer_kernels.activate, self._gaussians.count, self._learnt, self.data)
        return self._unlit.draw(self._scene).data

    def compare_surfaces(
        self, surfaces: SurfaceLoss, pixels: PixelData, photograph: Photograph, counted: float, gradient: PixelGradient
    ) -> SurfaceMaps:
        """As `SurfaceLoss.differentiate`, of the last frame."""
        return surfaces.differentiate(self._scene, self.drawn, pixels, photograph, counted=counted, gradient=gradient)

    def backward(
        self,
        pixels: PixelData,
        gradient: PixelGradient,
        surfaces: SurfaceLoss | None = None,
        record: SplatRecord | None = None,
    ) -> GaussianGradient:
        """Derivatives by the Gaussians of the last frame.

        Args:
            pixels: Of the last frame.
            gradient: Derivatives by these.
            surfaces: What was compared of its surfaces, if anything.
            record: Receives how strongly these turn normals; None: nobody asks.
        """
        self.by_splats(pixels, gradient)
        by_features = None if surfaces is None else surfaces.backward(self._scene, self.drawn, self.by_splat)
        by_gaussians = self._backward.gaussians(self._scene, self.drawn, self.by_splat, 0)
        if surfaces is not None and by_features is not None:
            surfaces.add_by_features(self._scene, by_features, by_gaussians)
            if record is not None:
                surfaces.note_turns(self._scene, self.drawn, by_features, record)
        return by_gaussians

    def by_splats(self, pixels: PixelData, gradient: PixelGradient) -> DeviceArray:
        """Derivatives by the splats of the last frame, ``SplatGradient``, alone; undefined where none was drawn.

        Args:
            pixels: Of the last frame.
            gradient: Derivatives by these.
        """
        self.by_splat = self._backward.splats(self._scene, self.drawn, pixels, gradient)
        return self.by_splat

    def flatten(self, weight: float, gradient: GaussianGradient) -> None:
        """Adds the derivatives of the mean least scale of what was drawn, times a weight."""
        count = self._gaussians.count
        inputs = (weight / count, self.drawn.splats.rects, self.data, gradient)
        self._launcher.run_banded(surface_kernels.flatten, count, *inputs)

    def channels(self) -> FeatureChannels:
        """What shows further features of the last frame."""
        return FeatureChannels(self._launcher, self._buffers, self._unlit, self._backward)

    def add_largest_weights(self, largest: DeviceArray) -> None:
        """Notes with how much weight each Gaussian was blended at most in the last frame.

        Args:
            largest: The largest so far, shape (N,).
        """
        run, drawn, tiles = self._launcher.run_banded, self.drawn, math.prod(self._scene.tile_grid)
        starts = self._backward.pair_starts(drawn)
        pairs = self._buffers.get("weights.pairs", wp.float32, drawn.tiles.items.shape[0])
        lists = (drawn.splats.data, drawn.splats.rects, starts, drawn.tiles.starts, drawn.tiles.items)
        run(weight_kernels.find_largest_weights, tiles, self._scene.camera, drawn.settings, *lists, drawn.meshes, pairs)
        run(weight_kernels.keep_largest, drawn.splats.count, starts, pairs, largest)

    def by_pose(self, camera: Camera) -> Doubles:
        """Derivatives by the upper rows of ``camera_from_world``, shape (3, 4); after ``backward``.

        Args:
            camera: Of the last frame.
        """
        sums = self._backward.pose(self._scene, self.drawn, self.by_splat, 0)
        return pose_gradient(sums, SplatInstance(self._gaussians), camera)

    @property
    def data(self) -> GaussianData:
        """The Gaussians that are drawn; there after the first frame."""
        return self._scene.assets[0].data

    @property
    def drawn(self) -> DrawnSplats:
        """What the last frame was drawn from."""
        assert self._unlit.drawn is not None
        return self._unlit.drawn
