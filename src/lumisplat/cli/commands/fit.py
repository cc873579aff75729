"""``lumisplat fit``: from a scene and photographs of it to the scene in the photographs' light."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

import lumisplat as ls
from lumisplat.cli.input.loading import scene_file, scene_settings
from lumisplat.cli.options.command import DeviceCommand, Flag, LoadingCommand
from lumisplat.cli.options.settings import PipelineName, SetCommand, setting
from lumisplat.cli.output.comparisons import check_report
from lumisplat.cli.output.console import print_columns, progress_bars
from lumisplat.cli.output.images import check_folder
from lumisplat.cli.output.light_reports import assets_of, fitted_document, light_rows, write_report

_log = logging.getLogger("lumisplat")

_PHOTOGRAPHS = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".hdr")


@dataclass(frozen=True, kw_only=True)
class Fit(LoadingCommand, DeviceCommand, SetCommand):
    """Find the lights of a scene from images of it.

    What is put into the scene then has the photograph's light: lumisplat fit room.toml photo.jpg --camera door
    -o fitted.toml

    Surfaces are known, and so are the lights' places unless --positions is given. Light bounces, as in reality: two
    lamps took half a minute on a CPU core, and with --positions four; fewer --samples and a smaller --size take less.
    """

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE PHOTO...", help_behavior_hint="")]] = ()
    """Read a scene, and images of it: .png, .jpg, .webp, .exr, .hdr."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")]
    """Write the scene with the lights that were found, as .toml."""
    overwrite: Flag = False
    """Replace OUT, which may be SCENE itself."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Read the images' cameras from this file."""
    camera: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = ()
    """Name the camera of the first image; again for the next."""
    mask: Annotated[UseAppendAction[tuple[Path, ...]], arg(metavar="FILE")] = ()
    """Use the pixels that are white in this mask; again for the next."""
    report: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Write images, renders, differences and report.json into this folder."""
    environment_degree: Annotated[Literal["auto", "none", "0", "1", "2", "3", "4"], arg(metavar="auto|none|0-4")] = (
        "auto"
    )
    """Set the SH degree of the environment; auto is 2."""
    no_intensities: Flag = False
    """Keep the lights' intensities and colours."""
    keep_hues: Flag = False
    """Keep the lights' colours, and find their intensities."""
    positions: Flag = False
    """Find positions of lights and directions of spots and suns; takes minutes."""
    radii: Flag = False
    """Find the radii of lights that have one."""
    angles: Flag = False
    """Find the cones of spots."""
    base_colors: Annotated[str | None, arg(metavar="all|NAMES", help_behavior_hint="")] = None
    """Find the base colours of all or of these materials."""
    exposure: Annotated[str | None, setting("STOPS|fit", "that of the cameras")] = None
    """Set the exposure of the images; fit finds it."""
    tone_map: Literal["none", "neutral", "agx"] = "none"
    """Set the tone map of the images."""
    pipeline: Annotated[PipelineName | None, setting("{raster,trace,hybrid,path}", "path")] = None
    """Choose how light is carried."""
    samples: Annotated[int | None, setting("N", "64 of paths")] = None
    """Average so many samples a pixel, for each light."""
    shadows: Annotated[Literal["off", "hard", "soft"] | None, setting("{off,hard,soft}", "hard")] = None
    """Cast these shadows, in pipelines other than path."""
    size: Annotated[int, arg(metavar="PX")] = 128
    """Compare images of this longer side."""

    def run(self) -> None:
        """Fits, writes, prints."""
        if self.no_intensities and self.keep_hues:
            raise ls.ConfigError("--no-intensities keeps what --keep-hues is to find: give one of them")
        scenes = [file for file in self.files if file.suffix.lower() not in _PHOTOGRAPHS]
        photographs = [file for file in self.files if file.suffix.lower() in _PHOTOGRAPHS]
        if not scenes or not photographs:
            missing = "scene" if not scenes else "photograph"
            raise ls.ConfigError(f"no {missing} given: lumisplat fit room.toml photo.jpg -o fitted.toml")
        self._check_output(photographs)
        file = scene_file(scenes)
        cameras = self._cameras(file, photographs)
        config = self._config(scene_settings(file))
        with progress_bars() as report:
            self.quiet_warp()
            document = ls.io.SceneDocument.open(scenes, partial(self.load_asset, report=report))
            if document.problems:
                raise ls.SceneError(document.problems[0])
            fit = ls.fit_lights(
                document.scene(),
                cameras,
                photographs,
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
            fitted, remarks = fitted_document(document, fit, self.output)
            fitted.save(self.output, overwrite=self.overwrite)
            if self.report is not None:
                renderer = ls.create_renderer(replace(config, tone_map=ls.ToneMap(self.tone_map)), self.device)
                write_report(self.report, fit, cameras, photographs, renderer)
        for line in (*fit.remarks, *remarks):
            _log.warning("%s", line)
        print_columns(*light_rows(fit))
        residuals = ", ".join(f"{view.residual:.4f}" for view in fit.views)
        print(f"{self.output}: residual {residuals} (1 is white)")

    def _check_output(self, photographs: list[Path]) -> None:
        """Refuses what cannot be written, before anything slow is done."""
        if self.output.suffix.lower() != ".toml":
            raise ls.FormatError(self.output, "is no .toml: the scene in the light that is found is saved as one")
        if self.output.exists() and not self.overwrite:
            raise ls.FormatError(self.output, "is there already: choose another name, or give --overwrite")
        if self.output.is_dir():
            raise ls.FormatError(self.output, "is a folder, expected the name of a file to write")
        check_folder(assets_of(self.output), self.output)
        if self.report is not None:
            check_report(self.report, photographs)

    def _cameras(self, file: Path | None, photographs: list[Path]) -> list[ls.Camera]:
        """The camera of each photograph.

        Raises:
            ConfigError: There are none, or it is not clear which.
        """
        path = self.cameras or file
        if path is None:
            raise ls.ConfigError("no cameras given: --cameras FILE, or a scene.toml with cameras")
        known = ls.load_cameras(path)
        if not known:
            raise ls.FormatError(
                path, "has no cameras: say by [[cameras]], or by --cameras FILE, who took the photographs"
            )
        if self.camera and len(self.camera) != len(photographs):
            raise ls.ConfigError(
                f"--camera names {len(self.camera)} and there are {len(photographs)} photographs: name one for each"
            )
        if self.camera:
            return [_named(path, known, name) for name in self.camera]
        if len(known) == len(photographs) == 1:
            return known
        return [_named(path, known, photograph.stem) for photograph in photographs]

    def _config(self, base: ls.RenderConfig) -> ls.RenderConfig:
        """How light behaves: by paths, unless another pipeline is given."""
        config = replace(base, pipeline=ls.Pipeline(self.pipeline or "path"), samples=self.samples, tone_map="none")
        return self.changed(config if self.shadows is None else replace(config, shadows=ls.Shadows(self.shadows)))

    def _degree(self) -> int | Literal["auto"] | None:
        if self.environment_degree == "auto":
            return "auto"
        return None if self.environment_degree == "none" else int(self.environment_degree)

    def _base_colors(self) -> bool | list[str]:
        """Those that were asked for.

        Raises:
            ConfigError: No name was given.
        """
        if self.base_colors is None or self.base_colors == "all":
            return self.base_colors is not None
        names = [name.strip() for name in self.base_colors.split(",") if name.strip()]
        if not names:
            raise ls.ConfigError(f"--base-colors is '{self.base_colors}', expected all, or names with commas")
        return names

    def _exposure(self) -> float | Literal["fit"] | None:
        """The exposure that was given.

        Raises:
            ConfigError: It is neither stops nor "fit".
        """
        if self.exposure is None or self.exposure == "fit":
            return "fit" if self.exposure else None
        try:
            return float(self.exposure)
        except ValueError:
            raise ls.ConfigError(f"--exposure is '{self.exposure}', expected stops, or fit") from None


def _named(path: Path, cameras: list[ls.Camera], name: str) -> ls.Camera:
    """The camera of a name, or of an image of that name.

    Raises:
        ConfigError: There is none.
    """
    for camera in cameras:
        if name in (camera.name, Path(camera.name).stem):
            return camera
    listed = ", ".join(camera.name for camera in cameras[:8]) + (", ..." if len(cameras) > 8 else "")
    raise ls.ConfigError(f"{path} has no camera '{name}', only {listed}: give --camera NAME for each photograph")
