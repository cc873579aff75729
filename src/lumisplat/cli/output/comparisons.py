"""Photographs beside what a scene shows in their place: figures and pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import lumisplat as ls
from lumisplat.cli.output.figures import Figures
from lumisplat.cli.output.reports.files import write_beside

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


@dataclass(frozen=True)
class Comparison:
    """The figures of one view."""

    view: ls.Photograph
    figures: Figures
    share: float
    """How much of the photograph was compared, 0..1."""
    problems: list[str]
    """Why figures are missing."""


def compare(view: ls.Photograph, frame: ls.Frame, scales: int) -> Comparison:
    """Compares a photograph with a frame of its camera, where its mask is at least half.

    Args:
        view: The photograph.
        frame: The frame, over the photograph's background.
        scales: Of MS-SSIM.

    Raises:
        FormatError: The photograph cannot be read, or nothing of it counts.
    """
    pair, region = (frame.pixels_srgb(), view.pixels()), _region(view)
    if not region.any():
        raise ls.FormatError(view.path, "has a mask under which no pixel counts at this size")
    metrics = {"psnr": ls.psnr, "ssim": ls.ssim, "ms-ssim": partial(ls.ms_ssim, scales=scales), "flip": ls.flip}
    figures: Figures = {}
    problems: list[str] = []
    for name, metric in metrics.items():
        try:
            figures[name] = metric(*pair, region=region)
        except (ls.MissingExtraError, ls.SceneError) as error:
            figures[name] = math.nan
            problems.append(f"no {name}: {error}")
    return Comparison(view, figures, float(region.mean()), problems)


def write_side_by_side(view: ls.Photograph, frame: ls.Frame, path: Path) -> None:
    """Writes photograph, picture and difference, from left to right; what does not count has no difference.

    Raises:
        FormatError: The file cannot be written.
    """
    write_beside(path, [(view.pixels(), frame.pixels_srgb())], _region(view))


def _region(view: ls.Photograph) -> npt.NDArray[np.bool_]:
    """Where a photograph counts, shape (H, W)."""
    import numpy as np

    mask = view.mask()
    return np.ones((view.camera.height, view.camera.width), np.bool_) if mask is None else mask >= 0.5
