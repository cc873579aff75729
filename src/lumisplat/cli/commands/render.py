"""``lumisplat render``: pictures of a scene."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

import lumisplat as ls
from lumisplat.cli.farm.alone import make_alone
from lumisplat.cli.farm.job import FrameJob, FrameList
from lumisplat.cli.farm.samples import SharedSamples
from lumisplat.cli.farm.tiles import Tiles
from lumisplat.cli.input.block_views import BlockViews, block_views
from lumisplat.cli.input.file_marks import file_marks
from lumisplat.cli.input.loading import scene_file, scene_settings
from lumisplat.cli.input.numbers import frame_numbers
from lumisplat.cli.options.command import Flag, ViewsCommand
from lumisplat.cli.options.frame import FrameCommand, shared_origin
from lumisplat.cli.options.remarks import frame_remarks
from lumisplat.cli.options.settings import Changes, given_options, setting, without_none
from lumisplat.cli.options.unused import not_used
from lumisplat.cli.options.up import parse_up
from lumisplat.cli.output.console import Report, counted, progress_bars
from lumisplat.cli.output.frame_folder import FrameFolder
from lumisplat.cli.output.frame_progress import FrameProgress
from lumisplat.cli.output.frame_source import FrameSource, WarmUp
from lumisplat.cli.output.frame_writer import FrameWriter, ViewName
from lumisplat.cli.output.pictures import Shot, check_writable, make_folder, plan_shots
from lumisplat.cli.output.standard_output import STANDARD_OUTPUT, refuse_standard_output, standard_output
from lumisplat.cli.output.stats import print_stats

_log = logging.getLogger("lumisplat")

_OF_RASTER = ("raster_strategy", "projection")
_OF_REALTIME = ("warm_up",)
_STAMP = "render.json"
_NOT_OF_PICTURES = ("output", "resume", "overwrite", "frames", "tiles", "debug", "stats", "device")
"""Options of which the pictures that are there do not depend."""


@dataclass(frozen=True)
class _Pictures:
    """What the pictures of a command are made of."""

    scene: ls.Scene
    shots: list[Shot]
    source: FrameSource
    writer: FrameWriter


@dataclass(frozen=True, kw_only=True)
class Render(ViewsCommand, FrameCommand):
    """Render a scene to pictures."""

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Captures (.ply, .compressed.ply, .spz, .sog), meshes (.obj, .ply, .stl), both (.glb, .gltf, .usda, .usdc, .usdz,
    .usd), or a scene.toml, which has lights, cameras and settings, too. Several make one scene. Of a capture in blocks,
    which lumisplat blocks makes, unlit, rasterised pictures load what they see."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")] = Path("out")
    """A folder, or for one frame a file: .png, .exr or .npz. - is standard output, in PNG or as --format says."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """transforms.json (nerfstudio), cameras.json (INRIA), or a glTF or scene.toml with cameras. Without: those of the
    scene.toml that is rendered, else the first view that a capture states, else one that shows all of it from the
    front."""
    frame: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = ()
    """Render only this frame of the camera file."""
    frames: Annotated[str, arg(metavar="FRAMES", help_behavior_hint="")] = ""
    """Render only these frames of the camera file or along --path, from 0: 1-100 (both), 1-100x2 (every second), 1,5,9,
    or A:B, from A to before B. Parts may be joined by commas."""
    resume: Flag = False
    """Pictures that are there stay, if they are of this scene and of these settings: render.json beside them says."""
    tiles: Annotated[str, arg(metavar="COLUMNSxROWS|auto", help_behavior_hint="")] = ""
    """Render each picture in parts, such as 4x4, so that one of 16384 x 9216 takes the memory of a part; auto: in bands
    of about 2048 x 2048 pixels. The pixels are the same. After an interruption, with --resume, parts that are there
    stay; workers share them: lumisplat farm render."""
    split_samples: Flag = False
    """Add the samples of each picture, or of each of its --tiles, up in blocks of 32, which workers share (lumisplat
    farm render): the same picture whoever makes them, and nearly that without the option. Needs --samples, in pipelines
    other than realtime."""
    warm_up: Annotated[int | None, setting("N", "32")] = None
    """Of --pipeline realtime: frames before each picture, in which light finds its way; along --path only before the
    first."""
    fps: Annotated[float, arg(metavar="FPS")] = 24.0
    """Frames a second along --path."""
    format: Literal["auto", "png", "exr", "npz"] = "auto"
    """PNG is 8-bit sRGB; EXR and NPZ hold floats. auto follows the name of the output, else png."""
    aov: Annotated[str, arg(metavar="LAYERS", help_behavior_hint="")] = ""
    """Also write some of depth, normal, gaussian_index, instance_index, position and, of lit frames, albedo, emission,
    reflection, lights, hits, variance, sample_count, of frames of paths direct_diffuse, indirect_diffuse,
    direct_glossy, indirect_glossy, bounces, or of frames in real time these but bounces, and motion, history, probes,
    cache, cache_cells (with commas): into the EXR, or beside the PNG as NAME.depth.png, depth also as 16-bit
    NAME.depth16.png, whose range is printed. An NPZ has them all."""
    cryptomatte: Flag = False
    """Also write mattes of objects and materials into the EXR, by which compositors select; 16 more frames."""
    deep: Flag = False
    """Also write NAME.deep.exr, in which each pixel has samples in depth, so that compositors put things in between."""
    view: Annotated[
        ViewName | None,
        arg(metavar="VIEW", help_behavior_hint=""),
    ] = None
    """Write this in colours instead of the picture, which shows how the frame came about: normal, depth, index, shadow,
    hits, transmittance, emission; of frames of paths and in real time direct_diffuse, indirect_diffuse, direct_glossy,
    indirect_glossy; of frames in real time motion, history, probes, cache, cache_cells."""
    raster_strategy: Annotated[Literal["sorted", "stochastic"] | None, setting("{sorted,stochastic}", "sorted")] = None
    """How the rasteriser resolves splats. sorted: front to back, without noise. stochastic: a random one of them,
    nothing is sorted; --samples average the noise."""
    projection: Annotated[Literal["ewa", "unscented"] | None, setting("{ewa,unscented}", "ewa")] = None
    """How the rasteriser sees Gaussians. ewa: as ellipses, by a pinhole. unscented: along the ray of each pixel, also
    through distorting lenses, fisheyes and rolling shutters."""
    antialiasing: Annotated[Literal["auto", "on", "off"] | None, setting("{auto,on,off}", "auto")] = None
    """Whether splats are those of Mip-Splatting, which dilation does not widen; auto: as each capture says."""
    sh_degree: Annotated[int | None, setting("0..3", "3")] = None
    """Highest degree of view-dependent colour."""
    transmittance_min: Annotated[float | None, setting("0..1", "0.0001")] = None
    """Pixels and rays, also rays to lights, end where less than this of what lies behind would show."""

    depth_iso: Annotated[float | None, setting("0..1", "0.7")] = None
    """Depth, normal, position and indices are those of the first Gaussian behind which the transmittance is below
    this."""

    def run(self) -> None:
        """Renders and writes the pictures."""
        if self.output == STANDARD_OUTPUT:
            format_name = "png" if self.format == "auto" else self.format
            if self.aov and format_name == "png":
                raise ls.ConfigError("-o - is one picture, --aov writes more beside a PNG: give --format exr or npz")
            if self.deep:
                raise ls.ConfigError("-o - is one picture, --deep writes a file beside it: give -o a name")
            with standard_output(f".{format_name}") as file:
                replace(self, output=file).run()
            return
        if self.resume or self.tiles or self.split_samples:
            with progress_bars() as report:
                job = self.open_frames(report)
                job = replace(job, frames=replace(job.frames, go_on="with --resume"))
                lines = make_alone(job, report, overwrite=not self.resume, video=None, fewer="--frames")
            print(lines)
            return
        with progress_bars() as report:
            pictures = self._open(report)
            print(self._render(pictures, report))
        if pictures.writer.legend:
            print(pictures.writer.legend)

    def open_frames(self, report: Report) -> FrameJob:
        """Checks all that can be checked, and loads the scene, to render pictures that are missing.

        Args:
            report: Shows the progress.

        Raises:
            LumisplatError: Something is wrong with the options or a file.
        """
        refuse_standard_output(self.output)
        if self.view:
            raise ls.ConfigError(
                "--view colours all pictures by the first of a run: pictures that are there stay wrong"
            )
        if self.tiles:
            self._check_tiles()
        pictures = self._open(report)
        shots, folder = pictures.shots, pictures.shots[0].path.parent
        config, source = pictures.source.renderer.config, pictures.source
        frames = FrameList(
            folder=FrameFolder(folder, "", _STAMP, tuple(shot.path.name for shot in shots)),
            origin=self._origin(config, source.renderer.device),
            wanted=tuple(self._wanted(shots)),
            in_sequence=config.pipeline.is_sequence and self.path is not None,
        )
        if self.tiles:
            tiles = Tiles.of(shots, [*frames.wanted], self.tiles, self.output, _STAMP, has_layers=bool(self.aov))
            if self.split_samples:
                shared = SharedSamples.of_tiles(tiles, ls.sample_blocks(source.renderer, pictures.scene))
                return self._shared_job(pictures, frames, shared)
            shots = list(tiles.shots)
            frames = replace(frames, folder=tiles.folder, wanted=tiles.wanted, unit="tile")
        elif self.split_samples:
            blocks = ls.sample_blocks(source.renderer, pictures.scene)
            shared = SharedSamples.of(shots, [*frames.wanted], blocks, self.output, _STAMP)
            return self._shared_job(pictures, frames, shared)
        elif folder != self.output:
            raise ls.ConfigError(f"-o {self.output} is one picture, and frames are many: give a folder")
        return FrameJob(
            frames=frames,
            render=lambda index, report: source.frame(pictures.scene, shots[index].camera, report),
            write=lambda frame, index: self._write(pictures, frame, shots[index]),
            summarise=(lambda frame, _: print_stats(frame, config.pipeline)) if self.stats else None,
        )

    def _open(self, report: Report) -> _Pictures:
        """Checks all that can be checked, and loads the scene."""
        writer = FrameWriter(self.aov, self.view)
        file = scene_file(self.scene)
        base = scene_settings(file)
        config = self.frame_config(base, {"aovs": (*base.aovs, *writer.aovs)}, self._changes())
        # What fails fast comes first: cameras, environment and device before a capture of a gigabyte.
        cameras = self._cameras(file)
        shots = self._shots(cameras) if cameras else None
        check_writable(self.output)
        environment = self.light.environment_light()
        renderer = self.start_renderer(report, config, profile=self.stats)
        blocks = self._blocks(config, lit=environment is not None)
        scene = blocks.preview if blocks else self.load_scene(self.scene, report, given_up=parse_up(self.viewpoint.up))
        scene = self.light.lit_scene(scene, environment)
        config = self.light.exposed_captures(renderer, config, scene)
        if not config.pipeline.is_sequence and (unused := given_options(self, _OF_REALTIME)):
            _log.warning("%s", not_used(config, unused, "realtime"))
        for line in frame_remarks(
            config, scene, given_options(self, _OF_RASTER), self.rays, self.light, device=self.device
        ):
            _log.warning("%s", line)
        shots = shots or self._shots([self.own_camera(scene, *self.scene)])
        return _Pictures(scene, shots, self.frame_source(renderer, self._warm_up(), blocks), writer)

    def _blocks(self, config: ls.RenderConfig, *, lit: bool) -> BlockViews | None:
        """What shows a capture in blocks, view by view; None: scenes are loaded whole."""
        given = {
            "--deep": self.deep,
            "--cryptomatte": self.cryptomatte,
            "--split-samples": self.split_samples,
            "--lod": self.lod is not None,
            "--lod-budget": self.lod_budget is not None,
            "gaussian_index": "gaussian_index" in config.aovs,
        }
        whole = next((name for name, is_given in given.items() if is_given), "")
        return block_views(self.scene, config, self.lod_pixels, lit=lit, whole=whole, upright=self.viewpoint.upright)

    def _shared_job(self, pictures: _Pictures, frames: FrameList, shared: SharedSamples) -> FrameJob:
        """Blocks of samples of all pictures or tiles, and these."""
        source, scene = pictures.source, pictures.scene

        def write(made: ls.Frame | ls.SamplePart, index: int) -> None:
            if isinstance(made, ls.SamplePart):
                made.save(shared.folder.path(index))
            else:
                self._write(pictures, made, shared.shot(index))

        return FrameJob(
            frames=replace(frames, folder=shared.folder, wanted=shared.wanted, needs=shared.needs, unit="part"),
            render=lambda index, report: shared.make(source, scene, index, report),
            write=write,
        )

    def _check_tiles(self) -> None:
        """Refuses what is not made of parts of a picture.

        Raises:
            ConfigError: Some of it is asked for.
        """
        given = {"--deep": self.deep, "--cryptomatte": self.cryptomatte, "--denoise": self.light.denoise}
        if whole := " and ".join(name for name, is_given in given.items() if is_given):
            raise ls.ConfigError(f"{whole} and --tiles do not go together: it is of the whole picture")

    def _wanted(self, shots: list[Shot]) -> list[int]:
        """The numbers of the pictures that are asked for."""
        return frame_numbers("--frames", self.frames, len(shots))

    def _render(self, pictures: _Pictures, report: Report) -> str:
        """Renders and writes the pictures; what was written, in a line."""
        shots = [pictures.shots[index] for index in self._wanted(pictures.shots)]
        make_folder(shots[0].path.parent)
        with suppress(OSError):
            (shots[0].path.parent / _STAMP).unlink()  # what it said of these pictures is no longer true
        fewer = "--frame, --frames" if self.path is None else "--frames, --fps"
        progress = FrameProgress(report, "rendering", len(shots), fewer)
        frame: ls.Frame | None = None
        for shot in shots:
            frame = pictures.source.frame(pictures.scene, shot.camera, report)
            self._write(pictures, frame, shot)
            progress.add(frame)
        assert frame is not None
        if self.stats:
            print_stats(frame, pictures.source.renderer.config.pipeline)
        return _summary(shots, frame)

    def _origin(self, config: ls.RenderConfig, device: str) -> dict[str, str]:
        """All that a picture follows from, except its number."""
        files = [*self.scene, *(path for path in (self.cameras, self.path, self.light.environment) if path is not None)]
        own = {field.name: getattr(self, field.name) for field in fields(self) if field.name not in _NOT_OF_PICTURES}
        return {
            "lumisplat": ls.__version__,
            "device": device,
            **{name: f"{value}" for name, value in own.items() if not is_dataclass(value)},
            "scene": " ".join(map(str, self.scene)),
            **shared_origin(self, config),
            **file_marks(files, self.output),
        }

    def _write(self, pictures: _Pictures, frame: ls.Frame, shot: Shot) -> None:
        """Writes a picture, with its mattes; its samples in depth come first, as a picture says that it is done."""
        if self.deep:
            renderer = pictures.source.renderer
            camera = pictures.source.focused(pictures.scene, shot.camera)
            deep = ls.render_deep(pictures.scene, camera, frame, renderer.config, device=renderer.device)
            deep.save(shot.path.with_suffix(".deep.exr"))
        mattes = self._mattes(pictures.scene, shot.camera, pictures.source.renderer)
        pictures.writer.write(frame, shot.path, mattes)

    def _mattes(self, scene: ls.Scene, camera: ls.Camera, renderer: ls.Renderer) -> ls.Mattes | None:
        """Mattes of a picture, if they are asked for."""
        if not self.cryptomatte:
            return None
        return ls.render_mattes(scene, camera, renderer.config, device=renderer.device)

    def _warm_up(self) -> WarmUp:
        """How frames in real time come to a picture.

        Raises:
            ConfigError: --warm-up is below 1.
        """
        if self.warm_up is None:
            return WarmUp(each=self.path is None)
        if self.warm_up < 1:
            raise ls.ConfigError(f"--warm-up is {self.warm_up}, expected 1 or more")
        return WarmUp(frames=self.warm_up, each=self.path is None)

    def _changes(self) -> Changes:
        """The settings of this command's own options that were given."""
        end = without_none({"transmittance_min": self.transmittance_min})
        shared = without_none({"sh_degree": self.sh_degree, "depth_iso_transmittance": self.depth_iso}) | end
        strategy = without_none({"strategy": self.raster_strategy and ls.RasterStrategy(self.raster_strategy)})
        strategy |= without_none({"projection": self.projection and ls.Projection(self.projection)})
        shared |= without_none({"antialiasing": self.antialiasing and ls.Antialiasing(self.antialiasing)})
        return {"raster": strategy | shared, "trace": shared, "shadow_rays": end}

    def _cameras(self, file: Path | None) -> list[ls.Camera]:
        """The cameras that are given, those of the frames along --path among them; none: one has to be made."""
        if self.path is None:
            return self.load_cameras(self.cameras, file)
        along = self.camera_path(self.path, self.cameras).frames(self.fps)
        return [self.light.exposed(camera.scaled(self.width, self.height)) for camera in along]

    def _shots(self, cameras: list[ls.Camera]) -> list[Shot]:
        """The pictures of cameras.

        Raises:
            ConfigError: The output does not suit them, or the view.
        """
        shots = plan_shots(cameras, self.frame, self.output, self.format)
        if self.view and shots[0].path.suffix.lower() != ".png":
            raise ls.ConfigError(f"{shots[0].path}: --view is a picture to look at, expected .png")
        if self.cryptomatte and shots[0].path.suffix.lower() != ".exr":
            raise ls.ConfigError(
                f"{shots[0].path}: --cryptomatte is written into an EXR: name one, or give --format exr"
            )
        if self.background is not None and shots[0].path.suffix.lower() == ".exr":
            _log.warning("--background is not used: an EXR holds premultiplied colour and alpha, without a background")
        return shots


def _summary(shots: list[Shot], frame: ls.Frame) -> str:
    """What was written, in a line; ``frame`` is that of the last picture."""
    first = shots[0]
    if len(shots) == 1:
        return f"{first.path} ({first.camera.width} x {first.camera.height}){_samples(frame)}"
    return f"{len(shots)} pictures in {first.path.parent}"


def _samples(frame: ls.Frame) -> str:
    """How many samples a frame has, and their noise, if their number was not given."""
    config, noise = frame.config, frame.stats.noise if frame.stats else None
    if config is None or (config.time_limit is None and config.noise is None) or not frame.samples:
        return ""
    return f", {counted(frame.samples, 'sample')}" + (f", noise {noise:.3f}" if noise is not None else "")
