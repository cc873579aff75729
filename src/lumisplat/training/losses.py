"""Host passes of the loss: how a frame differs from an image, and terms that flatten Gaussians onto surfaces.

The latter are those of Huang et al. 2024 and Gao et al. 2024.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient
from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.training import (
    LossGrid,
    LossMaps,
    LossWeights,
    SmoothnessMaps,
    SplatRecord,
    SurfaceMaps,
    SurfaceTerms,
    TargetImage,
)
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.gradients.features import FeatureChannels, RenderedFeatures
from lumisplat.renderer.raster.unlit_raster import DrawnSplats
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher
from lumisplat.training import loss_kernels, surface_kernels as kernels


@dataclass(frozen=True, slots=True)
class Loss:
    """How far a frame is from a photograph; means over pixels and channels that count."""

    l1: float
    squared: float
    """Mean squared error."""
    ssim: float
    """-1..1."""
    alpha: float
    """Mean error of alpha; 0 where it is not known."""
    entropy: float
    """Mean cross entropy of alpha, likewise."""
    total: float
    """What is minimised."""


class ImageLoss:
    """Compares frames with photographs.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        ssim: Share of SSIM, 0..1; the rest is L1.
        alpha: Weight of the error of alpha.
        entropy: Weight of the cross entropy of alpha.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, *, ssim: float, alpha: float, entropy: float = 0.0
    ) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._ssim, self._alpha, self._entropy = ssim, alpha, entropy
        self.counted = 1.0
        """Sum of what counts of the photograph, pixels."""

    def load(self, color: FloatArray, weight: FloatArray | None, alpha: FloatArray | None) -> TargetImage:
        """A photograph on the device, until the next one is loaded.

        Args:
            color: Display-referred sRGB, 0..1, shape (H, W, 3).
            weight: What counts, 0..1, shape (H, W); None: all.
            alpha: What the frame's alpha should be, shape (H, W); None: nobody knows.
        """
        target = TargetImage()
        self.counted = float(color.shape[0] * color.shape[1] if weight is None else weight.sum(dtype=np.float64)) or 1.0
        target.color = self._buffers.upload("target.color", wp.vec3, color.reshape(-1, 3))
        none = np.zeros(0, np.float32)
        for name, values in (("weight", weight), ("alpha", alpha)):
            array = none if values is None else np.ascontiguousarray(values.reshape(-1), np.float32)
            setattr(target, name, self._buffers.upload(f"target.{name}", wp.float32, array))
        return target

    def differentiate(
        self, size: tuple[int, int], pixels: PixelData, target: TargetImage
    ) -> tuple[Loss, PixelGradient]:
        """The loss of a frame, and its derivatives.

        Args:
            size: Width and height, pixels.
            pixels: Of the frame.
            target: Of the same size.
        """
        width, height = size
        run, get, count = self._launcher.run_banded, self._buffers.get, width * height
        grid = LossGrid()
        grid.width, grid.height, grid.run = width, height, 1 if self._launcher.is_parallel else width
        runs = count // grid.run
        maps, derivatives = (self._buffers.struct(f"loss.{name}", LossMaps, count) for name in ("maps", "derivatives"))
        ssim, sums = get("loss.ssim", wp.float32, runs), get("loss.sums", wp.vec4, runs)
        gradient = PixelGradient()
        gradient.color, gradient.alpha = get("loss.color", wp.vec3, count), get("loss.alpha", wp.float32, count)
        with self._launcher.stage("loss"):
            run(loss_kernels.blur_rows, runs, grid, pixels.color, target, maps)
            run(loss_kernels.compare_rows, runs, grid, maps, derivatives, ssim)
            run(loss_kernels.spread_rows, runs, grid, derivatives, maps)
            inputs = (grid, self._weights(), pixels.color, pixels.alpha, target, maps)
            run(loss_kernels.differentiate_rows, runs, *inputs, gradient.color, gradient.alpha, sums)
            if runs > height:
                of_runs = ssim, sums
                ssim, sums = get("loss.row_ssim", wp.float32, height), get("loss.row_sums", wp.vec4, height)
                run(loss_kernels.add_rows, height, grid, *of_runs, ssim, sums)
        return self._loss(count, ssim.numpy(), sums.numpy()), gradient

    def _weights(self) -> LossWeights:
        weights = LossWeights()
        weights.l1 = (1.0 - self._ssim) / (3.0 * self.counted)
        weights.ssim = self._ssim / (3.0 * self.counted)
        weights.alpha = self._alpha / self.counted
        weights.entropy = self._entropy / self.counted
        return weights

    def _loss(self, count: int, ssim_rows: FloatArray, sums: FloatArray) -> Loss:
        """Means over pixels that count; where none does, frame and photograph are the same, and SSIM is 1."""
        total = self.counted
        ssim = 1.0 - (3.0 * count - float(ssim_rows.sum(dtype=np.float64))) / (3.0 * total)
        means = sums.sum(axis=0, dtype=np.float64) / (3.0 * total, 3.0 * total, total, total)
        l1, squared, alpha, entropy = (float(mean) for mean in means)
        loss = (1.0 - self._ssim) * l1 + self._ssim * (1.0 - ssim) + self._alpha * alpha + self._entropy * entropy
        return Loss(l1, squared, ssim, alpha, entropy, loss)


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
        self._shown: RenderedFeatures
        self._by_sums: DeviceArray
        self._counted = 1.0
        self.smoothness: SmoothnessMaps | None = None
        """With the terms of each pixel of the last frame; None: smoothness does not count."""

    def differentiate(
        self,
        scene: DeviceScene,
        drawn: DrawnSplats,
        pixels: PixelData,
        target: TargetImage,
        *,
        counted: float,
        gradient: PixelGradient,
    ) -> SurfaceMaps:
        """Adds derivatives by alpha to those of a frame; those by features are kept for ``backward``.

        Args:
            scene: The scene on the device, as it was drawn, of one Gaussian set where it is.
            drawn: What was drawn.
            pixels: What came of it.
            target: Says which pixels count.
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
            shown = self._channels.render(scene, drawn, features)
            maps = self._buffers.struct("surfaces.maps", SurfaceMaps, count)
            by_sums = get("surfaces.by_sums", wp.float32, (count, FEATURES))
            seen = (scene.camera, self._terms)
            run(kernels.compare_surfaces, count, *seen, target, pixels.alpha, shown.of_pixels, maps, by_sums)
            run(kernels.gather_surfaces, count, *seen, pixels.alpha, shown.of_pixels, maps, by_sums, gradient.alpha)
            if self._smooth > 0.0:
                self.smoothness = self._buffers.struct("surfaces.smoothness", SmoothnessMaps, count)
                inputs = (self._smooth / counted, target, shown.of_pixels, self.smoothness)
                run(kernels.compare_smoothness, count, scene.camera, *inputs)
                run(kernels.gather_smoothness, count, scene.camera, self.smoothness, by_sums)
        self._shown, self._by_sums, self._counted = shown, by_sums, counted
        return maps

    def backward(self, scene: DeviceScene, drawn: DrawnSplats, by_splat: DeviceArray) -> DeviceArray:
        """Derivatives by features, shape (N, 5); adds those by splats to ``by_splat``."""
        with self._launcher.stage("backward: surfaces"):
            return self._channels.backward(scene, drawn, self._shown, self._by_sums, by_splat)

    def add_normal_gradients(
        self, scene: DeviceScene, drawn: DrawnSplats, by_features: DeviceArray, record: SplatRecord
    ) -> None:
        """Adds how strongly the terms turn the normals of what was drawn.

        Args:
            scene: The scene on the device, as it was drawn.
            drawn: What was drawn.
            by_features: As of ``backward``.
            record: Receives it.
        """
        data: GaussianData = scene.assets[0].data
        inputs = (scene.camera, self._counted, drawn.splats.rects, data, by_features, record)
        self._launcher.run_banded(kernels.add_normal_gradients, len(data.opacities), *inputs)

    def add_by_features(self, scene: DeviceScene, by_features: DeviceArray, gradient: GaussianGradient) -> None:
        """Adds derivatives by way of features to those by Gaussians."""
        data: GaussianData = scene.assets[0].data
        inputs = (scene.camera, self._terms, data, by_features, gradient)
        self._launcher.run_banded(kernels.add_by_features, len(data.opacities), *inputs)
