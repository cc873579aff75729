"""Animations: GIF, WebP, animated PNG and MP4 out of pictures. The file appears whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import ConfigError, FormatError, SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.image import to_bytes

if TYPE_CHECKING:
    from PIL import Image

_Bytes = npt.NDArray[np.uint8]

_FPS_MAX = 50.0
"""Frames a second: browsers show GIF frames of less than 20 ms ten times slower."""
_PALETTE_PIXELS = 100_000
"""Pixels over all frames from which the palette of a GIF is chosen: more changes nothing that is seen."""


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
        images = _paletted(pictures)
        # Given the palette, Pillow does not repeat it with each frame.
        options: dict[str, Any] = {"format": "GIF", "optimize": False, "palette": _palette_bytes(images[0])}
    else:
        images = [Image.fromarray(picture) for picture in pictures]
        options = {"format": "WEBP", "quality": 90} if suffix == ".webp" else {"format": "PNG"}
    with atomic_write(path) as temporary:
        durations = _durations_ms(len(images), fps, unit=10 if suffix == ".gif" else 1)
        images[0].save(temporary, save_all=True, append_images=images[1:], duration=durations, loop=0, **options)


def _durations_ms(count: int, fps: float, unit: int) -> list[int]:
    """Whole units for each frame, of which any number of frames takes as long as it should, to half a unit."""
    ends = np.floor(np.arange(count + 1) * 1000.0 / (fps * unit) + 0.5).astype(int)
    return [int(length) * unit for length in np.diff(ends)]


def _paletted(pictures: list[_Bytes]) -> list[Image.Image]:
    """The pictures in one palette of 256 colours."""
    from PIL import Image

    # An odd step, so that it does not pick a few columns only.
    step = max(1, len(pictures) * pictures[0].size // (3 * _PALETTE_PIXELS)) | 1
    chosen = np.concatenate([picture.reshape(-1, 3)[::step] for picture in pictures])
    # Spread over all colours first: median cut has none left for small things of their own colour.
    palette = Image.fromarray(chosen[None]).quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=3)
    colors = np.unique(np.array(palette.getpalette()).reshape(-1, 3), axis=0).astype(np.float64)
    apart = np.linalg.norm(colors[:, None] - colors[None], axis=2) + 1e9 * np.eye(len(colors))
    height, width, _ = pictures[0].shape
    y, x = np.mgrid[:height, :width]
    # Interleaved gradient noise (Jimenez 2014): each value about once in any 3 x 3 pixels, unlike white noise. It
    # moves colours about as far as those of the palette are apart.
    noise = (52.9829189 * ((0.06711056 * x + 0.00583715 * y) % 1.0)) % 1.0 - 0.5
    moves = np.median(apart.min(axis=1)) * noise[..., None] + 0.5
    images = []
    for picture in pictures:
        moved = np.clip(picture + moves, 0.0, 255.0).astype(np.uint8)
        images.append(Image.fromarray(moved).quantize(palette=palette, dither=Image.Dither.NONE))
    return images


def _palette_bytes(image: Image.Image) -> bytes:
    return bytes(image.getpalette() or ()).ljust(768, b"\0")
