"""``lumisplat render``: pictures of a scene."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction, arg

import lumisplat as ls
from lumisplat.cli.options.common import (
    DeviceCommand,
    Flag,
    given_options,
    load_scene,
    parse_background,
    resolved_up,
    scene_file,
    setting,
    settled,
    without_none,
)
from lumisplat.cli.options.lighting import LightGroup, LightOptions
from lumisplat.cli.options.tracing import PipelineName, TraceGroup, TraceOptions
from lumisplat.cli.options.unused import unused_options
from lumisplat.cli.options.view import FrameWriter, ViewName
from lumisplat.cli.output.console import progress_bars
from lumisplat.cli.output.pictures import Shot, check_writable, make_folder, plan_shots
from lumisplat.cli.output.stats import print_stats

_log = logging.getLogger("lumisplat")

_OF_RASTER = ("raster_strategy", "antialiasing")


@dataclass(frozen=True, kw_only=True)
class Render(DeviceCommand):
    """Render a scene to pictures."""

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Captures (.ply, .compressed.ply, .spz, .sog), meshes (.obj, .ply, .stl, .glb, .gltf) or a scene.toml, which has
    lights, cameras and settings, too. Several make one scene."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """transforms.json (nerfstudio), cameras.json (INRIA), or a glTF or scene.toml with cameras. Without: those of the
    scene.toml that is rendered, else all of the scene, from the front."""
    up: Literal["auto", "y-down", "y-up", "z-up"] = "auto"
    """Which way is up without cameras, and for --environment; auto: y-down with a capture, y-up for meshes alone."""
    pipeline: Annotated[PipelineName | None, setting("{raster,trace,hybrid}", "raster")] = None
    """raster: fast. trace: rays, exact through Gaussians, with mirrors, glass and fisheye cameras. hybrid: rasterised,
    and rays from there on for mirrors, glass and shadows."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")] = Path("out")
    """A folder, or for one frame a file: .png, .exr or .npz."""
    frame: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = ()
    """Render only this frame of the camera file."""
    width: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Image width; alone, it keeps the camera's aspect ratio."""
    height: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Image height; alone, it keeps the camera's aspect ratio."""
    background: Annotated[str | None, setting("COLOR", "black")] = None
    """black, white, transparent, #rrggbb, or r,g,b in 0..1. An EXR is without one."""
    format: Literal["auto", "png", "exr", "npz"] = "auto"
    """PNG is 8-bit sRGB; EXR and NPZ hold floats. auto follows the name of the output, else png."""
    aov: Annotated[str, arg(metavar="LAYERS", help_behavior_hint="")] = ""
    """Also write some of depth, normal, gaussian_index, instance_index, position and, of lit frames, albedo, emission,
    reflection, lights, hits (with commas): into the EXR, or beside the PNG as NAME.depth.png. An NPZ has them all."""
    view: Annotated[
        ViewName | None,
        arg(metavar="{normal,depth,index,shadow,hits,transmittance}", help_behavior_hint=""),
    ] = None
    """Write this instead of the picture, by colours: how the frame came about."""
    raster_strategy: Annotated[Literal["sorted", "stochastic"] | None, setting("{sorted,stochastic}", "sorted")] = None
    """How the rasteriser resolves splats. sorted: front to back, without noise. stochastic: one of them by chance,
    nothing is sorted; --samples take out the noise."""
    antialiasing: Annotated[Literal["auto", "on", "off"] | None, setting("{auto,on,off}", "auto")] = None
    """Mip-Splatting's opacity compensation; auto: as the capture was trained."""
    sh_degree: Annotated[int | None, setting("0..3", "3")] = None
    """Highest degree of view-dependent colour."""
    transmittance_min: Annotated[float | None, setting("0..1", "0.0001")] = None
    """Pixels and rays, also rays to lights, end where less than this of what lies behind would show."""
    drop_invalid: Flag = False
    """Leave out Gaussians with NaN or infinite values instead of refusing the file."""
    stats: Flag = False
    """Print times, counts and memory of the last frame."""
    trace: TraceGroup = field(default_factory=TraceOptions)
    """Of --pipeline trace and hybrid; --samples and --seed also of lit frames. With mirrors and glass, smooth edges and
    little noise: lumisplat render scene.toml --pipeline trace --samples 16 -o view.png"""
    light: LightGroup = field(default_factory=LightOptions)
    """Lights are those of a scene.toml and of glTF files. Soft shadows and an environment, filmic:
    lumisplat render scene.toml --environment sky.hdr --shadows soft --samples 32 --tone-map agx -o view.png"""

    def run(self) -> None:
        """Renders and writes the pictures."""
        writer = FrameWriter(self.aov, self.view)
        file = scene_file(self.scene)
        config = self._config(ls.RenderConfig() if file is None else ls.load_config(file), writer.aovs)
        # What fails fast comes first: cameras, environment and device before a capture of a gigabyte.
        cameras = self._loaded_cameras(self.cameras or file)
        shots = self._shots(cameras) if cameras else None
        check_writable(self.output)
        environment = self.light.environment_light()
        with progress_bars() as report:
            renderer = self.start_renderer(report, config, profile=self.stats)
            scene = load_scene(self.scene, drop_invalid=self.drop_invalid, report=report)
            scene = self.light.lit_scene(scene, environment, resolved_up(scene, self.up))
            for line in unused_options(config, scene, given_options(self, _OF_RASTER), self.trace, self.light):
                _log.warning("%s", line)
            shots = shots or self._shots([self._framing_camera(scene)])
            make_folder(shots[0].path.parent)
            report("rendering", 0.0)
            for done, shot in enumerate(shots, start=1):
                frame = renderer.render(scene, shot.camera, progress=report)
                writer.write(frame, shot.path)
                report("rendering", done / len(shots))
                if self.stats and done == len(shots):
                    print_stats(frame, config.pipeline)
        print(_summary(shots))
        if writer.legend:
            print(writer.legend)

    def _config(self, base: ls.RenderConfig, aovs: tuple[str, ...]) -> ls.RenderConfig:
        """The settings of the scene file, and what was given in their place."""
        end = without_none({"transmittance_min": self.transmittance_min})
        shared = without_none({"sh_degree": self.sh_degree}) | end
        raster = {
            "strategy": self.raster_strategy and ls.RasterStrategy(self.raster_strategy),
            "antialiasing": self.antialiasing and ls.Antialiasing(self.antialiasing),
        }
        changes: dict[str, Any] = {
            "aovs": (*base.aovs, *aovs),
            "raster": without_none(raster) | shared,
            "trace": shared,
            "shadow_rays": end,
        }
        if self.pipeline is not None:
            changes["pipeline"] = ls.Pipeline(self.pipeline)
        if self.background is not None:
            changes["background"] = parse_background(self.background)
        return settled(base, changes, self.trace.changes(), self.light.changes())

    def _loaded_cameras(self, path: Path | None) -> list[ls.Camera]:
        """The cameras of a file; none where there is no file, or where a scene file leaves the choice open."""
        if path is None:
            return []
        cameras = ls.load_cameras(path, width=self.width, height=self.height)
        if not cameras and self.cameras is not None:
            raise ls.FormatError(path, "has no cameras")
        return [self.light.exposed(camera.scaled(self.width, self.height)) for camera in cameras]

    def _framing_camera(self, scene: ls.Scene) -> ls.Camera:
        from lumisplat.cli.options.framing import framing_camera

        if self.width is not None and self.height is not None:
            camera = framing_camera(scene, self.up, self.width, self.height)
        else:
            camera = framing_camera(scene, self.up).scaled(self.width, self.height)
        return self.light.exposed(camera)

    def _shots(self, cameras: list[ls.Camera]) -> list[Shot]:
        shots = plan_shots(cameras, self.frame, self.output, self.format)
        if self.view and shots[0].path.suffix.lower() != ".png":
            raise ls.ConfigError(f"{shots[0].path}: --view is a picture to look at, expected .png")
        if self.background is not None and shots[0].path.suffix.lower() == ".exr":
            _log.warning("--background is not used: an EXR holds premultiplied colour and alpha, without a background")
        return shots


def _summary(shots: list[Shot]) -> str:
    first = shots[0]
    if len(shots) == 1:
        return f"{first.path} ({first.camera.width} x {first.camera.height})"
    return f"{len(shots)} pictures in {first.path.parent}"
