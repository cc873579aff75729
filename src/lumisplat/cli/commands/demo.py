"""``lumisplat demo``: renders a scene that the package makes itself, unlit and lit by each pipeline."""

from __future__ import annotations

import logging
import math
import tempfile
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

import lumisplat as ls
from lumisplat.cli.options.command import DeviceCommand, Flag, own_options_first
from lumisplat.cli.output.console import Report, progress_bars
from lumisplat.cli.output.images import check_writable, make_folder, plan_shots

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from PIL import Image


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Demo(DeviceCommand):
    """Render the demo scene; nothing is downloaded."""

    output: Annotated[Path, arg(aliases=("-o",), metavar="DIR")] = Path("out")
    """Write the images into this folder."""
    width: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Set the image width; lit images are half as wide, animations a quarter."""
    scene: Annotated[Literal["room", "moving"], arg(metavar="room|moving")] = "room"
    """Choose the room at rest, or one in motion, rendered in real time."""
    save_assets: Flag = False
    """Also write demo.ply and transforms.json, to try other commands."""

    def run(self) -> None:
        """Builds the scene, and renders and writes its images."""
        if self.scene == "moving":
            self._write_moving()
            return
        cameras = ls.demo_cameras()
        shots = plan_shots([camera.scaled(self.width) for camera in cameras], (), self.output, "png")
        check_writable(self.output)
        with progress_bars() as report:
            renderer = self.start_renderer(report, ls.RenderConfig(lighting=False))
            make_folder(self.output)
            scene = ls.demo_scene(report)
            if self.save_assets:
                self._save_assets(scene, cameras)
            for done, shot in enumerate(shots):
                report("rendering", done / len(shots))
                renderer.render(scene, shot.camera).save(shot.path)
                print(shot.path, flush=True)
            report("rendering", 1.0)
            self._write_lit_images(scene, shots[0].camera, report)

    def _write_lit_images(self, scene: ls.Scene, camera: ls.Camera, report: Report) -> None:
        """Writes the lit images, and prints the path of each as soon as it is written."""

        def start(config: ls.RenderConfig) -> ls.Renderer:
            return self.start_renderer(report, config)

        for path in lit_images(ls.demo_scene_lit(scene), camera, self.output, start, report):
            print(path, flush=True)

    def _write_moving(self) -> None:
        """Writes ``moving.webp`` and its frame in the middle, ``moving.png``."""
        if self.save_assets:
            raise ls.ConfigError("--save-assets writes the still room: leave out --scene moving")
        check_writable(self.output)
        with progress_bars() as report:
            config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, tone_map=ls.ToneMap.NEUTRAL)
            renderer = self.start_renderer(report, config)
            make_folder(self.output)
            for path in moving_images(renderer, self.width or 1280, self.output, report):
                print(path, flush=True)

    def _save_assets(self, scene: ls.Scene, cameras: list[ls.Camera]) -> None:
        ls.save(self.output / "demo.ply", scene.splats[0].gaussians)
        ls.save_cameras(self.output / "transforms.json", cameras)


_SAMPLES = 16
"""Samples per pixel of the lit images; few, so that a frame takes seconds: dark corners stay noisy."""
_SWING_FRAMES = 24
"""Number of frames of the animation, in which the spot light swings from right to left and back once."""
_SWING_SAMPLES = 8
"""Samples per pixel of the animation: half of what it takes to remove visible noise, as that took 156 s instead of 88
s on one core.
"""
_SWING_FPS = 12.0
_SWING_MIDDLE = 0.2
"""World x coordinate of the spot light in the middle of its swing, metres."""


def _lit_config() -> ls.RenderConfig:
    """Returns the render settings of the demo's lit images."""
    return ls.RenderConfig(
        pipeline=ls.Pipeline.HYBRID,
        shadows=ls.Shadows.SOFT,
        # Stochastic shadows are unbiased; with this many samples, no difference from exact ones is visible.
        shadow_rays=ls.ShadowConfig(method=ls.config.ShadowMethod.STOCHASTIC),
        tone_map=ls.ToneMap.NEUTRAL,
        samples=_SAMPLES,
        max_bounces=6,
    )


_Start = Callable[["ls.RenderConfig"], "ls.Renderer"]
"""Function that creates a renderer with the given settings."""


def lit_images(scene: ls.Scene, camera: ls.Camera, folder: Path, start: _Start, report: Report) -> Iterator[Path]:
    """Renders and writes ``lit-PIPELINE.png`` for each pipeline, ``lit-aovs.png`` and ``lit-swing.gif``.

    Args:
        scene: The lit scene.
        camera: The camera; lit images have half its width, the animation a quarter.
        folder: An existing folder.
        start: Creates a renderer with the given settings.
        report: Receives the progress.

    Yields:
        The path of each image, once it is written.
    """
    view = camera.scaled(max(1, camera.width // 2))
    for pipeline in (ls.Pipeline.RASTER, ls.Pipeline.TRACE, ls.Pipeline.HYBRID):
        aovs = _SHEET_AOVS if pipeline.rasterises and pipeline.spawns_rays else ()
        renderer = start(replace(_lit_config(), pipeline=pipeline, aovs=aovs))
        frame = renderer.render(scene, view, progress=_labelled(report, f"lighting, {pipeline.value}"))
        path = folder / f"lit-{pipeline.value}.png"
        frame.save(path)
        yield path
        if aovs:
            _write_sheet(frame, folder / "lit-aovs.png")
            yield folder / "lit-aovs.png"
    path = folder / "lit-swing.gif"
    with _few_samples():
        pictures = _swing(scene, camera.scaled(max(1, camera.width // 4)), start, report)
    ls.save_animation(path, pictures, fps=_SWING_FPS)
    yield path


@contextmanager
def _few_samples() -> Generator[None]:
    """Context in which no warnings about too few samples are logged: the demo uses few on purpose."""
    log = logging.getLogger("lumisplat.noise")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)


def _swing(scene: ls.Scene, camera: ls.Camera, start: _Start, report: Report) -> list[npt.NDArray[np.float32]]:
    """Returns the images of one swing of the spot light, from right to left and back."""
    spot, *others = scene.lights
    assert isinstance(spot, ls.LightSpot)
    renderer = start(replace(_lit_config(), samples=_SWING_SAMPLES))
    pictures: list[npt.NDArray[np.float32]] = []
    half = _SWING_FRAMES // 2
    for step in range(half + 1):
        report("moving a light", step / (half + 1))
        swing = math.cos(math.pi * step / half)
        (x, y, z), (dx, dy, dz) = spot.position, spot.direction
        position = (_SWING_MIDDLE + swing * (x - _SWING_MIDDLE), y, z)
        moved = replace(spot, position=position, direction=(swing * dx, dy, dz))
        pictures.append(renderer.render(replace(scene, lights=(moved, *others)), camera).pixels_srgb())
    report("moving a light", 1.0)
    return pictures + pictures[-2:0:-1]


def _labelled(report: Report, label: str) -> Report:
    """Returns a progress function that passes on fractions with a fixed label, whatever label it receives."""
    return lambda _, share: report(label, share)


_STILL_FRAMES = 16
"""Number of frames of the moving room before it moves, in which light settles."""
_MOVING_FPS = 24.0


def moving_images(renderer: ls.Renderer, width: int, folder: Path, report: Report) -> Iterator[Path]:
    """Renders and writes ``moving.png`` and ``moving.webp``, a quarter of ``width`` wide; yields each path."""
    from lumisplat.demo.moving import DURATION, moving_camera, moving_scene  # imports NumPy

    camera = moving_camera(max(16, width // 4), max(9, 9 * width // 64))
    count = round(_MOVING_FPS * DURATION)
    pictures: list[npt.NDArray[np.float32]] = []
    for number in range(-_STILL_FRAMES, count):
        report("rendering", (number + _STILL_FRAMES) / (count + _STILL_FRAMES))
        frame = renderer.render(moving_scene(number / _MOVING_FPS), camera)
        if number >= 0:
            pictures.append(frame.pixels_srgb())
        if number == count // 2:
            frame.save(folder / "moving.png")
            yield folder / "moving.png"
    report("rendering", 1.0)
    ls.save_animation(folder / "moving.webp", pictures, fps=_MOVING_FPS)
    yield folder / "moving.webp"


_COLUMNS = 4
_LAYERS = ("albedo", "normal", "depth", "position", "gaussian_index", "instance_index", "emission", "reflection")
"""Layers in the first two rows of the contact sheet ``lit-aovs.png``. The third row shows the direct light of each
light and ``hits``, the fourth the shadows of each light and the image itself."""

_SHEET_AOVS = ("albedo", "emission", "reflection", "lights", "hits")
"""AOVs that must be rendered for the contact sheet."""


def _write_sheet(frame: ls.Frame, path: Path) -> None:
    """Writes a contact sheet of a frame's layers, lights and shadows; it is twice as wide as the frame."""
    from PIL import Image

    tiles = _tiles(frame)
    width, height = max(1, frame.camera.width // 2), max(1, frame.camera.height // 2)
    sheet = Image.new("RGB", (_COLUMNS * width, -(-len(tiles) // _COLUMNS) * height))
    for index, (name, picture) in enumerate(tiles.items()):
        # Nearest, because index colours must not be blended.
        how = Image.Resampling.NEAREST if "index" in name else Image.Resampling.BOX
        tile = picture.resize((width, height), how)
        _label(tile, name)
        sheet.paste(tile, (index % _COLUMNS * width, index // _COLUMNS * height))
    sheet.save(path)


def _tiles(frame: ls.Frame) -> dict[str, Image.Image]:
    """Returns the small images of the contact sheet by layer name, in order."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        frame.save(Path(folder) / "picture.png", layers=(*_LAYERS, "lights", "hits"))
        pictures = {
            file.name.removeprefix("picture.").removesuffix("png").strip("."): Image.open(file).convert("RGB")
            for file in Path(folder).iterdir()
        }
    # Lights are listed in scene order, not by name.
    parts = {part: [f"light.{name}.{part}" for name in frame.light_names] for part in ("direct", "shadow")}
    order = [*_LAYERS, *parts["direct"], "hits", *parts["shadow"], ""]
    return {name or "picture": pictures[name] for name in order}


def _label(tile: Image.Image, name: str) -> None:
    from PIL import ImageDraw, ImageFont

    font = ImageFont.load_default(max(8, tile.height // 14))
    ImageDraw.Draw(tile).text(
        (6, tile.height - 5), name, fill="white", font=font, anchor="ld", stroke_width=2, stroke_fill="black"
    )
