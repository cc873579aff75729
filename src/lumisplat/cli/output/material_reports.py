"""Reports of materials: found ones as images beside the training images, and how near they are to the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import lumisplat as ls
from lumisplat.cli.output.comparisons import Figures, mean, plain, write_beside, write_json, write_picture
from lumisplat.cli.output.images import file_stems, make_folder

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

_VIEWS = 4
"""Photographs beside which materials are shown, at most."""
_SKY_PX = 16
"""Side of a pixel of the sky's picture."""
_SKY_MEAN = 0.3
"""Mean of the sky in its picture, linear: how bright it is there is a convention, and above 1 is white."""
_SH_C0 = 0.28209479177387814


def write_materials(
    folder: Path, found: ls.inverse.FoundMaterials, photographs: ls.io.Photographs, device: str
) -> None:
    """Writes a picture for some views, held out ones if there are any, the sky as a picture, and figures.

    Raises:
        FormatError: A file cannot be written.
    """
    import numpy as np

    make_folder(folder)
    views = (photographs.held_out or photographs.training)[:_VIEWS]
    renderer = ls.create_renderer(ls.RenderConfig(lighting=False), device)
    layers = [ls.Scene([layer]) for layer in _layers(found.gaussians)]
    for view, stem in zip(views, file_stems([view.name for view in views]), strict=True):
        shown = [view.pixels(), *(renderer.render(layer, view.camera).color for layer in layers)]
        write_picture(folder / f"{stem}.png", np.concatenate(shown, axis=1))
    image = found.environment.image
    if image is not None:
        exposed = image * (_SKY_MEAN / max(float(image.mean()), 1e-9))
        write_picture(folder / "environment.png", np.kron(_encoded(exposed), np.ones((_SKY_PX, _SKY_PX, 1))))
    told = plain({"error": found.error, "too_light": found.too_light}) | {"gaussians": found.gaussians.count}
    write_json(folder / "materials.json", told)


def _layers(gaussians: ls.Gaussians) -> list[ls.Gaussians]:
    """The capture with albedo, roughness and normals for colours."""
    import numpy as np

    assert gaussians.albedo is not None and gaussians.roughness is not None and gaussians.normals is not None
    grey = np.repeat(gaussians.roughness[:, None], 3, axis=1)
    return [_colored(gaussians, color) for color in (_encoded(gaussians.albedo), grey, 0.5 + 0.5 * gaussians.normals)]


def _colored(gaussians: ls.Gaussians, color: npt.NDArray[np.floating]) -> ls.Gaussians:
    import numpy as np

    return replace(gaussians, sh=((color - 0.5) / _SH_C0).astype(np.float32)[:, None])


def _encoded(linear: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Display-referred sRGB."""
    import numpy as np

    bright = 1.055 * np.maximum(linear, 1e-9) ** (1.0 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, bright)


_WORST = 3
"""How many of the worst views are shown."""
_FIGURES = {
    "albedo_psnr": ("albedo, one scale a channel", "dB", 2),
    "albedo_psnr_unscaled": ("albedo as it is", "dB", 2),
    "normal_mean": ("normals, mean", "degrees", 2),
    "normal_median": ("normals, median", "degrees", 2),
    "roughness_rmse": ("roughness, rmse", "", 4),
    "environment_psnr": ("environment, one scale a channel", "dB", 2),
}
"""Of the table: label, unit, digits."""
_VIEW_FIGURES = (
    "coverage",
    "albedo_psnr",
    "albedo_psnr_unscaled",
    "albedo_psnr_linear",
    "normal_mean",
    "normal_median",
    "roughness_rmse",
)


def figure_rows(result: ls.inverse.MaterialEvaluation) -> tuple[list[str], list[list[str]]]:
    """The table of all figures."""
    rows: list[list[str]] = []
    for name, (label, unit, digits) in _FIGURES.items():
        rows.append([label, _number(getattr(result, name), digits), unit])
    for name, figures in result.relit.items():
        rows.append([f"relit in {name}, psnr", _number(figures.psnr, 2), "dB"])
        rows.append([f"relit in {name}, ssim", _number(figures.ssim, 4), ""])
        rows.append([f"relit in {name}, flip", _number(figures.flip, 4), ""])
    rows.append(["scale of albedo", " ".join(f"{factor:.3f}" for factor in result.albedo_scale), "red green blue"])
    return [f"{len(result.views)} views", "figure", ""], rows


def write_material_report(folder: Path, result: ls.inverse.MaterialEvaluation) -> None:
    """Writes metrics.json and, for the worst views, a picture with a row for each thing that was found.

    Raises:
        FormatError: A file cannot be written.
    """
    overall: Figures = {name: getattr(result, name) for name in (*_FIGURES, "albedo_psnr_linear")}
    told = plain(overall) | {"relit": _relit(result.relit), "albedo_scale": list(result.albedo_scale)}
    views = [
        {"name": view.name, **plain({name: getattr(view, name) for name in _VIEW_FIGURES}), "relit": _relit(view.relit)}
        for view in result.views
    ]
    make_folder(folder)
    write_json(folder / "metrics.json", {"all": told, "views": views, "remarks": list(result.remarks)})
    worst = sorted(result.views, key=_quality)[:_WORST]
    for view, stem in zip(worst, file_stems([view.name for view in worst]), strict=True):
        write_beside(folder / f"{stem}.png", list(view.pictures.values()))


def _quality(view: ls.inverse.MaterialView) -> float:
    """By which the worst views are found: PSNR of relit pictures, else of albedo, else nearness of normals."""
    relit = mean([figures.psnr for figures in view.relit.values()])
    others = [value for value in (relit, view.albedo_psnr, -view.normal_mean) if not math.isnan(value)]
    return others[0] if others else 0.0


def _relit(relit: Mapping[str, ls.inverse.RelitFigures]) -> dict[str, dict[str, float | str | None]]:
    return {name: plain(figures._asdict()) for name, figures in relit.items()}


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
