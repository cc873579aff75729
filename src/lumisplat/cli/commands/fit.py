"""``lumisplat fit``: finds the lights of a scene from images of it, and writes the lit scene and a report."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

import lumisplat as ls
from lumisplat.cli.input.loading import camera_file, scene_file, scene_settings
from lumisplat.cli.options.command import (
    DeviceCommand,
    Flag,
    LoadingCommand,
    PipelineName,
    SetCommand,
    own_options_first,
    setting,
)
from lumisplat.cli.output.comparisons import check_report, write_comparison, write_json
from lumisplat.cli.output.console import print_columns, progress_bars
from lumisplat.cli.output.images import check_folder, file_stems, make_folder

_log = logging.getLogger("lumisplat")

_IMAGE_EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".hdr")


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Fit(LoadingCommand, DeviceCommand, SetCommand):
    """Find the lights of a scene from images of it.

    Objects in the scene are then lit as in the images.
    Finding two lights took half a minute on one CPU core, and four minutes with --positions.
    Guide: docs/guide/fit.md.
    First try: lumisplat fit room.toml photo.jpg --camera door -o fitted.toml
    """

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE PHOTO...", help_behavior_hint="")]] = ()
    """Read a scene, and images of it: .png, .jpg, .webp, .exr, .hdr."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")]
    """Write the scene with the estimated lights, as .toml."""
    overwrite: Flag = False
    """Replace OUT, which may be SCENE itself."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Read the images' cameras from this file."""
    camera: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = ()
    """Name the camera of the first image; repeat for each further image."""
    mask: Annotated[UseAppendAction[tuple[Path, ...]], arg(metavar="FILE")] = ()
    """Use only pixels where this mask is at least half white; repeat for each image."""
    report: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Write images, renders, differences and report.json into this folder."""
    environment_degree: Annotated[Literal["auto", "none", "0", "1", "2", "3", "4"], arg(metavar="N")] = "auto"
    """Set the environment's SH degree, 0..4, or none; auto: 2 unless it has an image."""
    no_intensities: Flag = False
    """Keep the lights' intensities and colours fixed."""
    keep_hues: Flag = False
    """Keep the lights' colours fixed, and find only their intensities."""
    positions: Flag = False
    """Find positions of lights, and directions of spots and suns; takes minutes."""
    radii: Flag = False
    """Find the radius of each light that has one."""
    angles: Flag = False
    """Find the cone angles of spots."""
    base_colors: Annotated[str | None, arg(metavar="all|NAMES", help_behavior_hint="")] = None
    """Find the base colours of all materials, or of the named ones."""
    exposure: Annotated[str | None, setting("STOPS|fit", "the cameras'")] = None
    """Set the exposure of the images in stops, or find it (fit)."""
    tone_map: Annotated[Literal["none", "neutral", "agx"], arg(metavar="NAME")] = "none"
    """Name the tone map that the images were made with: none, neutral or agx."""
    pipeline: Annotated[PipelineName | None, setting("NAME", "path")] = None
    """Render by raster, trace, hybrid or path."""
    samples: Annotated[int | None, setting("N", "64 with path")] = None
    """Average N samples per pixel, for each light."""
    shadows: Annotated[Literal["off", "hard", "soft"] | None, setting("off|hard|soft", "hard")] = None
    """Cast no, hard or soft shadows; path casts soft ones for hard, too."""
    size: Annotated[int, arg(metavar="PX")] = 128
    """Scale images to this longer side before comparing them."""

    def run(self) -> None:
        """Fits the lights, and writes the scene and the report."""
        if self.no_intensities and self.keep_hues:
            raise ls.ConfigError("--no-intensities keeps the intensities that --keep-hues finds: leave out one of them")
        scenes = [file for file in self.files if file.suffix.lower() not in _IMAGE_EXTENSIONS]
        images = [file for file in self.files if file.suffix.lower() in _IMAGE_EXTENSIONS]
        if not scenes or not images:
            missing = "scene" if not scenes else "image"
            raise ls.ConfigError(f"no {missing} given: lumisplat fit room.toml photo.jpg -o fitted.toml")
        self._check_output(images)
        cameras = self._cameras(camera_file(scenes), images)
        config = self._config(scene_settings(scene_file(scenes)))
        with progress_bars() as report:
            self.quiet_warp()
            document = ls.io.SceneDocument.open(scenes, partial(self.load_asset, report=report))
            if document.problems:
                raise ls.SceneError(document.problems[0])
            fit = ls.fit_lights(
                document.scene(),
                cameras,
                images,
                masks=list(self.mask) or None,
                environment_degree=self._degree(),
                intensities=not self.no_intensities,
                keep_hues=self.keep_hues,
                positions=self.positions,
                radii=self.radii,
                angles=self.angles,
                base_colors=self._base_colors(),
                exposure=self._exposure(),
                tone_map=self.tone_map,
                size=self.size,
                config=config,
                device=self.device,
                progress=report,
            )
            fitted, remarks = _fitted_document(document, fit, self.output)
            fitted.save(self.output, overwrite=self.overwrite)
            if self.report is not None:
                renderer = ls.create_renderer(replace(config, tone_map=ls.ToneMap(self.tone_map)), self.device)
                _write_report(self.report, fit, cameras, images, renderer)
        for line in (*fit.remarks, *remarks):
            _log.warning("%s", line)
        print_columns(*_light_rows(fit))
        residuals = ", ".join(f"{view.residual:.4f}" for view in fit.views)
        print(f"{self.output}: residual {residuals} (1 is white)")

    def _check_output(self, images: list[Path]) -> None:
        """Raises an error if scene file or report cannot be written or would replace an image, before the slow fit."""
        if self.output.suffix.lower() != ".toml":
            raise ls.FormatError(self.output, "is no .toml: the fitted scene is saved as .toml")
        if self.output.exists() and not self.overwrite:
            raise ls.FormatError(self.output, "already exists: choose another name, or give --overwrite")
        if self.output.is_dir():
            raise ls.FormatError(self.output, "is a folder, expected the name of a file to write")
        check_folder(_assets_of(self.output), self.output)
        if self.report is not None:
            check_report(self.report, images)

    def _cameras(self, file: Path | None, images: list[Path]) -> list[ls.Camera]:
        """Returns the camera of each image: named by ``--camera``, else by the image's file name, else the only one."""
        path = self.cameras or file
        if path is None:
            raise ls.ConfigError("no cameras given: --cameras FILE, or a scene.toml with cameras")
        known = ls.load_cameras(path)
        if not known:
            raise ls.FormatError(path, "has no cameras: add those of the images as [[cameras]], or give --cameras FILE")
        if self.camera and len(self.camera) != len(images):
            raise ls.ConfigError(
                f"--camera names {len(self.camera)} and there are {len(images)} images: name one for each"
            )
        if self.camera:
            return [_camera_named(path, known, name) for name in self.camera]
        if len(known) == len(images) == 1:
            return known
        return [_camera_named(path, known, image.stem) for image in images]

    def _config(self, base: ls.RenderConfig) -> ls.RenderConfig:
        """Returns the render settings of the fit: path tracing unless ``--pipeline`` is given, and no tone map."""
        config = replace(base, pipeline=ls.Pipeline(self.pipeline or "path"), samples=self.samples, tone_map="none")
        return self.changed(config if self.shadows is None else replace(config, shadows=ls.Shadows(self.shadows)))

    def _degree(self) -> int | Literal["auto"] | None:
        if self.environment_degree == "auto":
            return "auto"
        return None if self.environment_degree == "none" else int(self.environment_degree)

    def _base_colors(self) -> bool | list[str]:
        """Parses ``--base-colors``: True fits those of all materials, a list those of the named ones, False none."""
        if self.base_colors is None or self.base_colors == "all":
            return self.base_colors is not None
        names = [name.strip() for name in self.base_colors.split(",") if name.strip()]
        if not names:
            raise ls.ConfigError(f"--base-colors is '{self.base_colors}', expected all, or names with commas")
        return names

    def _exposure(self) -> float | Literal["fit"] | None:
        """Parses ``--exposure``: stops, ``fit`` to estimate them, or None to use the exposures of the cameras."""
        if self.exposure is None or self.exposure == "fit":
            return "fit" if self.exposure else None
        try:
            return float(self.exposure)
        except ValueError:
            raise ls.ConfigError(f"--exposure is '{self.exposure}', expected stops, or fit") from None


def _camera_named(path: Path, cameras: list[ls.Camera], name: str) -> ls.Camera:
    """Returns the camera whose name, with or without its file extension, is the given one.

    Args:
        path: File of the cameras, for the error message.
        cameras: All cameras of the file.
        name: Name as typed.
    """
    for camera in cameras:
        if name in (camera.name, Path(camera.name).stem):
            return camera
    listed = ", ".join(camera.name for camera in cameras[:8]) + (", ..." if len(cameras) > 8 else "")
    raise ls.ConfigError(f"{path} has no camera '{name}', only {listed}: give --camera NAME for each image")


def _fitted_document(
    document: ls.io.SceneDocument, fit: ls.inverse.LightFit, output: Path
) -> tuple[ls.io.SceneDocument, list[str]]:
    """Returns the document with the lights that were found, and warnings about base colours that it cannot store.

    An SH environment is written as ``NAME.assets/environment.exr``, and captures with new base colours beside it as
    ``.ply``.

    Args:
        document: Document of the fitted scene.
        fit: Result of the fit.
        output: The scene file to write.
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
    lights = [light for light in fit.lights if not isinstance(light, ls.LightEnvironment)]
    for light in ls.io.SceneDocument.of(ls.Scene(lights=lights)).entries:
        document, _ = document.added("lights", light.table)
    for light in fit.lights:
        if isinstance(light, ls.LightEnvironment):
            table: dict[str, Any] = _environment_table(light)
            if fit.environment is not None:
                image = {"path": _relative_name(document, _saved_environment(fit, output))}
            document, _ = document.added("environment", table | (image if light.image is not None else {}))
    return document, remarks


def _environment_table(light: ls.LightEnvironment) -> dict[str, Any]:
    """Returns the keys of a scene file's ``[environment]`` table for an environment; ``path`` is left to the caller."""
    (entry,) = ls.io.SceneDocument.of(ls.Scene(lights=[light])).entries
    return {key: value for key, value in entry.table.items() if key != "path"}


def _saved_environment(fit: ls.inverse.LightFit, output: Path) -> Path:
    """Writes the fitted SH environment as an .exr image in the assets folder, and returns its path."""
    assert fit.environment is not None
    path = _made_assets(output) / "environment.exr"
    fit.environment.save(path, rotation_wxyz=fit.scene.upright_wxyz, height=32)
    return path


def _assets_of(output: Path) -> Path:
    """Returns the path of the folder NAME.assets, for files to which the scene file NAME.toml refers."""
    return output.with_name(f"{output.stem}.assets").absolute()


def _relative_name(document: ls.io.SceneDocument, path: Path) -> str:
    """Returns how a document refers to a file: by its path from the document's folder, or absolute on another drive."""
    try:
        return Path(os.path.relpath(path, document.file.absolute().parent)).as_posix()
    except ValueError:
        return str(path)


def _made_assets(output: Path) -> Path:
    """Creates the folder NAME.assets beside a scene file if needed, and returns its path."""
    folder = _assets_of(output)
    make_folder(folder)
    return folder


def _with_captures(
    document: ls.io.SceneDocument, fit: ls.inverse.LightFit, output: Path
) -> tuple[ls.io.SceneDocument, list[str]]:
    """Writes each capture whose base colours were fitted as a .ply, and returns the document that refers to it.

    Also returns a warning for each such capture that is not a file of its own, whose colours are not written.
    """
    before, after = document.scene(), fit.scene
    entries = [document.owner(number) for number in range(len(before.splats))]
    changed = [n for n, (old, new) in enumerate(zip(before.splats, after.splats, strict=True)) if old is not new]
    stems = file_stems([Path(entries[number].table.get("path", "")).stem for number in changed])
    remarks: list[str] = []
    for number, stem in zip(changed, stems, strict=True):
        entry = entries[number]
        if entry.kind != "splats" or sum(one.id == entry.id for one in entries) > 1:
            remarks.append(f"{entry.name} is not a file of one capture: its colours are not written")
            continue
        path = _made_assets(output) / f"{stem}.ply"
        ls.save(path, after.splats[number].gaussians)
        document = document.changed(entry.id, path=_relative_name(document, path))
    return document, remarks


def _with_colors(document: ls.io.SceneDocument, fit: ls.inverse.LightFit) -> tuple[ls.io.SceneDocument, list[str]]:
    """Returns the document with the fitted base colours of meshes, and a warning for each that it cannot store."""
    before, after = document.scene(), fit.scene
    owned: dict[int, list[int]] = {}
    for number in range(len(before.meshes)):
        entry = document.owner(len(before.splats) + number)
        owned.setdefault(entry.id, []).append(number)
    remarks: list[str] = []
    for entry_id, numbers in owned.items():
        old = {before.meshes[number].mesh.material.mesh_color for number in numbers}
        new = {after.meshes[number].mesh.material.mesh_color for number in numbers}
        if old == new:
            continue
        entry = document.entry(entry_id)
        if len(new) > 1 or entry.kind != "meshes":
            remarks.append(
                f"{entry.name} has several materials, but its entry can hold one: its base colours are not written"
            )
            continue
        material = dict(document.material(entry_id)) | {"base_color": list(next(iter(new)))}
        document = document.changed(entry_id, material=material)
    return document, remarks


_WIDTH = 480
"""Largest width of the images in the report, pixels; wider ones are reduced."""


def _light_rows(fit: ls.inverse.LightFit) -> tuple[list[str], list[list[str]]]:
    """Returns header and rows of the table of fitted lights: power, position, standard errors, share of all light."""
    header = ["light", "red", "green", "blue", "+-", "position", "+-", "share"]
    rows: list[list[str]] = []
    for number, light in enumerate(fit.lights):
        power = _power(fit, number)
        position = getattr(light, "position", None)
        error = float(fit.position_errors[number].max())
        rows.append(
            [
                _name(fit, number),
                *(f"{x:.4g}" for x in power),
                f"{float(fit.standard_errors[number].max()):.2g}",
                "" if position is None else ", ".join(f"{x:z.4g}" for x in position),
                "" if math.isnan(error) else f"{error:.2g}",
                f"{fit.shares[number]:.1%}",
            ]
        )
    return header, rows


def _write_report(
    folder: Path,
    fit: ls.inverse.LightFit,
    cameras: Sequence[ls.Camera],
    images: Sequence[Path],
    renderer: ls.Renderer,
) -> None:
    """Writes report.json, and for each image a PNG with the image, the lit render and their difference.

    Raises:
        FormatError: A file cannot be written.
    """
    make_folder(folder)
    write_json(folder / "report.json", _figures(fit, images))
    stems = file_stems([image.stem for image in images])
    for view, camera, image, stem in zip(fit.views, cameras, images, stems, strict=True):
        width = min(camera.width, _WIDTH)
        shown = replace(camera.scaled(width), exposure=view.camera.exposure)
        frame = renderer.render(fit.scene, shown)
        write_comparison(folder / f"{stem}.png", [_image_and_frame(ls.load_image(image), frame)])


def _figures(fit: ls.inverse.LightFit, images: Sequence[Path]) -> dict[str, Any]:
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
        for path, view, stops in zip(images, fit.views, fit.exposures, strict=True)
    ]
    return {"lights": lights, "base_colors": fit.base_colors, "views": views, "remarks": list(fit.remarks)}


def _name(fit: ls.inverse.LightFit, number: int) -> str:
    return fit.lights[number].name or f"light{number}"


def _power(fit: ls.inverse.LightFit, number: int) -> list[float]:
    """Returns the linear RGB of a fitted light: colour times intensity, or mean radiance for an SH environment.

    Args:
        fit: Result of the fit.
        number: Index into ``fit.lights``; an SH environment is the last.
    """
    light = fit.lights[number]
    if fit.environment is not None and number == len(fit.lights) - 1:
        return [float(x) / (2.0 * math.sqrt(math.pi)) for x in fit.environment.coefficients[0]]
    return [float(channel * light.intensity) for channel in light.color]


def _image_and_frame(image: Any, frame: ls.Frame) -> tuple[Any, Any]:
    """Returns an image, resized to a frame's resolution, and the frame, as display colours 0..1, shape (H, W, 3)."""
    import numpy as np
    from PIL import Image

    picture = frame.pixels_srgb()[..., :3]
    height, width = picture.shape[:2]
    whole = Image.fromarray((255.0 * image + 0.5).astype(np.uint8)).resize((width, height), Image.Resampling.BOX)
    return np.asarray(whole, np.float32) / 255.0, picture
