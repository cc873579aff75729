"""``lumisplat evaluate``: how near a capture is to photographs that were held out."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import scene_file, scene_settings
from lumisplat.cli.options.command import DeviceCommand, LoadingCommand
from lumisplat.cli.options.settings import setting
from lumisplat.cli.output.comparisons import Comparison, compare, write_side_by_side
from lumisplat.cli.output.console import counted, print_columns, progress_bars
from lumisplat.cli.output.figures import cells, mean, plain
from lumisplat.cli.output.pictures import check_writable, file_stems, make_folder

_log = logging.getLogger("lumisplat")

_WORST = 3
"""How many of the worst views are named, and shown."""


@dataclass(frozen=True, kw_only=True)
class Evaluate(LoadingCommand, DeviceCommand):
    """Compare a capture with photographs that it has not learnt from.

    How near a trained capture is: lumisplat evaluate fox.ply fox -o report

    Photographs with a mask, and those of lenses that distort, are compared where their mask is at least half white:
    elsewhere the picture becomes the photograph, and means are over the rest.
    """

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE... FOLDER", help_behavior_hint="")]] = ()
    """A capture, or a scene.toml with settings of its own, and the folder of photographs: with transforms.json,
    transforms_train.json and transforms_test.json, or a sparse model of COLMAP."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="OUT", help_behavior_hint="")] = None
    """A folder for metrics.json, with the figures of all views, and for photograph, picture and difference (four times
    as strong) of the worst ones, side by side."""
    scale: Annotated[float, arg(metavar="0..1")] = 1.0
    """Size of the photographs, as a share of that of the files: that at which the capture was trained."""
    hold_out: Annotated[int, arg(metavar="N")] = 8
    """The first photograph by name and each Nth after it are compared; of Blender's sets those of transforms_test.json
    are."""
    pipeline: Annotated[Literal["raster", "trace"] | None, setting("{raster,trace}", "raster")] = None
    """What draws the capture: trace for a kernel degree other than 2, over photographs of lenses as they are."""
    projection: Annotated[Literal["ewa", "unscented"] | None, setting("{ewa,unscented}", "ewa")] = None
    """How Gaussians are rasterised: unscented, along the rays of lenses, whose photographs then stay as they are."""
    background: Annotated[str | None, setting("COLOR", "black")] = None
    """Behind the capture, and behind transparent photographs: a name such as white, #rrggbb, or r,g,b in 0..1."""

    def run(self) -> None:
        """Renders, compares, prints, and writes what is asked for."""
        if len(self.files) < 2:
            raise ls.ConfigError(f"{counted(len(self.files), 'file')} given, expected a capture and a folder")
        *scene_files, folder = self.files
        config = scene_settings(scene_file(scene_files))
        if self.background is not None:
            config = replace(config, background=self.background)  # pyright: ignore[reportArgumentType]
        if self.pipeline is not None:
            config = replace(config, pipeline=ls.Pipeline(self.pipeline))
        if self.projection is not None:
            config = replace(config, raster=replace(config.raster, projection=ls.Projection(self.projection)))
        if config.background is None:
            raise ls.ConfigError("--background is transparent, expected a colour over which pictures are compared")
        keeps_lenses = config.pipeline is ls.Pipeline.TRACE or config.raster.projection is ls.Projection.UNSCENTED
        if self.output is not None:
            check_writable(self.output)
        with progress_bars() as report:
            scene = self.load_scene(scene_files, report)
            views = self._views(folder, config.background, straighten=not keeps_lenses)
            scales = _common_scales(views)
            renderer = self.start_renderer(report, config)
            compared: list[Comparison] = []
            for index, view in enumerate(views):
                report("comparing", index / len(views))
                compared.append(compare(view, renderer.render(scene, view.camera), scales))
            report("comparing", 1.0)
        for problem in dict.fromkeys(problem for one in compared for problem in one.problems):
            _log.warning("%s", problem)
        means = {name: mean([one.figures[name] for one in compared]) for name in compared[0].figures}
        worst = sorted(compared, key=lambda one: one.figures["psnr"])[:_WORST]
        rows = [[f"mean of {counted(len(compared), 'view')}", *cells(means)]]
        print_columns(["", *means], rows + [[one.view.name, *cells(one.figures)] for one in worst])
        if self.output is None:
            return
        listed = [{"name": one.view.name, **plain(one.figures), "compared": one.share} for one in compared]
        _write_json(self.output, {"mean": plain(means), "views": listed, "ms_ssim_scales": scales, "scale": self.scale})
        for one, stem in zip(worst, file_stems([one.view.name for one in worst]), strict=True):
            write_side_by_side(one.view, renderer.render(scene, one.view.camera), self.output / f"{stem}.png")
        print(f"{self.output}: metrics.json, and the worst {counted(len(worst), 'view')} beside the photographs")

    def _views(
        self, folder: Path, background: tuple[float, float, float], *, straighten: bool
    ) -> Sequence[ls.Photograph]:
        """The photographs that are held out.

        Raises:
            ConfigError: None is.
            FormatError: The folder cannot be read.
        """
        photographs = ls.load_photographs(
            folder,
            scale=self.scale,
            hold_out=self.hold_out,
            background=background,
            straighten=straighten,
            allow_outside=self.allow_outside,
        )
        if not photographs.held_out:
            raise ls.ConfigError(f"--hold-out is {self.hold_out}: no photograph is left to compare, expected 2 or more")
        return photographs.held_out


def _common_scales(views: Sequence[ls.Photograph]) -> int:
    """How many scales of MS-SSIM suit all photographs; fewer than five are said."""
    smallest = min((view.camera for view in views), key=lambda camera: min(camera.width, camera.height))
    scales = ls.ms_ssim_scales(smallest.height, smallest.width)
    if 0 < scales < 5:
        size = f"{smallest.width} x {smallest.height}"
        _log.warning("ms-ssim has %d scales: photographs of %s pixels are too small for 5", scales, size)
    return max(1, scales)


def _write_json(folder: Path, content: Mapping[str, object]) -> None:
    """Writes metrics.json into a folder, which is made.

    Raises:
        FormatError: It cannot be written.
    """
    make_folder(folder)
    try:
        (folder / "metrics.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise ls.FormatError(folder / "metrics.json", f"cannot be written: {error.strerror or error}") from None
