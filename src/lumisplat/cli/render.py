"""``lumisplat render``: pictures of a scene."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

import lumisplat as ls
from lumisplat.cli.console import progress_bars
from lumisplat.cli.options import DeviceCommand, Flag, load_scene, parse_background
from lumisplat.cli.outputs import Shot, check_writable, make_folder, plan_shots
from lumisplat.cli.stats import print_stats
from lumisplat.cli.tracing import PipelineName, TraceGroup, TraceOptions, warn_unused
from lumisplat.cli.view import FrameWriter, ViewName

_log = logging.getLogger("lumisplat")


@dataclass(frozen=True, kw_only=True)
class Render(DeviceCommand):
    """Render a scene to pictures."""

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Captures (.ply, .compressed.ply, .spz, .sog), meshes (.obj, .ply, .stl, .glb, .gltf) or a scene.toml. Several
    make one scene."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """transforms.json (nerfstudio) or cameras.json (INRIA). Without: all of the scene, from the front."""
    up: Literal["auto", "y-down", "y-up", "z-up"] = "auto"
    """Which way is up without --cameras; auto: y-down with a capture, y-up for meshes alone."""
    pipeline: PipelineName = "raster"
    """raster: fast. trace: rays, exact through Gaussians, with mirrors, glass and fisheye cameras."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")] = Path("out")
    """A folder, or for one frame a file: .png, .exr or .npz."""
    frame: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME")] = ()
    """Render only this frame of the camera file."""
    width: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Image width; alone, it keeps the camera's aspect ratio."""
    height: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Image height; alone, it keeps the camera's aspect ratio."""
    background: Annotated[str | None, arg(metavar="COLOR", help_behavior_hint="")] = None
    """black (the default), white, transparent, #rrggbb, or r,g,b in 0..1. An EXR is without one."""
    format: Literal["auto", "png", "exr", "npz"] = "auto"
    """PNG is 8-bit sRGB; EXR and NPZ hold floats. auto follows the name of the output, else png."""
    aov: Annotated[str, arg(metavar="LAYERS", help_behavior_hint="")] = ""
    """Also write some of depth, normal, gaussian_index, instance_index, position and, of lit frames, albedo, emission,
    reflection, lights, hits (with commas): into the EXR, or beside the PNG as NAME.depth.png. An NPZ has them all."""
    view: Annotated[ViewName | None, arg(help_behavior_hint="")] = None
    """Write this instead of the picture, by colours: how the frame came about."""
    antialiasing: Literal["auto", "on", "off"] = "auto"
    """Mip-Splatting's opacity compensation; auto: as the capture was trained."""
    sh_degree: Annotated[int, arg(metavar="0..3")] = 3
    """Highest degree of view-dependent colour."""
    transmittance_min: Annotated[float, arg(metavar="0..1")] = 1e-4
    """A pixel is finished where less than this of what lies behind would show."""
    drop_invalid: Flag = False
    """Leave out Gaussians with NaN or infinite values instead of refusing the file."""
    stats: Flag = False
    """Print times, counts and memory of the last frame."""
    trace: TraceGroup = field(default_factory=TraceOptions)
    """Of --pipeline trace. With mirrors and glass, smooth edges and little noise:
    lumisplat render scene.toml --pipeline trace --samples 16 -o view.png"""

    def run(self) -> None:
        """Renders and writes the pictures."""
        writer = FrameWriter(self.aov, self.view)
        config = self._config(writer.aovs)
        # What fails fast comes first: cameras and device before a capture of a gigabyte.
        shots = None if self.cameras is None else self._shots(self._loaded_cameras(self.cameras))
        check_writable(self.output)
        with progress_bars() as report:
            renderer = self.start_renderer(report, config, profile=self.stats)
            scene = load_scene(self.scene, drop_invalid=self.drop_invalid, report=report)
            shots = shots or self._shots([self._framing_camera(scene)])
            make_folder(shots[0].path.parent)
            report("rendering", 0.0)
            for done, shot in enumerate(shots, start=1):
                frame = renderer.render(scene, shot.camera, progress=report)
                writer.write(frame, shot.path)
                report("rendering", done / len(shots))
                if self.stats and done == len(shots):
                    print_stats(frame, self.pipeline)
        print(_summary(shots))
        if writer.legend:
            print(writer.legend)

    def _config(self, aovs: tuple[str, ...]) -> ls.RenderConfig:
        shared = {"sh_degree": self.sh_degree, "transmittance_min": self.transmittance_min}
        config = ls.RenderConfig(
            pipeline=ls.Pipeline(self.pipeline),
            background=parse_background(self.background or "black"),
            raster=ls.RasterConfig(antialiasing=ls.Antialiasing(self.antialiasing), **shared),
            trace=self.trace.config(**shared),
            samples=self.trace.samples,
            seed=self.trace.seed,
            max_bounces=self.trace.max_bounces,
            aovs=aovs,
        )
        raster_options = ["--antialiasing"] if self.antialiasing != "auto" else []
        warn_unused(self.trace.given() if self.pipeline == "raster" else raster_options, self.pipeline)
        return config

    def _loaded_cameras(self, path: Path) -> list[ls.Camera]:
        cameras = ls.load_cameras(path, width=self.width, height=self.height)
        return [camera.scaled(self.width, self.height) for camera in cameras]

    def _framing_camera(self, scene: ls.Scene) -> ls.Camera:
        from lumisplat.cli.framing import framing_camera

        if self.width is not None and self.height is not None:
            return framing_camera(scene, self.up, self.width, self.height)
        return framing_camera(scene, self.up).scaled(self.width, self.height)

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
