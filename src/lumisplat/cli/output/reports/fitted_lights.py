"""What a fit of lights has found: a table, figures as JSON, and photographs beside what explains them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import lumisplat as ls
from lumisplat.cli.output.pictures import file_stems, make_folder
from lumisplat.cli.output.reports.files import write_beside, write_json

_WIDTH = 480
"""Of each picture, pixels, at most."""


def light_rows(fit: ls.LightFit) -> tuple[list[str], list[list[str]]]:
    """The table of the lights: power, its standard error, place, and share of the light."""
    header = ["light", "red", "green", "blue", "+-", "position", "+-", "share"]
    rows: list[list[str]] = []
    for number, light in enumerate(fit.lights):
        power = _power(fit, number)
        place = getattr(light, "position", None)
        error = float(fit.position_errors[number].max())
        rows.append(
            [
                _name(fit, number),
                *(f"{x:.4g}" for x in power),
                f"{float(fit.standard_errors[number].max()):.2g}",
                "" if place is None else ", ".join(f"{x:z.4g}" for x in place),
                "" if math.isnan(error) else f"{error:.2g}",
                f"{fit.shares[number]:.1%}",
            ]
        )
    return header, rows


def write_report(
    folder: Path,
    fit: ls.LightFit,
    cameras: Sequence[ls.Camera],
    photographs: Sequence[Path],
    renderer: ls.Renderer,
) -> None:
    """Writes report.json and a picture for each photograph: it, the scene in the light that was found, the difference.

    Raises:
        FormatError: A file cannot be written.
    """
    make_folder(folder)
    write_json(folder / "report.json", _figures(fit, photographs))
    stems = file_stems([photograph.stem for photograph in photographs])
    for view, camera, photograph, stem in zip(fit.views, cameras, photographs, stems, strict=True):
        width = min(camera.width, _WIDTH)
        shown = replace(camera.scaled(width), exposure=view.camera.exposure)
        frame = renderer.render(fit.scene, shown)
        write_beside(folder / f"{stem}.png", [_beside(ls.load_image(photograph), frame)])


def _figures(fit: ls.LightFit, photographs: Sequence[Path]) -> dict[str, Any]:
    lights = [
        {
            "light": _name(fit, number),
            **dict(zip(("red", "green", "blue"), _power(fit, number), strict=True)),
            "standard_error": fit.standard_errors[number].tolist(),
            "share": float(fit.shares[number]),
        }
        for number in range(len(fit.lights))
    ]
    views = [
        {
            "photograph": str(path),
            "residual": view.residual,
            "exposure": float(stops),
            "clipped": view.clipped,
            "masked": view.masked,
        }
        for path, view, stops in zip(photographs, fit.views, fit.exposures, strict=True)
    ]
    return {"lights": lights, "base_colors": fit.base_colors, "views": views, "remarks": list(fit.remarks)}


def _name(fit: ls.LightFit, number: int) -> str:
    return fit.lights[number].name or f"light{number}"


def _power(fit: ls.LightFit, number: int) -> list[float]:
    """Colour times intensity of a light, of harmonics their mean radiance."""
    light = fit.lights[number]
    if fit.environment is not None and number == len(fit.lights) - 1:
        return [float(x) / (2.0 * math.sqrt(math.pi)) for x in fit.environment.coefficients[0]]
    return [float(channel * light.intensity) for channel in light.color]


def _beside(photograph: Any, frame: ls.Frame) -> tuple[Any, Any]:
    """A photograph at the size of a frame, and that, display colours, shape (H, W, 3)."""
    import numpy as np
    from PIL import Image

    picture = frame.pixels_srgb()[..., :3]
    height, width = picture.shape[:2]
    whole = Image.fromarray((255.0 * photograph + 0.5).astype(np.uint8)).resize((width, height), Image.Resampling.BOX)
    return np.asarray(whole, np.float32) / 255.0, picture
