"""A set of photographs with poses, held in bounded memory."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path

import numpy as np

from lumisplat.config.checks import Color
from lumisplat.errors import FormatError
from lumisplat.io.photographs.cache import PixelCache, Pixels, Plane
from lumisplat.io.photographs.pixels import Source, decode
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.scene.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class Photograph:
    """A photograph as its camera sees it. Its pixels are decoded when they are asked for, and kept for a while.

    Every method reads the files if their contents are no longer kept, and raises `FormatError` if that fails.
    """

    name: str
    """That of the image without its extension; each of a set has its own."""
    camera: Camera
    """Of the size of the pixels: a pinhole without distortion, unless lenses were to stay as they are."""
    path: Path
    """The image."""
    background: Color | None
    """Display-referred sRGB, 0..1, behind the transparent pixels; None: they stay premultiplied, as over black."""
    _source: Source = field(repr=False)
    _cache: PixelCache = field(repr=False)

    def pixels(self) -> FloatArray:
        """Display-referred sRGB, 0..1, over the background, shape (H, W, 3)."""
        kept = self._kept()
        color = _share(kept.color)
        if kept.alpha is None or self.background is None:
            return color
        behind = (1.0 - _share(kept.alpha))[..., None] * np.array(self.background)
        return (color + behind).astype(np.float32)

    def alpha(self) -> FloatArray | None:
        """How much of each pixel shows something, 0..1, shape (H, W); None: the image has no transparency."""
        alpha = self._kept().alpha
        return None if alpha is None else _share(alpha)

    def mask(self) -> FloatArray | None:
        """How much of each pixel counts, 0..1, shape (H, W); None: all of it.

        It is 0 where the mask of the photograph is black, and where its lens does not show what the pinhole sees; of
        lenses that stay as they are, where there is no ray.
        """
        mask = self._kept().mask
        return None if mask is None else _share(mask)

    @property
    def fingerprint(self) -> str:
        """What tells it from others without decoding it: its camera and lens, and the bytes of its image and mask."""
        told = hashlib.sha256(f"{self.name} {self.background}".encode())
        try:
            for file in (self.path, self._source.mask):
                told.update(b"none" if file is None else hashlib.sha256(file.read_bytes()).digest())
        except OSError as error:
            raise FormatError(error.filename or self.path, f"cannot be read: {error.strerror or error}") from None
        told.update(_told(self.camera))
        told.update(_told(self._source.camera))
        return told.hexdigest()

    def _kept(self) -> Pixels:
        return self._cache.get(self.path, partial(decode, self._source))


@dataclass(frozen=True, slots=True)
class ReadFrom:
    """From where photographs were read, and how: the arguments of `load_photographs` that make the same ones again."""

    folder: Path
    """Its absolute path."""
    scale: float
    hold_out: int
    background: Color | None
    straighten: bool
    allow_outside: bool


@dataclass(frozen=True, slots=True, eq=False)
class Photographs:
    """Photographs of a scene with poses, as `load_photographs` reads them."""

    training: tuple[Photograph, ...]
    """Those to learn from, at least one, ordered by name."""
    held_out: tuple[Photograph, ...]
    """Those to measure with, ordered by name; there may be none."""
    points: Doubles | None
    """Points of the scene that COLMAP has found, world space, shape (N, 3); None: there are none."""
    point_colors: FloatArray | None
    """Their display-referred sRGB, 0..1, shape (N, 3)."""
    extent: float
    """1.1 times the largest distance of a training camera from the mean of their positions, scene units; 0: all of
    them stand in one place."""
    target: Doubles
    """What the training cameras look at: the point nearest to their optical axes in the sense of least squares, shape
    (3,). Where all axes are parallel it is the mean of the positions."""
    read_from: ReadFrom | None = None
    """From where, and how; None: a program has put them together."""

    @property
    def fingerprint(self) -> str:
        """What tells those to learn from, and the points, from others.

        Raises:
            FormatError: A file is no longer there.
        """
        told = hashlib.sha256("".join(photograph.fingerprint for photograph in self.training).encode())
        for array in (self.points, self.point_colors):
            told.update(b"none" if array is None else array.tobytes())
        return told.hexdigest()


def _told(camera: Camera) -> bytes:
    """All that a camera is."""
    values = (getattr(camera, one.name) for one in fields(camera))
    return b" ".join(value.tobytes() if isinstance(value, np.ndarray) else str(value).encode() for value in values)


def _share(plane: Plane) -> FloatArray:
    return np.divide(plane, 255.0, dtype=np.float32)
