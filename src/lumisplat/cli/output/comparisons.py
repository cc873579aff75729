"""Compares images with renders: metrics, JSON, and images side by side."""

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
    """Image in display colours, 0..1, shape (H, W, 3)."""


@dataclass(frozen=True)
class Comparison:
    """Metrics of the frame of one view, compared with the view's image."""

    view: ls.io.TrainingImage
    figures: Figures
    share: float
    """Fraction of the image that was compared, 0..1."""
    problems: list[str]
    """Reasons for missing metrics."""


def compare(view: ls.io.TrainingImage, frame: ls.Frame, scales: int) -> Comparison:
    """Compares an image with a frame of its camera, in the pixels whose mask is at least half.

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
    """Writes image, render and their difference side by side; the difference is black where the mask excludes pixels.

    Raises:
        FormatError: The file cannot be written.
    """
    write_comparison(path, [(view.pixels(), frame.pixels_srgb())], _region(view))


def _region(view: ls.io.TrainingImage) -> npt.NDArray[np.bool_]:
    """Returns True for the pixels of an image that are compared, shape (H, W)."""
    import numpy as np

    mask = view.mask()
    return np.ones((view.camera.height, view.camera.width), np.bool_) if mask is None else mask >= 0.5


Figures = dict[str, float]
"""Metric values by name; NaN marks a missing value."""

_DIGITS = {"psnr": 2, "ncm_ab": 2}


def mean(values: Sequence[float]) -> float:
    """Returns the mean of the values that are not NaN; NaN if there is none."""
    existing = [value for value in values if not math.isnan(value)]
    return sum(existing) / len(existing) if existing else math.nan


def plain(figures: Figures) -> dict[str, float | str | None]:
    """Converts metric values to JSON values: null for NaN, ``"inf"`` for infinity."""
    return {
        name: None if math.isnan(value) else "inf" if math.isinf(value) else value for name, value in figures.items()
    }


def cells(figures: Figures) -> list[str]:
    """Formats metric values as the cells of a table row."""
    return [digits(name, value) for name, value in figures.items()]


def digits(name: str, value: float) -> str:
    """Formats the value of the metric ``name`` for a table; ``-`` for NaN."""
    return "-" if math.isnan(value) else f"{value:.{_DIGITS.get(name, 4)}f}"


_GAIN = 4.0
"""Factor by which difference images are amplified."""


def check_report(folder: Path, images: Iterable[Path]) -> None:
    """Checks that a report folder can be written, and holds no compared image, which the report would overwrite.

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
    """Writes pairs of images as rows of a PNG, each with the pair's difference, amplified four times.

    Args:
        path: Path of the PNG.
        rows: Pairs of images, from top to bottom.
        region: Pixels whose difference is shown, shape (H, W); None shows all.

    Raises:
        FormatError: The file cannot be written.
    """
    import numpy as np

    shown = 1.0 if region is None else region[..., None]
    beside = [np.concatenate([a, b, shown * np.clip(_GAIN * np.abs(a - b), 0.0, 1.0)], axis=1) for a, b in rows]
    write_image(path, np.concatenate(beside))


@contextmanager
def _replaced(path: Path) -> Generator[Path]:
    """Yields a temporary file that replaces ``path`` if the block succeeds; otherwise ``path`` stays unchanged.

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
