"""Timing steps of `bench.gpu`: large frames, sorts, copies, and frames beside gsplat."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp

import lumisplat as ls
from bench.gpu.worker import Finding, Setting
from bench.page import times_as_fast
from bench.presets import Preset, synthetic
from bench.timing import TimedRenderer
from lumisplat.runtime.buffers import DeviceArray
from lumisplat.runtime.primitives import sort_pairs

WARM, REPEATS = 3, 10
"""Frames before the timed ones, in which buffers grow and a graph is captured; number of timed frames."""
LIGHT = ls.LightPoint((1.0, -3.0, -3.0), intensity=30.0)


def view(setting: Setting, count: int) -> ls.Camera:
    """Returns the camera of the benchmarks' synthetic sets."""
    return Preset("first light", setting.width, setting.width * 9 // 16, count).camera()


def raster_times(setting: Setting) -> Iterator[Finding]:
    """Times unlit rasterised frames."""
    for count in setting.sizes:
        yield from frame_times(setting, count, ls.RenderConfig(), ls.Scene(splats=[synthetic(count)]), REPEATS)


def trace_times(setting: Setting) -> Iterator[Finding]:
    """Times unlit ray-traced frames and their BVHs."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE)
    for count in setting.sizes:
        yield from frame_times(setting, count, config, ls.Scene(splats=[synthetic(count)]), 3)


def lit_times(setting: Setting) -> Iterator[Finding]:
    """Times hybrid frames with one shadowed light."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID)
    for count in setting.sizes:
        yield from frame_times(setting, count, config, ls.Scene(splats=[synthetic(count)], lights=[LIGHT]), 3)


def frame_times(
    setting: Setting, count: int, config: ls.RenderConfig, scene: ls.Scene, repeats: int
) -> Iterator[Finding]:
    """Reports the first frame, the median of later ones, and the stages of a frame that waits after each."""
    renderer, camera = TimedRenderer(config, setting.device), view(setting, count)
    first = renderer.render(scene, camera)
    yield Finding(f"{count:,}: first frame, ms", round(first.wall_ms, 1))
    yield Finding(f"{count:,}: its stages, ms", rounded(first.stage_ms))
    for _ in range(min(WARM, repeats)):
        renderer.render(scene, camera)
    walls: list[float] = []
    timed = first
    for _ in range(repeats):
        timed = renderer.render(scene, camera)
        walls.append(timed.wall_ms)
    walls.sort()
    yield Finding(
        f"{count:,}: frame, ms (least, most)", [round(ms, 2) for ms in (statistics.median(walls), walls[0], walls[-1])]
    )
    yield Finding(f"{count:,}: stages, ms", rounded(timed.stage_ms))
    stats = timed.frame.stats
    assert stats is not None
    yield Finding(f"{count:,}: visible, pairs, MiB", [stats.visible_count, stats.pair_count, stats.memory_bytes >> 20])


def rounded(stage_ms: dict[str, float]) -> dict[str, float]:
    """Returns milliseconds with two decimals."""
    return {name: round(ms, 2) for name, ms in stage_ms.items()}


def sort_times(setting: Setting) -> Iterator[Finding]:
    """Times the sorts of the rasteriser: of depths, and of pairs by tile."""
    largest = max(setting.sizes)
    for count, bits in ((largest, 32), (2 * largest, 13)):
        values = np.random.default_rng(0).integers(0, 1 << min(bits, 30), 2 * count, dtype=np.int32)
        keys = DeviceArray(values, dtype=wp.int32, device=setting.device)
        items = DeviceArray(shape=2 * count, dtype=wp.int32, device=setting.device)
        sort_pairs(keys, items, count, bits=bits)
        found = keys.numpy()[:count].astype(np.int64) & ((1 << bits) - 1)
        took = milliseconds(setting, partial(sort_pairs, keys, items, count, bits=bits))
        is_sorted = bool((np.diff(found) >= 0).all())
        yield Finding(f"{count:,} pairs by {bits} bits, ms", took, is_wrong=not is_sorted)


def copy_times(setting: Setting) -> Iterator[Finding]:
    """Times copies of a frame's images, 10 words per pixel: to the host, and within the device."""
    words = 10 * setting.width * (setting.width * 9 // 16)
    source, target = (DeviceArray(shape=words, dtype=wp.float32, device=setting.device) for _ in range(2))
    yield Finding("MB", 4e-6 * words)
    yield Finding("within the device, ms", milliseconds(setting, lambda: wp.copy(target, source)))
    yield Finding("to new memory of the host, ms", milliseconds(setting, lambda: source.numpy().copy()))
    if setting.device != "cpu":
        pinned = DeviceArray(shape=words, dtype=wp.float32, device="cpu", pinned=True)
        yield Finding("to pinned memory of the host, ms", milliseconds(setting, lambda: wp.copy(pinned, source)))


def milliseconds(setting: Setting, work: Callable[[], object]) -> float:
    """Returns the median time of some synchronised runs."""
    spans = []
    for _ in range(REPEATS + 1):
        begun = time.perf_counter()
        work()
        wp.synchronize_device(setting.device)
        spans.append(1e3 * (time.perf_counter() - begun))
    return round(statistics.median(spans[1:]), 3)


def beside_gsplat(setting: Setting) -> Iterator[Finding]:
    """Times alternating frames of gsplat's rasteriser and ours, and their PSNR."""
    if setting.device == "cpu":
        yield Finding("skipped", "gsplat rasterises on CUDA only")
        return
    try:
        import torch  # pyright: ignore[reportMissingImports]
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        yield Finding("skipped", f"gsplat is not installed here: {error}")
        return
    for count in setting.sizes:
        yield from turns_with_gsplat(setting, count, torch, rasterization)


def turns_with_gsplat(setting: Setting, count: int, torch: Any, rasterization: Any) -> Iterator[Finding]:
    """Times one set with both renderers, alternating.

    Args:
        setting: Device and size.
        count: Number of Gaussians.
        torch: The module.
        rasterization: gsplat's function.
    """
    gaussians, camera = synthetic(count), view(setting, count)
    draw = gsplat_draw(setting, gaussians, camera, torch, rasterization)
    ours = TimedRenderer(replace(ls.RenderConfig(), background=(0.0, 0.0, 0.0)), setting.device)
    theirs: list[float] = []
    walls: list[float] = []
    scene = ls.Scene(splats=[gaussians])
    image, timed = draw()[0], ours.render(scene, camera)
    for _ in range(WARM + REPEATS):
        torch.cuda.synchronize()
        begun = time.perf_counter()
        image = draw()[0]
        torch.cuda.synchronize()
        theirs.append(1e3 * (time.perf_counter() - begun))
        timed = ours.render(scene, camera)
        walls.append(timed.wall_ms)
    error = np.mean((np.clip(image[0].cpu().numpy(), 0, 1) - np.clip(timed.frame.color, 0, 1)) ** 2)
    drawing = sum(ms for stage, ms in timed.stage_ms.items() if stage not in ("sync", "download"))
    yield Finding(f"{count:,}: gsplat on the device, ms", round(statistics.median(theirs[WARM:]), 2))
    yield Finding(f"{count:,}: ours with download, ms", round(statistics.median(walls[WARM:]), 2))
    what = f"frame, {count:,} Gaussians, {camera.width} x {camera.height}"
    figure = beside(what, drawing, statistics.median(theirs[WARM:]))
    yield Finding(f"{count:,}: our stages but sync and download, ms", round(drawing, 2), figure=figure)
    yield Finding(f"{count:,}: PSNR, dB", round(float(-10.0 * np.log10(error)), 1))


def beside(what: str, ours: float, theirs: float) -> tuple[str, ...]:
    """Returns the page's row of our time beside gsplat's, milliseconds."""
    return "gsplat", what, f"**{ours:.2f} ms**", f"gsplat {theirs:.2f} ms", times_as_fast(ours, theirs)


def gsplat_draw(
    setting: Setting, gaussians: ls.Gaussians, camera: ls.Camera, torch: Any, rasterization: Any
) -> Callable[[], Any]:
    """Returns a call of gsplat's rasteriser with tensors that are already on the device."""
    given = {name: torch.tensor(values, device=setting.device) for name, values in columns(gaussians).items()}
    matrix = torch.tensor(camera.camera_from_world, dtype=torch.float32, device=setting.device)[None]
    lens = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    return partial(
        rasterization,
        **given,
        viewmats=matrix,
        Ks=torch.tensor([lens], dtype=torch.float32, device=setting.device),
        width=camera.width,
        height=camera.height,
        sh_degree=3,
        packed=False,
    )


def columns(gaussians: ls.Gaussians) -> dict[str, np.ndarray]:
    """Returns the arguments of gsplat for a set."""
    return {
        "means": gaussians.means,
        "quats": gaussians.rotations_wxyz,
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        "colors": gaussians.sh,
    }
