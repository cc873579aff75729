"""``lumisplat animate``: the frames of an animated scene, and a video of them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.options.common import DeviceCommand, Flag, parse_background, resolved_up, setting, settled
from lumisplat.cli.options.lighting import LightGroup, LightOptions
from lumisplat.cli.options.tracing import PipelineName, TraceGroup, TraceOptions
from lumisplat.cli.options.unused import unused_options
from lumisplat.cli.output.console import Report, counted, progress_bars
from lumisplat.cli.output.filming import Filming, with_actors
from lumisplat.cli.output.frame_folder import FrameFolder
from lumisplat.cli.output.named_files import file_marks
from lumisplat.cli.output.pictures import check_writable

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True, kw_only=True)
class Animate(DeviceCommand):
    """Render an animated scene, frame by frame: actors cast shadows onto captures, and take on their light.

    Begin again with the same command where it was interrupted: frames that are there stay.
    """

    scene: Positional[Annotated[Path, arg(metavar="SCENE.toml")]]
    """A scene file with [[actors]], and an [animation] that says how many frames there are."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="FOLDER")] = Path("frames")
    """Where frames go, as frame_0000.png and so on, with animate.json, which says what they are of."""
    video: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Make a video of the frames, too: .mp4 (H.264; pip install 'lumisplat[video]'), .gif, .webp or .apng."""
    frames: Annotated[str, arg(metavar="A:B", help_behavior_hint="")] = ""
    """Only these frames, from A to before B, such as 0:48, 48: or :10."""
    fps: Annotated[float | None, arg(metavar="FPS", help_behavior_hint="")] = None
    """Frames a second, in place of the scene file's; it lasts as long."""
    overwrite: Flag = False
    """Remove the frames that are there first, whatever they are of."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """A camera file as render takes, with one camera, or one for each frame. Without: those of the scene file, else
    all of the scene, from the front."""
    camera: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """The one of the cameras that is used for all frames."""
    up: Literal["auto", "y-down", "y-up", "z-up"] = "auto"
    """Which way is up without cameras, and for --environment; auto: y-down with a capture, y-up for meshes alone."""
    pipeline: Annotated[PipelineName | None, setting("{raster,trace,hybrid}", "raster")] = None
    """raster: fast. trace: rays, with mirrors, glass and fisheye cameras. hybrid: rasterised, and rays from there."""
    width: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Image width; alone, it keeps the camera's aspect ratio."""
    height: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Image height; alone, it keeps the camera's aspect ratio."""
    background: Annotated[str | None, setting("COLOR", "black")] = None
    """black, white, transparent, #rrggbb, or r,g,b in 0..1."""
    format: Literal["png", "exr", "npz"] = "png"
    """PNG is 8-bit sRGB; EXR and NPZ hold floats. A video is made of PNGs."""
    no_shadows: Flag = False
    """Actors cast no shadows onto captures."""
    no_relight: Flag = False
    """Actors keep the colours that they have."""
    direct: Annotated[float | None, setting("0..1", "0.7")] = None
    """Share of a capture's light that comes from the lights, and that shadows take away."""
    gamma: Annotated[float | None, setting("FACTOR", "1")] = None
    """Brightness of relit actors: above 1 where a place is much darker than display white."""
    drop_invalid: Flag = False
    """Leave out Gaussians with NaN or infinite values instead of refusing the file."""
    stats: Flag = False
    """Print what a frame takes."""
    trace: TraceGroup = field(default_factory=TraceOptions)
    """Of --pipeline trace and hybrid; --samples and --seed also of lit frames."""
    light: LightGroup = field(default_factory=LightOptions)
    """Of what is lit by lights; captures are shown as captured, with the shadows of actors."""

    def run(self) -> None:
        """Renders the frames that are missing, then the video."""
        if self.scene.suffix.lower() != ".toml":
            raise ls.FormatError(self.scene, "is no scene.toml: a scene file says what moves, and how")
        config = self._config(ls.load_config(self.scene))
        check_writable(self.output)
        environment = self.light.environment_light()
        with progress_bars() as report:
            renderer = self.start_renderer(report, config, profile=self.stats)
            report(f"loading {self.scene.name}", 0.0)
            animation = self._animation(environment)
            report(f"loading {self.scene.name}", 1.0)
            cameras = self._cameras(animation)
            wanted = _frame_range(self.frames, animation.frame_count)
            if self.video is not None:
                self._try_video(self.video, animation.fps)
            folder = FrameFolder(self.output, self.format)
            folder.prepare(self._origin(animation, config, renderer.device), self.overwrite)
            missing = [index for index in wanted if not folder.is_finished(index)]
            try:
                if missing:
                    remarks = partial(unused_options, config, raster=[], trace=self.trace, light=self.light)
                    filming = Filming(animation, cameras, renderer, folder, stats=self.stats, remarks=remarks)
                    filming.film(missing, report)
                if self.video is not None:
                    pictures = _read([folder.path(index) for index in wanted], report)
                    ls.save_animation(self.video, pictures, animation.fps)
            except KeyboardInterrupt:
                raise KeyboardInterrupt(self._progress(folder, wanted)) from None
        there = len(wanted) - len(missing)
        were = "was" if there == 1 else "were"
        print(f"{counted(len(wanted), 'frame')} in {self.output}" + f", {there} of them {were} there" * bool(there))
        if self.video is not None:
            print(f"{self.video} ({animation.fps:g} frames a second, {len(wanted) / animation.fps:.2f} s)")

    def _progress(self, folder: FrameFolder, wanted: range) -> str:
        """What is there already, and how to go on."""
        there = sum(folder.is_finished(index) for index in wanted)
        again = "the same command without --overwrite" if self.overwrite else "the same command"
        return f"{self.output} holds {there} of {counted(len(wanted), 'frame')}; {again} goes on"

    def _config(self, base: ls.RenderConfig) -> ls.RenderConfig:
        """The settings of the scene file, and what was given in their place."""
        changes: dict[str, Any] = {}
        if self.pipeline is not None:
            changes["pipeline"] = ls.Pipeline(self.pipeline)
        if self.background is not None:
            changes["background"] = parse_background(self.background)
        return settled(base, changes, self.trace.changes(), self.light.changes())

    def _animation(self, environment: ls.LightEnvironment | None) -> ls.Animation:
        """The animation of the scene file, with what was given in place of its own."""
        animation = ls.load_animation(self.scene, drop_invalid=self.drop_invalid)
        changes: dict[str, Any] = {}
        if self.no_shadows:
            changes["shadows"] = False
        if self.no_relight:
            changes["relight"] = False
        if self.direct is not None:
            changes["direct"] = self.direct
        if self.gamma is not None:
            changes["transfer"] = replace(animation.lighting.transfer, gamma=self.gamma)
        lit = self.light.lit_scene(animation.scene, environment, resolved_up(animation.scene, self.up))
        animation = replace(animation, scene=lit, lighting=replace(animation.lighting, **changes))
        if self.fps is None:
            return animation
        if not 0.0 < self.fps < math.inf:
            raise ls.ConfigError(f"--fps is {self.fps}, expected a positive number")
        length = animation.duration * self.fps
        if length == math.inf:
            raise ls.ConfigError(f"--fps is {self.fps}, of an animation of {animation.duration:g} s: too many frames")
        return replace(animation, fps=self.fps, frame_count=max(1, round(length)))

    def _cameras(self, animation: ls.Animation) -> list[ls.Camera]:
        """One camera for each frame."""
        count, source = animation.frame_count, self.cameras or self.scene
        cameras = list(animation.cameras)
        if self.cameras is not None or cameras:
            cameras = ls.load_cameras(source, width=self.width, height=self.height)
        if not cameras and self.cameras is not None:
            raise ls.FormatError(source, "has no cameras")
        if self.camera is not None:
            named = [camera for camera in cameras if camera.name == self.camera]
            if not named:
                listed = ", ".join(camera.name for camera in cameras[:5]) or "none"
                raise ls.ConfigError(f"{source} has no camera named '{self.camera}': there are {listed}")
            cameras = named
        if not cameras:
            from lumisplat.cli.options.framing import framing_camera

            whole = with_actors(animation.scene, animation.actors_at(0.0))
            width, height = (self.width or 1280, self.height or 720)
            both = self.width is not None and self.height is not None
            cameras = [framing_camera(whole, self.up, width, height) if both else framing_camera(whole, self.up)]
        if len(cameras) not in (1, count):
            raise ls.ConfigError(
                f"{source} has {len(cameras)} cameras, expected one, or one for each of the {count} frames: choose by "
                "--camera NAME"
            )
        seen = [self.light.exposed(camera.scaled(self.width, self.height)) for camera in cameras]
        return seen * count if len(seen) == 1 else seen

    def _try_video(self, path: Path, fps: float) -> None:
        """Finds out whether a video can be written, before an hour of frames: extension, rate, package and folder."""
        if self.format != "png":
            raise ls.ConfigError(f"--video is made of the PNGs of frames, --format is {self.format}")
        if path.suffix.lower() == ".png":
            raise ls.FormatError(path, "is a picture's name, expected .mp4, .gif, .webp or .apng")
        import numpy as np

        trial = path.with_name(f".trial.{path.name}")
        try:
            ls.save_animation(trial, [np.zeros((16, 16, 3), np.float32)], fps)
        except ls.FormatError as error:
            raise ls.FormatError(path, str(error).removeprefix(f"{trial}: ")) from None
        trial.unlink()

    def _origin(self, animation: ls.Animation, config: ls.RenderConfig, device: str) -> dict[str, str]:
        """All that a frame follows from but its number."""
        files = [self.scene, *(path for path in (self.cameras, self.light.environment) if path is not None)]
        chosen = ("width", "height", "camera", "up", "drop_invalid")
        return {
            "lumisplat": ls.__version__,
            "device": device,
            "fps": f"{animation.fps!r}",
            **{name: f"{getattr(self, name)}" for name in chosen},
            "exposure": f"{self.light.exposure}",
            "environment_rotation": f"{self.light.environment_rotation}",
            **dict(_flat("", config)),
            **dict(_flat("actors.", animation.lighting)),
            **file_marks(files, self.output),
        }


def _frame_range(text: str, count: int) -> range:
    """The frames of ``A:B``; nothing: all.

    Raises:
        ConfigError: It is no such range, or holds no frame of the animation.
    """
    if not text:
        return range(count)
    found = re.fullmatch(r"(\d*):(\d*)", text)
    if not found:
        raise ls.ConfigError(f"--frames is '{text}', expected A:B, such as 0:48, 48: or :10")
    first, end = int(found[1] or 0), int(found[2] or count)
    if not first < end <= count:
        raise ls.ConfigError(f"--frames is '{text}', of an animation of {count} frames, 0:{count}")
    return range(first, end)


def _read(paths: list[Path], report: Report) -> Iterator[np.ndarray]:
    """Pictures one by one."""
    for done, path in enumerate(paths):
        report("writing the video", done / len(paths))
        try:
            yield ls.load_image(path)
        except ls.FormatError as error:
            raise ls.SceneError(f"{error}; delete it and run the command again, which makes it anew") from None
    report("writing the video", 1.0)


def _flat(prefix: str, settings: Any) -> Iterator[tuple[str, str]]:
    """Names and values of settings, also of those within."""
    for entry in fields(settings):
        value = getattr(settings, entry.name)
        if is_dataclass(value):
            yield from _flat(f"{prefix}{entry.name}.", value)
        else:
            yield f"{prefix}{entry.name}", value.value if isinstance(value, Enum) else repr(value)
