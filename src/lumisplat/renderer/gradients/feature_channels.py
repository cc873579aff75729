"""Host pass: any numbers of Gaussians as further channels of an unlit raster frame, and their derivatives.

Splats show six at a time in place of their colours and normals, and are differentiated three at a time in place of
their colours, by the kernels of frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import warp as wp

from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.device.structs.raster import Splat
from lumisplat.device.structs.rays import EXTRA_FIELDS, GaussianHits
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.gradients import feature_kernels as kernels
from lumisplat.renderer.gradients.splat_backward import SplatBackward
from lumisplat.renderer.raster.unlit_raster import DrawnSplats, UnlitRaster
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.camera_rays import ray_count
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher


@dataclass(frozen=True, slots=True)
class ShownFeatures:
    """Features that a frame's splats have shown."""

    of_splats: DeviceArray
    """Shape (N, C)."""
    of_pixels: DeviceArray
    """Weighted sums, shape (H * W, C)."""

    @property
    def count(self) -> int:
        """C."""
        return self.of_splats.shape[1]


class FeatureChannels:
    """Shows features of the splats of a frame, and differentiates what they have shown.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        raster: Has drawn the frame.
        backward: Goes back from pixels to splats.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, raster: UnlitRaster, backward: SplatBackward) -> None:
        self._launcher, self._buffers, self._raster, self._backward = launcher, buffers, raster, backward

    @staticmethod
    def modules() -> list[KernelModule]:
        """The kernel modules."""
        return [kernels]

    def show(self, scene: DeviceScene, drawn: DrawnSplats, features: FloatArray | DeviceArray) -> ShownFeatures:
        """Sums of features over the splats of each pixel, with the weights of their colours.

        Args:
            scene: The scene on the device, as it was drawn.
            drawn: What was drawn.
            features: Of all Gaussians of the scene, shape (N, C).
        """
        pixels, columns = math.prod(scene.image_size), features.shape[1]
        shown = ShownFeatures(
            self._upload("features.splats", features),
            self._buffers.get("features.pixels", wp.float32, (pixels, columns)),
        )
        sums = self._buffers.struct("features.sums", GaussianHits, ray_count(*scene.image_size), EXTRA_FIELDS)
        for first in range(0, columns, 6):
            self._raster.sum_splats(scene, self._showing(drawn, shown, first), sums)
            self._launcher.run_banded(kernels.store_sums, pixels, scene.camera, sums, first, shown.of_pixels)
        return shown

    def backward(
        self,
        scene: DeviceScene,
        drawn: DrawnSplats,
        shown: ShownFeatures,
        by_pixels: FloatArray | DeviceArray,
        by_splat: DeviceArray,
    ) -> DeviceArray:
        """Derivatives by the features, shape (N, C); adds those by the shapes of splats to ``by_splat``.

        Args:
            scene: As of ``show``.
            drawn: As of ``show``.
            shown: The features.
            by_pixels: Derivatives by what was shown, shape (H * W, C).
            by_splat: Receives derivatives by splats.
        """
        count, get, run = by_pixels.shape[0], self._buffers.get, self._launcher.run_banded
        given = self._upload("features.by_pixels", by_pixels)
        pixels, gradient = PixelData(), PixelGradient()
        pixels.color, gradient.color = (get(f"features.{name}", wp.vec3, count) for name in ("shown", "by_shown"))
        pixels.alpha = gradient.alpha = get("features.no_alpha", wp.float32, count)
        pixels.alpha.fill_(0.0)
        by_features = get("features.by_splats", wp.float32, shown.of_splats.shape)
        for first in range(0, shown.count, 3):
            run(kernels.take_three, count, shown.of_pixels, first, pixels.color)
            run(kernels.take_three, count, given, first, gradient.color)
            showing = self._showing(drawn, shown, first)
            part = self._backward.splats(scene, showing, pixels, gradient, name="features.gradients")
            run(kernels.add_gradients, drawn.splats.count, part, first, by_splat, by_features)
        return by_features[: drawn.splats.count]

    def _showing(self, drawn: DrawnSplats, shown: ShownFeatures, first: int) -> DrawnSplats:
        """What was drawn, with features from column ``first`` on in place of colours and normals."""
        splats = self._buffers.get("features.shown_splats", Splat, drawn.splats.count)
        inputs = (shown.of_splats, first, drawn.splats.rects, drawn.splats.data, splats)
        self._launcher.run_banded(kernels.show_features, drawn.splats.count, *inputs)
        return replace(drawn, splats=replace(drawn.splats, data=splats), tiles=replace(drawn.tiles, splats=splats))

    def _upload(self, name: str, values: FloatArray | DeviceArray) -> DeviceArray:
        if isinstance(values, wp.array):
            return values
        array = self._buffers.get(name, wp.float32, (max(len(values), 1), values.shape[1]))
        if values.size:
            array.assign(values)
        return array
