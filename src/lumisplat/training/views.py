"""What is fitted: photographs with poses, read when their turn comes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from PIL import Image

from lumisplat.io.photographs.photographs import Photograph
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """The pixels of a photograph."""

    color: FloatArray
    """Display-referred sRGB, 0..1, over the background where it is transparent, shape (H, W, 3)."""
    weight: FloatArray | None = None
    """What counts, 0..1, shape (H, W); None: all."""
    alpha: FloatArray | None = None
    """What the frame's alpha should be, 0..1, shape (H, W); None: nobody knows."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainingView:
    """A photograph, and from where it was taken."""

    name: str
    camera: Camera
    """A pinhole of the photograph's size."""
    read: Callable[[], Picture]
    """Reads its pixels."""

    @classmethod
    def of(cls, photograph: Photograph) -> TrainingView:
        """That of a photograph of a set."""

        def read() -> Picture:
            return Picture(photograph.pixels(), photograph.mask(), photograph.alpha())

        return cls(photograph.name, photograph.camera, read)

    def smaller(self, halvings: int) -> tuple[Camera, Picture]:
        """The camera and the pixels, with sides halved so often; pixels are means over areas."""
        picture = self.read()
        if halvings == 0:
            return self.camera, picture
        width, height = (max(side >> halvings, 1) for side in (self.camera.width, self.camera.height))
        camera = self.camera.scaled(width, height)
        layers = (picture.color, picture.weight, picture.alpha)
        color, weight, alpha = (None if layer is None else _resized(layer, (width, height)) for layer in layers)
        assert color is not None
        return camera, Picture(color, weight, alpha)


def _resized(layer: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Means over areas of an image of one or three channels."""
    channels = layer[..., None] if layer.ndim == 2 else layer
    parts = [
        np.asarray(Image.fromarray(channels[..., k]).resize(size, Image.Resampling.BOX), np.float32)
        for k in range(channels.shape[2])
    ]
    return parts[0] if layer.ndim == 2 else np.ascontiguousarray(np.stack(parts, axis=-1))
