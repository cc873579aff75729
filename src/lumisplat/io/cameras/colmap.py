"""Reads COLMAP sparse models: ``cameras``, ``images`` and ``points3D``, .bin or .txt, with OpenCV axes.

Tracks of points are skipped.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.cameras.common import name_from_image
from lumisplat.io.files.source import PathLike, is_number_word, parsing, read_bytes, read_text
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.transforms import rotation_matrix
from lumisplat.scene.camera import Camera, CameraModel

_FILES = ("cameras.bin", "cameras.txt", "images.bin", "images.txt")
"""Files of a COLMAP sparse model; a caller may pass the path of any of them instead of the model's folder."""

_NAMES: tuple[str, ...] = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
    *("SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR"),
)
"""Names of COLMAP's camera models; the index in the list is the number that cameras.bin stores."""

_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
}
"""Names of the parameters, in file order, of the COLMAP camera models that `Camera` supports."""

_IMAGE = struct.Struct("<i7di")
"""Layout of an image in images.bin: image number, camera_from_world as rotation wxyz and translation, camera number."""
_CAMERA = struct.Struct("<iiQQ")
"""Layout of a camera in cameras.bin before its parameters: camera number, model number, width, height."""
_POINT_BYTES = 24

_Lens = tuple[str, int, int, list[float]]
"""Camera model name, width, height and parameters of one camera in the cameras file of a sparse model."""

_POINT = np.dtype([("number", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
"""Layout of a point in points3D.bin, without the track that follows the point."""
_TRACK_BYTES = 8
_TRACK_AT = _POINT.itemsize - 8


def is_colmap(path: Path) -> bool:
    """Returns whether a path is a file of a sparse model, or a folder that holds one."""
    return path.name in _FILES or (path.is_dir() and any((path / name).is_file() for name in _FILES))


def read_colmap(path: PathLike) -> list[Camera]:
    """Reads the cameras of a sparse model, in the order of its images. The model lists only images with a pose.

    Args:
        path: Folder of the model, or one of `_FILES`.

    Raises:
        FormatError: A file is missing or damaged, or has a camera model that is not supported.
    """
    return [camera for camera, _ in read_colmap_images(path)]


def read_colmap_images(path: PathLike) -> list[tuple[Camera, str]]:
    """Reads the cameras as `read_colmap` does, each with the path of its image relative to the image folder."""
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    with parsing(path, "a COLMAP sparse model"):
        lenses = dict(_read_cameras(_file(folder, "cameras")))
        images = _file(folder, "images")
        found = [(_camera(images, lenses, entry), entry[3]) for entry in _read_images(images)]
        if not found:
            raise FormatError(images, "has no images with a pose")
        return found


def count_colmap_images(folder: Path) -> int:
    """Returns the number of images with a pose in a model; 0 if the images file is damaged or missing."""
    try:
        path = _file(folder, "images")
        with parsing(path, "a COLMAP sparse model"):
            if path.suffix == ".txt":
                return sum(1 for _ in _read_images(path))
            return int(struct.unpack_from("<Q", read_bytes(path))[0])
    except FormatError:
        return 0


def _file(folder: Path, stem: str) -> Path:
    """Returns the file of a model by its stem, such as ``images``; .bin takes precedence over .txt, as in COLMAP.

    Raises:
        FormatError: The folder has neither.
    """
    for suffix in (".bin", ".txt"):
        if (folder / (stem + suffix)).is_file():
            return folder / (stem + suffix)
    raise FormatError(
        folder, f"has no {stem}.bin or {stem}.txt, expected the folder of a sparse model, such as sparse/0"
    )


def _camera(path: Path, lenses: dict[int, _Lens], entry: tuple[int, list[float], int, str]) -> Camera:
    """Creates the camera of an image.

    Args:
        path: File to name in errors.
        lenses: Lenses by camera number.
        entry: An image from `_read_images`.
    """
    number, pose, lens_number, name = entry
    where = f"image {number} ({name})"
    if lens_number not in lenses:
        raise FormatError(path, f"{where} refers to camera {lens_number}, which is not in the model")
    model, width, height, values = lenses[lens_number]
    if model not in _PARAMETERS:
        raise FormatError(
            path,
            f"camera {lens_number} is a {model}, expected {', '.join(_PARAMETERS)}: undistort the images "
            "(colmap image_undistorter) and use their new model",
        )
    names = _PARAMETERS[model].split()
    if len(names) != len(values):
        raise FormatError(path, f"camera {lens_number} has {len(values)} parameters, expected {' '.join(names)}")
    given = dict(zip(names, values, strict=True))
    camera_from_world = np.eye(4)
    try:
        camera_from_world[:3, :3] = rotation_matrix(pose[:4])
        camera_from_world[:3, 3] = pose[4:]
        k1, k2, k3, k4, p1, p2 = (given.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
        return Camera(
            width=width,
            height=height,
            fx=given.get("fx", given.get("f", 0.0)),
            fy=given.get("fy", given.get("f", 0.0)),
            cx=given["cx"],
            cy=given["cy"],
            camera_from_world=camera_from_world,
            name=name_from_image(name),
            model=CameraModel.FISHEYE if model.endswith("FISHEYE") else CameraModel.PINHOLE,
            distortion=(k1, k2, k3, k4, p1, p2),
        )
    except SceneError as error:
        raise FormatError(path, f"{where}: {error}") from None


def _read_cameras(path: Path) -> Iterator[tuple[int, _Lens]]:
    """Yields camera number and lens of each camera in a cameras file."""
    if path.suffix == ".txt":
        for line in _text_lines(path):
            number, model, width, height, *values = line.split()
            yield int(number), (model, int(width), int(height), [float(value) for value in values])
        return
    data = read_bytes(path)
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        number, model, width, height = map(int, _CAMERA.unpack_from(data, at))
        at += _CAMERA.size
        name = _NAMES[model] if 0 <= model < len(_NAMES) else f"model {model}"
        if name not in _PARAMETERS:
            raise FormatError(path, f"camera {number} is a {name}, expected {', '.join(_PARAMETERS)}")
        values = struct.unpack_from(f"<{len(_PARAMETERS[name].split())}d", data, at)
        at += 8 * len(values)
        yield number, (name, width, height, list(values))


def _read_images(path: Path) -> Iterator[tuple[int, list[float], int, str]]:
    """Yields image number, camera_from_world (rotation wxyz, translation), camera number and name of each image."""
    if path.suffix == ".txt":
        follows = False  # whether 2D points may follow; some programs omit them
        for line in _text_lines(path):
            if follows and not _is_image(line):
                follows = False
                continue
            number, *pose, camera, name = line.split(maxsplit=9)
            yield int(number), [float(value) for value in pose], int(camera), name.strip()
            follows = True
        return
    data = read_bytes(path)
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        number, *pose, camera = _IMAGE.unpack_from(data, at)
        at += _IMAGE.size
        end = data.index(b"\0", at)
        name = data[at:end].decode(errors="surrogateescape")
        if min(name, default=" ") < " ":
            raise FormatError(path, f"image {number} has a name with control characters: damaged")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + _POINT_BYTES * points
        if at > len(data):
            raise FormatError(path, f"truncated in image {number} ({name})")
        yield number, pose, camera, name


def _is_image(line: str) -> bool:
    """Returns whether a line of images.txt describes an image. Other lines list 2D points as triples of numbers."""
    words = line.split(maxsplit=9)
    return len(words) == 10 and (not is_number_word(words[9].split()[0]) or len(line.split()) % 3 != 0)


def _text_lines(path: Path) -> Iterator[str]:
    """Yields the lines of a text file without comments and empty lines."""
    for line in read_text(path, errors="surrogateescape").splitlines():
        if line.strip() and not line.startswith("#"):
            yield line


def read_colmap_points(folder: Path) -> tuple[Doubles, FloatArray] | None:
    """Reads the points of a sparse model.

    Args:
        folder: Folder of the model; .bin takes precedence over .txt, as in COLMAP.

    Returns:
        Positions in world space, shape (N, 3), and display-referred colours, 0..1, shape (N, 3); None if the model has
        no points.

    Raises:
        FormatError: The file is damaged or truncated, or has a position that is not finite.
    """
    path = next((path for name in ("points3D.bin", "points3D.txt") if (path := folder / name).is_file()), None)
    if path is None:
        return None
    with parsing(path, "the points of a COLMAP sparse model"):
        positions, colors = _read_binary(path) if path.suffix == ".bin" else _read_text(path)
        if not len(positions):
            return None
        finite = np.asarray(np.isfinite(positions).all(axis=1))
        if not finite.all():
            first, count = finite.argmin(), np.count_nonzero(~finite)
            raise FormatError(
                path, f"has {count:,} of {finite.size:,} points without a finite position, the first is {first:,}"
            )
        return positions, colors / np.float32(255.0)


def _read_binary(path: Path) -> tuple[Doubles, FloatArray]:
    data = read_bytes(path)
    (count,) = struct.unpack_from("<Q", data)
    length, at, starts = struct.Struct("<Q"), 8, list[int]()
    if count * _POINT.itemsize > len(data):
        raise FormatError(path, f"truncated: its header promises {count:,} points, but it has {len(data):,} bytes")
    for _ in range(count):
        starts.append(at)
        at += _POINT.itemsize + _TRACK_BYTES * length.unpack_from(data, at + _TRACK_AT)[0]
    if at > len(data):
        raise FormatError(path, f"truncated: it ends within the last of {count:,} points")
    rows = np.asarray(starts, np.int64)[:, None] + np.arange(_POINT.itemsize)
    points = np.frombuffer(data, np.uint8)[rows].view(_POINT)[:, 0]
    return points["xyz"].astype(np.float64), points["rgb"].astype(np.float32)


def _read_text(path: Path) -> tuple[Doubles, FloatArray]:
    rows = [line.split(maxsplit=7)[1:7] for line in _text_lines(path)]
    short = next((index for index, row in enumerate(rows) if len(row) < 6), None)
    if short is not None:
        raise FormatError(path, f"point {short:,} has too few values, expected a number, X Y Z, R G B and an error")
    values = np.array(rows, np.float64).reshape(-1, 6)
    if (values[:, 3:] < 0.0).any() or (values[:, 3:] > 255.0).any():
        raise FormatError(path, "has a colour outside of 0..255")
    return values[:, :3], values[:, 3:].astype(np.float32)
