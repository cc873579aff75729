"""Materials that were found as pictures: albedo, roughness and normals beside photographs, and the sky."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.cli.output.figures import plain
from lumisplat.cli.output.pictures import file_stems, make_folder
from lumisplat.cli.output.reports.files import write_json, write_picture

_VIEWS = 4
"""Photographs beside which materials are shown, at most."""
_SKY_PX = 16
"""Side of a pixel of the sky's picture."""
_SKY_MEAN = 0.3
"""Mean of the sky in its picture, linear: how bright it is there is a convention, and above 1 is white."""
_SH_C0 = 0.28209479177387814


def write_materials(folder: Path, found: ls.FoundMaterials, photographs: ls.Photographs, device: str) -> None:
    """Writes a picture for some views, held out ones if there are any, the sky as a picture, and figures.

    Raises:
        FormatError: A file cannot be written.
    """
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
    assert gaussians.albedo is not None and gaussians.roughness is not None and gaussians.normals is not None
    grey = np.repeat(gaussians.roughness[:, None], 3, axis=1)
    return [_colored(gaussians, color) for color in (_encoded(gaussians.albedo), grey, 0.5 + 0.5 * gaussians.normals)]


def _colored(gaussians: ls.Gaussians, color: npt.NDArray[np.floating]) -> ls.Gaussians:
    return replace(gaussians, sh=((color - 0.5) / _SH_C0).astype(np.float32)[:, None])


def _encoded(linear: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Display-referred sRGB."""
    bright = 1.055 * np.maximum(linear, 1e-9) ** (1.0 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, bright)
