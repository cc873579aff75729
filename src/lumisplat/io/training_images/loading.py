"""Loads folders of posed training images: splits, masks, point cloud, scene extent and decoded pixels.

Pixels are decoded on demand: downscaled, undistorted to a pinhole camera, and cached in bounded memory.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from threading import Lock

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import Color, check_flag, check_range, check_whole, display_color, is_number, quoted
from lumisplat.constants import COINCIDENT_EXTENT
from lumisplat.errors import ConfigError, FormatError, MissingFileError
from lumisplat.io.cameras.colmap import count_colmap_images, is_colmap, read_colmap_points
from lumisplat.io.cameras.common import unique_names
from lumisplat.io.files.source import PathLike, references_outside
from lumisplat.io.images.texture import check_undamaged, image_size, read_texture
from lumisplat.io.training_images.listing import (
    ListedImage,
    Splits,
    colmap_images,
    nerfstudio_points,
    report_without_pose,
    some_names,
    transforms_images,
    view_folder_images,
)
from lumisplat.math.arrays import Doubles, Flags, FloatArray
from lumisplat.math.distortion import distort, distortion_reach
from lumisplat.math.resampling import area_mean, cubic_samples
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.local_frame import camera_extent

IMAGE_CACHE_BYTES = 1 << 30
"""Default memory limit of decoded images, bytes: 520 images of 960 x 720. It fits beside a training run on small
machines."""

HOLD_OUT = 8
"""Default of ``hold_out``: every 8th image is held out for evaluation, as in Mip-NeRF 360 and later work."""

SAME_POSITION = 1e-3
"""Two cameras count as at one position if their distance is below this fraction of the extent of all cameras."""

SAME_ROTATION = 1e-3
"""Two cameras count as equally rotated if the angle between their rotations is below this, radians.

A rotation by this angle moves the image by a pixel or two."""

_log = logging.getLogger("lumisplat")

_EXPECTED = "transforms.json (nerfstudio), transforms_train.json (Blender) or a COLMAP sparse model"


def camera_target(cameras: Sequence[Camera]) -> Doubles:
    """Returns the point with the least sum of squared distances to all optical axes, shape (3,).

    If the point is not unique, as for parallel axes, the solution nearest to the mean camera position is returned.
    """
    eyes = np.stack([camera.eye for camera in cameras])
    axes = np.stack([camera.camera_from_world[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = eyes.mean(axis=0)
    inverse = np.asarray(np.linalg.pinv(across.sum(axis=0), rcond=1e-9), dtype=np.float64)
    return middle + inverse @ np.einsum("nij,nj->i", across, eyes - middle)


def count_positions(cameras: Sequence[Camera]) -> int:
    """Counts distinct camera positions; positions within `SAME_POSITION` of each other count once."""
    return len(_distinct(cameras, with_rotation=False))


def count_poses(cameras: Sequence[Camera]) -> int:
    """Counts distinct camera poses; poses within `SAME_POSITION` and `SAME_ROTATION` of each other count once."""
    return len(_distinct(cameras, with_rotation=True))


def _distinct(cameras: Sequence[Camera], *, with_rotation: bool) -> list[int]:
    """Returns the index of the first camera at each pose.

    Poses are the same within `SAME_POSITION` and `SAME_ROTATION`.

    If ``with_rotation`` is False, only positions are compared.
    """
    eyes = np.stack([camera.eye for camera in cameras])
    rotations = np.stack([camera.camera_from_world[:3, :3] for camera in cameras])
    near = SAME_POSITION * max(camera_extent(cameras), COINCIDENT_EXTENT / SAME_POSITION * float(np.abs(eyes).max()))
    found: list[int] = []
    for number, (eye, rotation) in enumerate(zip(eyes, rotations, strict=True)):
        same = np.linalg.norm(eyes[found] - eye, axis=1) <= near
        if with_rotation:
            # The Frobenius norm of the difference of two rotations is 2 sqrt(2) sin(angle / 2).
            same &= np.linalg.norm(rotations[found] - rotation, axis=(1, 2)) <= np.sqrt(2.0) * SAME_ROTATION
        if not same.any():
            found.append(number)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class TrainingImage:
    """An image with its camera, name and mask. Pixels are decoded on demand and cached in bounded memory.

    Methods read the files again if the pixels are no longer cached, and raise `FormatError` if that fails.
    """

    name: str
    """File name without its extension, made unique within the image set."""
    camera: Camera
    """Camera with the image size of `pixels`: an undistorted pinhole, or the original lens if ``straighten`` was
    False."""
    path: Path
    """The image file."""
    background: Color | None
    """Display-referred sRGB background behind transparent pixels, 0..1; None leaves colours premultiplied (over
    black)."""
    _source: ImageSource = field(repr=False)
    _cache: _PixelCache = field(repr=False)

    def pixels(self) -> FloatArray:
        """Returns display-referred sRGB, 0..1, composited over the background, shape (H, W, 3)."""
        decoded = self._decoded()
        color = _unit_range(decoded.color)
        if decoded.alpha is None or self.background is None:
            return color
        behind = (1.0 - _unit_range(decoded.alpha))[..., None] * np.array(self.background)
        return (color + behind).astype(np.float32)

    def alpha(self) -> FloatArray | None:
        """Returns alpha of the image, 0..1, shape (H, W), or None if the image has no transparency."""
        alpha = self._decoded().alpha
        return None if alpha is None else _unit_range(alpha)

    def mask(self) -> FloatArray | None:
        """Returns the training weight of each pixel, 0..1, shape (H, W), or None if all pixels have weight 1.

        The weight is 0 where the mask file is black and where the undistorted pinhole looks past the edge of the
        original image. If lenses are not straightened, the weight is 0 where the lens model has no ray.
        """
        mask = self._decoded().mask
        return None if mask is None else _unit_range(mask)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of camera, lens, background and the bytes of the image and mask files, without decoding them."""
        digest = hashlib.sha256(f"{self.name} {self.background}".encode())
        try:
            for file in (self.path, self._source.mask):
                digest.update(b"none" if file is None else hashlib.sha256(file.read_bytes()).digest())
        except OSError as error:
            raise FormatError(error.filename or self.path, f"cannot be read: {error.strerror or error}") from None
        digest.update(_camera_bytes(self.camera))
        digest.update(_camera_bytes(self._source.camera))
        return digest.hexdigest()

    def _decoded(self) -> Pixels:
        return self._cache.get(self.path, partial(decode, self._source))


@dataclass(frozen=True, slots=True)
class ReadFrom:
    """Arguments with which `load_training_images` loaded a set of images, so that the set can be loaded again."""

    folder: Path
    """Absolute path of the folder."""
    scale: float
    hold_out: int
    background: Color | None
    straighten: bool
    allow_outside: bool


@dataclass(frozen=True, slots=True, eq=False)
class TrainingImages:
    """Posed images of a scene, as `load_training_images` returns them."""

    training: tuple[TrainingImage, ...]
    """Images to train with, ordered by name; at least one."""
    held_out: tuple[TrainingImage, ...]
    """Images held out for evaluation, ordered by name; may be empty."""
    points: Doubles | None
    """Sparse points in world space, shape (N, 3), from COLMAP or nerfstudio's ``ply_file_path``; None if there are
    none."""
    point_colors: FloatArray | None
    """Display-referred sRGB of the points, 0..1, shape (N, 3); None if there are no points."""
    extent: float
    """1.1 times the largest distance of a training camera from the mean camera position, scene units; 0 if all cameras
    are at one position."""
    target: Doubles
    """Point that the training cameras look at, shape (3,): the point with the least sum of squared distances to their
    optical axes. For parallel axes, the mean camera position."""
    read_from: ReadFrom | None = None
    """Arguments that loaded these images; None if they were not loaded by `load_training_images`."""

    @property
    def fingerprint(self) -> str:
        """SHA-256 of all training images with their cameras and masks, and of the points, but not of held-out images.

        Raises:
            FormatError: A file no longer exists.
        """
        digest = hashlib.sha256("".join(image.fingerprint for image in self.training).encode())
        for array in (self.points, self.point_colors):
            digest.update(b"none" if array is None else array.tobytes())
        return digest.hexdigest()


def _camera_bytes(camera: Camera) -> bytes:
    """Returns all fields of a camera as bytes, for hashing."""
    values = (getattr(camera, one.name) for one in fields(camera))
    return b" ".join(value.tobytes() if isinstance(value, np.ndarray) else str(value).encode() for value in values)


def _unit_range(plane: Plane) -> FloatArray:
    return np.divide(plane, 255.0, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class _FolderContents:
    """Images to train with, held-out images and point cloud that a folder of training images lists."""

    file: Path
    """The ``transforms.json``, or the folder of the COLMAP model, that lists the images."""
    images: list[ListedImage]
    held_out: list[ListedImage] | None = None
    """Images that the folder's files declare as held out; None if the files define no split."""
    points: tuple[Doubles, FloatArray] | None = None


@dataclass(frozen=True, slots=True)
class _ImageSettings:
    """Arguments of `load_training_images` that apply to every image: scale, background and straightening."""

    scale: float
    background: Color | None
    straighten: bool


def load_training_images(
    folder: PathLike,
    *,
    scale: float = 1.0,
    hold_out: int = HOLD_OUT,
    background: str | Sequence[float] | None = None,
    straighten: bool = True,
    cache_bytes: int = IMAGE_CACHE_BYTES,
    allow_outside: bool = False,
) -> TrainingImages:
    """Loads the posed images of a folder; pixels are decoded on demand.

    The folder may hold one of these, tried in this order:

    - ``train_000/metadata.json``, ``train_001/metadata.json``, ... (NeRFactor, TensoIR). The images of ``test_000``,
      ... are held out.
    - ``transforms_train.json`` (Blender, NeRF-synthetic). The images of ``transforms_test.json``, or else of
      ``transforms_val.json``, are held out.
    - ``transforms.json`` (nerfstudio, instant-ngp). Its ``train_filenames`` and ``test_filenames`` (or
      ``val_filenames``) define the split, and its ``ply_file_path`` names points.
    - A COLMAP sparse model in ``sparse`` (the one with most images if there are several) or in the folder itself, with
      its images in ``images``.

    Masks come from the file or from a ``masks`` folder with files named after the images; only pixels that are not
    black in the mask are used. Log lines count skipped images, images without a pose, unused models and unused masks.

    Distorted and fisheye lenses are resampled to pinholes with the same focal lengths and size by Catmull-Rom
    interpolation, unless ``straighten`` is False; a log line says so. Pinhole pixels outside the original image are
    masked out. Downscaling takes area means of display-referred values, the space in which captures blend, before
    undistortion.

    Args:
        folder: The folder.
        scale: Factor on the image size, above 0, at most 1.
        hold_out: Hold out the first image in the order of names and every ``hold_out``-th after it; at least 2, or 0. 0
            holds out no image, and ignores a test file.
        background: Colour behind transparent pixels, as in `RenderConfig`: three numbers in 0..1, a name or
            ``"#rrggbb"``. None or ``"transparent"`` leaves colours premultiplied by alpha.
        straighten: Whether to resample distorted and fisheye lenses to pinholes. If False, cameras keep their lens,
            which `Pipeline.TRACE` and `Projection.UNSCENTED` render, and pixels without a ray are masked out.
        cache_bytes: Memory for decoded images, 8 bits per value, at least 0. Images that do not fit are decoded again
            at each use.
        allow_outside: Whether the file may refer to images outside its own folder. Only for files that you trust.

    Raises:
        ConfigError: A setting is out of range.
        FormatError: The folder holds none of these layouts, or fewer than two images; a file is damaged; a pose is not
            rigid or not finite; an image cannot be read or differs in size from its camera; a mask is black everywhere
            or has another size; a camera is orthographic. The message names the file.
        MissingFileError: There is no such folder.
    """
    if not is_number(scale) or not 0.0 < scale <= 1.0:
        raise ConfigError(f"scale is {quoted(scale)}, expected more than 0 and at most 1")
    check_whole("hold_out", hold_out, 0, 1 << 31)
    check_flag("straighten", straighten)
    check_range("cache_bytes", cache_bytes, 0, 1 << 62)
    if hold_out == 1:
        raise ConfigError(
            "hold_out is 1, which leaves no image to train with: expected 2 or more, or 0 to hold out none"
        )
    color = display_color("background", background)
    with references_outside(allow_outside):
        found = _find(Path(folder), hold_out > 0)
    if len(found.images) < 2:
        raise FormatError(found.file, "has a single image, expected two or more: depth needs several viewpoints")
    views_of = partial(_views, found.file, _ImageSettings(scale, color, straighten), _PixelCache(cache_bytes))
    views = views_of(found.images)
    if found.held_out is None:
        held = [view for index, view in enumerate(views) if hold_out and index % hold_out == 0]
        views = [view for view in views if view not in held]
    else:
        held = views_of(found.held_out)
    cameras = [view.camera for view in views]
    points, colors = found.points or (None, None)
    return TrainingImages(
        training=tuple(views),
        held_out=tuple(held),
        points=points,
        point_colors=colors,
        extent=camera_extent(cameras),
        target=camera_target(cameras),
        read_from=ReadFrom(Path(os.path.abspath(folder)), scale, hold_out, color, straighten, allow_outside),
    )


def _find(folder: Path, with_held_out: bool) -> _FolderContents:
    """Detects the layout of a folder, as listed in `load_training_images`, and reads its lists of images.

    Args:
        folder: The folder.
        with_held_out: Whether to list held-out images, too.
    """
    if not folder.exists():
        raise MissingFileError(folder, "no such folder")
    if not folder.is_dir():
        raise FormatError(folder, f"is a file, expected the folder that holds {_EXPECTED}")
    if (folder / "train_000" / "metadata.json").is_file():
        held_out = view_folder_images(folder, "test") if with_held_out and (folder / "test_000").is_dir() else None
        return _FolderContents(folder, view_folder_images(folder, "train"), held_out)
    train = folder / "transforms_train.json"
    if train.is_file():
        return _FolderContents(train, transforms_images(train), _held_out(folder) if with_held_out else None)
    if (folder / "transforms.json").is_file():
        file = folder / "transforms.json"
        listed = transforms_images(file)
        report_without_pose(file, folder, listed)
        training, held_out = Splits.of(file).divide(file, listed, holds_out=with_held_out)
        return _FolderContents(file, training, held_out, nerfstudio_points(file))
    model = find_model(folder)
    if model is None:
        raise FormatError(
            folder,
            f"has no images with poses: expected {_EXPECTED} in sparse/0; for images without poses, "
            "find_poses (--poses colmap) creates one",
        )
    listed = colmap_images(model, folder)
    report_without_pose(model, folder, listed)
    return _FolderContents(model, listed, points=read_colmap_points(model))


def _held_out(folder: Path) -> list[ListedImage] | None:
    """Lists the images of ``transforms_test.json``, else of ``transforms_val.json``; None if neither has an image.

    Some exporters write a test file without its images. In this case a log line says which images are held out instead.
    """
    files = [path for name in ("test", "val") if (path := folder / f"transforms_{name}.json").is_file()]
    lists = [transforms_images(path, may_lack_all=True) for path in files]
    found = next((number for number, listed in enumerate(lists) if listed), None)
    lacking = files[:found]
    if lacking:
        instead = "some training images" if found is None else f"the images of {files[found].name}"
        _log.warning("%s: none of its images exists: %s are held out instead", lacking[0], instead)
    return None if found is None else lists[found]


def find_model(folder: Path) -> Path | None:
    """Finds the folder of a COLMAP sparse model, or returns None.

    If ``sparse`` holds several models, the one with most images is returned, and a log line says so.
    """
    sparse = folder / "sparse"
    inside = [path for path in sparse.iterdir() if path.is_dir()] if sparse.is_dir() else []
    models = sorted((path for path in inside if is_colmap(path)), key=lambda path: (len(path.name), path.name))
    if len(models) > 1:
        counts = [count_colmap_images(path) for path in models]
        best = counts.index(max(counts))
        others = [f"{path.name} with {count}" for path, count in zip(models, counts, strict=True)]
        chosen = models[best]
        del others[best]
        _log.warning(
            "%s has %d models: %s with %d images is used; %s not used, as each model has its own coordinate system",
            sparse,
            len(models),
            chosen.name,
            counts[best],
            f"{some_names(others)} {'is' if len(others) == 1 else 'are'}",
        )
        return chosen
    return next((path for path in (*models, sparse, folder) if is_colmap(path)), None)


def _views(
    file: Path, settings: _ImageSettings, cache: _PixelCache, listed: Sequence[ListedImage]
) -> list[TrainingImage]:
    """Builds the training images of ``listed``, in the order of their paths, downscaled as the settings say.

    Args:
        file: File that lists the images, for messages.
        settings: Settings of all images.
        cache: Cache for the decoded pixels.
        listed: The images; each is checked against its camera and mask.
    """
    for entry in listed:
        _check(file, entry)
    ordered = sorted(listed, key=lambda entry: entry.image)
    cameras = unique_names([entry.camera for entry in ordered])
    curvilinear = sum(is_curvilinear(camera) for camera in cameras)
    if curvilinear and settings.straighten:
        _log.warning("%s: %d images of distorted or fisheye lenses are resampled to pinholes", file, curvilinear)
    views: list[TrainingImage] = []
    for camera, entry in zip(cameras, ordered, strict=True):
        lens = _scaled(camera, settings.scale)
        source = ImageSource(lens, entry.image, entry.mask, straightens=settings.straighten)
        view_camera = pinhole_of(lens) if settings.straighten else lens
        views.append(TrainingImage(camera.name, view_camera, entry.image, settings.background, source, cache))
    return views


def _check(file: Path, entry: ListedImage) -> None:
    """Raises `FormatError` if an image does not match its camera or mask, or is damaged."""
    camera, size = entry.camera, image_size(entry.image)
    if camera.model is CameraModel.ORTHOGRAPHIC:
        raise FormatError(file, f"{camera.name} is of an orthographic camera, expected a pinhole or a fisheye")
    if size != (camera.width, camera.height):
        raise FormatError(
            entry.image,
            f"has {size[0]} x {size[1]} pixels, but its camera in {file} has {camera.width} x {camera.height}: "
            "expected the images that the cameras were computed from (scale downscales them)",
        )
    check_undamaged(entry.image)
    if entry.mask is None:
        return
    if (mask_size := image_size(entry.mask)) != size:
        raise FormatError(
            entry.mask,
            f"has {mask_size[0]} x {mask_size[1]} pixels, expected the {size[0]} x {size[1]} of {entry.image}",
        )
    _read_mask(entry.mask)


def _scaled(camera: Camera, scale: float) -> Camera:
    """Returns the camera with its image size multiplied by ``scale`` and rounded to whole pixels."""
    return camera.scaled(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))


Plane = npt.NDArray[np.uint8]

_COVERAGE_MIN = 1e-3
"""Fraction of a downscaled pixel's area that must be unmasked for the pixel to count; less is rounding error."""


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """A decoded image, 8 bits per value, downscaled and undistorted."""

    color: Plane
    """Display-referred sRGB, premultiplied by alpha, shape (H, W, 3)."""
    alpha: Plane | None
    """Alpha, shape (H, W); None if the image is opaque."""
    mask: Plane | None
    """Training weight of each pixel, shape (H, W); None if all weights are 1."""

    @property
    def size(self) -> int:
        """Memory of colour, alpha and mask together, bytes."""
        return sum(plane.nbytes for plane in (self.color, self.alpha, self.mask) if plane is not None)


@dataclass(slots=True, eq=False)
class _PixelCache:
    """LRU cache of decoded images with a limit in bytes. Safe to use from several threads."""

    limit: int
    """Largest total size, bytes."""
    held: int = field(default=0, init=False)
    """Current total size, bytes."""
    _entries: OrderedDict[Path, Pixels] = field(default_factory=OrderedDict[Path, Pixels], init=False)
    _lock: Lock = field(default_factory=Lock, init=False)

    def get(self, key: Path, decode: Callable[[], Pixels]) -> Pixels:
        """Returns the cached image of ``key``; if there is none, decodes the image by ``decode`` and caches it."""
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


def is_curvilinear(camera: Camera) -> bool:
    """Returns whether the lens of a camera bends straight lines: it is a fisheye, or has distortion."""
    return camera.is_distorted or camera.model is CameraModel.FISHEYE


def pinhole_of(camera: Camera) -> Camera:
    """Returns a pinhole without distortion that has the camera's pose, focal lengths, principal point and size."""
    return replace(camera, model=CameraModel.PINHOLE, distortion=(0.0,) * 6)


def lens_points(camera: Camera) -> tuple[Doubles, Flags]:
    """Maps each pixel of the camera's undistorted pinhole to a position in the original image.

    Args:
        camera: A pinhole or fisheye camera with a lens.

    Returns:
        Positions in the original image (column, row), shape (H, W, 2), and whether each position lies inside of the
        image, shape (H, W).
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    center, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    directions = (np.stack([x, y], axis=-1) - center) / focal
    if camera.model is CameraModel.FISHEYE:
        tangent = np.linalg.norm(directions, axis=-1, keepdims=True)
        directions = directions * np.divide(np.arctan(tangent), tangent, out=np.ones_like(tangent), where=tangent > 0.0)
    reached = np.linalg.norm(directions, axis=-1) <= distortion_reach(camera.distortion)
    points = distort(np.where(reached[..., None], directions, 0.0), camera.distortion) * focal + center
    inside = ((points >= 0.0) & (points <= (camera.width, camera.height))).all(axis=-1)
    return points, reached & inside


def _straightened(plane: Plane, points: Doubles, covered: Flags) -> Plane:
    """Resamples a plane of the original image to the undistorted pinhole.

    Args:
        plane: Plane of the original image, shape (H, W, channels).
        points: Positions in the original image, from `lens_points`.
        covered: Whether each position is inside of the image, from `lens_points`; other pixels become 0.

    Returns:
        Resampled plane, shape (H, W, channels).
    """
    resampled = cubic_samples(plane.astype(np.float32), np.where(covered[..., None], points, 0.5))
    return np.where(covered[..., None], resampled + 0.5, 0.0).astype(np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class ImageSource:
    """Files and lens of a training image, from which `decode` makes the pixels."""

    camera: Camera
    """Camera with its original lens, at the scaled size."""
    image: Path
    mask: Path | None = None
    straightens: bool = True
    """Whether to resample a distorted or fisheye image to a pinhole."""


def decode(source: ImageSource) -> Pixels:
    """Decodes, downscales and undistorts an image.

    Images are downscaled by area means of display-referred values, the space in which captures blend.

    Raises:
        FormatError: A file cannot be read, or the image is transparent everywhere.
    """
    texels = read_texture(source.image)
    planes = {"color": texels[..., :3]}
    if texels.shape[2] == 4:
        planes["alpha"] = texels[..., 3:]
        if not planes["alpha"].any():
            raise FormatError(source.image, "is transparent everywhere: there is nothing to train with")
        planes["color"] = (planes["color"] * (planes["alpha"] / np.float32(255.0)) + 0.5).astype(np.uint8)
    if source.mask is not None:
        planes["mask"] = _read_mask(source.mask)
    lens = source.camera
    smaller = {name: _area_reduced(plane, lens.width, lens.height) for name, plane in planes.items()}
    planes = (
        _masked_means(planes, smaller)
        if "mask" in planes and planes["color"].shape != smaller["color"].shape
        else smaller
    )
    if is_curvilinear(lens) and not source.straightens:
        has_ray = lens.ray_directions().any(axis=2, keepdims=True)
        if not has_ray.all():
            planes["mask"] = np.where(has_ray, planes.get("mask", 255), 0).astype(np.uint8)
    elif is_curvilinear(lens):
        points, covered = lens_points(lens)
        if not covered.all():
            planes.setdefault("mask", np.full((lens.height, lens.width, 1), 255, np.uint8))
        planes = {name: _straightened(plane, points, covered) for name, plane in planes.items()}
    alpha, mask = (planes[name][..., 0] if name in planes else None for name in ("alpha", "mask"))
    return Pixels(planes["color"], alpha, mask)


def _read_mask(path: Path) -> Plane:
    """Reads a mask, shape (H, W, 1): 0 where the mask is black or transparent, 255 where the image is used.

    Pixels of a JPEG count as black below half brightness, because compression makes black inexact beside white.
    """
    texels = read_texture(path)
    counts = texels[..., 3:] if texels.shape[2] == 4 else texels.max(axis=2, keepdims=True)
    counts = counts > (127 if path.suffix.lower() in (".jpg", ".jpeg") else 0)
    if not counts.any():
        raise FormatError(
            path, "is black everywhere, so no pixel of its image would be used: expected white where pixels are used"
        )
    return 255 * counts.astype(np.uint8)


def _masked_means(planes: dict[str, Plane], smaller: dict[str, Plane]) -> dict[str, Plane]:
    """Downscales planes by area means over unmasked pixels only, so that masked pixels do not bleed into others.

    Args:
        planes: Planes at the size of the file, among them the mask.
        smaller: The same planes downscaled without regard to the mask. Their values are used where all pixels are
            masked.
    """
    height, width = smaller["mask"].shape[:2]
    counts = planes["mask"] > 0
    coverage = area_mean(counts, width, height)
    made = dict(smaller)
    for name in smaller.keys() - {"mask"}:
        mean = area_mean(planes[name] * counts, width, height) / np.maximum(coverage, _COVERAGE_MIN)
        made[name] = np.where(coverage > _COVERAGE_MIN, mean + 0.5, smaller[name]).astype(np.uint8)
    return made


def _area_reduced(plane: Plane, width: int, height: int) -> Plane:
    """Downscales a plane by area means. Whole factors use Pillow's ``reduce``, which gives the same result faster."""
    from PIL import Image

    rows, columns, channels = plane.shape
    if columns % width or rows % height:
        return (area_mean(plane, width, height) + 0.5).astype(np.uint8)
    image = Image.fromarray(plane[..., 0] if channels == 1 else plane)
    return np.asarray(image.reduce((columns // width, rows // height))).reshape(height, width, channels)
