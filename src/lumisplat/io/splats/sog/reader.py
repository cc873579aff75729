"""PlayCanvas SOG (spatially ordered Gaussians): lossless WebP images and a meta.json, as a folder or zipped.

Pixel i of each image, counted row by row, belongs to Gaussian i. Version 2 stores scales and SH as indices into
codebooks of 256 values; version 1, which has no version number, maps bytes linearly to a range. Axes are those of the
PLY that it was made from.
Specification: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/
"""

from __future__ import annotations

import io
import json
import lzma
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from lumisplat.errors import FormatError
from lumisplat.io.files.limits import check_expansion, check_gaussian_count
from lumisplat.io.files.source import PathLike, parsing, read_bytes
from lumisplat.io.splats.columns import Floats, SplatColumns
from lumisplat.io.splats.orientation import orientation_of
from lumisplat.io.splats.smallest_three import unpack_smallest_three

Bytes = npt.NDArray[np.uint8]
Meta = dict[str, Any]

OURS = "lumisplat"
"""Key of what only we read: up and first view."""

PALETTE_COLUMNS = 64
"""SH palette entries in a row of the centroids image; an entry has one pixel per coefficient."""

QUATERNION_TAG = 252
"""The alpha of a rotation pixel minus this is the index of its largest component."""

DECODER_THREADS = 4


def read_sog(path: PathLike) -> SplatColumns:
    """Reads a SOG capture.

    Args:
        path: A bundled ``.sog``, a folder that holds ``meta.json``, or that ``meta.json``.

    Raises:
        FormatError: A file is missing or damaged, the version is unknown, or images are too small for the count.
    """
    with _open_source(path) as read_file, parsing(path, "a SOG capture"):
        meta = json.loads(read_file("meta.json"))
        version = meta.get("version", 1)
        if version not in (1, 2):
            raise FormatError(path, f"is SOG version {version}, expected 1 or 2")
        count = int(meta["count"] if version == 2 else meta["means"]["shape"][0])
        fields = [field for field in ("means", "quats", "scales", "sh0", "shN") if meta.get(field)]
        names = [_plain_name(path, name) for field in fields for name in meta[field]["files"]]
        stored = {name: read_file(name) for name in names}
        check_gaussian_count(path, count, 1, sum(map(len, stored.values())))
        images = _decode_images(path, stored)
        return _columns(path, meta, images, count, logits=version == 1)


def read_meta(path: PathLike) -> Meta:
    """Reads the ``meta.json`` of a SOG capture alone.

    Raises:
        FormatError: It is missing or damaged.
    """
    with _open_source(path) as read_file, parsing(path, "a SOG capture"):
        return json.loads(read_file("meta.json"))


@contextmanager
def _open_source(path: PathLike) -> Generator[Callable[[str], bytes]]:
    """Yields a function that reads a file of the capture by its name."""
    if Path(path).is_dir() or Path(path).name == "meta.json":
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        yield lambda name: read_bytes(folder / name, wanted_by=path)
        return
    archive = io.BytesIO(read_bytes(path))
    try:
        with zipfile.ZipFile(archive) as bundle:
            yield lambda name: _read_member(path, bundle, name)
    except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, RuntimeError, OSError, UnicodeError, struct.error) as error:
        raise FormatError(path, f"damaged or truncated, expected a zip archive: {error}") from None


def _read_member(path: PathLike, bundle: zipfile.ZipFile, name: str) -> bytes:
    try:
        info = bundle.getinfo(name)
    except KeyError:
        raise FormatError(path, f"the bundle has no {name}") from None
    check_expansion(path, name, info.file_size, info.compress_size)
    return bundle.read(info)


def _plain_name(path: PathLike, name: str) -> str:
    """The name of a file, refused if it has a folder."""
    if Path(name).name != name:
        raise FormatError(path, f"refers to {name!r}, expected the name of a file beside its meta.json")
    return name


def _decode_images(path: PathLike, stored: dict[str, bytes]) -> dict[str, Bytes]:
    """RGBA pixels of each image, shape (height, width, 4).

    Raises:
        FormatError: An image is damaged, or it, or all of them together, are larger than files of their size can be.
    """

    def decoded(name: str) -> Bytes:
        with _decoding(path, name):
            return np.asarray(images[name].convert("RGBA"))

    with warnings.catch_warnings(), ThreadPoolExecutor(DECODER_THREADS) as threads:
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        images: dict[str, Image.Image] = {}
        total = 0
        for name, data in stored.items():
            with _decoding(path, name):
                image = images[name] = Image.open(io.BytesIO(data), formats=("WEBP", "PNG"))
            size = 4 * image.width * image.height
            check_expansion(path, name, size, len(data))
            total += size
        check_expansion(path, "all its images", total, sum(map(len, stored.values())))
        return dict(zip(stored, threads.map(decoded, stored), strict=True))


@contextmanager
def _decoding(path: PathLike, name: str) -> Generator[None]:
    """What an image raises inside of the block becomes a `FormatError` that names it."""
    try:
        yield
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise FormatError(path, f"{name} is too large to decode: {error}") from None
    except (OSError, SyntaxError, EOFError) as error:
        raise FormatError(path, f"{name} is damaged, or no image: expected WebP") from error


def _columns(path: PathLike, meta: Meta, images: dict[str, Bytes], count: int, logits: bool) -> SplatColumns:
    def rows(name: str) -> Bytes:
        pixels = images[name].reshape(-1, 4)
        if len(pixels) < count:
            raise FormatError(path, f"{name} has {len(pixels):,} pixels, fewer than its {count:,} Gaussians")
        return pixels[:count]

    low, high = (rows(name)[:, :3] for name in meta["means"]["files"])
    least, most = (np.asarray(meta["means"][name], np.float64) for name in ("mins", "maxs"))
    # In double precision: far from the origin, the exponential enlarges what float32 rounds.
    log_means = least + (low | high.astype(np.uint16) << 8) / 65535.0 * (most - least)
    sh0 = rows(meta["sh0"]["files"][0])
    dc = _values(sh0 if logits else sh0[:, :3], meta["sh0"])
    sh = dc[:, None, :3]
    if meta.get("shN"):
        sh = np.concatenate([sh, _palette_sh(path, meta["shN"], images, rows)], axis=1)
    generator = meta.get("asset", {}).get("generator")
    with np.errstate(over="ignore"):  # damaged ranges are refused later, as infinite values
        means = (np.sign(log_means) * np.expm1(np.abs(log_means))).astype(np.float32)
    return SplatColumns(
        means=means,
        rotations_wxyz=_rotations(rows(meta["quats"]["files"][0])),
        log_scales=_values(rows(meta["scales"]["files"][0])[:, :3], meta["scales"]),
        opacities=dc[:, 3] if logits else sh0[:, 3] / np.float32(255.0),
        sh=sh,
        opacities_are_logits=logits,
        antialiased=meta.get("antialias") is True or meta.get("model") == "antialiased",
        comments=(f"Generated by {generator}",) if generator else (),
        orientation=orientation_of(path, meta.get(OURS)),
    )


def _values(stored: Bytes, field: Meta) -> Floats:
    """Converts bytes to numbers, by the codebook of a field or, in version 1, by its range."""
    if "codebook" not in field:
        return _scale_to_range(stored / np.float32(255.0), field)
    codebook = np.array(field["codebook"], dtype=np.float32)
    if field["codebook"][0] is None:  # some writers lost the first entry; PlayCanvas's engine extrapolates it too
        codebook[0] = codebook[1] + (codebook[1] - codebook[-1]) / 255.0
    return codebook[stored]


def _scale_to_range(unit: Floats, field: Meta) -> Floats:
    """Values of 0..1 scaled to the range of a field."""
    low, high = (np.asarray(field[name], dtype=np.float32) for name in ("mins", "maxs"))
    return low + unit * (high - low)


def _rotations(pixels: Bytes) -> Floats:
    """Quaternions wxyz, shape (N, 4), from their smallest three components, one byte each.

    Where the tag is invalid the quaternion is zero, which is refused later.
    """
    smallest = (pixels[:, :3] / np.float32(255.0) - np.float32(0.5)) * np.float32(np.sqrt(2.0))
    largest = pixels[:, 3].astype(np.int64) - QUATERNION_TAG
    return unpack_smallest_three(largest, smallest) * (largest >= 0)[:, None]


def _palette_sh(path: PathLike, field: Meta, images: dict[str, Bytes], rows: Callable[[str], Bytes]) -> Floats:
    """SH coefficients from degree 1, looked up in a palette of at most 65,536 entries, shape (N, K - 1, 3)."""
    # Writers list the centroids first, the specification lists the labels first: only the names are reliable.
    centroids_name, labels_name = sorted(field["files"][:2], key=lambda name: "label" in name)
    centroids = images[centroids_name][..., :3]
    coefficients, remainder = divmod(centroids.shape[1], PALETTE_COLUMNS)
    if remainder or coefficients not in (3, 8, 15):
        raise FormatError(path, f"{centroids_name} is {centroids.shape[1]} pixels wide, expected 192, 512 or 960")
    palette = _values(centroids.reshape(-1, coefficients, 3), field)
    labels = rows(labels_name)
    return palette[labels[:, 0] | labels[:, 1].astype(np.uint16) << 8]
