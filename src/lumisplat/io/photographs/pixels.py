"""The pixels of a photograph: decoded, made smaller, and straightened."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.images.texture import read_texture
from lumisplat.io.photographs.cache import Pixels, Plane
from lumisplat.io.photographs.lens import is_bent, lens_points, straightened
from lumisplat.math.resampling import area_mean
from lumisplat.scene.camera import Camera

SHARE_MIN = 1e-3
"""Share of a pixel that counts, below which it is rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """What a photograph is made of."""

    camera: Camera
    """With its lens, at the size that is wanted."""
    image: Path
    mask: Path | None = None
    straightens: bool = True
    """Whether a lens that distorts, or a fisheye, is made a pinhole."""


def decode(source: Source) -> Pixels:
    """The pixels of a photograph.

    Means over areas are those of display-referred values, as captures blend in them.

    Raises:
        FormatError: A file cannot be read, or all of the image is transparent.
    """
    texels = read_texture(source.image)
    planes = {"color": texels[..., :3]}
    if texels.shape[2] == 4:
        planes["alpha"] = texels[..., 3:]
        if not planes["alpha"].any():
            raise FormatError(source.image, "is transparent everywhere: it shows nothing to learn from")
        planes["color"] = (planes["color"] * (planes["alpha"] / np.float32(255.0)) + 0.5).astype(np.uint8)
    if source.mask is not None:
        planes["mask"] = read_mask(source.mask)
    lens = source.camera
    smaller = {name: _smaller(plane, lens.width, lens.height) for name, plane in planes.items()}
    planes = (
        _counted(planes, smaller) if "mask" in planes and planes["color"].shape != smaller["color"].shape else smaller
    )
    if is_bent(lens) and not source.straightens:
        has_ray = lens.ray_directions().any(axis=2, keepdims=True)
        if not has_ray.all():
            planes["mask"] = np.where(has_ray, planes.get("mask", 255), 0).astype(np.uint8)
    elif is_bent(lens):
        points, covered = lens_points(lens)
        if not covered.all():
            planes.setdefault("mask", np.full((lens.height, lens.width, 1), 255, np.uint8))
        planes = {name: straightened(plane, points, covered) for name, plane in planes.items()}
    alpha, mask = (planes[name][..., 0] if name in planes else None for name in ("alpha", "mask"))
    return Pixels(planes["color"], alpha, mask)


def read_mask(path: Path) -> Plane:
    """Reads a mask: 255 where the image counts, which is wherever it is not black, or transparent; shape (H, W, 1).

    Of a JPEG, what is darker than half is black: its black is not exact beside white.

    Raises:
        FormatError: The file cannot be read, or nothing counts.
    """
    texels = read_texture(path)
    counts = texels[..., 3:] if texels.shape[2] == 4 else texels.max(axis=2, keepdims=True)
    counts = counts > (127 if path.suffix.lower() in (".jpg", ".jpeg") else 0)
    if not counts.any():
        raise FormatError(
            path, "is black everywhere: no pixel of its photograph would count, expected white where it does"
        )
    return 255 * counts.astype(np.uint8)


def _counted(planes: dict[str, Plane], smaller: dict[str, Plane]) -> dict[str, Plane]:
    """Smaller planes that are means over what counts of their areas: what does not is not mixed in.

    Args:
        planes: Of the size of the file.
        smaller: Means over all of the areas, which stay where nothing counts, and those of the mask.
    """
    height, width = smaller["mask"].shape[:2]
    counts = planes["mask"] > 0
    share = area_mean(counts, width, height)
    made = dict(smaller)
    for name in smaller.keys() - {"mask"}:
        mean = area_mean(planes[name] * counts, width, height) / np.maximum(share, SHARE_MIN)
        made[name] = np.where(share > SHARE_MIN, mean + 0.5, smaller[name]).astype(np.uint8)
    return made


def _smaller(plane: Plane, width: int, height: int) -> Plane:
    """The mean over the area of each pixel; by whole factors as Pillow reduces, which is the same and fast."""
    from PIL import Image

    rows, columns, channels = plane.shape
    if columns % width or rows % height:
        return (area_mean(plane, width, height) + 0.5).astype(np.uint8)
    image = Image.fromarray(plane[..., 0] if channels == 1 else plane)
    return np.asarray(image.reduce((columns // width, rows // height))).reshape(height, width, channels)
