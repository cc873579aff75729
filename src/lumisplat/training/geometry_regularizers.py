"""Host pass: terms of the loss that flatten Gaussians onto surfaces (Huang et al. 2024, Gao et al. 2024)."""

from __future__ import annotations

import math

import warp as wp

from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient
from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.training import Photograph, SmoothnessMaps, SplatRecord, SurfaceMaps, SurfaceTerms
from lumisplat.renderer.gradients.feature_channels import FeatureChannels, ShownFeatures
from lumisplat.renderer.raster.unlit_raster import DrawnSplats
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher
from lumisplat.training import smoothness_kernels
from lumisplat.training import surface_kernels as kernels

FEATURES = 5
"""Depth, its square, and normal."""


class SurfaceLoss:
    """Terms on normals and depths of frames.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        channels: Shows features.
        normals: Weight of 1 less the cosine between normals of Gaussians and of their depth.
        depth: Weight of the standard deviation of depth along rays, in extents.
        smooth: Weight of the differences between normals of neighbouring pixels, but for edges of the photograph.
        middle: A view depth in the middle of the scene, scene units.
        extent: Of the scene, scene units.
    """

    def __init__(
        self,
        launcher: Launcher,
        buffers: Buffers,
        channels: FeatureChannels,
        *,
        normals: float,
        depth: float,
        smooth: float,
        middle: float,
        extent: float,
    ) -> None:
        self._launcher, self._buffers, self._channels = launcher, buffers, channels
        self._normals, self._depth, self._smooth = normals, depth, smooth
        self._terms = SurfaceTerms()
        self._terms.middle, self._terms.per_unit = middle, 1.0 / extent
        self._shown: ShownFeatures
        self._by_sums: DeviceArray
        self._counted = 1.0
        self.smoothness: SmoothnessMaps | None = None
        """With the terms of each pixel of the last frame; None: smoothness does not count."""

    def differentiate(
        self,
        scene: DeviceScene,
        drawn: DrawnSplats,
        pixels: PixelData,
        photograph: Photograph,
        *,
        counted: float,
        gradient: PixelGradient,
    ) -> SurfaceMaps:
        """Adds derivatives by alpha to those of a frame; those by features are kept for ``backward``.

        Args:
            scene: The scene on the device, as it was drawn, of one Gaussian set where it is.
            drawn: What was drawn.
            pixels: What came of it.
            photograph: Says which pixels count.
            counted: How many do.
            gradient: Receives derivatives by alpha.

        Returns:
            With the terms of each pixel.
        """
        run, get, count = self._launcher.run_banded, self._buffers.get, math.prod(scene.image_size)
        self._terms.normals, self._terms.depth = self._normals / counted, self._depth / counted
        features = get("surfaces.features", wp.float32, (drawn.splats.count, FEATURES))
        with self._launcher.stage("surfaces"):
            data = scene.assets[0].data
            run(kernels.find_features, drawn.splats.count, scene.camera, self._terms, data, features)
            shown = self._channels.show(scene, drawn, features)
            maps = self._buffers.struct("surfaces.maps", SurfaceMaps, count)
            by_sums = get("surfaces.by_sums", wp.float32, (count, FEATURES))
            seen = (scene.camera, self._terms)
            run(kernels.compare, count, *seen, photograph, pixels.alpha, shown.of_pixels, maps, by_sums)
            run(kernels.gather, count, *seen, pixels.alpha, shown.of_pixels, maps, by_sums, gradient.alpha)
            if self._smooth > 0.0:
                self.smoothness = self._buffers.struct("surfaces.smoothness", SmoothnessMaps, count)
                inputs = (self._smooth / counted, photograph, shown.of_pixels, self.smoothness)
                run(smoothness_kernels.compare, count, scene.camera, *inputs)
                run(smoothness_kernels.gather, count, scene.camera, self.smoothness, by_sums)
        self._shown, self._by_sums, self._counted = shown, by_sums, counted
        return maps

    def backward(self, scene: DeviceScene, drawn: DrawnSplats, by_splat: DeviceArray) -> DeviceArray:
        """Derivatives by features, shape (N, 5); adds those by splats to ``by_splat``."""
        with self._launcher.stage("backward: surfaces"):
            return self._channels.backward(scene, drawn, self._shown, self._by_sums, by_splat)

    def note_turns(self, scene: DeviceScene, drawn: DrawnSplats, by_features: DeviceArray, record: SplatRecord) -> None:
        """Adds how strongly the terms turn the normals of what was drawn.

        Args:
            scene: The scene on the device, as it was drawn.
            drawn: What was drawn.
            by_features: As of ``backward``.
            record: Receives it.
        """
        data: GaussianData = scene.assets[0].data
        inputs = (scene.camera, self._counted, drawn.splats.rects, data, by_features, record)
        self._launcher.run_banded(kernels.note_turns, len(data.opacities), *inputs)

    def add_by_features(self, scene: DeviceScene, by_features: DeviceArray, gradient: GaussianGradient) -> None:
        """Adds derivatives by way of features to those by Gaussians."""
        data: GaussianData = scene.assets[0].data
        inputs = (scene.camera, self._terms, data, by_features, gradient)
        self._launcher.run_banded(kernels.add_by_features, len(data.opacities), *inputs)
