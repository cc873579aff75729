"""SOG version 2: see `lumisplat.io.splats.sog.reader` for the layout.

Gaussians are sorted along a Morton curve, by which images compress better, so that the order of the input is lost.
"""

from __future__ import annotations

import io
import json
import logging
import math
import os
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from lumisplat.constants import KERNEL_DEGREE
from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write, written_together
from lumisplat.io.files.source import PathLike
from lumisplat.io.splats.columns import Floats, warn_lost_materials
from lumisplat.io.splats.orientation import orientation_values
from lumisplat.io.splats.smallest_three import pack_smallest_three
from lumisplat.io.splats.sog.codebook import encode, fit_codebook
from lumisplat.io.splats.sog.reader import OURS, PALETTE_COLUMNS, QUATERNION_TAG
from lumisplat.scene.editing.morton import morton_order
from lumisplat.scene.gaussians import Gaussians

_log = logging.getLogger("lumisplat")

Bytes = npt.NDArray[np.uint8]
Contents = dict[str, bytes]

PALETTE_ENTRIES_MAX = 2**16
"""SH palette entries: labels have 16 bits."""

COMPRESSION = 1
"""Effort of Pillow's lossless WebP, 0 to 6, see docs/adr/0065-sog-written.md."""

IMAGE_SIDE_MAX = 16_380
"""Largest width and height of a WebP that is a multiple of 4."""

FILE_TIME = (1980, 1, 1, 0, 0, 0)
"""Time of all files in a bundle, the earliest that zip has: the same capture makes the same bytes."""

THREADS = 4


def write_sog(path: PathLike, gaussians: Gaussians) -> None:
    """Writes a SOG bundle, or a folder with its files if ``path`` is its ``meta.json``.

    Values are quantised: positions to 16 bits of sign(x) log(1 + abs(x)) between their least and largest, rotations to
    8 bits a component, log scales and DC to 256 values that suit them best, opacities to 8 bits. Other SH become one of
    up to 65,536 sets, whose coefficients are of 256 values.

    Raises:
        FormatError: There are too many Gaussians for an image, or a file cannot be written.
    """
    warn_losses(path, gaussians)
    if gaussians.count > IMAGE_SIDE_MAX**2:
        raise FormatError(path, f"{gaussians.count:,} Gaussians are more than a SOG holds, {IMAGE_SIDE_MAX**2:,}")
    steps = coarse_steps(gaussians)
    warn_coarse_positions(path, len(steps), float(steps.max(initial=0.0)))
    contents = sog_contents(gaussians.subset(morton_order(gaussians.means)))
    if Path(path).name.lower() == "meta.json":
        with written_together(Path(path).parent) as written:
            write_folder(Path(path), contents, written)
        return
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as bundle:
        for name, data in contents.items():
            bundle.writestr(zipfile.ZipInfo(name, FILE_TIME), data)


def warn_losses(path: PathLike, gaussians: Gaussians) -> None:
    """Logs what of a capture SOG cannot store."""
    warn_lost_materials(path, "SOG", gaussians)
    if gaussians.kernel_degree != KERNEL_DEGREE:
        _log.warning(
            "%s: SOG cannot store the kernel degree, %s: left out, save as .ply to keep it",
            os.fspath(path),
            gaussians.kernel_degree,
        )


def remove_file(path: Path) -> None:
    """Removes a file, if it is there.

    Raises:
        FormatError: It cannot be removed.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise FormatError(path, f"cannot be written: {error.strerror or error}") from None


def write_folder(meta: Path, contents: Contents, written: list[Path]) -> None:
    """Writes the files of a capture into a folder.

    The old ``meta.json`` goes first and the new one comes last: a folder without one is no capture, so that none is
    half old and half new.

    Args:
        meta: Path of the ``meta.json``.
        contents: What the files hold, by their names.
        written: Receives the files.

    Raises:
        FormatError: A file cannot be written.
    """
    remove_file(meta)
    for name in sorted(contents, key=lambda name: name == meta.name):
        with atomic_write(meta.with_name(name)) as temporary:
            temporary.write_bytes(contents[name])
        written.append(meta.with_name(name))


def sog_contents(gaussians: Gaussians) -> Contents:
    """The files of a capture by their names, ``meta.json`` first."""
    side = 4 * math.ceil(math.sqrt(gaussians.count) / 4)
    images: dict[str, Bytes] = {}
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "Lumisplat"},
        "count": gaussians.count,
        "antialias": gaussians.antialiased,
    }
    if stated := orientation_values(gaussians.up, gaussians.first_view):
        meta[OURS] = stated

    def add(name: str, pixels: Bytes, width: int = side) -> str:
        images[f"{name}.webp"] = _image(pixels, width)
        return f"{name}.webp"

    meta["means"] = _means(gaussians.means, add)
    log_scales = np.log(gaussians.scales)
    codebook = fit_codebook(log_scales)
    meta["scales"] = {"codebook": codebook.tolist(), "files": [add("scales", encode(log_scales, codebook))]}
    meta["quats"] = {"files": [add("quats", _rotations(gaussians.rotations_wxyz))]}
    dc = gaussians.sh[:, 0]
    codebook = fit_codebook(dc)
    opacities = np.floor(255.0 * gaussians.opacities + 0.5).astype(np.uint8)
    sh0 = np.column_stack([encode(dc, codebook), opacities])
    meta["sh0"] = {"codebook": codebook.tolist(), "files": [add("sh0", sh0)]}
    if gaussians.sh_degree:
        meta["shN"] = _palette(gaussians, add)
    with ThreadPoolExecutor(THREADS) as threads:
        packed = dict(zip(images, threads.map(_webp, images.values()), strict=True))
    return {"meta.json": json.dumps(meta, separators=(",", ":")).encode()} | packed


def coarse_steps(gaussians: Gaussians) -> Floats:
    """Returns the steps in which positions are stored, scene units, of the Gaussians that are smaller than them.

    A step is 1 / 65535 of the range of the logarithms, or the rounding of these in single precision, in which engines
    decode them, whichever is larger, times the derivative 1 + abs(x).
    """
    means = gaussians.means.astype(np.float64)
    logs = np.log1p(np.abs(means))
    extent = np.ptp(np.sign(means) * logs, axis=0)
    steps = (1.0 + np.abs(means)) * np.maximum(extent / 65535.0, np.spacing(logs.astype(np.float32)))
    largest = steps.max(axis=1)
    return largest[largest > gaussians.scales.max(axis=1)]


def warn_coarse_positions(path: PathLike, count: int, step: float) -> None:
    """Logs that some Gaussians are smaller than the steps of their positions, if any are.

    Args:
        path: The file.
        count: Number of these.
        step: The largest step, scene units.
    """
    if count:
        _log.warning(
            "%s: the positions of %s are stored in steps larger than they are, up to %.2g, because they lie "
            "far from the origin, or others do: move the capture there (--translate), remove strays (--floaters), or "
            "save as .ply",
            os.fspath(path),
            f"{count:,} Gaussian{'s' * (count > 1)}",
            step,
        )


def _means(means: Floats, add: Callable[[str, Bytes], str]) -> dict[str, Any]:
    """The entry of the positions, and their images of low and high bytes."""
    logs = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = logs.min(axis=0), logs.max(axis=0)
    size = np.where(high > low, high - low, 1.0)
    stored = np.floor((logs - low) / size * 65535.0 + 0.5).astype(np.uint16)
    files = [add("means_l", (stored & 0xFF).astype(np.uint8)), add("means_u", (stored >> 8).astype(np.uint8))]
    return {"mins": low.tolist(), "maxs": high.tolist(), "files": files}


def _rotations(wxyz: Floats) -> Bytes:
    """The smallest three components as bytes, and which one is left out."""
    largest, smallest = pack_smallest_three(wxyz)
    unit = np.clip(smallest * np.sqrt(0.5) + 0.5, 0.0, 1.0)
    return np.column_stack([np.floor(255.0 * unit + 0.5), largest + QUATERNION_TAG]).astype(np.uint8)


def palette_size(count: int) -> int:
    """Entries of the SH palette for so many Gaussians: a power of two, which PlayCanvas's tools choose so, too."""
    return min(PALETTE_ENTRIES_MAX, 2 ** int(math.log2(max(count, 1))))


def _palette(gaussians: Gaussians, add: Callable[..., str]) -> dict[str, Any]:
    """The entry of the SH above degree 0, and their images."""
    # Imported here: nothing else in files needs kernels.
    from lumisplat.palettes.palette import fit_palette

    rest = gaussians.sh.shape[1] - 1
    palette = fit_palette(gaussians.sh[:, 1:].reshape(gaussians.count, -1), palette_size(gaussians.count))
    # Neighbours in the image are alike if entries stand in the order in which Gaussians use them.
    used, first = np.unique(palette.labels, return_index=True)
    order = used[np.argsort(first, kind="stable")]
    place = np.empty(len(palette.entries), dtype=np.int64)
    place[order] = np.arange(len(order))
    labels = place[palette.labels].astype("<u2")
    codebook = fit_codebook(palette.entries)
    centroids = encode(palette.entries[order].reshape(-1, 3), codebook)
    files = [
        add("shN_centroids", centroids, PALETTE_COLUMNS * rest),
        add("shN_labels", labels[:, None].view(np.uint8)),
    ]
    return {"count": len(order), "bands": gaussians.sh_degree, "codebook": codebook.tolist(), "files": files}


def _image(values: Bytes, width: int) -> Bytes:
    """Values, shape (N, 1 to 4), as rows of opaque pixels, shape (height, width, 4); the rest is 0.

    Its height is a multiple of 4, as the width is.
    """
    height = 4 * -(-len(values) // (4 * width))
    pixels = np.zeros((height * width, 4), dtype=np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return pixels.reshape(height, width, 4)


def _webp(pixels: Bytes) -> bytes:
    """A lossless WebP of exactly these pixels; without ``exact``, those of alpha 0 would lose their colours."""
    buffer = io.BytesIO()
    opaque = bool((pixels[..., 3] == 255).all())
    image = Image.fromarray(np.ascontiguousarray(pixels[..., :3]) if opaque else pixels)
    image.save(buffer, "WEBP", lossless=True, exact=True, quality=100, method=COMPRESSION)
    return buffer.getvalue()
