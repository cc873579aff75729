"""``lumisplat render``: renders images of a scene."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.farm.job import FrameJob, FrameList, make_frames
from lumisplat.cli.farm.parts import Parts
from lumisplat.cli.input.loading import (
    BlockViews,
    block_views,
    camera_file,
    file_fingerprints,
    scene_file,
    scene_settings,
    warn_of_unused_cameras,
)
from lumisplat.cli.input.numbers import frame_numbers
from lumisplat.cli.options.camera import parse_up
from lumisplat.cli.options.command import Flag, ViewsCommand, given_settings, own_options_first, setting
from lumisplat.cli.options.frame import FrameCommand, frame_remarks, shared_provenance
from lumisplat.cli.output.console import FrameProgress, Report, counted, print_stats, progress_bars
from lumisplat.cli.output.frame_folder import FrameFolder
from lumisplat.cli.output.frame_source import REALTIME_FRAMES, FrameSource, WarmUp
from lumisplat.cli.output.images import (
    FORMATS,
    STANDARD_OUTPUT,
    FrameWriter,
    Layers,
    Shot,
    Views,
    check_writable,
    make_folder,
    plan_shots,
    refuse_standard_output,
    standard_output,
)

_log = logging.getLogger("lumisplat")

_STAMP = "render.json"
_PATH_FPS = 24.0
"""Frame rate of images along a camera path; ``orbit --camera-path`` has other rates."""
_NUMBERS = re.compile(r"[\d:x\s-]+")
_NOT_IN_PROVENANCE = ("output", "resume", "overwrite", "frames", "tiles", "debug", "stats", "device", "changes")
"""Options that do not change the content of an image, or that render.json stores in another form, such as --set."""


@dataclass(frozen=True)
class _ImageJob:
    """Scene, cameras, renderer and writer of the images of one command."""

    scene: ls.Scene
    shots: list[Shot]
    source: FrameSource
    writer: FrameWriter


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Render(ViewsCommand, FrameCommand):
    """Render a scene to images.

    Guide: docs/guide/captures.md, light.md, image_layers.md.
    First try: lumisplat render garden.ply -o garden.png
    """

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Read captures, meshes, glTF, OpenUSD, or a scene.toml; several make one scene."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")] = Path("out")
    """Write into this folder, or one image file; - is standard output."""
    cameras: Annotated[Path | None, setting("FILE", "the scene's, else the front")] = None
    """Render an image for each camera of this file."""
    frames: Annotated[str, setting("LIST", "all")] = ""
    """Render only these images, by name, or number from 0: 1-100, 1-100x2 (every second), 1,5,9."""
    format: Annotated[Literal["auto", "png", "exr", "npz"], arg(metavar="FORMAT")] = "auto"
    """Write png, exr or npz; auto follows the output's name; png in a folder."""
    aov: Annotated[str, arg(metavar="LAYERS", help_behavior_hint="")] = ""
    """Write layers too, such as depth,normal,cryptomatte,deep; an unknown name lists all."""
    view: Annotated[str, arg(metavar="VIEWS", help_behavior_hint="")] = ""
    """Write a layer in false colours: normal, depth, hits ...; or insets: color,depth,normal."""
    resume: Flag = False
    """Keep existing images that were rendered with the same settings."""
    tiles: Annotated[str, arg(metavar="GRID", help_behavior_hint="")] = ""
    """Render in parts: tiles (4x4, auto), blocks of 32 samples (samples), or both (4x4,samples)."""

    def run(self) -> None:
        """Renders and writes the images."""
        if self.output == STANDARD_OUTPUT:
            format_name = "png" if self.format == "auto" else self.format
            if self._layers.names and format_name == "png":
                raise ls.ConfigError(
                    "-o - is one file, but --aov writes more files beside a PNG: give --format exr or npz"
                )
            if self._layers.deep:
                raise ls.ConfigError("-o - is one file, but --aov deep writes another beside it: give -o a name")
            with standard_output(f".{format_name}") as file:
                replace(self, output=file).run()
            return
        if self.resume or self.tiles:
            with progress_bars() as report:
                job = self.open_frames(report)
                folder = replace(job.frames.folder, replace_hint="leave out --resume")
                job = replace(job, frames=replace(job.frames, folder=folder, resume_hint="with --resume"))
                lines = make_frames(job, report, overwrite=not self.resume, video=None, fewer="--frames")
            print(lines)
            return
        with progress_bars() as report:
            job = self._open(report)
            print(self._render(job, report))
        if job.writer.legend:
            print(job.writer.legend)

    def open_frames(self, report: Report) -> FrameJob:
        """Checks options and files, loads the scene, and returns images or parts of them with functions to make them.

        It is called for ``--resume``, ``--tiles`` and ``lumisplat farm render``.

        Args:
            report: Receives the progress.

        Raises:
            LumisplatError: An option or a file is wrong.
        """
        refuse_standard_output(self.output)
        if self._views.main:
            raise ls.ConfigError("--view colours all images by the first of a run, so existing ones would not match")
        tiles_text, splits_samples = self._parts
        if tiles_text:
            self._check_tiles()
        job = self._open(report)
        shots, folder = job.shots, job.shots[0].path.parent
        config, source = job.source.renderer.config, job.source
        frames = FrameList(
            folder=FrameFolder(folder, "", _STAMP, tuple(shot.path.name for shot in shots)),
            provenance=self._provenance(config, source.renderer.device),
            wanted=tuple(self._wanted(shots)),
            in_sequence=config.pipeline.is_sequence and self.camera_path is not None,
        )
        parts = Parts.of(shots, frames.wanted, self.output, _STAMP)
        if tiles_text:
            parts = parts.cut(tiles_text, has_layers=bool(self._layers.names))
        if splits_samples:
            parts = parts.split(ls.farm.sample_blocks(source.renderer, job.scene))
        if tiles_text or splits_samples:
            unit = "part" if splits_samples else "tile"
            frames = replace(frames, folder=parts.folder, wanted=parts.wanted, needs=parts.needs, unit=unit)
        elif folder != self.output:
            raise ls.ConfigError(f"-o {self.output} is one image, but there are several frames: give a folder")

        def write(made: ls.Frame | ls.farm.SamplePart, index: int) -> None:
            if isinstance(made, ls.farm.SamplePart):
                made.save(parts.folder.path(index))
            else:
                self._write(job, made, parts.shot(index))

        return FrameJob(
            frames=frames,
            render=lambda index, report: parts.make(source, job.scene, index, report),
            write=write,
            summarise=(lambda frame, _: print_stats(frame, config.pipeline))
            if self.stats and not splits_samples
            else None,
        )

    def _open(self, report: Report) -> _ImageJob:
        """Checks options and files, loads the scene, and starts the renderer."""
        writer = FrameWriter(self._layers.names, self._views)
        base = scene_settings(scene_file(self.scene))
        config = self.frame_config(base, {"aovs": (*base.aovs, *writer.aovs)})
        if config.pipeline.is_sequence and self.samples is not None:
            config = replace(config, samples=base.samples)  # --samples counts warm-up frames here
        # Cameras, environment and device can fail fast, so they come before large captures.
        cameras = self._cameras(camera_file(self.scene))
        shots = self._shots(cameras) if cameras else None
        check_writable(self.output)
        environment = self.light.environment_light()
        renderer = self.start_renderer(report, config, profile=self.stats)
        blocks = self._blocks(config, lit=environment is not None or self.light.shadow_catcher)
        scene = blocks.preview if blocks else self.load_scene(self.scene, report, given_up=parse_up(self.viewpoint.up))
        scene = self.light.lit_scene(scene, environment)
        config = self.light.with_capture_gain(renderer, config, scene)
        for line in frame_remarks(config, scene, dict(given_settings(self)), self.light, device=self.device):
            _log.warning("%s", line)
        shots = shots or self._shots([self.viewpoint_camera(scene, *self.scene)])
        if self.background and config.background is not None and shots[0].path.suffix.lower() == ".exr":
            _log.warning(
                "--background shows only in mirrors and glass: an EXR stores premultiplied colour and alpha, without a "
                "background"
            )
        return _ImageJob(scene, shots, self.frame_source(renderer, self._warm_up(), blocks), writer)

    def _blocks(self, config: ls.RenderConfig, *, lit: bool) -> BlockViews | None:
        """Returns a loader that, for each camera, loads the visible blocks of a folder of `lumisplat blocks`.

        None if the scene is loaded whole, because it is no such folder or an option needs all of it.
        """
        given = {
            "--aov deep": self._layers.deep,
            "--aov cryptomatte": self._layers.cryptomatte,
            "--tiles samples": self._parts[1],
            "--lod": self.chooses_level,
            "gaussian_index": "gaussian_index" in config.aovs,
        }
        whole = next((name for name, is_given in given.items() if is_given), "")
        return block_views(self.scene, config, self.lod_pixels, lit=lit, whole=whole, upright=self.viewpoint.upright)

    def _check_tiles(self) -> None:
        """Raises a ConfigError if ``--tiles`` is given with an option that needs the whole image, such as --denoise."""
        layers = self._layers
        given = {
            "--aov deep": layers.deep,
            "--aov cryptomatte": layers.cryptomatte,
            "--denoise": self.light.denoise,
            "--view": bool(self._views.insets),
        }
        if whole := " and ".join(name for name, is_given in given.items() if is_given):
            raise ls.ConfigError(f"{whole} and --tiles exclude each other: the former needs the whole image")

    @property
    def _layers(self) -> Layers:
        return Layers.of(self.aov)

    @property
    def _views(self) -> Views:
        return Views.of(self.view)

    @property
    def _parts(self) -> tuple[str, bool]:
        """Value of ``--tiles``: the grid such as ``4x4``, or empty text; and True if samples are rendered in blocks."""
        parts = [part.strip() for part in self.tiles.split(",")]
        return ",".join(part for part in parts if part != "samples"), "samples" in parts

    def _wanted(self, shots: list[Shot]) -> list[int]:
        """Returns the indices into ``shots`` of the images that ``--frames`` selects by name or number."""
        is_chosen = self._is_one_file or self._names([shot.camera for shot in shots])
        return frame_numbers("--frames", "" if is_chosen else self.frames, len(shots), self._unit)

    @property
    def _is_one_file(self) -> bool:
        """True if ``-o`` names an image file instead of a folder."""
        return self.output.suffix.lower().removeprefix(".") in FORMATS

    @property
    def _unit(self) -> str:
        return "camera" if self.camera_path is None else "frame"

    def _names(self, cameras: Sequence[ls.Camera]) -> list[str]:
        """Returns the camera names that ``--frames`` lists; empty if it lists numbers or is not given."""
        names = {camera.name for camera in cameras}
        parts = [part.strip() for part in self.frames.split(",") if part.strip()]
        is_named = any(
            not _NUMBERS.fullmatch(part) or (part.startswith("0") and part in names - {"0"}) for part in parts
        )
        return parts if is_named else []

    def _render(self, job: _ImageJob, report: Report) -> str:
        """Renders and writes the images; returns a summary line."""
        shots = [job.shots[index] for index in self._wanted(job.shots)]
        make_folder(shots[0].path.parent)
        with suppress(OSError):
            (shots[0].path.parent / _STAMP).unlink()  # the stamp no longer describes the images
        progress = FrameProgress(report, "rendering", len(shots), "--frames")
        frame: ls.Frame | None = None
        for shot in shots:
            frame = job.source.frame(job.scene, shot.camera, report)
            self._write(job, frame, shot)
            progress.add(frame)
        assert frame is not None
        if self.stats:
            print_stats(frame, job.source.renderer.config.pipeline)
        return _summary(shots, frame)

    def _provenance(self, config: ls.RenderConfig, device: str) -> dict[str, str]:
        """Returns everything that the images depend on, as text by name: version, device, settings, file fingerprints.

        A later run with ``--resume`` continues with existing images only if these values are equal.
        """
        files = [
            *self.scene,
            *(path for path in (self.cameras, self.camera_path, self.light.environment) if path is not None),
        ]
        own = {field.name: getattr(self, field.name) for field in fields(self) if field.name not in _NOT_IN_PROVENANCE}
        return {
            "lumisplat": ls.__version__,
            "device": device,
            **{name: f"{value}" for name, value in own.items() if not is_dataclass(value)},
            "split_samples": f"{self._parts[1]}",
            "scene": " ".join(map(str, self.scene)),
            **shared_provenance(self, config),
            **file_fingerprints(files, self.output),
        }

    def _write(self, job: _ImageJob, frame: ls.Frame, shot: Shot) -> None:
        """Writes an image with the layers of ``--aov``; deep samples first, as an existing image counts as finished."""
        if self._layers.deep:
            renderer = job.source.renderer
            camera = job.source.focused(job.scene, shot.camera)
            deep = ls.layers.render_deep(job.scene, camera, frame, renderer.config, device=renderer.device)
            deep.save(shot.path.with_suffix(".deep.exr"))
        mattes = self._mattes(job.scene, shot.camera, job.source.renderer)
        job.writer.write(frame, shot.path, mattes)

    def _mattes(self, scene: ls.Scene, camera: ls.Camera, renderer: ls.Renderer) -> ls.layers.Mattes | None:
        """Renders the Cryptomatte mattes of an image; None unless ``--aov`` lists cryptomatte."""
        if not self._layers.cryptomatte:
            return None
        return ls.layers.render_mattes(scene, camera, renderer.config, device=renderer.device)

    def _warm_up(self) -> WarmUp:
        """Returns how many realtime frames are rendered before one is kept: ``--samples``, else the default."""
        frames = self.samples if isinstance(self.samples, int) else REALTIME_FRAMES
        return WarmUp(frames=frames, each=self.camera_path is None)

    def _cameras(self, file: Path | None) -> list[ls.Camera]:
        """Returns the cameras of ``--camera-path``, ``--cameras`` or the scene file; an empty list without any.

        The caller then chooses a view of the scene.
        """
        if self.camera_path is None:
            if self.cameras is None and not self.viewpoint.is_given:
                warn_of_unused_cameras(self.scene)
            return self.load_cameras(self.cameras, file)
        along = self.load_camera_path(self.camera_path, self.cameras).frames(_PATH_FPS)
        return [self.light.exposed(camera.scaled(self.width, self.height)) for camera in along]

    def _shots(self, cameras: list[ls.Camera]) -> list[Shot]:
        """Returns the camera and the file path of each image to render."""
        names = self._names(cameras)
        if self._is_one_file and not names:
            cameras = [cameras[index] for index in frame_numbers("--frames", self.frames, len(cameras), self._unit)]
        shots = plan_shots(cameras, names, self.output, self.format)
        if self._views != Views() and shots[0].path.suffix.lower() != ".png":
            raise ls.ConfigError(f"{shots[0].path}: --view writes an image in colours, expected .png")
        if self._layers.cryptomatte and shots[0].path.suffix.lower() != ".exr":
            raise ls.ConfigError(
                f"{shots[0].path}: --aov cryptomatte needs an EXR: give -o NAME.exr, or a folder and --format exr"
            )
        return shots


def _summary(shots: list[Shot], frame: ls.Frame) -> str:
    """Returns a line about what was written: path, size and samples of the only image, or the count and folder.

    Args:
        shots: Camera and file of each image.
        frame: Last rendered frame.
    """
    first = shots[0]
    if len(shots) == 1:
        return f"{first.path} ({first.camera.width} x {first.camera.height}){_samples(frame)}"
    return f"{len(shots)} images in {first.path.parent}"


def _samples(frame: ls.Frame) -> str:
    """Returns samples and noise of a frame as text; empty unless a time or noise limit chose the sample count."""
    config, noise = frame.config, frame.stats.noise if frame.stats else None
    if config is None or (config.time_limit is None and config.noise is None) or not frame.samples:
        return ""
    return f", {counted(frame.samples, 'sample')}" + (f", noise {noise:.3f}" if noise is not None else "")
