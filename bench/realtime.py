"""Times the passes of real-time frames by quality, pixels, Gaussians, lights and models (5 minutes).

``python -m bench.realtime [--only quality,pixels,...]`` prints milliseconds of CPU time over all threads: the median of
6 frames after 4, alternating with unlit raster frames of the same view. The first table shows the demo scene in each
quality, the others depend on pixels, Gaussians, lights and models. The last is the moving room of ``python -m bench.gpu
--slices realtime``, whose 1.57 million Gaussians and 1920 x 1088 pixels are scaled by ``--scale``.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator

import numpy as np

import lumisplat as ls
from bench.presets import MovingRoom, Preset, synthetic

WARM_FRAMES, FRAMES = 4, 6
SIZE = 640, 360
PASSES: tuple[str, ...] = ("surfaces", "direct", "mirrors", "indirect", "filters", "sum", "antialiasing")
COUNTS = {"gaussians": (100_000, 300_000, 1_000_000, 3_000_000), "lights": (1, 16, 100, 1_000), "models": (1, 10, 50)}
GROWTH_SIZE = 320, 180
ROOM_SCALE = 0.05
Case = tuple[str, ls.RenderConfig, Callable[[int], ls.Scene], ls.Camera]
"""Name, settings, scene by the frame's number, and camera."""


def main() -> None:
    """Prints a table for each parameter."""
    from bench.timing import parser, print_head, quiet_warp

    tables = {"quality": qualities, "pixels": sizes, **dict.fromkeys(COUNTS, growth)}
    tables["room"] = lambda _: moving_room(options.scale)
    asked = parser("realtime", __doc__)
    asked.add_argument("--scale", type=float, default=ROOM_SCALE, help="fraction of the moving room's size")
    asked.add_argument("--only", default=",".join(tables), help="some of " + ", ".join(tables))
    options = asked.parse_args()
    quiet_warp()
    for name in options.only.split(","):
        print_head(name, "unlit", "frame", "times unlit", *PASSES)
        for label, config, scene, camera in tables[name](name):
            print(row(label, config, scene, camera), flush=True)


def realtime(quality: ls.config.RealtimeQuality = ls.config.RealtimeQuality.BALANCED) -> ls.RenderConfig:
    """Returns settings of real-time frames."""
    return ls.RenderConfig(
        pipeline=ls.Pipeline.REALTIME,
        lighting=True,
        tone_map=ls.ToneMap.NEUTRAL,
        realtime=ls.RealtimeConfig(quality=quality),
    )


def qualities(_: str) -> Iterator[Case]:
    """Yields the demo scene in each quality."""
    scene = ls.demo_scene_lit()
    for quality in ls.config.RealtimeQuality:
        yield quality.value, realtime(quality), lambda _: scene, ls.demo_cameras(*SIZE, count=1)[0]


def sizes(_: str) -> Iterator[Case]:
    """Yields the demo scene in two sizes."""
    scene = ls.demo_scene_lit()
    for width, height in (GROWTH_SIZE, SIZE):
        yield f"{width} x {height}", realtime(), lambda _: scene, ls.demo_cameras(width, height, count=1)[0]


def growth(name: str) -> Iterator[Case]:
    """Yields a relit synthetic capture with lights and spheres around it, in growing numbers of one of them."""
    camera = Preset("", *GROWTH_SIZE, 1).camera()
    for count in COUNTS[name]:
        number = {"gaussians": 100_000, "lights": 1, "models": 10} | {name: count}
        capture = ls.SplatInstance(synthetic(number["gaussians"]), material=ls.MaterialPbr())
        lights = [ls.LightPoint(tuple(at), intensity=6.0 / number["lights"]) for at in ring(number["lights"], 2.2)]
        ball = ls.sphere(0.12)
        balls = [ls.MeshInstance(ball, position=at) for at in ring(number["models"], 1.3)]
        scene = ls.Scene(splats=[capture], meshes=balls, lights=lights)
        yield f"{count:,}", realtime(), lambda _, scene=scene: scene, camera


def moving_room(scale: float) -> Iterator[Case]:
    """Yields the moving room."""
    preset = MovingRoom(scale)
    yield preset.title, preset.config(), preset.scene, preset.camera()


def ring(count: int, radius: float) -> np.ndarray:
    """Returns points of a circle, shape (count, 3)."""
    angles = 2.0 * np.pi * np.arange(count) / count + 0.3
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, -0.8)], axis=1)


def row(label: str, config: ls.RenderConfig, scene_of: Callable[[int], ls.Scene], camera: ls.Camera) -> str:
    """Returns a row of the table."""
    from lumisplat.runtime.launcher import Launcher

    launcher = Launcher("cpu")
    launcher.clock = time.process_time
    lit, unlit = ls.Renderer(config, launcher), ls.create_renderer(ls.RenderConfig(lighting=False), "cpu")
    unlit_ms: list[float] = []
    frame_ms: list[float] = []
    pass_ms: list[dict[str, float]] = []
    for number in range(WARM_FRAMES + FRAMES):
        scene = scene_of(number)
        unlit_ms.append(cpu_ms(unlit, scene, camera))
        frame_ms.append(cpu_ms(lit, scene, camera))
        passes = dict.fromkeys(PASSES, 0.0)
        for stage, milliseconds in launcher.stage_ms.items():
            name = stage.partition(":")[0]
            passes[name] = passes.get(name, 0.0) + milliseconds
        pass_ms.append(passes)
    before, now = (statistics.median(values[WARM_FRAMES:]) for values in (unlit_ms, frame_ms))
    medians = [statistics.median(passes[name] for passes in pass_ms[WARM_FRAMES:]) for name in PASSES]
    shown = " | ".join(f"{value:,.0f}" for value in medians)
    return f"| {label} | {before:,.0f} | {now:,.0f} | {now / before:.1f} | {shown} |"


def cpu_ms(renderer: ls.Renderer, scene: ls.Scene, camera: ls.Camera) -> float:
    """Returns the CPU time of a frame with its colours on the host, milliseconds."""
    started = time.process_time()
    assert renderer.render(scene, camera).color.size
    return 1e3 * (time.process_time() - started)


if __name__ == "__main__":
    main()
