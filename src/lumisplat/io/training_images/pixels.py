"""Decodes pixels of training images: made smaller, straightened to a pinhole, and cached in bounded memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.images.texture import read_texture
from lumisplat.math.arrays import Doubles, Flags
from lumisplat.math.distortion import distort, distortion_reach
from lumisplat.math.resampling import area_mean, cubic_samples
from lumisplat.scene.camera import Camera, CameraModel

Plane = npt.NDArray[np.uint8]

_SHARE_MIN = 1e-3
"""Share of a pixel that counts, below which it is rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """A photograph in 8 bits, as a pinhole sees it."""

    color: Plane
    """Display-referred sRGB, premultiplied by alpha, shape (H, W, 3)."""
    alpha: Plane | None
    """How much of the pixel shows something, shape (H, W); None: all of it everywhere."""
    mask: Plane | None
    """How much of the pixel counts, shape (H, W); None: all of it everywhere."""

    @property
    def size(self) -> int:
        """Bytes."""
        return sum(plane.nbytes for plane in (self.color, self.alpha, self.mask) if plane is not None)


@dataclass(slots=True, eq=False)
class PixelCache:
    """Keeps what was decoded last, up to a number of bytes. May be used by several threads."""

    limit: int
    """Bytes."""
    held: int = field(default=0, init=False)
    """Bytes that are in use."""
    _entries: OrderedDict[Path, Pixels] = field(default_factory=OrderedDict[Path, Pixels], init=False)
    _lock: Lock = field(default_factory=Lock, init=False)

    def get(self, key: Path, decode: Callable[[], Pixels]) -> Pixels:
        """What is kept under a key, else what ``decode`` returns."""
        with self._lock:
            if key in self._entries:
                self._entries.move_to_end(key)
                return self._entries[key]
        pixels = decode()
        with self._lock:
            if key not in self._entries:
                self._entries[key] = pixels
                self.held += pixels.size
            while self.held > self.limit:
                self.held -= self._entries.popitem(last=False)[1].size
        return pixels


def is_bent(camera: Camera) -> bool:
    """Whether straight lines are not straight in the pictures of a camera."""
    return camera.is_distorted or camera.model is CameraModel.FISHEYE


def pinhole_of(camera: Camera) -> Camera:
    """The pinhole of the same pose, focal lengths, principal point and size."""
    return replace(camera, model=CameraModel.PINHOLE, distortion=(0.0,) * 6)


def lens_points(camera: Camera) -> tuple[Doubles, Flags]:
    """Where a camera shows what its pinhole sees.

    Args:
        camera: A pinhole or fisheye camera with a lens.

    Returns:
        Columns and rows in the picture of the camera, for the pixels of the pinhole, shape (H, W, 2), and whether they
        lie in that picture, shape (H, W).
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    center, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    seen = (np.stack([x, y], axis=-1) - center) / focal
    if camera.model is CameraModel.FISHEYE:
        tangent = np.linalg.norm(seen, axis=-1, keepdims=True)
        seen = seen * np.divide(np.arctan(tangent), tangent, out=np.ones_like(tangent), where=tangent > 0.0)
    reached = np.linalg.norm(seen, axis=-1) <= distortion_reach(camera.distortion)
    points = distort(np.where(reached[..., None], seen, 0.0), camera.distortion) * focal + center
    inside = ((points >= 0.0) & (points <= (camera.width, camera.height))).all(axis=-1)
    return points, reached & inside


def _straightened(plane: Plane, points: Doubles, covered: Flags) -> Plane:
    """A picture of a lens as its pinhole sees it.

    Args:
        plane: Shape (H, W, C).
        points: As from `lens_points`.
        covered: Likewise; 0 elsewhere.

    Returns:
        Shape (H, W, C).
    """
    seen = cubic_samples(plane.astype(np.float32), np.where(covered[..., None], points, 0.5))
    return np.where(covered[..., None], seen + 0.5, 0.0).astype(np.uint8)


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
        planes = {name: _straightened(plane, points, covered) for name, plane in planes.items()}
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
        mean = area_mean(planes[name] * counts, width, height) / np.maximum(share, _SHARE_MIN)
        made[name] = np.where(share > _SHARE_MIN, mean + 0.5, smaller[name]).astype(np.uint8)
    return made


def _smaller(plane: Plane, width: int, height: int) -> Plane:
    """The mean over the area of each pixel; by whole factors as Pillow reduces, which is the same and fast."""
    from PIL import Image

    rows, columns, channels = plane.shape
    if columns % width or rows % height:
        return (area_mean(plane, width, height) + 0.5).astype(np.uint8)
    image = Image.fromarray(plane[..., 0] if channels == 1 else plane)
    return np.asarray(image.reduce((columns // width, rows // height))).reshape(height, width, channels)
