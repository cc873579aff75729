"""``lumisplat animate``: renders the frames of an animated scene, and a video of them."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.farm.job import FrameJob, FrameList, make_frames
from lumisplat.cli.input.loading import WITH_CAMERAS, file_fingerprints, scene_settings
from lumisplat.cli.input.numbers import frame_numbers
from lumisplat.cli.input.programs import PROGRAM, run_program
from lumisplat.cli.options.command import LIGHTING, Flag, given_settings, own_options_first, setting
from lumisplat.cli.options.frame import FrameCommand, frame_remarks, shared_provenance
from lumisplat.cli.output.console import Report, found_light, print_stats, print_table, progress_bars
from lumisplat.cli.output.frame_folder import FrameFolder, flat_settings
from lumisplat.cli.output.frame_source import FrameSource
from lumisplat.cli.output.images import FrameWriter, Views, check_writable, refuse_standard_output


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Animate(FrameCommand):
    """Render the frames of an animated scene, and a video of them.

    Actors cast shadows onto captures, and are lit by them.
    The same command continues after an interruption, and keeps existing frames.
    Guide: docs/guide/animate.md.
    """

    scene: Positional[Annotated[Path, arg(metavar="SCENE")]]
    """Read a scene.toml, OpenUSD, an animated glTF, or a Python file with an animation."""
    output: Annotated[
        Path | None,
        arg(aliases=("-o",), metavar="DIR", help_behavior_hint="(default: named after the video, or frames)"),
    ] = None
    """Write frames and animate.json into this folder."""
    video: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write a video: .mp4 (pip install 'lumisplat[video]'), .gif, .webp or .apng."""
    frames: Annotated[str, setting("LIST", "all")] = ""
    """Render only these frames, numbered from 0: 1-100, 1-100x2 (every second), 1,5,9, 0:48, 48:."""
    fps: Annotated[float | None, setting("FPS", "the scene's")] = None
    """Render FPS frames per second; the duration stays the same."""
    overwrite: Flag = False
    """Delete the existing frames before rendering."""
    cameras: Annotated[Path | None, setting("FILE", "the scene's, else the front")] = None
    """Read one camera from this file, or one camera for each frame."""
    camera: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """Use the camera with this name for all frames."""
    format: Annotated[Literal["png", "exr", "npz"], arg(metavar="png|exr|npz")] = "png"
    """Write frames in this format; a video needs png."""
    view: Annotated[str, arg(metavar="VIEWS", help_behavior_hint="")] = ""
    """Draw layers small, in the lower right corner of the frames: color,depth,normal."""

    def run(self) -> None:
        """Renders the missing frames, then the video."""
        with progress_bars() as report:
            job = self.open_frames(report)
            lines = make_frames(job, report, overwrite=self.overwrite, video=self.video, fewer="--frames")
        print(lines)

    def open_frames(self, report: Report) -> FrameJob:
        """Checks options and files, loads the scene, and returns the frames with functions that make them.

        Args:
            report: Receives the progress.

        Raises:
            LumisplatError: An option or a file is wrong.
        """
        folder = FrameFolder.named_after(self.output, self.video, "frames", self.format, "animate.json")
        refuse_standard_output(folder.folder)
        suffix = self.scene.suffix.lower()
        if suffix not in (*WITH_CAMERAS, PROGRAM):
            raise ls.FormatError(self.scene, "is no animated scene: expected a scene.toml, OpenUSD, glTF or .py")
        if self.video is not None and self.format != "png":
            raise ls.ConfigError(f"--video needs frames as png, but --format is {self.format}")
        views = Views.of(self.view)
        if views.main:
            raise ls.ConfigError(f"--view {self.view}: frames of animations show the image: --view color,{views.main}")
        if views.insets and self.format != "png":
            raise ls.ConfigError(f"--view draws insets on frames as png, but --format is {self.format}")
        base = scene_settings(self.scene if suffix == ".toml" else None)
        config = self.frame_config(base, {"aovs": (*base.aovs, *views.aovs)})
        check_writable(folder.folder)
        environment = self.light.environment_light()
        renderer = self.start_renderer(report, config, profile=self.stats)
        animation = self._animation(environment, report)
        config = self.light.with_capture_gain(
            renderer, config, with_actors(animation.scene_at(0.0), animation.actors_at(0.0))
        )
        cameras = self._cameras(animation)
        frames = FrameList(
            folder=folder,
            provenance=self._provenance(animation, config, renderer.device, folder.folder),
            wanted=tuple(frame_numbers("--frames", self.frames, animation.frame_count)),
            fps=animation.fps,
            in_sequence=config.pipeline.is_sequence,
        )
        given = dict(given_settings(self))
        remarks = partial(frame_remarks, config, given=given, light=self.light, device=self.device)
        writer = FrameWriter((), views)
        maker = _AnimationFrames(animation, cameras, self.frame_source(renderer), folder, writer, remarks=remarks)
        summarise = maker.summarise if self.stats else None
        return FrameJob(frames=frames, render=maker.render, write=maker.write, summarise=summarise)

    def _animation(self, environment: ls.LightEnvironment | None, report: Report) -> ls.Animation:
        """Loads the animation of the scene file; options change its environment, up direction, actor light and rate."""
        report(f"loading {self.scene.name}", 0.0)
        if self.scene.suffix.lower() == PROGRAM:
            animation = run_program(self.scene)
        else:
            animation = ls.load_animation(
                self.scene,
                drop_invalid=self.drop_invalid,
                crease_angle=self.crease_radians,
                allow_outside=self.allow_outside,
            )
        lit = self.light.lit_scene(self.viewpoint.upright(animation.scene), environment)
        at_start = [(one, ls.lights.light_at(one, 0.0)) for one in animation.lights]
        moving = [one for one, light in at_start if environment is None or not isinstance(light, ls.LightEnvironment)]
        lighting = self.changed(animation.lighting, LIGHTING)
        animation = replace(animation, scene=lit, lights=moving, lighting=lighting)
        report(f"loading {self.scene.name}", 1.0)
        return animation if self.fps is None else _at_rate(animation, self.fps)

    def _cameras(self, animation: ls.Animation) -> list[ls.Camera]:
        """Returns a camera for each frame: of ``--camera-path``, a camera file, the scene file or viewpoint options."""
        count, source = animation.frame_count, self.cameras or self.scene
        is_program = self.scene.suffix.lower() == PROGRAM
        cameras = self.load_cameras(self.cameras, None if is_program else self.scene)
        if is_program and not (self.cameras or self.viewpoint.is_given):
            cameras = [self.light.exposed(camera.scaled(self.width, self.height)) for camera in animation.cameras]
        if self.camera is not None:
            named = [camera for camera in cameras if camera.name == self.camera]
            if not named:
                listed = ", ".join(camera.name for camera in cameras[:5]) or "none"
                raise ls.ConfigError(f"{source} has no camera named '{self.camera}': there are {listed}")
            cameras = named
        if self.camera_path is not None:
            return self.cameras_on_path(self.camera_path, animation.times.tolist())
        if animation.camera_path is not None and self.camera is None and not (self.cameras or self.viewpoint.is_given):
            along = (animation.camera_path.at(float(time)) for time in animation.times)
            return [self.light.exposed(camera.scaled(self.width, self.height)) for camera in along]
        if not cameras:
            cameras = [
                self.viewpoint_camera(with_actors(animation.scene_at(0.0), animation.actors_at(0.0)), self.scene)
            ]
        if len(cameras) not in (1, count):
            raise ls.ConfigError(
                f"{source} has {len(cameras)} cameras, expected one, or one for each of the {count} frames: choose by "
                "--camera NAME"
            )
        return cameras * count if len(cameras) == 1 else cameras

    def _provenance(
        self, animation: ls.Animation, config: ls.RenderConfig, device: str, folder: Path
    ) -> dict[str, str]:
        """Returns everything that the frames depend on, as text by name: version, device, settings, file fingerprints.

        A later run continues with existing frames only if these values are equal.
        """
        files = [
            self.scene,
            *(path for path in (self.cameras, self.camera_path, self.light.environment) if path is not None),
        ]
        chosen = ("width", "height", "camera", "drop_invalid", "view")
        return {
            "lumisplat": ls.__version__,
            "device": device,
            "fps": f"{animation.fps!r}",
            **{name: f"{getattr(self, name)}" for name in chosen},
            **shared_provenance(self, config),
            **dict(flat_settings("actors.", animation.lighting)),
            **file_fingerprints(files, folder),
        }


def _at_rate(animation: ls.Animation, fps: float) -> ls.Animation:
    """Returns the animation with ``fps`` frames per second and, as its duration stays, another number of frames."""
    if not 0.0 < fps < math.inf:
        raise ls.ConfigError(f"--fps is {fps}, expected a positive number")
    length = animation.duration * fps
    if length == math.inf:
        raise ls.ConfigError(
            f"--fps is {fps}, too high for an animation of {animation.duration:g} s: choose a lower rate"
        )
    return replace(animation, fps=fps, frame_count=max(1, round(length)))


_log = logging.getLogger("lumisplat")


class _AnimationFrames:
    """Renders and writes the frames of an animation.

    Args:
        animation: Scene, actors and their lighting.
        cameras: Camera of each frame.
        source: Renders the frames.
        folder: Folder of the frames.
        writer: Writes their images.
        remarks: Returns warnings about the settings; called once, with the scene of the first rendered frame.
    """

    def __init__(
        self,
        animation: ls.Animation,
        cameras: list[ls.Camera],
        source: FrameSource,
        folder: FrameFolder,
        writer: FrameWriter,
        *,
        remarks: Callable[..., Iterable[str]],
    ) -> None:
        self._animation, self._cameras, self._source = animation, cameras, source
        self._folder, self._writer, self._remarks = folder, writer, remarks
        self._last: int | None = None
        self._lighter: ls.AvatarLighter | None = None
        self._seconds = {"lighting": 0.0, "rendering": 0.0, "writing": 0.0}

    def render(self, index: int, report: Report) -> ls.Frame:
        """Lights the actors at the time of a frame number, and renders the frame."""
        is_first = self._last is None
        if is_first and self._animation.scene.splats and self._animation.actors:
            self._start_lighter(report)
        with self._timed("lighting"):
            scene = self._lit_scene(index)
        if is_first:
            # Remarks are about the lit scene, because actors may light a scene without lights.
            remarks = self._remarks(self._without_lit_albedos(scene), has_actors=self._lighter is not None)
            for line in (*remarks, *self._light_remarks()):
                _log.warning("%s", line)
        if self._last != index - 1:
            self._source.cut()
        with self._timed("rendering"):
            frame = self._source.frame(scene, self._cameras[index], report)
        self._last = index
        return frame

    def write(self, frame: ls.Frame, index: int) -> None:
        """Writes a rendered frame to the file of its number, and adds the time to the stage ``writing``."""
        with self._timed("writing"):
            self._writer.write(frame, self._folder.path(index))

    def summarise(self, frame: ls.Frame, count: int) -> None:
        """Prints the mean time of ``count`` frames, and the statistics of ``frame``, the last one."""
        rows = [(name, f"{1e3 * taken / count:8.1f} ms") for name, taken in self._seconds.items()]
        print_table(f"mean of {count} frames", rows)
        print_stats(frame, self._source.renderer.config.pipeline)

    def _start_lighter(self, report: Report) -> None:
        """Creates the object that lights the actors by the captures, and estimates the scene's lights at frame 0.

        If no light can be estimated, actors cast no shadows, which is logged.
        """
        self._lighter = ls.AvatarLighter(
            self._animation.scene_at(0.0),
            config=self._animation.lighting,
            background=self._source.renderer.config.background or (0.0, 0.0, 0.0),
            device=self._source.renderer.device,
            progress=report,
        )
        try:
            self._lit_scene(0)
        except ls.SceneError as error:
            if self._lighter.lights is not None:
                raise
            _log.warning("actors cast no shadows: %s", error)
            self._lighter.config = replace(self._lighter.config, shadows=False)

    def _lit_scene(self, index: int) -> ls.Scene:
        """Returns the scene at the time of a frame number, with actors lit by captures and casting shadows on them."""
        animation, now = self._animation, float(self._animation.times[index])
        placed = animation.placed_at(now)
        instances, scene = [instance for instance, _, _ in placed], animation.scene_at(now)
        if self._lighter is None:
            return with_actors(scene, instances)
        self._lighter.update(scene)
        return self._lighter.light(
            instances,
            casts_shadow=[actor.casts_shadow for _, actor, _ in placed],
            relit=[actor.relight for _, actor, _ in placed],
            keys=[key for _, _, key in placed],
        )

    def _without_lit_albedos(self, scene: ls.Scene) -> ls.Scene:
        """Returns the scene without the albedos of actors, so that no warning asks for a material to relight them.

        Actors are lit without a material; without a lighter, returns the scene unchanged.
        """
        if self._lighter is None:
            return scene
        count = len(self._animation.scene.splats)
        lit = (replace(one, gaussians=replace(one.gaussians, albedo=None)) for one in scene.splats[count:])
        return replace(scene, splats=(*scene.splats[:count], *lit))

    def _light_remarks(self) -> Iterable[str]:
        """Yields a log line about the lights that were estimated at frame 0; none if the scene has lights itself."""
        found = found_light(self._lighter) if self._lighter is not None else None
        if found is not None:
            yield f"no lights are given; shadows use those that were found: {found}"

    @contextmanager
    def _timed(self, name: str) -> Generator[None]:
        """Context that adds its duration to the total seconds of a stage, such as ``rendering``."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[name] += time.perf_counter() - begun


def with_actors(scene: ls.Scene, actors: Sequence[ls.SplatInstance | ls.MeshInstance]) -> ls.Scene:
    """Returns the scene with actors in the colours of their files: not lit, and casting no shadows on captures."""
    splats = [actor for actor in actors if isinstance(actor, ls.SplatInstance)]
    meshes = [actor for actor in actors if isinstance(actor, ls.MeshInstance)]
    return replace(scene, splats=(*scene.splats, *splats), meshes=(*scene.meshes, *meshes))
