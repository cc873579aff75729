"""Reports of a fit of lights: the scene file with what was found, a table, JSON, and images side by side."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import lumisplat as ls
from lumisplat.cli.output.comparisons import write_beside, write_json
from lumisplat.cli.output.images import file_stems, make_folder


def fitted_document(
    document: ls.io.SceneDocument, fit: ls.inverse.LightFit, output: Path
) -> tuple[ls.io.SceneDocument, list[str]]:
    """The document in the light that was found, and a line for each base colour that it cannot hold.

    An environment of harmonics is written as ``NAME.assets/environment.exr``, captures of other base colours beside it
    as ``.ply``.

    Args:
        document: Of the scene that was fitted.
        fit: What was found.
        output: The scene file that is to be written.

    Raises:
        FormatError: The image of the environment, or a capture, cannot be written.
    """
    document, remarks = _with_colors(document, fit)
    document, more = _with_captures(document, fit, output)
    remarks += more
    image = {}
    for entry in document.entries:
        if entry.kind in ("lights", "environment") and entry.table.get("enabled", True):
            image = {"path": entry.table["path"]} if "path" in entry.table else image
            document = document.removed(entry.id)
        elif entry.lights and entry.kind == "meshes":
            document = document.changed(entry.id, lights=False)
    lamps = [light for light in fit.lights if not isinstance(light, ls.LightEnvironment)]
    for light in ls.io.SceneDocument.of(ls.Scene(lights=lamps)).entries:
        document, _ = document.added("lights", light.table)
    for light in fit.lights:
        if isinstance(light, ls.LightEnvironment):
            table: dict[str, Any] = _sky_table(light)
            if fit.environment is not None:
                image = {"path": _named(document, _written(fit, output))}
            document, _ = document.added("environment", table | (image if light.image is not None else {}))
    return document, remarks


def _sky_table(light: ls.LightEnvironment) -> dict[str, Any]:
    """The table of an environment, but for its image."""
    (entry,) = ls.io.SceneDocument.of(ls.Scene(lights=[light])).entries
    return {key: value for key, value in entry.table.items() if key != "path"}


def _written(fit: ls.inverse.LightFit, output: Path) -> Path:
    """The file of the harmonics' image."""
    assert fit.environment is not None
    path = _made_assets(output) / "environment.exr"
    fit.environment.save(path, rotation_wxyz=fit.scene.upright_wxyz, height=32)
    return path


def assets_of(output: Path) -> Path:
    """The folder for what a scene file names."""
    return output.with_name(f"{output.stem}.assets").absolute()


def _named(document: ls.io.SceneDocument, path: Path) -> str:
    """The name of a file from the folder of a document; its whole path, if that is on another drive."""
    try:
        return Path(os.path.relpath(path, document.file.absolute().parent)).as_posix()
    except ValueError:
        return str(path)


def _made_assets(output: Path) -> Path:
    """The same, which is there."""
    folder = assets_of(output)
    make_folder(folder)
    return folder


def _with_captures(
    document: ls.io.SceneDocument, fit: ls.inverse.LightFit, output: Path
) -> tuple[ls.io.SceneDocument, list[str]]:
    """The document with captures of the base colours that were found, each a file of its own."""
    before, after = document.scene(), fit.scene
    entries = [document.owner(number) for number in range(len(before.splats))]
    changed = [n for n, (old, new) in enumerate(zip(before.splats, after.splats, strict=True)) if old is not new]
    stems = file_stems([Path(entries[number].table.get("path", "")).stem for number in changed])
    remarks: list[str] = []
    for number, stem in zip(changed, stems, strict=True):
        entry = entries[number]
        if entry.kind != "splats" or sum(one.id == entry.id for one in entries) > 1:
            remarks.append(f"{entry.name} is no file of one capture: its colours stay")
            continue
        path = _made_assets(output) / f"{stem}.ply"
        ls.save(path, after.splats[number].gaussians)
        document = document.changed(entry.id, path=_named(document, path))
    return document, remarks


def _with_colors(document: ls.io.SceneDocument, fit: ls.inverse.LightFit) -> tuple[ls.io.SceneDocument, list[str]]:
    """The document with the base colours."""
    before, after = document.scene(), fit.scene
    owned: dict[int, list[int]] = {}
    for number in range(len(before.meshes)):
        entry = document.owner(len(before.splats) + number)
        owned.setdefault(entry.id, []).append(number)
    remarks: list[str] = []
    for entry_id, numbers in owned.items():
        old = {before.meshes[number].mesh.material.base_color for number in numbers}
        new = {after.meshes[number].mesh.material.base_color for number in numbers}
        if old == new:
            continue
        entry = document.entry(entry_id)
        if len(new) > 1 or entry.kind != "meshes":
            remarks.append(f"{entry.name} has several materials, and one entry holds one: its base colours stay")
            continue
        material = dict(document.material(entry_id)) | {"base_color": list(next(iter(new)))}
        document = document.changed(entry_id, material=material)
    return document, remarks


_WIDTH = 480
"""Of each picture, pixels, at most."""


def light_rows(fit: ls.inverse.LightFit) -> tuple[list[str], list[list[str]]]:
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
    fit: ls.inverse.LightFit,
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


def _figures(fit: ls.inverse.LightFit, photographs: Sequence[Path]) -> dict[str, Any]:
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


def _name(fit: ls.inverse.LightFit, number: int) -> str:
    return fit.lights[number].name or f"light{number}"


def _power(fit: ls.inverse.LightFit, number: int) -> list[float]:
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
