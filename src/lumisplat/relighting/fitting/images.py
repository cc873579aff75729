"""Reads images for a fit of lights: linear, small, and with what does not count masked."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from lumisplat.config import ToneMap
from lumisplat.errors import SceneError, check_instance
from lumisplat.io.images.radiance import LINEAR, read_picture, read_radiance
from lumisplat.math.arrays import Doubles, Flags, FloatArray
from lumisplat.math.resampling import area_mean
from lumisplat.math.tone_map import remove_tone_map
from lumisplat.scene.camera import Camera

CLIPPED_ABOVE = 0.995
"""Display value from which on a pixel may be clipped: 254 of 255 and above."""

_ASPECT_ERROR = 0.51
"""Pixels by which the height of a photograph may miss the camera's aspect ratio."""
_WHOLE = 1.0 - 1e-4
"""Share of its own pixels that count from which on a larger pixel counts."""


@dataclass(frozen=True, slots=True, eq=False)
class FitPhotograph:
    """A photograph at its own size."""

    camera: Camera
    """Of the photograph's size."""
    light: Doubles
    """Linear Rec.709, exposed, shape (H, W, 3)."""
    counts: Flags
    """Which channels of which pixels are fitted, shape (H, W, 3)."""
    label: str
    """What messages call it."""
    clipped: int
    """Pixels that are left out, as they are at the end of the range."""
    masked: int
    """Pixels that a mask leaves out."""
    full_size: int
    """Pixels of the photograph as it was given."""

    def scaled(self, longest: int) -> FitPhotograph:
        """The photograph with at most so many pixels along its longer side; a pixel counts if all of it does."""
        height, width = self.light.shape[:2]
        factor = longest / max(height, width)
        if factor >= 1.0:
            return self
        size = max(1, round(factor * width)), max(1, round(factor * height))
        return FitPhotograph(
            camera=self.camera.scaled(*size),
            light=area_mean(self.light, *size).astype(np.float64),
            counts=area_mean(self.counts.astype(np.float32), *size) >= _WHOLE,
            label=self.label,
            clipped=self.clipped,
            masked=self.masked,
            full_size=self.full_size,
        )


def read_photographs(
    cameras: Camera | Sequence[Camera],
    photographs: Any,
    masks: Any = None,
    *,
    linear: bool | None = None,
    tone_map: ToneMap = ToneMap.NONE,
) -> list[FitPhotograph]:
    """The photographs of cameras.

    Args:
        cameras: One, or one a photograph.
        photographs: As of `lumisplat.fit_lights`.
        masks: One a photograph, (H, W): what is at least half white counts; None, also in place of one: all does.
        linear: Whether arrays hold linear light; None: arrays and pictures are display-referred, EXR and HDR linear.
        tone_map: What display colours went through.

    Raises:
        SceneError: Numbers or sizes do not match, values are not finite, or nothing counts.
        FormatError: A file cannot be read.
    """
    views = [cameras] if isinstance(cameras, Camera) else list(cameras)
    given = [photographs] if _is_one(photographs) else list(photographs)
    covers = [None] * len(given) if masks is None else [masks] if _is_one(masks) else list(masks)
    for view in views:
        check_instance(view, Camera, "cameras holds something else, expected a Camera")
    if not given or len(views) != len(given):
        raise SceneError(f"there are {len(views)} cameras and {len(given)} photographs, expected one camera for each")
    if len(covers) != len(given):
        raise SceneError(f"there are {len(given)} photographs and {len(covers)} masks, expected one for each, or None")
    rows = zip(range(len(given)), views, given, covers, strict=True)
    return [
        _read(number if len(given) > 1 else None, view, one, cover, linear=linear, tone_map=tone_map)
        for number, view, one, cover in rows
    ]


def _path_of(given: Any) -> Path | None:
    """The path, if it is one."""
    return Path(cast("str", given)) if isinstance(given, str | os.PathLike) else None


def _is_one(photographs: Any) -> bool:
    """Whether this is one picture: a path, or an array of three axes; else it is a sequence of them."""
    if _path_of(photographs) is not None:
        return True
    return not isinstance(photographs, list | tuple) and np.ndim(photographs) < 4


def _read(
    number: int | None, camera: Camera, photograph: Any, mask: Any, *, linear: bool | None, tone_map: ToneMap
) -> FitPhotograph:
    path = _path_of(photograph)
    label = "the photograph" if number is None else f"photograph {number}"
    label = label if path is None else str(path)
    if path is not None:
        is_linear = path.suffix.lower() in LINEAR
        values: npt.NDArray[Any] = read_radiance(path) if is_linear else read_picture(path)
    else:
        is_linear, values = bool(linear), np.asarray(photograph)
    values = _checked(label, values)
    camera = _fitting(label, camera, values.shape[1], values.shape[0])
    counts: Flags = np.ones(values.shape, np.bool_)
    if not is_linear:
        bright = values >= CLIPPED_ABOVE
        counts = (values > 0.0) & ~(bright if tone_map is ToneMap.NONE else bright.any(axis=2, keepdims=True))
    clipped = int(np.count_nonzero(~counts.all(axis=2)))
    light = np.maximum(values, 0.0) if is_linear else remove_tone_map(values, tone_map)
    masked = 0
    if mask is not None:
        shown = _mask(label, mask, values.shape[:2])
        masked = int(np.count_nonzero(~shown))
        counts = counts & shown[..., None]
    if not light.any():
        raise SceneError(f"{label} is black: there is no light in it to be explained")
    if not counts.any():
        why = "is clipped or masked" if masked else f"is clipped, at 0 or at {CLIPPED_ABOVE} and above"
        raise SceneError(f"{label}: every pixel {why}, so that nothing is left to fit; expose it otherwise")
    return FitPhotograph(
        camera=camera,
        light=np.asarray(light, np.float64),
        counts=counts,
        label=label,
        clipped=clipped,
        masked=masked,
        full_size=camera.width * camera.height,
    )


def _checked(label: str, values: npt.NDArray[Any]) -> FloatArray:
    """An image of numbers: bytes become 0..1."""
    if values.dtype.kind not in "fu" or values.ndim != 3 or values.shape[2] != 3 or not values.size:
        raise SceneError(f"{label} is an array {values.shape} of {values.dtype}, expected (H, W, 3), float or uint8")
    if values.dtype.kind == "u":
        return (values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)).astype(np.float32)
    bad = int(np.count_nonzero(~np.isfinite(values).all(axis=2)))
    if bad:
        raise SceneError(f"{label} has {bad:,} pixels that are NaN or infinite: mend them, or mask them with 0 instead")
    return values.astype(np.float32)


def _fitting(label: str, camera: Camera, width: int, height: int) -> Camera:
    """The camera at the size of its photograph.

    Raises:
        SceneError: The aspect ratio is another.
    """
    if abs(height - width * camera.height / camera.width) > _ASPECT_ERROR * max(1.0, height / camera.height):
        raise SceneError(
            f"{label} is {width} x {height}, and its camera {camera.name or 'without a name'} {camera.width} x "
            f"{camera.height}, of another shape: crop the picture, or give the camera that took it"
        )
    return camera.scaled(width, height)


def _mask(label: str, mask: Any, size: tuple[int, ...]) -> Flags:
    """Where a photograph counts, shape (H, W).

    Raises:
        SceneError: The mask has another size.
    """
    values: npt.NDArray[Any] = np.asarray(mask) if _path_of(mask) is None else read_picture(mask)
    if values.dtype == np.uint8:
        values = values / 255.0
    if values.ndim == 3:
        values = values.mean(axis=2)
    if values.shape != size:
        raise SceneError(f"the mask of {label} has shape {values.shape}, expected {size}, as the photograph")
    return values >= 0.5
