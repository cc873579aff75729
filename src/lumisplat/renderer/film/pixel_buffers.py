"""Device buffers of the pixels of a frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.device.structs.camera import LitPixels, PixelData, PixelSums
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.downloads import Copies, Downloads

Pixels = TypeVar("Pixels", PixelData, LitPixels)

FIELDS = (
    ("color", wp.vec3, 3),
    ("alpha", wp.float32, 1),
    ("depth", wp.float32, 1),
    ("normal", wp.vec3, 3),
    ("gaussian", wp.int32, 1),
    ("instance", wp.int32, 1),
)
"""Arrays of ``PixelData``: field name, element type, and 32-bit words per element."""

LIT_FIELDS = (("captured_weight", wp.float32, 1), ("light", wp.vec3, 3), ("color", wp.vec3, 3))
"""Arrays of ``LitPixels``: field name, element type, and 32-bit words per element."""

SUM_FIELDS = (("color", wp.vec3d, 6), ("alpha", wp.float64, 2), ("radiance", wp.vec3d, 6), ("squares", wp.vec3d, 6))
"""Arrays of ``PixelSums`` in all frames: field name, element type, and 32-bit words per element."""

LIT_SUM_FIELDS = (("captured_weight", wp.float64, 2), ("light", wp.vec3d, 6))
"""Further arrays of ``PixelSums`` in lit frames: field name, element type, and 32-bit words per element."""


@dataclass(frozen=True, slots=True)
class PixelBuffers(Generic[Pixels]):
    """Arrays of a frame's pixels, one after another in one block of device memory."""

    data: Pixels
    """Struct whose fields are the arrays. Kernels get the struct as an argument."""
    block: DeviceArray
    """The memory block that holds all arrays, as float32."""
    size: tuple[int, int]
    """Width and height of the image, pixels."""
    fields: tuple[tuple[str, type[object], int], ...]
    """Arrays in the block, in order: field name, element type, and 32-bit words per element."""
    downloads: Downloads
    """Pool of host memory through which the block is downloaded."""

    @staticmethod
    def of(buffers: Buffers, size: tuple[int, int]) -> PixelBuffers[PixelData]:
        """Returns buffers for an image of ``size`` (width, height); all images of one size share their memory."""
        return _split_block(buffers, "pixels", PixelData(), FIELDS, size)

    @staticmethod
    def of_light(buffers: Buffers, size: tuple[int, int]) -> PixelBuffers[LitPixels]:
        """Returns buffers for the images that only lit frames have; ``size`` is width and height."""
        return _split_block(buffers, "lit_pixels", LitPixels(), LIT_FIELDS, size)

    def upload(self, images: dict[str, npt.NDArray[Any]]) -> None:
        """Copies images to the device arrays of the same field names."""
        self.block.assign(np.concatenate([images[name].reshape(-1).view(np.float32) for name, _, _ in self.fields]))

    def download(self) -> dict[str, npt.NDArray[Any]]:
        """Copies all images to the host, by field name; shapes (H, W) or (H, W, 3)."""
        copies = self.downloads.copies({"pixels": self.block})
        return {name: read() for name, read in self._reads(copies, "pixels").items()}

    def images(self, copies: Copies, name: str) -> dict[str, Any]:
        """Returns the images of a copied block by field name, or functions that download them; (H, W) or (H, W, 3).

        Args:
            copies: Copies of ``block`` and of other arrays.
            name: Name under which ``copies`` holds ``block``.
        """
        return {field: copies.lazy(read) for field, read in self._reads(copies, name).items()}

    def _reads(self, copies: Copies, name: str) -> dict[str, Callable[[], npt.NDArray[Any]]]:
        width, height = self.size
        reads: dict[str, Callable[[], npt.NDArray[Any]]] = {}
        first = 0
        for field, dtype, channels in self.fields:
            count = width * height * channels
            shape = (height, width) if channels == 1 else (height, width, channels)
            number = np.int32 if dtype is wp.int32 else np.float32
            reads[field] = partial(_image, copies, (name, first, count), shape, number)
            first += count
        return reads


def pixel_sums(buffers: Buffers, count: int, *, is_lit: bool) -> tuple[PixelSums, DeviceArray]:
    """Returns the sums of ``count`` pixels, and the float32 memory block that holds them."""
    fields = SUM_FIELDS + (LIT_SUM_FIELDS if is_lit else ())
    block, arrays = buffers.split("pixel_sums", fields, count)
    sums = PixelSums()
    for field, array in arrays.items():
        setattr(sums, field, array)
    return sums, block


def _image(
    copies: Copies, words: tuple[str, int, int], shape: tuple[int, ...], number: type[np.generic]
) -> npt.NDArray[Any]:
    """Returns one image from copies.

    Args:
        copies: Copies of memory blocks.
        words: Name of the copied block, the image's first word in the block, and its number of words.
        shape: Shape of the image.
        number: Type of the image's numbers.
    """
    return copies.words(*words).view(number).reshape(shape)


def _split_block(
    buffers: Buffers,
    name: str,
    data: Pixels,
    fields: tuple[tuple[str, type[object], int], ...],
    size: tuple[int, int],
) -> PixelBuffers[Pixels]:
    """Allocates one memory block, sets views of it as the fields of ``data``, and returns the buffers.

    ``fields`` gives each field's name, element type and 32-bit words per element; ``size`` is width and height.
    """
    block, arrays = buffers.split(name, fields, size[0] * size[1])
    for field, array in arrays.items():
        setattr(data, field, array)
    return PixelBuffers(data, block, size, fields, buffers.downloads)
