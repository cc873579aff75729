"""Training views: images with poses, whose pixels are read from disk when an iteration needs them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from PIL import Image

from lumisplat.io.training_images.loading import TrainingImage
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.camera import Camera

WEIGHT_MIN = 1e-6
"""Lower bound of the total loss weight in a downscaled pixel, which avoids a division by zero."""


@dataclass(frozen=True, slots=True, eq=False)
class TargetPixels:
    """Pixels of a training image."""

    color: FloatArray
    """Display-referred sRGB composited over the background, 0..1, shape (H, W, 3)."""
    weight: FloatArray | None = None
    """Weight of each pixel in the loss, 0..1, shape (H, W); None for weight 1 everywhere."""
    alpha: FloatArray | None = None
    """Target alpha of the rendered frame, 0..1, shape (H, W); None if it is unknown."""

    def resized(self, size: tuple[int, int]) -> TargetPixels:
        """Returns the pixels at another size; each new pixel is the mean over its area, weighted by the loss weights.

        Args:
            size: Width and height in pixels.
        """
        weight = None if self.weight is None else _resized(self.weight, size)
        color, alpha = (self._mean_of(layer, weight, size) for layer in (self.color, self.alpha))
        assert color is not None
        return TargetPixels(color, weight, alpha)

    def _mean_of(self, layer: FloatArray | None, weight: FloatArray | None, size: tuple[int, int]) -> FloatArray | None:
        """Returns colour or alpha at another size, as means over areas weighted by the loss weights.

        ``weight`` holds the loss weights at the new size.
        """
        if layer is None or self.weight is None or weight is None:
            return None if layer is None else _resized(layer, size)
        shares, total = ((w if layer.ndim == 2 else w[..., None]) for w in (self.weight, weight))
        return np.asarray(_resized(layer * shares, size) / np.maximum(total, WEIGHT_MIN), np.float32)

    def over(self, change: npt.ArrayLike) -> TargetPixels:
        """Returns the pixels composited over another background; opaque pixels stay as they are.

        Args:
            change: New background minus the old one, display-referred, shape (3,).
        """
        if self.alpha is None:
            return self
        color = self.color + (1.0 - self.alpha)[..., None] * np.asarray(change, np.float32)
        return replace(self, color=color.astype(np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class TrainingView:
    """Training image with its camera."""

    name: str
    camera: Camera
    """Camera with the image's size in pixels: a pinhole camera, unless the training backend traces camera rays."""
    read: Callable[[], TargetPixels]
    """Reads the pixels of the image."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Display-referred sRGB over which transparent pixels are composited."""

    @classmethod
    def of(cls, image: TrainingImage) -> TrainingView:
        """Returns the view of a loaded training image."""

        def read() -> TargetPixels:
            return TargetPixels(image.pixels(), image.mask(), image.alpha())

        return cls(image.name, image.camera, read, image.background or (0.0, 0.0, 0.0))

    def downscaled_camera(self, halvings: int) -> Camera:
        """Returns the camera with both sides of its image halved ``halvings`` times."""
        return self.camera.scaled(*self._size(halvings)) if halvings else self.camera

    def read_downscaled(self, halvings: int) -> TargetPixels:
        """Reads the pixels with both sides halved ``halvings`` times; each pixel is the mean over its area."""
        return self.read().resized(self._size(halvings)) if halvings else self.read()

    def _size(self, halvings: int) -> tuple[int, int]:
        """Returns width and height in pixels after ``halvings`` halvings."""
        return max(self.camera.width >> halvings, 1), max(self.camera.height >> halvings, 1)


def _resized(layer: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Returns an image of one or three channels at another size; each pixel is the mean over its area."""
    channels = layer[..., None] if layer.ndim == 2 else layer
    parts = [
        np.asarray(Image.fromarray(channels[..., k]).resize(size, Image.Resampling.BOX), np.float32)
        for k in range(channels.shape[2])
    ]
    return parts[0] if layer.ndim == 2 else np.ascontiguousarray(np.stack(parts, axis=-1))
