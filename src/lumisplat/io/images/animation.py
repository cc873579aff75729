"""Animations from pictures: GIF, WebP, animated PNG and MP4."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import ConfigError, FormatError, SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.png import to_bytes

if TYPE_CHECKING:
    from PIL import Image

_Bytes = npt.NDArray[np.uint8]

_FPS_MAX = 50.0
"""Largest number of frames per second: browsers show GIF frames shorter than 20 ms ten times slower."""
_PALETTE_PIXELS = 100_000
"""Number of pixels, over all frames, from which the palette of a GIF is chosen: more make no visible difference."""


def write_animation(path: PathLike, frames: Iterable[npt.ArrayLike], fps: float) -> None:
    """As `lumisplat.io.save_animation`."""
    from PIL import Image

    suffix = Path(path).suffix.lower()
    if suffix == ".mp4":
        from lumisplat.io.images.video import write_video

        write_video(path, frames, fps)
        return
    if suffix not in (".gif", ".webp", ".png", ".apng"):
        expected = ".mp4, .gif, .webp, .png or .apng"
        raise FormatError(path, f"unknown extension '{suffix}' of an animation, expected {expected}")
    if not 0.0 < fps <= _FPS_MAX:
        raise ConfigError(f"fps is {fps}, expected more than 0, at most {_FPS_MAX:g}")
    pictures = [to_bytes(frame, path) for frame in frames]
    if len({picture.shape for picture in pictures}) != 1 or pictures[0].shape[2] != 3:
        shapes = sorted({picture.shape for picture in pictures})
        raise SceneError(f"an animation takes pictures of one shape (H, W, 3), got {shapes or 'none'}")
    if suffix == ".gif":
        images = _quantise(pictures)
        # With the palette given, Pillow does not repeat it for each frame.
        options: dict[str, Any] = {"format": "GIF", "optimize": False, "palette": _palette_bytes(images[0])}
    else:
        images = [Image.fromarray(picture) for picture in pictures]
        options = {"format": "WEBP", "quality": 90} if suffix == ".webp" else {"format": "PNG"}
    with atomic_write(path) as temporary:
        durations = _durations_ms(len(images), fps, unit=10 if suffix == ".gif" else 1)
        images[0].save(temporary, save_all=True, append_images=images[1:], duration=durations, loop=0, **options)


def _durations_ms(count: int, fps: float, unit: int) -> list[int]:
    """Durations in whole units, so that any number of frames takes the right time to half a unit."""
    ends = np.floor(np.arange(count + 1) * 1000.0 / (fps * unit) + 0.5).astype(int)
    return [int(length) * unit for length in np.diff(ends)]


def _quantise(pictures: list[_Bytes]) -> list[Image.Image]:
    """The pictures in one palette of 256 colours, with ordered dithering."""
    from PIL import Image

    # An odd step, so that the pixels are not all in a few columns.
    step = max(1, len(pictures) * pictures[0].size // (3 * _PALETTE_PIXELS)) | 1
    samples = np.concatenate([picture.reshape(-1, 3)[::step] for picture in pictures])
    # Maximum coverage, because median cut has no colour left for small objects.
    palette = Image.fromarray(samples[None]).quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=3)
    colors = np.unique(np.array(palette.getpalette()).reshape(-1, 3), axis=0).astype(np.float64)
    distances = np.linalg.norm(colors[:, None] - colors[None], axis=2) + 1e9 * np.eye(len(colors))
    height, width, _ = pictures[0].shape
    y, x = np.mgrid[:height, :width]
    # Interleaved gradient noise (Jimenez 2014): unlike white noise, any 3 x 3 pixels have each value about once. Its
    # amplitude is about the distance between colours of the palette.
    noise = (52.9829189 * ((0.06711056 * x + 0.00583715 * y) % 1.0)) % 1.0 - 0.5
    offsets = np.median(distances.min(axis=1)) * noise[..., None] + 0.5
    images: list[Image.Image] = []
    for picture in pictures:
        noisy = np.clip(picture + offsets, 0.0, 255.0).astype(np.uint8)
        images.append(Image.fromarray(noisy).quantize(palette=palette, dither=Image.Dither.NONE))
    return images


def _palette_bytes(image: Image.Image) -> bytes:
    return bytes(image.getpalette() or ()).ljust(768, b"\0")
