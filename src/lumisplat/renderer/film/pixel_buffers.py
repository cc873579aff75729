"""The pixels of a frame on the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from lumisplat.device.structs.film import LitPixels, PixelData
from lumisplat.runtime.buffers import Buffers

FIELDS = (
    ("color", wp.vec3, 3),
    ("alpha", wp.float32, 1),
    ("depth", wp.float32, 1),
    ("normal", wp.vec3, 3),
    ("gaussian", wp.int32, 1),
    ("instance", wp.int32, 1),
)
"""Arrays of ``PixelData``: name, element, 32-bit words an element."""


LIT_FIELDS = (("captured_weight", wp.float32, 1), ("light", wp.vec3, 3), ("color", wp.vec3, 3))
"""The same of ``LitPixels``."""


@dataclass(frozen=True, slots=True)
class PixelBuffers:
    """Arrays of a frame's pixels, one after another in one block of device memory."""

    data: Any
    """What kernels take: PixelData, or LitPixels."""
    block: Any
    """The memory, as float32."""
    size: tuple[int, int]
    """Width and height of the image."""
    fields: tuple[tuple[str, Any, int], ...]
    """What the block holds."""

    @classmethod
    def of(cls, buffers: Buffers, size: tuple[int, int]) -> PixelBuffers:
        """The buffers of an image of that width and height; the same memory for every image of that size."""
        return cls._of(buffers, "pixels", PixelData(), FIELDS, size)

    @classmethod
    def of_light(cls, buffers: Buffers, size: tuple[int, int]) -> PixelBuffers:
        """What a lit image keeps beside them."""
        return cls._of(buffers, "lit_pixels", LitPixels(), LIT_FIELDS, size)

    @classmethod
    def _of(
        cls, buffers: Buffers, name: str, data: Any, fields: tuple[tuple[str, Any, int], ...], size: tuple[int, int]
    ) -> PixelBuffers:
        block, arrays = buffers.split(name, fields, size[0] * size[1])
        for field, array in arrays.items():
            setattr(data, field, array)
        return cls(data, block, size, fields)

    def upload(self, images: dict[str, np.ndarray]) -> None:
        """Puts images back that ``download`` gave."""
        self.block.assign(np.concatenate([images[name].reshape(-1).view(np.float32) for name, _, _ in self.fields]))

    def download(self) -> dict[str, np.ndarray]:
        """Copies all images to the host at once; shapes (H, W) or (H, W, 3)."""
        words = self.block.numpy()
        if self.block.device.is_cpu:
            words = words.copy()  # there, what Warp gives is the buffer itself
        width, height = self.size
        images, first = {}, 0
        for name, dtype, channels in self.fields:
            image = words[first : first + height * width * channels]
            images[name] = image.reshape((height, width) if channels == 1 else (height, width, channels))
            if dtype is wp.int32:
                images[name] = images[name].view(np.int32)
            first += image.size
        return images
