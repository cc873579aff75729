"""Runs the kernels of the loss: image loss, and surface terms, which align Gaussians with surfaces.

The surface terms are those of Huang et al. 2024 and Gao et al. 2024.
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
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.primitives import copy_elements
from lumisplat.training import loss_kernels, surface_kernels as kernels

ROW_SUMS = 5
"""Number of sums that the loss of a frame needs of each row of pixels: SSIM, L1, squares, alpha and entropy."""


@dataclass(frozen=True, slots=True)
class Loss:
    """Loss between a frame and a training image, and its terms: means over pixels and channels, weighted by pixel."""

    l1: float
    squared: float
    """Mean squared error."""
    ssim: float
    """Structural similarity, -1..1."""
    alpha: float
    """Mean absolute error of alpha; 0 if the target alpha is unknown."""
    entropy: float
    """Mean binary cross entropy between rendered and target alpha; 0 if the target alpha is unknown."""
    total: float
    """Image loss that is minimised: ``(1 - s) L1 + s (1 - SSIM) + a alpha + e entropy``, with the weights of
    `ImageLoss`."""


@dataclass(frozen=True, slots=True)
class DeviceImage:
    """A training image on the device."""

    pixels: TargetImage
    weight_sum: float
    """Sum of the pixel weights."""

    @classmethod
    def of(
        cls, buffers: Buffers, name: str, color: FloatArray, weight: FloatArray | None, alpha: FloatArray | None
    ) -> DeviceImage:
        """Uploads an image; the next call with the same name overwrites it.

        Args:
            buffers: Owner of the device arrays.
            name: Prefix of the arrays' names.
            color: Display-referred sRGB, 0..1, shape (H, W, 3).
            weight: Weight of each pixel, 0..1, shape (H, W); None for 1 everywhere.
            alpha: Target alpha of the frame, shape (H, W); None if unknown.
        """
        pixels, none = TargetImage(), np.zeros(0, np.float32)
        pixels.color = buffers.upload(f"{name}.color", wp.vec3, color.reshape(-1, 3))
        for field, values in (("weight", weight), ("alpha", alpha)):
            array = none if values is None else np.ascontiguousarray(values.reshape(-1), np.float32)
            setattr(pixels, field, buffers.upload(f"{name}.{field}", wp.float32, array))
        weight_sum = color.shape[0] * color.shape[1] if weight is None else weight.sum(dtype=np.float64)
        return cls(pixels, float(weight_sum) or 1.0)

    def copied(self, buffers: Buffers, name: str) -> DeviceImage:
        """Copies the image to other arrays on the device, named as by ``of``."""
        pixels = TargetImage()
        for field in ("color", "weight", "alpha"):
            source = device_array(getattr(self.pixels, field))
            copy = buffers.get(f"{name}.{field}", source.dtype, len(source))
            if len(source):
                copy_elements(source, copy, len(source))
            setattr(pixels, field, copy)
        return DeviceImage(pixels, self.weight_sum)


class ImageLoss:
    """Loss between frames and training images.

    Args:
        launcher: Runs the kernels.
        buffers: Owner of the device arrays.
        ssim: Fraction of SSIM in the colour loss, 0..1; the rest is L1.
        alpha: Weight of the absolute alpha error.
        entropy: Weight of the cross entropy of alpha.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, *, ssim: float, alpha: float, entropy: float = 0.0
    ) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._ssim, self._alpha, self._entropy = ssim, alpha, entropy
        self.weight_sum = 1.0
        """Sum of the pixel weights of the loaded image."""
        self._weights: DeviceArray
        """``LossWeights`` of the loaded image, an array with one element."""
        self.rows: DeviceArray
        """Sums of the last frame's errors over each row of pixels, from which ``loss_of`` computes the loss."""

    def load(self, color: FloatArray, weight: FloatArray | None, alpha: FloatArray | None) -> TargetImage:
        """Uploads an image, with the arguments of `DeviceImage.of`; the next call overwrites the returned arrays."""
        return self._loaded(DeviceImage.of(self._buffers, "target", color, weight, alpha))

    def load_copy(self, image: DeviceImage) -> TargetImage:
        """Copies an image that is on the device to the arrays of ``load``, which recorded graphs read."""
        return self._loaded(image.copied(self._buffers, "target"))

    def differentiate(self, size: tuple[int, int], pixels: PixelData, target: TargetImage) -> PixelGradient:
        """Returns the gradient of the loss with respect to a frame's pixels, and writes ``rows``. It only launches.

        Args:
            size: Width and height in pixels.
            pixels: Pixels of the frame.
            target: Loaded image of the same size.
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
            inputs = (grid, self._weights, pixels.color, pixels.alpha, target, maps)
            run(loss_kernels.differentiate_rows, runs, *inputs, gradient.color, gradient.alpha, sums)
            self.rows = get("loss.rows", wp.float32, ROW_SUMS * height)
            run(loss_kernels.add_rows, height, grid, ssim, sums, self.rows)
        return gradient

    def _loaded(self, image: DeviceImage) -> TargetImage:
        self.weight_sum = image.weight_sum
        weights = LossWeights()
        weights.l1 = (1.0 - self._ssim) / (3.0 * self.weight_sum)
        weights.ssim = self._ssim / (3.0 * self.weight_sum)
        weights.alpha = self._alpha / self.weight_sum
        weights.entropy = self._entropy / self.weight_sum
        self._weights = self._buffers.table("loss.weights", LossWeights, [weights])
        return image.pixels

    def read(self, size: tuple[int, int]) -> Loss:
        """Waits for the last frame of ``size``, width and height in pixels, and returns its loss."""
        return self.loss_of(self.rows.numpy(), size, self.weight_sum)

    def loss_of(self, rows: FloatArray, size: tuple[int, int], weight_sum: float) -> Loss:
        """Returns the loss of a frame as means over pixels, weighted by the pixel weights.

        The kernels treat pixels of weight 0 as equal to the image, so their SSIM is 1; these pixels do not count.

        Args:
            rows: Copy of ``rows`` after that frame; further elements are ignored.
            size: Width and height of the frame in pixels.
            weight_sum: Sum of the image's pixel weights.
        """
        total, (width, height) = weight_sum, size
        by_row = rows[: ROW_SUMS * height].reshape(height, ROW_SUMS)
        ssim_sum = float(by_row[:, 0].sum(dtype=np.float64))
        ssim = 1.0 - (3.0 * width * height - ssim_sum) / (3.0 * total)
        means = by_row[:, 1:].sum(axis=0, dtype=np.float64) / (3.0 * total, 3.0 * total, total, total)
        l1, squared, alpha, entropy = (float(mean) for mean in means)
        loss = (1.0 - self._ssim) * l1 + self._ssim * (1.0 - ssim) + self._alpha * alpha + self._entropy * entropy
        return Loss(l1, squared, ssim, alpha, entropy, loss)


FEATURES = 5
"""Number of values per Gaussian that the surface terms blend: depth, squared depth, and three of the normal."""


class SurfaceLoss:
    """Loss terms on the depths and normals of a frame, which align Gaussians with surfaces.

    Args:
        launcher: Runs the kernels.
        buffers: Owner of the device arrays.
        channels: Blends the depths and normals of Gaussians along pixels.
        normals: Weight of 1 minus the cosine between the Gaussians' normal and the normal of the depth map.
        depth: Weight of the standard deviation of depth along a ray, in units of the extent.
        smooth: Weight of the difference between normals of neighbouring pixels, reduced at edges of the image.
        middle: View depth in the middle of the scene, which is subtracted from depths to save digits, scene units.
        extent: Scene extent, scene units.
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
        self._scale = middle, 1.0 / extent
        self._terms: DeviceArray
        """``SurfaceTerms`` of the current image, an array with one element."""
        self._shown: RenderedFeatures
        self._by_sums: DeviceArray
        self.smoothness: SmoothnessMaps | None = None
        """Smoothness term of each pixel of the last frame; None if its weight is 0."""

    def begin(self, weight_sum: float) -> None:
        """Uploads the weights of the terms for an image whose pixel weights have the sum ``weight_sum``."""
        terms = SurfaceTerms()
        terms.middle, terms.per_unit = self._scale
        terms.weight_sum, terms.smooth = weight_sum, self._smooth / weight_sum
        terms.normals, terms.depth = self._normals / weight_sum, self._depth / weight_sum
        self._terms = self._buffers.table("surfaces.settings", SurfaceTerms, [terms])

    def differentiate(
        self, scene: DeviceScene, drawn: DrawnSplats, pixels: PixelData, target: TargetImage, gradient: PixelGradient
    ) -> SurfaceMaps:
        """Evaluates the depth, normal and smoothness terms of a frame, and their gradients.

        The gradient with respect to alpha is added to ``gradient``; that with respect to the blended depths and normals
        is stored for ``backward``.

        Args:
            scene: Device scene of the frame, with one Gaussian set in world space.
            drawn: Splats of the frame.
            pixels: Pixels of the frame.
            target: Uploaded image with the weight of each pixel.
            gradient: Gradient with respect to the pixels; its alpha is changed in place.

        Returns:
            Maps with the terms of each pixel.
        """
        run, get, count = self._launcher.run_banded, self._buffers.get, math.prod(scene.image_size)
        features = get("surfaces.features", wp.float32, (drawn.splats.count, FEATURES))
        with self._launcher.stage("surfaces"):
            data = scene.assets[0].data
            run(kernels.find_features, drawn.splats.count, scene.camera, self._terms, data, features)
            shown = self._channels.render(scene, drawn, features)
            maps = self._buffers.struct("surfaces.maps", SurfaceMaps, count)
            by_sums = get("surfaces.by_sums", wp.float32, (count, FEATURES))
            view_and_terms = (scene.camera, self._terms)
            run(kernels.compare_surfaces, count, *view_and_terms, target, pixels.alpha, shown.of_pixels, maps, by_sums)
            run(
                kernels.gather_surfaces,
                count,
                *view_and_terms,
                pixels.alpha,
                shown.of_pixels,
                maps,
                by_sums,
                gradient.alpha,
            )
            if self._smooth > 0.0:
                self.smoothness = self._buffers.struct("surfaces.smoothness", SmoothnessMaps, count)
                inputs = (self._terms, target, shown.of_pixels, self.smoothness)
                run(kernels.compare_smoothness, count, scene.camera, *inputs)
                run(kernels.gather_smoothness, count, scene.camera, self.smoothness, by_sums)
        self._shown, self._by_sums = shown, by_sums
        return maps

    def backward(self, scene: DeviceScene, drawn: DrawnSplats, by_splat: DeviceArray) -> DeviceArray:
        """Returns the gradient with respect to depth, squared depth and normal of each of N Gaussians, shape (N, 5).

        The gradient with respect to the splats is added to ``by_splat``.
        """
        with self._launcher.stage("backward: surfaces"):
            return self._channels.backward(scene, drawn, self._shown, self._by_sums, by_splat)

    def add_normal_gradients(
        self, scene: DeviceScene, drawn: DrawnSplats, by_features: DeviceArray, record: SplatRecord
    ) -> None:
        """Adds each drawn Gaussian's loss gradient for rotating its normal to the densification statistics.

        Args:
            scene: Device scene of the frame.
            drawn: Splats of the frame.
            by_features: Gradient with respect to depth, squared depth and normal of each Gaussian, from ``backward``.
            record: Densification statistics, changed in place.
        """
        data: GaussianData = scene.assets[0].data
        inputs = (scene.camera, self._terms, drawn.splats.rects, data, by_features, record)
        self._launcher.run_banded(kernels.add_normal_gradients, len(data.opacities), *inputs)

    def add_by_features(self, scene: DeviceScene, by_features: DeviceArray, gradient: GaussianGradient) -> None:
        """Adds to ``gradient`` the gradient of means and rotations, from that of the Gaussians' depths and normals."""
        data: GaussianData = scene.assets[0].data
        inputs = (scene.camera, self._terms, data, by_features, gradient)
        self._launcher.run_banded(kernels.add_by_features, len(data.opacities), *inputs)
