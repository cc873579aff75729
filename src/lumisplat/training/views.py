"""What is fitted: photographs with poses, read when their turn comes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from PIL import Image

from lumisplat.io.training_images.loading import TrainingImage
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.camera import Camera

LEAST_WEIGHT = 1e-6
"""Where less counts, it does not matter what is there."""


@dataclass(frozen=True, slots=True, eq=False)
class TargetPixels:
    """The pixels of a photograph."""

    color: FloatArray
    """Display-referred sRGB, 0..1, over the background where it is transparent, shape (H, W, 3)."""
    weight: FloatArray | None = None
    """What counts, 0..1, shape (H, W); None: all."""
    alpha: FloatArray | None = None
    """What the frame's alpha should be, 0..1, shape (H, W); None: nobody knows."""

    def resized(self, size: tuple[int, int]) -> TargetPixels:
        """With other pixels, each the mean over its area of what counts there.

        Args:
            size: Width and height.
        """
        weight = None if self.weight is None else _resized(self.weight, size)
        color, alpha = (self._mean_of(layer, weight, size) for layer in (self.color, self.alpha))
        assert color is not None
        return TargetPixels(color, weight, alpha)

    def _mean_of(self, layer: FloatArray | None, weight: FloatArray | None, size: tuple[int, int]) -> FloatArray | None:
        """One of its layers with other pixels, of which so much counts."""
        if layer is None or self.weight is None or weight is None:
            return None if layer is None else _resized(layer, size)
        shares, total = ((w if layer.ndim == 2 else w[..., None]) for w in (self.weight, weight))
        return np.asarray(_resized(layer * shares, size) / np.maximum(total, LEAST_WEIGHT), np.float32)

    def over(self, change: npt.ArrayLike) -> TargetPixels:
        """Over another background.

        Args:
            change: How it differs from that of before, shape (3,).
        """
        if self.alpha is None:
            return self
        color = self.color + (1.0 - self.alpha)[..., None] * np.asarray(change, np.float32)
        return replace(self, color=color.astype(np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class TrainingView:
    """A photograph, and from where it was taken."""

    name: str
    camera: Camera
    """Of the photograph's size; a pinhole, unless rays draw it."""
    read: Callable[[], TargetPixels]
    """Reads its pixels."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Display-referred sRGB over which these are where they are transparent."""

    @classmethod
    def of(cls, image: TrainingImage) -> TrainingView:
        """That of a photograph of a set."""

        def read() -> TargetPixels:
            return TargetPixels(image.pixels(), image.mask(), image.alpha())

        return cls(image.name, image.camera, read, image.background or (0.0, 0.0, 0.0))

    def downscaled(self, halvings: int) -> tuple[Camera, TargetPixels]:
        """The camera and the pixels, with sides halved so often; pixels are means over areas."""
        if halvings == 0:
            return self.camera, self.read()
        width, height = (max(side >> halvings, 1) for side in (self.camera.width, self.camera.height))
        return self.camera.scaled(width, height), self.read().resized((width, height))


@dataclass(frozen=True, slots=True, eq=False)
class StepInput:
    """What a step learns from."""

    number: int
    """Of the photograph."""
    camera: Camera
    image: TargetPixels
    background: tuple[float, float, float]
    """Display-referred sRGB behind the Gaussians, and behind what is transparent in the picture."""


def _resized(layer: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Means over areas of an image of one or three channels."""
    channels = layer[..., None] if layer.ndim == 2 else layer
    parts = [
        np.asarray(Image.fromarray(channels[..., k]).resize(size, Image.Resampling.BOX), np.float32)
        for k in range(channels.shape[2])
    ]
    return parts[0] if layer.ndim == 2 else np.ascontiguousarray(np.stack(parts, axis=-1))
