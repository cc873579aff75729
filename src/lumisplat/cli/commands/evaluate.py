"""``lumisplat evaluate``: compares a capture with held-out images."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import scene_file, scene_settings
from lumisplat.cli.options.command import DeviceCommand, Flag, LoadingCommand, own_options_first, setting
from lumisplat.cli.output.comparisons import (
    Comparison,
    Figures,
    cells,
    check_report,
    compare,
    mean,
    plain,
    write_comparison,
    write_json,
    write_view_comparison,
)
from lumisplat.cli.output.console import Report, counted, print_columns, progress_bars
from lumisplat.cli.output.images import check_folder, file_stems, make_folder

_log = logging.getLogger("lumisplat")

_HOLD_OUT = 8
"""Default of ``--hold-out``: every eighth image is evaluated and was not trained on."""
_WORST = 3
"""Number of views with the worst metrics that the report lists and writes as images."""


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Evaluate(LoadingCommand, DeviceCommand):
    """Compare a capture with held-out images.

    Only pixels where an image's mask is at least half white are compared.
    With --materials, the folder is a data set with ground-truth materials (docs/guide/materials.md).
    With --protocol, it is an object of a published benchmark (docs/guide/published_sets.md).
    Guide: docs/guide/evaluate.md, metrics.md.
    First try: lumisplat evaluate fox.ply fox -o report
    """

    files: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE... FOLDER", help_behavior_hint="")]] = ()
    """Read a capture, and a folder of images with poses."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="OUT", help_behavior_hint="")] = None
    """Write metrics.json and the worst views into this folder."""
    scale: Annotated[float, arg(metavar="0..1", help_behavior_hint="(default: 1)")] = 1.0
    """Scale the images by this factor, above 0 and at most 1."""
    hold_out: Annotated[int, arg(metavar="N")] = _HOLD_OUT
    """Compare the images that train --hold-out N holds out: every N-th, or test images."""
    pipeline: Annotated[Literal["raster", "trace", "hybrid", "path"] | None, setting("NAME", "raster")] = None
    """Render by raster or trace; with --materials or --protocol, also hybrid or path."""
    projection: Annotated[Literal["ewa", "unscented"] | None, setting("NAME", "ewa")] = None
    """Rasterise as ellipses (ewa), or along the rays of any lens (unscented)."""
    background: Annotated[str | None, setting("COLOR", "black")] = None
    """Fill transparent parts of images and renders: a name, #rrggbb, or r,g,b in 0..1."""

    materials: Flag = False
    """Compare materials and relit images with the ground truth in the folder."""
    environment: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """With --materials: read the estimated environment from this .exr or .hdr, else NAME.environment.exr."""
    samples: Annotated[int | None, setting("N", "64")] = None
    """With --materials or --protocol: average N samples per pixel in relit images."""
    denoise: Flag = False
    """With --materials or --protocol: denoise relit images; needs pip install 'lumisplat[denoise]'."""

    protocol: Annotated[
        Literal["tensoir", "synthetic4relight", "orb", "nerf-synthetic"] | None,
        arg(metavar="NAME", help_behavior_hint=""),
    ] = None
    """Score by a benchmark's rules: tensoir, synthetic4relight, orb, nerf-synthetic; without a capture, train one."""
    lights: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """With --protocol: read the environments of relit images from this folder."""

    def run(self) -> None:
        """Renders and compares, prints a table, and writes a report if asked."""
        if self.denoise:
            ls.Frame.check_denoiser()
        if self.protocol is not None:
            self._compare_published(ls.inverse.Benchmark(self.protocol))
            return
        if self.lights is not None:
            raise ls.ConfigError("--lights needs --protocol")
        if len(self.files) < 2:
            raise ls.ConfigError(f"{counted(len(self.files), 'file')} given, expected a capture and a folder")
        *captures, folder = self.files
        if self.materials:
            self._compare_materials(captures, folder)
        else:
            self._compare_views(captures, folder)

    def _compare_views(self, scene_files: Sequence[Path], folder: Path) -> None:
        """Renders and compares the held-out views, prints a table, and writes a report if asked."""
        if self.environment or self.samples is not None or self.denoise or self.pipeline in ("hybrid", "path"):
            raise ls.ConfigError(
                "--environment, --samples, --denoise and the pipelines hybrid and path need --materials or --protocol"
            )
        config = scene_settings(scene_file(scene_files))
        if self.background is not None:
            config = replace(config, background=self.background)  # pyright: ignore[reportArgumentType]
        if self.pipeline is not None:
            config = replace(config, pipeline=ls.Pipeline(self.pipeline))
        if self.projection is not None:
            config = replace(config, raster=replace(config.raster, projection=ls.config.Projection(self.projection)))
        if config.background is None:
            raise ls.ConfigError("--background is transparent, expected a colour behind the compared images")
        keeps_lenses = not config.pipeline.rasterises or config.raster.projection is ls.config.Projection.UNSCENTED
        if self.output is not None:
            check_folder(self.output)
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
        make_folder(self.output)
        write_json(
            self.output / "metrics.json",
            {"mean": plain(means), "views": listed, "ms_ssim_scales": scales, "scale": self.scale},
        )
        for one, stem in zip(worst, file_stems([one.view.name for one in worst]), strict=True):
            write_view_comparison(one.view, renderer.render(scene, one.view.camera), self.output / f"{stem}.png")
        print(f"{self.output}: metrics.json, and images of the worst {counted(len(worst), 'view')}")

    def _compare_materials(self, captures: Sequence[Path], folder: Path) -> None:
        """Compares materials and environment with the ground truth, prints a table, and writes a report if asked."""
        if (
            self.scale != 1.0
            or self.hold_out != _HOLD_OUT
            or self.projection is not None
            or self.background is not None
        ):
            raise ls.ConfigError("--scale, --hold-out, --projection and --background cannot be used with --materials")
        if len(captures) != 1:
            raise ls.ConfigError(f"{counted(len(captures), 'capture')} given, expected one with --materials")
        if self.output is not None:
            inside = self.output.resolve().is_relative_to(folder.resolve())
            check_report(self.output, _files_of(ls.io.load_training_images(folder)) if inside else ())
        found = self.environment or captures[0].with_suffix(".environment.exr")
        light = ls.io.load_radiance(found) if self.environment or found.is_file() else None
        config = None if self.pipeline is None else ls.RenderConfig(pipeline=ls.Pipeline(self.pipeline))
        with progress_bars() as report:
            self.quiet_warp()
            result = ls.inverse.evaluate_materials(
                self._capture(captures[0], report),
                folder,
                environment=light,
                config=config,
                samples=self.samples,
                denoise=self.denoise,
                device=self.device,
                progress=report,
            )
        for line in result.remarks:
            _log.warning("%s", line)
        print_columns(*_figure_rows(result))
        if self.output is not None:
            _write_material_report(self.output, result)
            print(f"{self.output}: metrics.json, and images of the worst views: estimate, truth and difference")

    def _capture(self, path: Path, report: Report) -> ls.Gaussians:
        """Loads a capture, and refuses other files."""
        capture = self.load_asset(path, report)
        if not isinstance(capture, ls.Gaussians):
            raise ls.FormatError(path, "is not a capture, expected Gaussians")
        return capture

    def _compare_published(self, benchmark: ls.inverse.Benchmark) -> None:
        """Scores a capture by the rules of a published benchmark, and trains it first if none is given."""
        if self.materials or self.environment or self.projection is not None or self.background is not None:
            raise ls.ConfigError("--materials, --environment, --projection and --background exclude --protocol")
        if self.scale != 1.0 or self.hold_out != _HOLD_OUT:
            raise ls.ConfigError("--scale and --hold-out exclude --protocol: the benchmark says which images count")
        if not 1 <= len(self.files) <= 2:
            raise ls.ConfigError(f"{counted(len(self.files), 'file')} given, expected a capture and a folder")
        *captures, folder = self.files
        if not captures and self.output is None:
            raise ls.ConfigError("without a capture, one is trained: -o OUT says where it is written")
        if self.output is not None:
            check_folder(self.output)
        ls.inverse.check_published(folder, benchmark, self.lights)
        seconds: float | None = None
        if captures:
            file = captures[0]
        else:
            assert self.output is not None
            file, seconds = self._trained(folder, benchmark, self.output)
        config = None  # paths, with settings that suit these sets
        if self.pipeline not in (None, "path"):
            config = ls.RenderConfig(pipeline=ls.Pipeline(self.pipeline))
        with progress_bars() as report:
            self.quiet_warp()
            result = ls.inverse.evaluate_published(
                self._capture(file, report),
                folder,
                benchmark,
                lights=self.lights,
                config=config,
                samples=self.samples,
                denoise=self.denoise,
                device=self.device,
                progress=report,
            )
        for line in result.remarks:
            _log.warning("%s", line)
        rows = [
            [_published_label(name), _number(value, 4 if value < 2.0 else 2)] for name, value in result.figures.items()
        ]
        if seconds is not None:
            rows.append(["training, seconds", f"{seconds:.0f}"])
        print_columns([f"{result.views} views", self.protocol or ""], rows)
        if self.output is not None:
            make_folder(self.output)
            figures = plain(dict(result.figures)) | {"albedo_scale": list(result.albedo_scale), "seconds": seconds}
            write_json(self.output / "metrics.json", {"protocol": self.protocol, "figures": figures})
            print(f"{self.output}: metrics.json")

    def _trained(self, folder: Path, benchmark: ls.inverse.Benchmark, output: Path) -> tuple[Path, float]:
        """Trains a capture by the defaults of ``train --relightable``; returns its file, and the seconds it took."""
        from lumisplat.cli.commands.train import Train

        images = folder
        if benchmark is ls.inverse.Benchmark.ORB:
            images = ls.inverse.write_orb_images(folder, output / "images")
        started = time.monotonic()
        command = Train(
            folder=images,
            output=output / f"{folder.resolve().name}.ply",
            hold_out=0,
            relightable=benchmark is not ls.inverse.Benchmark.NERF_SYNTHETIC,
            device=self.device,
        )
        command.run()
        return command.output, time.monotonic() - started

    def _views(
        self, folder: Path, background: tuple[float, float, float], *, straighten: bool
    ) -> Sequence[ls.io.TrainingImage]:
        """Returns the held-out images, whose views are rendered and compared.

        Args:
            folder: Folder of images with poses.
            background: RGB behind transparent parts of the images; rendered frames have the same background.
            straighten: True removes lens distortion from images and cameras.
        """
        images = ls.io.load_training_images(
            folder,
            scale=self.scale,
            hold_out=self.hold_out,
            background=background,
            straighten=straighten,
            allow_outside=self.allow_outside,
        )
        if not images.held_out:
            raise ls.ConfigError(f"--hold-out is {self.hold_out}: no image is left to compare, expected 2 or more")
        if self.output is not None:
            check_report(self.output, _files_of(images))
        return images.held_out


def _files_of(images: ls.io.TrainingImages) -> list[Path]:
    """Returns the paths of all images of a data set, training and held-out; their file names may repeat."""
    return [view.path for view in (*images.training, *images.held_out)]


def _common_scales(views: Sequence[ls.io.TrainingImage]) -> int:
    """Returns the number of scales for MS-SSIM, at most five, that the smallest image allows; logs if below five."""
    smallest = min((view.camera for view in views), key=lambda camera: min(camera.width, camera.height))
    scales = ls.metrics.ms_ssim_scales(smallest.height, smallest.width)
    if 0 < scales < 5:
        size = f"{smallest.width} x {smallest.height}"
        _log.warning("ms-ssim has %d scales: images of %s pixels are too small for 5", scales, size)
    return max(1, scales)


_PUBLISHED = {
    "novel": "novel views",
    "normal_mae": "normals, mean error of the image, degrees",
    "normal_mae_object": "normals, mean error of the object, degrees",
    "normal_cosine": "normals, cosine distance",
    "roughness_mse": "roughness, mean squared error",
    "psnr_h": "PSNR-H, dB",
    "psnr_l": "PSNR-L, dB",
    "psnr": "PSNR, dB",
    "ssim": "SSIM",
}
"""Words of the table for the names of figures, and for their parts."""


def _published_label(name: str) -> str:
    """Returns the words for a figure such as ``relit_psnr/city``: relit in city, PSNR, dB."""
    name, _, light = name.partition("/")
    if name in _PUBLISHED:
        return _PUBLISHED[name]
    what, _, metric = name.partition("_")
    return f"{_PUBLISHED.get(what, what)}{f' in {light}' if light else ''}, {_PUBLISHED.get(metric, metric)}"


_FIGURES = {
    "albedo_psnr": ("albedo, scaled per channel", "dB", 2),
    "albedo_psnr_unscaled": ("albedo, unscaled", "dB", 2),
    "normal_mean": ("normals, mean", "degrees", 2),
    "normal_median": ("normals, median", "degrees", 2),
    "roughness_rmse": ("roughness, rmse", "", 4),
    "environment_psnr": ("environment, scaled per channel", "dB", 2),
}
"""Label, unit and number of decimals with which the table shows each metric, by metric name."""
_VIEW_FIGURES = (
    "coverage",
    "albedo_psnr",
    "albedo_psnr_unscaled",
    "albedo_psnr_linear",
    "normal_mean",
    "normal_median",
    "roughness_rmse",
)


def _figure_rows(result: ls.inverse.MaterialEvaluation) -> tuple[list[str], list[list[str]]]:
    """Returns the header and the rows of the table of material metrics."""
    rows: list[list[str]] = []
    for name, (label, unit, digits) in _FIGURES.items():
        rows.append([label, _number(getattr(result, name), digits), unit])
    for name, figures in result.relit.items():
        rows.append([f"relit in {name}, psnr", _number(figures.psnr, 2), "dB"])
        rows.append([f"relit in {name}, ssim", _number(figures.ssim, 4), ""])
        rows.append([f"relit in {name}, flip", _number(figures.flip, 4), ""])
    rows.append(["scale of albedo", " ".join(f"{factor:.3f}" for factor in result.albedo_scale), "red green blue"])
    return [f"{len(result.views)} views", "figure", ""], rows


def _write_material_report(folder: Path, result: ls.inverse.MaterialEvaluation) -> None:
    """Writes metrics.json, and for each of the worst views an image that compares estimates with the ground truth."""
    overall: Figures = {name: getattr(result, name) for name in (*_FIGURES, "albedo_psnr_linear")}
    figures = plain(overall) | {"relit": _relit(result.relit), "albedo_scale": list(result.albedo_scale)}
    views = [
        {"name": view.name, **plain({name: getattr(view, name) for name in _VIEW_FIGURES}), "relit": _relit(view.relit)}
        for view in result.views
    ]
    make_folder(folder)
    write_json(folder / "metrics.json", {"all": figures, "views": views, "remarks": list(result.remarks)})
    worst = sorted(result.views, key=_quality)[:_WORST]
    for view, stem in zip(worst, file_stems([view.name for view in worst]), strict=True):
        write_comparison(folder / f"{stem}.png", list(view.pictures.values()))


def _quality(view: ls.inverse.MaterialView) -> float:
    """Returns a number that is larger for better views: PSNR of relit images, else of albedo, else -normal error."""
    relit = mean([figures.psnr for figures in view.relit.values()])
    others = [value for value in (relit, view.albedo_psnr, -view.normal_mean) if not math.isnan(value)]
    return others[0] if others else 0.0


def _relit(relit: Mapping[str, ls.inverse.RelitFigures]) -> dict[str, dict[str, float | str | None]]:
    return {name: plain(figures._asdict()) for name, figures in relit.items()}


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
