"""Loads folders of training images with poses: what they hold, which are held out, and the extent of the scene.

Pixels are decoded when they are needed: made smaller, straightened to a pinhole, and cached in bounded memory.
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
)
from lumisplat.math.arrays import Doubles, Flags, FloatArray
from lumisplat.math.distortion import distort, distortion_reach
from lumisplat.math.resampling import area_mean, cubic_samples
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.local_frame import camera_extent

IMAGE_CACHE_BYTES = 1 << 30
"""Memory for photographs that have been decoded, by default: 520 of 960 x 720, and more would not fit beside a trainer
on small machines."""

HOLD_OUT = 8
"""One photograph of so many is not trained with, as Mip-NeRF 360 and those after it do."""

SAME_POSITION = 1e-3
"""Distance of two cameras, as a share of the extent of all, up to which they stand in one place: between them, hardly
anything moves in the picture."""

SAME_ROTATION = 1e-3
"""Angle between two cameras, radians, up to which they are turned alike: a pixel or two."""

_log = logging.getLogger("lumisplat")

_EXPECTED = "transforms.json (nerfstudio), transforms_train.json (Blender) or a sparse model of COLMAP"


def camera_target(cameras: Sequence[Camera]) -> Doubles:
    """The point nearest to the optical axes in the sense of least squares, shape (3,).

    Of several, as where all axes are parallel, it is the one nearest to the mean of the positions.
    """
    eyes = np.stack([camera.eye for camera in cameras])
    axes = np.stack([camera.camera_from_world[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = eyes.mean(axis=0)
    inverse = np.asarray(np.linalg.pinv(across.sum(axis=0), rcond=1e-9), dtype=np.float64)
    return middle + inverse @ np.einsum("nij,nj->i", across, eyes - middle)


def count_positions(cameras: Sequence[Camera]) -> int:
    """From how many places cameras see, those that are as good as the same counted once."""
    return len(_distinct(cameras, with_rotation=False))


def count_poses(cameras: Sequence[Camera]) -> int:
    """How many poses cameras have, those that are as good as the same counted once."""
    return len(_distinct(cameras, with_rotation=True))


def _distinct(cameras: Sequence[Camera], *, with_rotation: bool) -> list[int]:
    """Numbers of cameras that are in another place than all of these before them, or if ``turned`` otherwise turned."""
    eyes = np.stack([camera.eye for camera in cameras])
    rotations = np.stack([camera.camera_from_world[:3, :3] for camera in cameras])
    near = SAME_POSITION * max(camera_extent(cameras), COINCIDENT_EXTENT / SAME_POSITION * float(np.abs(eyes).max()))
    found: list[int] = []
    for number, (eye, rotation) in enumerate(zip(eyes, rotations, strict=True)):
        same = np.linalg.norm(eyes[found] - eye, axis=1) <= near
        if with_rotation:
            # The Frobenius norm of the difference of two rotations is 2 sqrt(2) times the sine of half their angle.
            same &= np.linalg.norm(rotations[found] - rotation, axis=(1, 2)) <= np.sqrt(2.0) * SAME_ROTATION
        if not same.any():
            found.append(number)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class TrainingImage:
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
    _source: ImageSource = field(repr=False)
    _cache: _PixelCache = field(repr=False)

    def pixels(self) -> FloatArray:
        """Display-referred sRGB, 0..1, over the background, shape (H, W, 3)."""
        decoded = self._decoded()
        color = _unit_range(decoded.color)
        if decoded.alpha is None or self.background is None:
            return color
        behind = (1.0 - _unit_range(decoded.alpha))[..., None] * np.array(self.background)
        return (color + behind).astype(np.float32)

    def alpha(self) -> FloatArray | None:
        """How much of each pixel shows something, 0..1, shape (H, W); None: the image has no transparency."""
        alpha = self._decoded().alpha
        return None if alpha is None else _unit_range(alpha)

    def mask(self) -> FloatArray | None:
        """How much of each pixel counts, 0..1, shape (H, W); None: all of it.

        It is 0 where the mask of the photograph is black, and where its lens does not show what the pinhole sees; of
        lenses that stay as they are, where there is no ray.
        """
        mask = self._decoded().mask
        return None if mask is None else _unit_range(mask)

    @property
    def fingerprint(self) -> str:
        """What tells it from others without decoding it: its camera and lens, and the bytes of its image and mask."""
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
    """The arguments of `load_training_images` that read the same images again."""

    folder: Path
    """Its absolute path."""
    scale: float
    hold_out: int
    background: Color | None
    straighten: bool
    allow_outside: bool


@dataclass(frozen=True, slots=True, eq=False)
class TrainingImages:
    """Images of a scene with poses, as `load_training_images` reads them."""

    training: tuple[TrainingImage, ...]
    """Those to learn from, at least one, ordered by name."""
    held_out: tuple[TrainingImage, ...]
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
        digest = hashlib.sha256("".join(image.fingerprint for image in self.training).encode())
        for array in (self.points, self.point_colors):
            digest.update(b"none" if array is None else array.tobytes())
        return digest.hexdigest()


def _camera_bytes(camera: Camera) -> bytes:
    """All that a camera is."""
    values = (getattr(camera, one.name) for one in fields(camera))
    return b" ".join(value.tobytes() if isinstance(value, np.ndarray) else str(value).encode() for value in values)


def _unit_range(plane: Plane) -> FloatArray:
    return np.divide(plane, 255.0, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class _FolderContents:
    """What a folder holds."""

    file: Path
    """The one that lists the photographs."""
    images: list[ListedImage]
    held_out: list[ListedImage] | None = None
    """Photographs that have a file of their own; None: there is none."""
    points: tuple[Doubles, FloatArray] | None = None


@dataclass(frozen=True, slots=True)
class _ImageSettings:
    """How photographs are to be."""

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
    """Finds the photographs of a folder and their poses; pixels are decoded when they are asked for.

    The first that is there counts: ``transforms_train.json`` (Blender, NeRF-synthetic; what is held out are the
    photographs of ``transforms_test.json``, else of ``transforms_val.json``), ``transforms.json`` (nerfstudio,
    instant-ngp), or a sparse model of COLMAP in ``sparse`` (of several there, the one with most photographs), or in the
    folder itself, with its photographs in ``images``. The ``train_filenames`` and ``test_filenames`` (else
    ``val_filenames``) of a ``transforms.json``, where it has these, say what is held out, and its ``ply_file_path`` has
    points. Where the file names a mask, or ``masks`` holds one that is named after a photograph, only what is not black
    there counts. Log lines count what is left out: photographs that are missing or have no pose, models, and masks.

    Lenses that distort, and fisheyes, are straightened, unless they are to stay: the cameras are pinholes of the same
    focal lengths and size, whose pixels are resampled by Catmull-Rom's cubics; a log line says so. What the pinhole
    sees beyond the picture of the lens is masked out, what it does not see is left out. Smaller photographs are means
    over areas, of display-referred values, for captures blend in these; they are made smaller before they are
    straightened.

    Args:
        folder: The folder.
        scale: Size of the photographs, as a share of that of the files, above 0, at most 1.
        hold_out: The first of the photographs in the order of their names, and each so many after it, are held out, at
            least 2; 0: none is, also of a test file.
        background: Behind transparent pixels, as of `RenderConfig`: three numbers in 0..1, a name or ``"#rrggbb"``;
            None or ``"transparent"``: they stay premultiplied by alpha.
        straighten: Whether lenses that distort, and fisheyes, become pinholes; else their cameras are what they are,
            which `Pipeline.TRACE` and `Projection.UNSCENTED` draw, and pixels that they have no ray for are masked out.
        cache_bytes: Memory for decoded photographs, 8 bits a value, at least 0; what does not fit is decoded again.
        allow_outside: Whether the file may name photographs outside of its own folder, as files that you trust do.

    Raises:
        ConfigError: A setting is out of its range.
        FormatError: The folder holds none of these, or fewer than two photographs; a file is damaged; a pose is not
            rigid or not finite; a photograph has another size than its camera says, or cannot be read; a mask is black
            everywhere, or has another size; a camera is orthographic. Names the file.
        MissingFileError: There is no such folder.
    """
    if not is_number(scale) or not 0.0 < scale <= 1.0:
        raise ConfigError(f"scale is {quoted(scale)}, expected more than 0 and at most 1")
    check_whole("hold_out", hold_out, 0, 1 << 31)
    check_flag("straighten", straighten)
    check_range("cache_bytes", cache_bytes, 0, 1 << 62)
    if hold_out == 1:
        raise ConfigError("hold_out is 1, which leaves no photograph to learn from: expected 2 or more, or 0 for none")
    color = display_color("background", background)
    with references_outside(allow_outside):
        found = _find(Path(folder), hold_out > 0)
    if len(found.images) < 2:
        raise FormatError(
            found.file, "has a single photograph, expected two or more: depth shows between photographs only"
        )
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
    """What a folder holds, its files read."""
    if not folder.exists():
        raise MissingFileError(folder, "no such folder")
    if not folder.is_dir():
        raise FormatError(folder, f"is a file, expected the folder that holds {_EXPECTED}")
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
            f"has no photographs with poses: expected {_EXPECTED} in sparse/0; for photographs without poses, "
            "find_poses (--poses colmap) makes one",
        )
    listed = colmap_images(model, folder)
    report_without_pose(model, folder, listed)
    return _FolderContents(model, listed, points=read_colmap_points(model))


def _held_out(folder: Path) -> list[ListedImage] | None:
    """Returns the images of ``transforms_test.json``, else of ``transforms_val.json``; None: there are none.

    Some exporters write a test file and leave its images to be rendered: a log line says what is held out then.
    """
    files = [path for name in ("test", "val") if (path := folder / f"transforms_{name}.json").is_file()]
    lists = [transforms_images(path, may_lack_all=True) for path in files]
    found = next((number for number, listed in enumerate(lists) if listed), None)
    lacking = files[:found]
    if lacking:
        instead = "some of those to learn from" if found is None else f"those of {files[found].name}"
        _log.warning("%s: none of its images is there: %s are held out instead", lacking[0], instead)
    return None if found is None else lists[found]


def find_model(folder: Path) -> Path | None:
    """Returns the folder of a sparse model; of several in ``sparse``, the one with most images, as a line says."""
    sparse = folder / "sparse"
    inside = [path for path in sparse.iterdir() if path.is_dir()] if sparse.is_dir() else []
    models = sorted((path for path in inside if is_colmap(path)), key=lambda path: (len(path.name), path.name))
    if len(models) > 1:
        counts = [count_colmap_images(path) for path in models]
        best = counts.index(max(counts))
        others = [f"{path.name} with {count}" for path, count in zip(models, counts, strict=True)]
        taken = models[best]
        del others[best]
        _log.warning(
            "%s has %d models: %s with %d images is taken, and %s left out, whose poses are in frames of their own",
            sparse,
            len(models),
            taken.name,
            counts[best],
            f"{some_names(others)} {'is' if len(others) == 1 else 'are'}",
        )
        return taken
    return next((path for path in (*models, sparse, folder) if is_colmap(path)), None)


def _views(
    file: Path, settings: _ImageSettings, cache: _PixelCache, listed: Sequence[ListedImage]
) -> list[TrainingImage]:
    """The photographs of a file, in the order of their names, smaller by a factor."""
    for entry in listed:
        _check(file, entry)
    ordered = sorted(listed, key=lambda entry: entry.image)
    cameras = unique_names([entry.camera for entry in ordered])
    curvilinear = sum(is_curvilinear(camera) for camera in cameras)
    if curvilinear and settings.straighten:
        _log.warning(
            "%s: %d photographs of distorting lenses are straightened: resampled as of pinholes", file, curvilinear
        )
    views: list[TrainingImage] = []
    for camera, entry in zip(cameras, ordered, strict=True):
        lens = _scaled(camera, settings.scale)
        source = ImageSource(lens, entry.image, entry.mask, straightens=settings.straighten)
        shown = pinhole_of(lens) if settings.straighten else lens
        views.append(TrainingImage(camera.name, shown, entry.image, settings.background, source, cache))
    return views


def _check(file: Path, entry: ListedImage) -> None:
    """Refuses a photograph that is not what its camera says."""
    camera, size = entry.camera, image_size(entry.image)
    if camera.model is CameraModel.ORTHOGRAPHIC:
        raise FormatError(file, f"{camera.name} is of an orthographic camera, expected a pinhole or a fisheye")
    if size != (camera.width, camera.height):
        raise FormatError(
            entry.image,
            f"has {size[0]} x {size[1]} pixels, its camera in {file} {camera.width} x {camera.height}: expected the "
            "photographs that the cameras were made for (scale makes them smaller)",
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
    """The camera at a share of its size, in whole pixels."""
    return camera.scaled(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))


Plane = npt.NDArray[np.uint8]

_COVERAGE_MIN = 1e-3
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
class _PixelCache:
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


def is_curvilinear(camera: Camera) -> bool:
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
    directions = (np.stack([x, y], axis=-1) - center) / focal
    if camera.model is CameraModel.FISHEYE:
        tangent = np.linalg.norm(directions, axis=-1, keepdims=True)
        directions = directions * np.divide(np.arctan(tangent), tangent, out=np.ones_like(tangent), where=tangent > 0.0)
    reached = np.linalg.norm(directions, axis=-1) <= distortion_reach(camera.distortion)
    points = distort(np.where(reached[..., None], directions, 0.0), camera.distortion) * focal + center
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
    resampled = cubic_samples(plane.astype(np.float32), np.where(covered[..., None], points, 0.5))
    return np.where(covered[..., None], resampled + 0.5, 0.0).astype(np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class ImageSource:
    """What a photograph is made of."""

    camera: Camera
    """With its lens, at the size that is wanted."""
    image: Path
    mask: Path | None = None
    straightens: bool = True
    """Whether a lens that distorts, or a fisheye, is made a pinhole."""


def decode(source: ImageSource) -> Pixels:
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
    """Reads a mask: 255 where the image counts, which is wherever it is not black, or transparent; shape (H, W, 1).

    Of a JPEG, what is darker than half is black: its black is not exact beside white.
    """
    texels = read_texture(path)
    counts = texels[..., 3:] if texels.shape[2] == 4 else texels.max(axis=2, keepdims=True)
    counts = counts > (127 if path.suffix.lower() in (".jpg", ".jpeg") else 0)
    if not counts.any():
        raise FormatError(
            path, "is black everywhere: no pixel of its photograph would count, expected white where it does"
        )
    return 255 * counts.astype(np.uint8)


def _masked_means(planes: dict[str, Plane], smaller: dict[str, Plane]) -> dict[str, Plane]:
    """Smaller planes that are means over what counts of their areas: what does not is not mixed in.

    Args:
        planes: Of the size of the file.
        smaller: Means over all of the areas, which stay where nothing counts, and those of the mask.
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
    """The mean over the area of each pixel; by whole factors as Pillow reduces, which is the same and fast."""
    from PIL import Image

    rows, columns, channels = plane.shape
    if columns % width or rows % height:
        return (area_mean(plane, width, height) + 0.5).astype(np.uint8)
    image = Image.fromarray(plane[..., 0] if channels == 1 else plane)
    return np.asarray(image.reduce((columns // width, rows // height))).reshape(height, width, channels)
