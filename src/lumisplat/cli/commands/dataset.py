"""``lumisplat dataset``: renders random views of a scene in random light, as training data."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.farm.job import FrameJob, FrameList, make_frames
from lumisplat.cli.input.loading import camera_file, file_fingerprints, scene_file, scene_settings
from lumisplat.cli.input.numbers import frame_numbers
from lumisplat.cli.options.camera import parse_up
from lumisplat.cli.options.command import (
    Flag,
    InsertingCommand,
    given_options,
    given_settings,
    own_options_first,
    setting,
    without_none,
)
from lumisplat.cli.options.frame import FrameCommand, frame_remarks, shared_provenance
from lumisplat.cli.output.console import Report, counted, print_stats, progress_bars
from lumisplat.cli.output.frame_folder import FrameFolder, flat_settings
from lumisplat.cli.output.frame_source import FrameSource
from lumisplat.cli.output.images import check_folder, refuse_standard_output

_log = logging.getLogger("lumisplat")

_NOT_IN_PROVENANCE = ("views", "shard_views")
"""Settings that do not change the content of a view, so that a run with other values continues with existing views."""


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Dataset(FrameCommand, InsertingCommand):
    """Render training data: random views, light and objects.

    The same command continues after an interruption; a larger --views adds to the existing views.
    Guide: docs/guide/dataset.md.
    First try: lumisplat dataset garden.ply --views 20 -o set
    """

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Read captures, meshes or a scene.toml; several make one scene."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="DIR")] = Path("dataset")
    """Write images, layers, transforms.json and dataset.json into this folder."""
    file: Annotated[Path | None, arg(name="settings", metavar="FILE.toml", help_behavior_hint="")] = None
    """Read settings of poses, lights and objects from this file."""
    views: Annotated[int | None, setting("N", "100")] = None
    """Render N views."""
    width: Annotated[int | None, setting("PX", "640")] = None
    """Set the image width."""
    height: Annotated[int | None, setting("PX", "480")] = None
    """Set the image height."""
    layers: Annotated[str | None, setting("LAYERS", "depth,normal,instance")] = None
    """Write these layers too: depth, normal, albedo, alpha, mask, instance, category, exr; or none."""
    objects: Annotated[tuple[Path, ...], arg(metavar="FILE...", help_behavior_hint="")] = ()
    """Insert a random selection of these captures and meshes into each view."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Place views near the cameras of this file instead of around the scene."""
    seed: Annotated[int | None, setting("N", "0")] = None
    """Set the random seed of poses, lights, objects and noise."""
    shards: Annotated[int | None, setting("N", "0")] = None
    """Pack the views into WebDataset shards of N views; 0 writes no shards."""
    frames: Annotated[str, setting("LIST", "all")] = ""
    """Render only these views, numbered from 0: 1-100, 1-100x2 (every second), 1,5,9, 48:."""
    overwrite: Flag = False
    """Delete the existing views before rendering."""

    def run(self) -> None:
        """Renders the missing views, then writes transforms.json and the other files that list all views."""
        with progress_bars() as report:
            job = self.open_frames(report)
            lines = make_frames(job, report, overwrite=self.overwrite, video=None, fewer="--views")
        print(lines)
        self.finish()

    def settings(self) -> ls.config.DatasetConfig:
        """Returns the settings of the ``--settings`` file, changed by the command's options.

        Raises:
            ConfigError: A value is out of range, or options exclude each other.
            FormatError: The file cannot be read, or a setting is wrong.
        """
        refuse_standard_output(self.output)
        single = given_options(self.viewpoint)
        single = [option for option in single if option not in ("--up", "--aperture", "--focus")]
        single += ["--camera-path"] * (self.camera_path is not None)
        if single:
            raise ls.ConfigError(
                f"{single[0]} sets one camera, but views are random: set [poses] in the file of --settings"
            )
        config = ls.config.DatasetConfig() if self.file is None else ls.io.load_dataset_config(self.file)
        given = {
            "views": self.views,
            "seed": self.seed,
            "width": self.width,
            "height": self.height,
            "layers": None if self.layers is None else self.layers.replace("none", ""),
            "shard_views": self.shards,
        }
        config = replace(config, **without_none(given))
        if self.objects:
            for path in self.objects:
                if not path.exists():
                    raise ls.errors.MissingFileError(path, "no such file")
            config = replace(config, objects=replace(config.objects, files=tuple(map(str, self.objects))))
        if self.cameras is not None:
            config = replace(config, poses=replace(config.poses, where=ls.config.PosePlaces.CAMERAS))
        return config

    def open_frames(self, report: Report) -> FrameJob:
        """Checks options and files, loads the scene, and returns the views with functions that make them.

        Args:
            report: Receives the progress.

        Raises:
            LumisplatError: An option or a file is wrong.
        """
        settings = self.settings()
        names = tuple(f"views/view_{index:06d}.json" for index in range(settings.views))
        wanted = tuple(frame_numbers("--frames", self.frames, settings.views, "view"))
        base = scene_settings(scene_file(self.scene))
        albedo = ("albedo",) if "albedo" in settings.layers else ()
        config = self.frame_config(base, {"aovs": (*base.aovs, *albedo)}, without_none({"seed": self.seed}))
        if config.pipeline.is_sequence:
            raise ls.ConfigError(
                "--pipeline realtime needs consecutive frames, but views are unrelated: use --pipeline path or hybrid"
            )
        cameras = self._cameras(settings)
        check_folder(self.output)
        environment = self.light.environment_light()
        renderer = self.start_renderer(report, config, profile=self.stats)
        scene = self.load_scene(self.scene, report, given_up=parse_up(self.viewpoint.up))
        scene = self.light.lit_scene(scene, environment)
        views = ls.dataset.DatasetViews(
            scene,
            settings,
            cameras=cameras,
            load=lambda path: self.load_asset(path, report),
            device=renderer.device,
        )
        if albedo and not (views.are_lit if config.lighting is None else config.lighting):
            raise ls.ConfigError("--layers has albedo, which only lit views have: give lights, or --lighting on")
        given = {name: option for name, option in given_settings(self) if name != "seed"}  # poses always use the seed
        for line in frame_remarks(config, views.view(wanted[0]).scene, given, self.light, device=self.device):
            _log.warning("%s", line)
        maker = _ViewMaker(self, views, self.frame_source(renderer))
        return FrameJob(
            frames=FrameList(
                folder=FrameFolder(self.output, "json", "dataset.json", names),
                provenance=self._provenance(settings, config, renderer.device),
                wanted=wanted,
                unit="view",
            ),
            render=maker.render,
            write=maker.write,
            summarise=(lambda frame, _: print_stats(frame, config.pipeline)) if self.stats else None,
        )

    def finish(self) -> None:
        """Writes transforms.json, shards and the contact sheet if all views exist, and prints a summary."""
        summary = ls.dataset.finish_dataset(self.output, self.settings())
        if summary.missing:
            are, them = ("is", "it") if summary.missing == 1 else ("are", "them")
            print(f"{counted(summary.missing, 'view')} {are} missing: the same command without --frames makes {them}")
            return
        if summary.left_out:
            _log.warning(
                "%s did not fit into views of %s: views/*.json list them as left_out",
                counted(summary.left_out, "object"),
                self.output,
            )
        shards = f", {counted(len(summary.shards), 'shard')}" * bool(summary.shards)
        print(
            f"{self.output / 'transforms.json'}: {summary.train} for training, {summary.val} for validation and "
            f"{summary.test} for testing{shards}; {self.output / 'contact_sheet.png'} shows the first"
        )

    def _cameras(self, settings: ls.config.DatasetConfig) -> list[ls.Camera]:
        """Returns the cameras of ``--cameras``, near which views are placed; empty if views surround the scene."""
        if settings.poses.where is not ls.config.PosePlaces.CAMERAS:
            return []
        cameras = self.load_cameras(self.cameras, camera_file(self.scene))
        if not cameras:
            raise ls.ConfigError("views near cameras need cameras: give --cameras FILE")
        return cameras

    def _provenance(self, settings: ls.config.DatasetConfig, config: ls.RenderConfig, device: str) -> dict[str, str]:
        """Returns everything that the views depend on, as text by name: version, device, settings, file fingerprints.

        A later run continues with existing views only if these values are equal.
        """
        # The settings file itself is left out: `settings` has its values, and some of them do not affect views.
        files = [*self.scene, *(path for path in (self.cameras, self.light.environment) if path is not None)]
        files += [Path(name) for name in (*settings.objects.files, *settings.lights.environments)]
        return {
            "lumisplat": ls.__version__,
            "device": device,
            "scene": " ".join(map(str, self.scene)),
            "drop_invalid": f"{self.drop_invalid}",
            **{
                name: value
                for name, value in flat_settings("dataset.", settings)
                if name.removeprefix("dataset.") not in _NOT_IN_PROVENANCE
            },
            **shared_provenance(self, config),
            **file_fingerprints(files, self.output),
        }


class _ViewMaker:
    """Renders and writes the views of a data set.

    Args:
        command: Command with the options.
        views: Views of the data set.
        source: Renders the frames.
    """

    def __init__(self, command: Dataset, views: ls.dataset.DatasetViews, source: FrameSource) -> None:
        self._command, self._views, self._source = command, views, source
        self._view: ls.dataset.DatasetView | None = None

    def render(self, index: int, report: Report) -> ls.Frame:
        """Renders the view of a number: its random camera, lights and objects."""
        view = self._views.view(index)
        self._view = replace(view, camera=self._exposed(view.camera))
        return self._source.frame(view.scene, self._view.camera, report)

    def write(self, frame: ls.Frame, index: int) -> None:
        """Writes the images and layers of the view that `render` has rendered last."""
        assert self._view is not None and self._view.index == index
        self._views.save(self._view, frame, self._command.output)

    def _exposed(self, camera: ls.Camera) -> ls.Camera:
        """Returns the camera with its own exposure plus ``--exposure``, stops."""
        more = self._command.light.exposure
        return camera if more is None else replace(camera, exposure=camera.exposure + more)
