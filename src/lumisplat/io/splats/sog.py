"""Reads and writes PlayCanvas SOG (spatially ordered Gaussians): lossless WebP images and a meta.json.

A capture is a folder or a zip bundle. Pixel i of each image, counted row by row, belongs to Gaussian i. Version 2
stores scales and SH as indices into codebooks of 256 values, fitted for a small squared error (Max 1960, Lloyd 1982).
Version 1, whose meta.json has no version number, maps bytes linearly to a range. Axes are those of the original PLY.
Lumisplat writes version 2, with the Gaussians sorted along a Morton curve, which compresses better.
Specification: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/
"""

from __future__ import annotations

import heapq
import io
import json
import logging
import lzma
import math
import os
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
from lumisplat.io.files.atomic import atomic_write, written_together
from lumisplat.io.files.source import PathLike, check_expansion, check_gaussian_count, parsing, read_bytes
from lumisplat.io.splats.columns import (
    Floats,
    SplatColumns,
    pack_smallest_three,
    unpack_smallest_three,
    warn_losses,
)
from lumisplat.io.splats.orientation import orientation_of, orientation_values
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.neighbours import morton_order

_log = logging.getLogger("lumisplat")

_ENTRIES = 256
"""Number of entries in a codebook, 256: files store the index of an entry as one byte."""

_LLOYD_STEPS = 50

Doubles = npt.NDArray[np.float64]

Bytes = npt.NDArray[np.uint8]
Meta = dict[str, Any]

LUMISPLAT_KEY = "lumisplat"
"""Key under which meta.json holds Lumisplat's own metadata: up direction and first view."""

_PALETTE_COLUMNS = 64
"""Number of SH palette entries side by side in the image of SH centroids; each entry has one pixel per coefficient."""

_QUATERNION_TAG = 252
"""Alpha of a rotation pixel whose largest quaternion component is w; 253, 254 and 255 stand for x, y and z."""

_DECODER_THREADS = 4
Contents = dict[str, bytes]

_PALETTE_ENTRIES_MAX = 2**16
"""Largest number of SH palette entries, because labels have 16 bits."""

_COMPRESSION = 1
"""Effort of Pillow's lossless WebP encoder, 0 to 6; see docs/adr/0065-sog-codebooks-by-k-means.md."""

_IMAGE_SIDE_MAX = 16_380
"""Largest width and height of a written image: the largest multiple of 4 that WebP supports."""

_FILE_TIME = (1980, 1, 1, 0, 0, 0)
"""Timestamp of all files in a .sog bundle, the earliest that zip supports, so that equal captures give equal bytes."""

_THREADS = 4


def fit_codebook(values: Floats) -> npt.NDArray[np.float32]:
    """Fits a codebook of 256 ascending numbers to ``values``. If fewer values are distinct, the last entry repeats.

    The sorted values are split 255 times where a split lowers the squared error most, so that outliers get entries of
    their own. Then Lloyd's algorithm updates the entries and the borders between them in turn.

    Args:
        values: Finite numbers of any shape, at least one.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = _PrefixSums(ordered)
    borders = _split_runs(sums, len(ordered))
    for _ in range(_LLOYD_STEPS):
        entries = sums.means(borders)
        moved = np.searchsorted(ordered, 0.5 * (entries[:-1] + entries[1:]), side="right")
        moved = np.concatenate([[0], moved, [len(ordered)]])
        if np.array_equal(moved, borders) or not (np.diff(moved) > 0).all():
            break
        borders = moved
    entries = sums.means(borders).astype(np.float32)
    return np.append(entries, np.full(_ENTRIES - len(entries), entries[-1]))


def encode(values: Floats, codebook: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Returns, for each number in ``values``, the index of the nearest entry of an ascending codebook."""
    borders = 0.5 * (codebook[:-1].astype(np.float64) + codebook[1:])
    return np.searchsorted(borders, values, side="left").astype(np.uint8)


class _PrefixSums:
    """Prefix sums of sorted numbers: mean of a run of them, and error that splitting it saves, in constant time.

    A run is a range of consecutive indices of the sorted numbers.
    """

    def __init__(self, ordered: Doubles) -> None:
        self._center = ordered.mean()
        centered = ordered - self._center
        self._sum = np.concatenate([[0.0], np.cumsum(centered)])
        self._squares = np.concatenate([[0.0], np.cumsum(centered * centered)])

    def means(self, borders: npt.NDArray[np.intp]) -> Doubles:
        """Returns the mean of each run of sorted numbers; run i has the indices ``borders[i]..borders[i + 1] - 1``."""
        return np.diff(self._sum[borders]) / np.diff(borders) + self._center

    def best_cut(self, start: int, end: int) -> tuple[float, int]:
        """Returns by how much the best split of a run lowers the sum of squared deviations, and the index to split at.

        Args:
            start: Index of the run's first number.
            end: Index after the run's last number.
        """
        if end - start < 2:
            return 0.0, start
        cuts = np.arange(start + 1, end)
        total = self._sum[end] - self._sum[start]
        below = self._sum[cuts] - self._sum[start]
        gains = below**2 / (cuts - start) + (total - below) ** 2 / (end - cuts) - total**2 / (end - start)
        best = int(gains.argmax())
        return float(gains[best]), start + 1 + best

    def least_gain(self) -> float:
        """Returns the smallest reduction of the squared error above rounding error: 1e-12 of the sum of squares."""
        return 1e-12 * float(self._squares[-1])


def _split_runs(sums: _PrefixSums, count: int) -> npt.NDArray[np.intp]:
    """Splits ``count`` sorted numbers greedily into at most 256 runs of similar numbers, for a codebook.

    Returns:
        The indices at which runs begin, from 0, and ``count`` at the end.
    """

    def entry(start: int, end: int) -> tuple[float, int, int, int]:
        gain, cut = sums.best_cut(start, end)
        return -gain, start, end, cut

    runs = [entry(0, count)]
    borders = [0, count]
    while len(borders) <= _ENTRIES and -runs[0][0] > sums.least_gain():
        _, start, end, cut = heapq.heappop(runs)
        borders.append(cut)
        heapq.heappush(runs, entry(start, cut))
        heapq.heappush(runs, entry(cut, end))
    return np.sort(np.array(borders, dtype=np.intp))


def read_sog(path: PathLike) -> SplatColumns:
    """Reads a SOG capture.

    Args:
        path: A bundled ``.sog``, a folder that holds ``meta.json``, or that ``meta.json``.

    Raises:
        FormatError: A file is missing or damaged, the version is unknown, or images have fewer pixels than Gaussians.
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
    """Reads only the ``meta.json`` of a SOG capture.

    Raises:
        FormatError: The file is missing or damaged.
    """
    with _open_source(path) as read_file, parsing(path, "a SOG capture"):
        return json.loads(read_file("meta.json"))


@contextmanager
def _open_source(path: PathLike) -> Generator[Callable[[str], bytes]]:
    """Opens a .sog bundle or a SOG folder. Yields a function that reads a file of the capture by its name."""
    if Path(path).is_dir() or Path(path).name == "meta.json":
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        yield lambda name: read_bytes(folder / name, referrer=path)
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
    """Returns a file name from meta.json; raises `FormatError` if the name contains a folder, which may be anywhere."""
    if Path(name).name != name:
        raise FormatError(path, f"refers to {name!r}, expected the name of a file beside its meta.json")
    return name


def _decode_images(path: PathLike, stored: dict[str, bytes]) -> dict[str, Bytes]:
    """Decodes a capture's WebP images in several threads. Returns RGBA, shape (height, width, 4), by file name."""

    def decoded(name: str) -> Bytes:
        with _decoding(path, name):
            return np.asarray(images[name].convert("RGBA"))

    with warnings.catch_warnings(), ThreadPoolExecutor(_DECODER_THREADS) as threads:
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
    """Converts errors of Pillow's decoders inside the block to a `FormatError` that names the image."""
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
    # In double precision: far from the origin, the exponential amplifies float32 rounding errors.
    log_means = least + (low | high.astype(np.uint16) << 8) / 65535.0 * (most - least)
    sh0 = rows(meta["sh0"]["files"][0])
    dc = _values(sh0 if logits else sh0[:, :3], meta["sh0"])
    sh = dc[:, None, :3]
    if meta.get("shN"):
        sh = np.concatenate([sh, _palette_sh(path, meta["shN"], images, rows)], axis=1)
    generator = meta.get("asset", {}).get("generator")
    with np.errstate(over="ignore"):  # damaged ranges give infinite values, refused later
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
        orientation=orientation_of(path, meta.get(LUMISPLAT_KEY)),
    )


def _values(stored: Bytes, field: Meta) -> Floats:
    """Decodes bytes as the meta.json entry ``field`` states: by a codebook or, in version 1, by a linear range."""
    if "codebook" not in field:
        return _scale_to_range(stored / np.float32(255.0), field)
    codebook = np.array(field["codebook"], dtype=np.float32)
    if field["codebook"][0] is None:  # some writers lost the first entry; PlayCanvas's engine extrapolates it too
        codebook[0] = codebook[1] + (codebook[1] - codebook[-1]) / 255.0
    return codebook[stored]


def _scale_to_range(unit: Floats, field: Meta) -> Floats:
    """Scales values from 0..1 to the range ``mins`` to ``maxs`` of their meta.json entry ``field``."""
    low, high = (np.asarray(field[name], dtype=np.float32) for name in ("mins", "maxs"))
    return low + unit * (high - low)


def _rotations(pixels: Bytes) -> Floats:
    """Decodes N quaternions wxyz, shape (N, 4), from pixels: three smallest components as RGB, one byte each.

    Alpha is 252 plus the index of the largest component. A lower alpha gives a zero quaternion, which later checks
    refuse.
    """
    smallest = (pixels[:, :3] / np.float32(255.0) - np.float32(0.5)) * np.float32(np.sqrt(2.0))
    largest = pixels[:, 3].astype(np.int64) - _QUATERNION_TAG
    return unpack_smallest_three(largest, smallest) * (largest >= 0)[:, None]


def _palette_sh(path: PathLike, field: Meta, images: dict[str, Bytes], rows: Callable[[str], Bytes]) -> Floats:
    """Looks up the SH coefficients above DC of N Gaussians in a palette, shape (N, coefficients, 3).

    Args:
        path: File to name in errors.
        field: Entry of the SH in meta.json.
        images: Decoded images by name.
        rows: Returns the pixels of an image for the N Gaussians.
    """
    # Writers list the centroids first, the specification lists the labels first: only the names are reliable.
    centroids_name, labels_name = sorted(field["files"][:2], key=lambda name: "label" in name)
    centroids = images[centroids_name][..., :3]
    coefficients, remainder = divmod(centroids.shape[1], _PALETTE_COLUMNS)
    if remainder or coefficients not in (3, 8, 15):
        raise FormatError(path, f"{centroids_name} is {centroids.shape[1]} pixels wide, expected 192, 512 or 960")
    palette = _values(centroids.reshape(-1, coefficients, 3), field)
    labels = rows(labels_name)
    return palette[labels[:, 0] | labels[:, 1].astype(np.uint16) << 8]


def write_sog(path: PathLike, gaussians: Gaussians) -> None:
    """Writes a SOG bundle, or a folder of files if ``path`` is a ``meta.json``.

    Values are quantised. Positions have 16 bits of sign(x) log(1 + abs(x)) over their range, and rotations 8 bits per
    component. Log scales and DC use codebooks of 256 values, opacities 8 bits. SH above degree 0 are replaced by one of
    up to 65,536 palette entries, whose coefficients use a codebook of 256 values.

    Raises:
        FormatError: There are too many Gaussians for an image, or a file cannot be written.
    """
    warn_losses(path, "SOG", gaussians)
    if gaussians.count > _IMAGE_SIDE_MAX**2:
        raise FormatError(path, f"{gaussians.count:,} Gaussians are more than a SOG holds, {_IMAGE_SIDE_MAX**2:,}")
    steps = coarse_steps(gaussians)
    warn_coarse_positions(path, len(steps), float(steps.max(initial=0.0)))
    contents = sog_contents(gaussians.subset(morton_order(gaussians.means)))
    if Path(path).name.lower() == "meta.json":
        with written_together(Path(path).parent) as written:
            write_folder(Path(path), contents, written)
        return
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as bundle:
        for name, data in contents.items():
            bundle.writestr(zipfile.ZipInfo(name, _FILE_TIME), data)


def remove_file(path: Path) -> None:
    """Removes a file if it exists.

    Raises:
        FormatError: The file cannot be removed.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise FormatError(path, f"cannot be written: {error.strerror or error}") from None


def write_folder(meta: Path, contents: Contents, written: list[Path]) -> None:
    """Writes the files of a capture into a folder.

    The old ``meta.json`` is removed first and the new one written last. A folder without ``meta.json`` is no capture,
    so a mix of old and new files after an interrupted write cannot be loaded.

    Args:
        meta: Path of the ``meta.json``.
        contents: Contents of the files, by name.
        written: List to which the written files are appended.

    Raises:
        FormatError: A file cannot be written.
    """
    remove_file(meta)
    for name in sorted(contents, key=lambda name: name == meta.name):
        with atomic_write(meta.with_name(name)) as temporary:
            temporary.write_bytes(contents[name])
        written.append(meta.with_name(name))


def sog_contents(gaussians: Gaussians) -> Contents:
    """Encodes a capture. Returns the contents of its files by name, ``meta.json`` first."""
    side = 4 * math.ceil(math.sqrt(gaussians.count) / 4)
    images: dict[str, Bytes] = {}
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "Lumisplat"},
        "count": gaussians.count,
        "antialias": gaussians.antialiased,
    }
    if stated := orientation_values(gaussians.up, gaussians.first_view):
        meta[LUMISPLAT_KEY] = stated

    def add(name: str, pixels: Bytes, width: int = side) -> str:
        images[f"{name}.webp"] = _image(pixels, width)
        return f"{name}.webp"

    meta["means"] = _mean_images(gaussians.means, add)
    log_scales = np.log(gaussians.scales)
    codebook = fit_codebook(log_scales)
    meta["scales"] = {"codebook": codebook.tolist(), "files": [add("scales", encode(log_scales, codebook))]}
    meta["quats"] = {"files": [add("quats", _rotation_image(gaussians.rotations_wxyz))]}
    dc = gaussians.sh[:, 0]
    codebook = fit_codebook(dc)
    opacities = np.floor(255.0 * gaussians.opacities + 0.5).astype(np.uint8)
    sh0 = np.column_stack([encode(dc, codebook), opacities])
    meta["sh0"] = {"codebook": codebook.tolist(), "files": [add("sh0", sh0)]}
    if gaussians.sh_degree:
        meta["shN"] = _palette(gaussians, add)
    with ThreadPoolExecutor(_THREADS) as threads:
        packed = dict(zip(images, threads.map(_webp, images.values()), strict=True))
    return {"meta.json": json.dumps(meta, separators=(",", ":")).encode()} | packed


def coarse_steps(gaussians: Gaussians) -> Floats:
    """Returns the position quantisation steps of those Gaussians that are smaller than their own step.

    Steps are in scene units. The step of a coordinate x is the step of its logarithm times the derivative 1 + abs(x).
    The step of the logarithm is 1 / 65535 of the range of all logarithms, or the spacing of float32 at the logarithm
    (engines decode in single precision), whichever is larger.
    """
    means = gaussians.means.astype(np.float64)
    logs = np.log1p(np.abs(means))
    extent = np.ptp(np.sign(means) * logs, axis=0)
    steps = (1.0 + np.abs(means)) * np.maximum(extent / 65535.0, np.spacing(logs.astype(np.float32)))
    largest = steps.max(axis=1)
    return largest[largest > gaussians.scales.max(axis=1)]


def warn_coarse_positions(path: PathLike, count: int, step: float) -> None:
    """Logs that some Gaussians are smaller than the quantisation step of their positions; nothing if ``count`` is 0.

    Args:
        path: The file.
        count: Number of Gaussians that are smaller than their step.
        step: Largest quantisation step of these Gaussians, scene units.
    """
    if count:
        _log.warning(
            "%s: the positions of %s are rounded to steps larger than their size, up to %.2g, because the capture is "
            "far from the origin or has outliers: move it (convert --translate=X,Y,Z), remove outliers (convert "
            "--floaters 4), or save as .ply",
            os.fspath(path),
            f"{count:,} Gaussian{'s' * (count > 1)}",
            step,
        )


def _mean_images(means: Floats, add: Callable[[str, Bytes], str]) -> dict[str, Any]:
    """Encodes positions as 16-bit logarithms in two images, of low and high bytes; returns their meta.json entry.

    ``add`` stores an image by its name without extension, and returns the file name.
    """
    logs = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = logs.min(axis=0), logs.max(axis=0)
    size = np.where(high > low, high - low, 1.0)
    stored = np.floor((logs - low) / size * 65535.0 + 0.5).astype(np.uint16)
    files = [add("means_l", (stored & 0xFF).astype(np.uint8)), add("means_u", (stored >> 8).astype(np.uint8))]
    return {"mins": low.tolist(), "maxs": high.tolist(), "files": files}


def _rotation_image(wxyz: Floats) -> Bytes:
    """Encodes quaternions as pixels: three smallest components as RGB, 252 plus index of the largest one as alpha."""
    largest, smallest = pack_smallest_three(wxyz)
    unit = np.clip(smallest * np.sqrt(0.5) + 0.5, 0.0, 1.0)
    return np.column_stack([np.floor(255.0 * unit + 0.5), largest + _QUATERNION_TAG]).astype(np.uint8)


def palette_size(count: int) -> int:
    """Returns the number of SH palette entries for a capture: the largest power of two <= ``count``, at most 65,536."""
    return min(_PALETTE_ENTRIES_MAX, 2 ** int(math.log2(max(count, 1))))


def _palette(gaussians: Gaussians, add: Callable[..., str]) -> dict[str, Any]:
    """Encodes SH above degree 0 as palette entries and labels, an image each; returns their meta.json entry.

    ``add`` stores an image by its name without extension, and returns the file name.
    """
    # Imported here because no other file format needs kernels.
    from lumisplat.palette import fit_palette

    rest = gaussians.sh.shape[1] - 1
    palette = fit_palette(gaussians.sh[:, 1:].reshape(gaussians.count, -1), palette_size(gaussians.count))
    # Entries are ordered by first use, so that neighbouring labels are similar and compress well.
    used, first = np.unique(palette.labels, return_index=True)
    order = used[np.argsort(first, kind="stable")]
    new_index = np.empty(len(palette.entries), dtype=np.int64)
    new_index[order] = np.arange(len(order))
    labels = new_index[palette.labels].astype("<u2")
    codebook = fit_codebook(palette.entries)
    centroids = encode(palette.entries[order].reshape(-1, 3), codebook)
    files = [
        add("shN_centroids", centroids, _PALETTE_COLUMNS * rest),
        add("shN_labels", labels[:, None].view(np.uint8)),
    ]
    return {"count": len(order), "bands": gaussians.sh_degree, "codebook": codebook.tolist(), "files": files}


def _image(values: Bytes, width: int) -> Bytes:
    """Arranges N values of 1 to 4 channels as opaque pixels, row by row, shape (height, width, 4).

    Channels that ``values`` lacks are 0. The height is a multiple of 4, like the width.
    """
    height = 4 * -(-len(values) // (4 * width))
    pixels = np.zeros((height * width, 4), dtype=np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return pixels.reshape(height, width, 4)


def _webp(pixels: Bytes) -> bytes:
    """Encodes pixels as lossless WebP. The option ``exact`` keeps the colours of pixels with alpha 0."""
    buffer = io.BytesIO()
    opaque = bool((pixels[..., 3] == 255).all())
    image = Image.fromarray(np.ascontiguousarray(pixels[..., :3]) if opaque else pixels)
    image.save(buffer, "WEBP", lossless=True, exact=True, quality=100, method=_COMPRESSION)
    return buffer.getvalue()
