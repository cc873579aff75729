"""Steps of `bench.gpu` that time frames: rasterised, traced, lit, path traced and in real time."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import warp as wp

import lumisplat as ls
from bench.gpu.kernel_times import KernelLauncher
from bench.gpu.worker import Finding, Setting
from bench.path_rate import SAMPLES, config as path_config, ray_costs, room, room_view, with_gaussians
from bench.presets import DemoRoom, MovingRoom, OneObject, Preset, stage_ms, synthetic
from support.compare.graph_launcher import GraphLauncher

WARM = 4
"""Frames before the timed ones, in which buffers grow and graphs are captured."""
REPEATS = 10
LIGHT = ls.LightPoint((1.0, -3.0, -3.0), intensity=30.0)
SMALL_DEMO = 160
"""Width of the demo's frames in rehearsals, pixels."""
HOST_STAGES = ("sync", "download")
Stage = Callable[[int], tuple[ls.Scene, ls.Camera]]
"""Returns what a frame shows, by the frame's number."""


def view(setting: Setting, count: int) -> ls.Camera:
    """Returns the camera of the benchmarks' synthetic sets."""
    return Preset("GPU", setting.width, setting.width * 9 // 16, count).camera()


def device_renderer(setting: Setting, config: ls.RenderConfig, *, profile: bool = False) -> ls.Renderer:
    """Returns a renderer on the device; on the CPU with the schedule of GPUs, replayed from graphs.

    Args:
        setting: The device.
        config: Settings of its frames.
        profile: Whether to time stages by waiting for each, without graphs.
    """
    if setting.device == "cpu":
        launcher = GraphLauncher()
        launcher.profile = profile
        return ls.Renderer(config, launcher)
    return ls.create_renderer(config, setting.device, profile=profile)


def still(scene: ls.Scene, camera: ls.Camera) -> Stage:
    """Returns a scene that does not change."""
    return lambda _: (scene, camera)


@dataclass(frozen=True)
class FrameTimes:
    """Times of steady frames, milliseconds."""

    first: float
    """The first frame, with kernels that are not loaded yet."""
    walls: list[float]
    """Each lasts until the colours are on the host."""
    device: float
    """Median of the activities of the device, as its events time them; 0 on a CPU."""
    activities: dict[str, int]
    """Number of the device's activities in the last frame by kind."""
    stages: dict[str, float]
    """Stages of a frame that waits after each."""
    frame: ls.Frame

    @property
    def wall(self) -> float:
        """The median frame, until its colours are on the host."""
        return statistics.median(self.walls)

    @property
    def drawing(self) -> float:
        """The frame's stages without upload and download."""
        return sum(ms for stage, ms in self.stages.items() if stage not in HOST_STAGES)

    @property
    def text(self) -> str:
        """The times as a cell of the page shows them."""
        return f"{self.wall:.2f} ms, on the device {self.drawing:.2f} ms"

    def findings(self, name: str, figure: tuple[str, ...] = ()) -> Iterator[Finding]:
        """Yields what was measured; ``figure`` is the region and the name of the page's row."""
        spread = [round(ms, 2) for ms in (self.wall, min(self.walls), max(self.walls))]
        yield Finding(f"{name}: first frame, ms", round(self.first, 1))
        row = (*figure, self.text, "", "") if figure else ()
        yield Finding(f"{name}: frame, ms (median, least, most)", spread, figure=row)
        yield Finding(f"{name}: device events, ms", round(self.device, 2))
        yield Finding(f"{name}: activities of a frame", self.activities)
        yield Finding(f"{name}: stages, ms", rounded(self.stages))
        stats = self.frame.stats
        if stats is not None:
            sizes = [stats.visible_count, stats.pair_count, stats.memory_bytes >> 20]
            yield Finding(f"{name}: visible, pairs, MiB", sizes)


def frame_times(setting: Setting, config: ls.RenderConfig, shown: Stage, repeats: int = REPEATS) -> FrameTimes:
    """Times frames of ``shown``."""
    repeats = repeats if setting.device != "cpu" else 2
    renderer = device_renderer(setting, config)
    walls: list[float] = []
    device: list[float] = []
    activities: dict[str, int] = {}
    frame: ls.Frame | None = None
    for number in range(1 + WARM + repeats):
        scene, camera = shown(number)
        begun = time.perf_counter()
        frame = renderer.render(scene, camera)
        assert frame.color.size
        walls.append(1e3 * (time.perf_counter() - begun))
    try:
        for number in range(1 + WARM + repeats, 1 + WARM + 2 * repeats):
            found, frame = timed_activities(setting, renderer, *shown(number))
            device.append(sum(ms for _, ms in found))
            activities = {kind: sum(kind == one for one, _ in found) for kind, _ in found}
    except RuntimeError as error:  # the times above stay known
        device, activities = [0.0], {f"{error}"[:200]: 0}
    profiled = device_renderer(setting, config, profile=True)
    stages: list[dict[str, float]] = []
    for number in range(1 + repeats):
        stages.append(stage_ms(profiled.render(*shown(number))))
    names = stages[-1]
    middle = {name: statistics.median(row.get(name, 0.0) for row in stages[1:]) for name in names}
    assert frame is not None
    return FrameTimes(walls[0], walls[1 + WARM :], statistics.median(device), activities, middle, frame)


def timed_activities(
    setting: Setting, renderer: ls.Renderer, scene: ls.Scene, camera: ls.Camera
) -> tuple[list[tuple[str, float]], ls.Frame]:
    """Renders a frame; returns the kind and the milliseconds of each activity of the GPU, and the frame.

    On a CPU, it returns the calls that would be made, without times.
    """
    if setting.device == "cpu":
        launcher = renderer._launcher
        assert isinstance(launcher, GraphLauncher)
        before = launcher.draws, launcher.launches
        frame = renderer.render(scene, camera)
        counted = {"graph": launcher.draws - before[0], "kernel": launcher.launches - before[1]}
        return [(kind, 0.0) for kind, count in counted.items() for _ in range(count)], frame
    kinds = {wp.TIMING_KERNEL: "kernel", wp.TIMING_MEMCPY: "copy", wp.TIMING_MEMSET: "fill", wp.TIMING_GRAPH: "graph"}
    wp.timing_begin()
    frame = renderer.render(scene, camera)
    assert frame.color.size
    return [(kinds.get(one.filter, "kernel"), one.elapsed) for one in wp.timing_end()], frame


def rounded(stage_times: dict[str, float]) -> dict[str, float]:
    """Returns milliseconds with two decimals."""
    return {name: round(ms, 2) for name, ms in stage_times.items()}


def synthetic_frames(
    setting: Setting, region: str, what: str, config: ls.RenderConfig, lights: Sequence[ls.LightPoint] = ()
) -> Iterator[Finding]:
    """Times frames of the synthetic sets of all sizes."""
    for count in setting.sizes:
        scene, camera = ls.Scene(splats=[synthetic(count)], lights=lights), view(setting, count)
        title = f"{what}, {count:,} synthetic Gaussians, {camera.width} x {camera.height}"
        yield from frame_times(setting, config, still(scene, camera)).findings(title, (region, title))


def rasterised(setting: Setting) -> Iterator[Finding]:
    """Times unlit rasterised frames."""
    yield from synthetic_frames(setting, "frames", "rasterised", ls.RenderConfig())


def hybrid_lit(setting: Setting) -> Iterator[Finding]:
    """Times hybrid frames with one shadowed light."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID)
    yield from synthetic_frames(setting, "frames", "`hybrid`, lit by one light", config, [LIGHT])


def traced(setting: Setting, strategy: str) -> Iterator[Finding]:
    """Times unlit ray-traced frames."""
    trace = ls.TraceConfig(strategy=ls.config.TraceStrategy(strategy))
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, trace=trace, samples=1)
    yield from synthetic_frames(setting, "rays", f"traced, `{strategy}`", config)


def demo(setting: Setting, pipeline: str) -> Iterator[Finding]:
    """Times frames of the lit room, with one sample each."""
    width = SMALL_DEMO if setting.device == "cpu" else 1280
    scene, camera = ls.demo_scene_lit(), ls.demo_cameras(width, width * 9 // 16, count=1)[0]
    config = ls.RenderConfig(pipeline=ls.Pipeline(pipeline), samples=1)
    title = f"demo, {camera.width} x {camera.height}, `{pipeline}`, 1 sample"
    region = {"path": "rays", "realtime": "realtime"}.get(pipeline, "frames")
    yield from frame_times(setting, config, still(scene, camera)).findings(title, (region, title))
    yield Finding("kernels of a frame", kernel_rows(setting, config, scene, camera))


def moving(setting: Setting, preset_name: str) -> Iterator[Finding]:
    """Times real-time frames of a scene in motion by pass and by kernel, and what waits for the host."""
    presets = {"room": MovingRoom, "demo": DemoRoom, "object": OneObject}
    preset = presets[preset_name](0.01 if setting.device == "cpu" else 1.0)
    camera = preset.camera()
    times = frame_times(setting, preset.config(), lambda number: (preset.scene(number), camera), repeats=30)
    yield from times.findings(preset.title)
    per_second = f"{1e3 / times.wall:.1f} frames a second"
    waits = f"{times.wall:.2f} ms a frame, of which activities of the GPU take {times.device:.2f} ms"
    row = ("realtime", preset.title, f"{per_second}; {waits}", "", "")
    yield Finding("frames a second", round(1e3 / times.wall, 1), figure=row)
    if setting.device != "cpu":
        yield Finding("host alone, ms", round(times.wall - times.device, 2))
    yield Finding("kernels of a frame", kernel_rows(setting, preset.config(), preset.scene(0), camera))


def kernel_rows(
    setting: Setting, config: ls.RenderConfig, scene: ls.Scene, camera: ls.Camera
) -> list[dict[str, object]]:
    """Returns the kernels of a frame that take most time, each with its launches and milliseconds."""
    launcher = KernelLauncher(setting.device)
    renderer = ls.Renderer(config, launcher)
    for _ in range(3):
        launcher.reset()
        renderer.render(scene, camera)
    longest = sorted(launcher.kernel_ms, key=lambda key: -launcher.kernel_ms[key])[:16]
    return [
        {"kernel": key, "launches": launcher.launches[key], "ms": round(launcher.kernel_ms[key], 3)} for key in longest
    ]


def shadow_rays(setting: Setting) -> Iterator[Finding]:
    """Times the kernels of one light's shadow rays, one ray per pixel that shows a surface, for each method."""
    count = setting.sizes[0]
    capture = ls.SplatInstance(synthetic(count), material=ls.MaterialPbr())
    scene, camera = ls.Scene(splats=[capture], lights=[LIGHT]), view(setting, count)
    for method in ls.config.ShadowMethod:
        config = ls.RenderConfig(
            pipeline=ls.Pipeline.HYBRID, samples=1, shadows=ls.Shadows.HARD, shadow_rays=ls.ShadowConfig(method=method)
        )
        launcher = KernelLauncher(setting.device)
        renderer = ls.Renderer(config, launcher)
        spent: list[float] = []
        frame = renderer.render(scene, camera)
        for _ in range(WARM):
            launcher.reset()
            frame = renderer.render(scene, camera)
            spent.append(sum(ms for key, ms in launcher.kernel_ms.items() if "shadow" in key))
        rays = int((frame.alpha > 0.0).sum())
        ms = statistics.median(spent)
        title = (
            f"shadow rays of one light, `{method.value}`, {count:,} relit Gaussians, {camera.width} x {camera.height}"
        )
        row = ("rays", title, f"{ms:.2f} ms, {1e6 * ms / max(rays, 1):.2f} ns a ray", "", "")
        yield Finding(title, round(ms, 3), figure=row)
        yield Finding(f"{method.value}: kernels, ms", rounded(dict(launcher.kernel_ms)))


def bounced_rays(setting: Setting) -> Iterator[Finding]:
    """Times the hits of camera rays and of bounced rays, which are incoherent."""
    scenes = {"mesh room": (ls.Scene(meshes=room()), room_view())}
    scenes |= {f"room with {count:,} Gaussians": (with_gaussians(count), room_view()) for count in setting.sizes[:1]}
    scenes["demo"] = ls.demo_scene_lit(), ls.demo_cameras(640, 360, count=1)[0]
    for name, (scene, camera) in scenes.items():
        size = camera.scaled(64 if setting.device == "cpu" else 1280)
        coherent, incoherent = ray_costs(scene, size, setting.device, time.perf_counter)
        row = ("rays", f"hits of a camera ray; of a bounced ray, {name}", f"{coherent:.1f}; {incoherent:.1f} ns")
        ratio = f"bounced rays take {incoherent / coherent:.2f} times as long"
        yield Finding(f"{name}: ns a camera ray, a bounced ray", [coherent, incoherent], figure=(*row, "", ratio))


def deep_shadow_map(setting: Setting) -> Iterator[Finding]:
    """Times the build of a deep shadow map of 100,000 casters."""
    count, repeats = (500, 1) if setting.device == "cpu" else (100_000, 5)
    casters = synthetic(count)
    spent: list[float] = []
    for _ in range(1 + repeats):
        begun = time.perf_counter()
        ls.DeepShadowMap.build(casters, (0.5, -3.0, 1.0), casters, device=setting.device)
        wp.synchronize()
        spent.append(1e3 * (time.perf_counter() - begun))
    ms = f"{statistics.median(spent[1:]):.0f} ms"
    row = ("frames", f"deep shadow map of {count:,} casters: build", ms, "", "")
    yield Finding(f"{count:,} casters", ms, figure=row)


def path_rate(setting: Setting) -> Iterator[Finding]:
    """Times frames of a room by path tracing: of meshes, and with relit Gaussians."""
    camera = room_view().scaled(32) if setting.device == "cpu" else room_view()
    scenes = {"room of meshes": ls.Scene(meshes=room())}
    scenes |= {f"room with {count:,} relit Gaussians": with_gaussians(count) for count in (100_000, setting.sizes[0])}
    for name, scene in scenes.items():
        times = frame_times(setting, path_config(SAMPLES), still(scene, camera))
        yield from times.findings(name)
        rate = f"{1e-3 * camera.width * camera.height * SAMPLES / times.wall:.3g} million"
        yield Finding(f"{name}: samples a second", rate, figure=("rays", f"samples per second, {name}", rate, "", ""))
