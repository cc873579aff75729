"""How near found materials and light are to the truth: a table, figures as JSON, pictures of the worst views."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.output.figures import Figures, mean, plain
from lumisplat.cli.output.pictures import file_stems, make_folder
from lumisplat.cli.output.reports.files import write_beside, write_json

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


def figure_rows(result: ls.MaterialEvaluation) -> tuple[list[str], list[list[str]]]:
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


def write_material_report(folder: Path, result: ls.MaterialEvaluation) -> None:
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


def _quality(view: ls.MaterialView) -> float:
    """By which the worst views are found: PSNR of relit pictures, else of albedo, else nearness of normals."""
    relit = mean([figures.psnr for figures in view.relit.values()])
    others = [value for value in (relit, view.albedo_psnr, -view.normal_mean) if not math.isnan(value)]
    return others[0] if others else 0.0


def _relit(relit: Mapping[str, ls.RelitFigures]) -> dict[str, dict[str, float | str | None]]:
    return {name: plain(figures._asdict()) for name, figures in relit.items()}


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
