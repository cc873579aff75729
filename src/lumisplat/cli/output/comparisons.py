"""Compares images with renders of their cameras: metrics, reports in JSON, and images side by side."""

from __future__ import annotations

import json
import math
import os
import secrets
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import lumisplat as ls
from lumisplat.cli.output.images import check_folder

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Picture = npt.NDArray[np.floating]
    """Image of display colours (sRGB-encoded), 0..1, shape (H, W, 3)."""


@dataclass(frozen=True)
class Comparison:
    """Metrics of a rendered frame against the image that was taken with the same camera."""

    view: ls.io.TrainingImage
    figures: Figures
    share: float
    """Fraction of the image's pixels that were compared, 0..1; a mask excludes the others."""
    problems: list[str]
    """A text for each metric that could not be computed, such as a missing package."""


def compare(view: ls.io.TrainingImage, frame: ls.Frame, scales: int) -> Comparison:
    """Compares an image with a frame rendered from its camera, where the image's mask is at least half white.

    Args:
        view: The image.
        frame: The frame, rendered over the image's background.
        scales: Number of scales of MS-SSIM.

    Raises:
        FormatError: The image cannot be read, or its mask leaves no pixel.
    """
    pair, region = (frame.pixels_srgb(), view.pixels()), _region(view)
    if not region.any():
        raise ls.FormatError(view.path, "has a mask that leaves no pixel at this size")
    metrics = {
        "psnr": ls.metrics.psnr,
        "ssim": ls.metrics.ssim,
        "ms-ssim": partial(ls.metrics.ms_ssim, scales=scales),
        "flip": ls.metrics.flip,
    }
    figures: Figures = {}
    problems: list[str] = []
    for name, metric in metrics.items():
        try:
            figures[name] = metric(*pair, region=region)
        except (ls.errors.MissingExtraError, ls.SceneError) as error:
            figures[name] = math.nan
            problems.append(f"no {name}: {error}")
    return Comparison(view, figures, float(region.mean()), problems)


def write_view_comparison(view: ls.io.TrainingImage, frame: ls.Frame, path: Path) -> None:
    """Writes a PNG with an image, its render and their difference, which is black where the mask excludes pixels.

    Raises:
        FormatError: The file cannot be written.
    """
    write_comparison(path, [(view.pixels(), frame.pixels_srgb())], _region(view))


def _region(view: ls.io.TrainingImage) -> npt.NDArray[np.bool_]:
    """Returns a mask of the pixels to compare, shape (H, W): True where the image's mask is at least half white."""
    import numpy as np

    mask = view.mask()
    return np.ones((view.camera.height, view.camera.width), np.bool_) if mask is None else mask >= 0.5


Figures = dict[str, float]
"""Metric values by metric name; NaN if a metric could not be computed."""

_DIGITS = {"psnr": 2, "ncm_ab": 2}


def mean(values: Sequence[float]) -> float:
    """Returns the mean of the values that are not NaN; NaN if there is none."""
    existing = [value for value in values if not math.isnan(value)]
    return sum(existing) / len(existing) if existing else math.nan


def plain(figures: Figures) -> dict[str, float | str | None]:
    """Converts metric values to values that JSON can store: null for NaN, ``"inf"`` for infinity."""
    return {
        name: None if math.isnan(value) else "inf" if math.isinf(value) else value for name, value in figures.items()
    }


def cells(figures: Figures) -> list[str]:
    """Formats metric values as texts for the cells of a table row, in the order of the metrics."""
    return [digits(name, value) for name, value in figures.items()]


def digits(name: str, value: float) -> str:
    """Formats a metric's value with the number of decimals that the metric ``name`` needs; ``-`` for NaN."""
    return "-" if math.isnan(value) else f"{value:.{_DIGITS.get(name, 4)}f}"


_GAIN = 4.0
"""Factor on the absolute difference of two images in difference images."""


def check_report(folder: Path, images: Iterable[Path]) -> None:
    """Checks that a report can be written to a folder, and that the folder has no input image that it might overwrite.

    Args:
        folder: Folder of the report.
        images: The images that the report compares.

    Raises:
        ConfigError: The folder holds one of the images.
        FormatError: The folder cannot be written.
    """
    check_folder(folder)
    if any(image.absolute().parent.resolve() == folder.resolve() for image in images):
        raise ls.ConfigError(f"{folder} has the images, which the report's images would replace: name another folder")


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Writes a dictionary as JSON.

    Raises:
        FormatError: The file cannot be written.
    """
    with _replaced(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def write_image(path: Path, color: Picture) -> None:
    """Writes an image of display colours as PNG.

    Raises:
        FormatError: The file cannot be written.
    """
    import numpy as np
    from PIL import Image

    with _replaced(path) as temporary:
        Image.fromarray((255.0 * np.clip(color, 0.0, 1.0) + 0.5).astype(np.uint8)).save(temporary)


def write_comparison(
    path: Path, rows: Sequence[tuple[Picture, Picture]], region: npt.NDArray[np.bool_] | None = None
) -> None:
    """Writes a PNG with a row for each pair of images: both images, and their absolute difference times four.

    Args:
        path: Path of the PNG.
        rows: Pairs of images, from top to bottom.
        region: Pixels whose difference is shown, shape (H, W), others are black; None shows all.

    Raises:
        FormatError: The file cannot be written.
    """
    import numpy as np

    shown = 1.0 if region is None else region[..., None]
    beside = [np.concatenate([a, b, shown * np.clip(_GAIN * np.abs(a - b), 0.0, 1.0)], axis=1) for a, b in rows]
    write_image(path, np.concatenate(beside))


@contextmanager
def _replaced(path: Path) -> Generator[Path]:
    """Context that yields a temporary path: on success its file replaces ``path``, on errors ``path`` stays as it is.

    Raises:
        FormatError: The file cannot be written.
    """
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(6)}.report{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise ls.FormatError(path, f"cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            temporary.unlink()
