"""The demo's lit pictures: one a pipeline, a sheet of what they are made of, and a light that swings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.output.console import Report
from lumisplat.cli.output.demo_sheet import write_sheet

_SAMPLES = 16
"""Of each picture: noise is still seen in dark corners, and a frame takes seconds."""
_SWING_FRAMES = 24
"""Of the animation: one swing, there and back."""
_SWING_SAMPLES = 8
_SWING_FPS = 12.0
_SWING_MIDDLE = 0.2
"""x of the plane through the room about which the spot swings, metres."""

_LOOK = ls.RenderConfig(
    pipeline=ls.Pipeline.HYBRID,
    shadows=ls.Shadows.SOFT,
    # On average as bright as exact shadows, and twice as fast: with this many samples, nobody sees the difference.
    shadow_rays=ls.ShadowConfig(method=ls.ShadowMethod.STOCHASTIC),
    tone_map=ls.ToneMap.NEUTRAL,
    samples=_SAMPLES,
    max_bounces=6,
)

Start = Callable[[ls.RenderConfig], ls.Renderer]
"""Makes a renderer."""


def lit_pictures(scene: ls.Scene, camera: ls.Camera, folder: Path, start: Start, report: Report) -> Iterator[Path]:
    """Renders and writes ``lit-PIPELINE.png`` thrice, ``lit-aovs.png``, ``lit-swing.gif``.

    Args:
        scene: The lit scene.
        camera: The view; lit pictures are half as wide, those of the animation a quarter.
        folder: Where to; it is there.
        start: Makes renderers.
        report: Hears of the progress.

    Yields:
        The path of each, once it is written.
    """
    view = camera.scaled(max(1, camera.width // 2))
    for pipeline in (ls.Pipeline.RASTER, ls.Pipeline.TRACE, ls.Pipeline.HYBRID):
        aovs = tuple(ls.Frame.NEEDS.values()) if pipeline is ls.Pipeline.HYBRID else ()
        renderer = start(replace(_LOOK, pipeline=pipeline, aovs=aovs))
        frame = renderer.render(scene, view, progress=_labelled(report, f"lighting, {pipeline.value}"))
        path = folder / f"lit-{pipeline.value}.png"
        frame.save(path)
        yield path
    path = folder / "lit-aovs.png"
    write_sheet(frame, path)
    yield path
    path = folder / "lit-swing.gif"
    ls.save_animation(path, _swing(scene, camera.scaled(max(1, camera.width // 4)), start, report), fps=_SWING_FPS)
    yield path


def _swing(scene: ls.Scene, camera: ls.Camera, start: Start, report: Report) -> list:
    """Pictures of one swing of the spot, from right to left and back."""
    spot, *others = scene.lights
    assert isinstance(spot, ls.LightSpot)
    renderer = start(replace(_LOOK, samples=_SWING_SAMPLES))
    way = []
    turn = _SWING_FRAMES // 2
    for step in range(turn + 1):
        report("moving a light", step / (turn + 1))
        share = math.cos(math.pi * step / turn)
        (x, y, z), (dx, dy, dz) = spot.position, spot.direction
        position = (_SWING_MIDDLE + share * (x - _SWING_MIDDLE), y, z)
        moved = replace(spot, position=position, direction=(share * dx, dy, dz))
        way.append(renderer.render(replace(scene, lights=(moved, *others)), camera).pixels_srgb())
    report("moving a light", 1.0)
    return way + way[-2:0:-1]


def _labelled(report: Report, label: str) -> Report:
    """Reports under a label of its own."""
    return lambda _, share: report(label, share)
