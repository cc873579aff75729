"""Steps of `bench.gpu` beside gsplat's rasteriser, with alternating frames of both."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

import lumisplat as ls
from bench.gpu.derivatives import stages_of_gradients
from bench.gpu.frames import HOST_STAGES, rounded, view
from bench.gpu.worker import Finding, Setting
from bench.page import times_as_fast
from bench.presets import synthetic
from bench.timing import TimedRenderer

WARM, REPEATS = 3, 10
"""Frames before the timed ones, and timed frames."""


def modules(setting: Setting) -> tuple[Any, Any] | str:
    """Returns PyTorch and gsplat's function, or why they cannot be used."""
    if setting.device == "cpu":
        return "gsplat rasterises on CUDA only"
    try:
        import torch  # pyright: ignore[reportMissingImports]
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        return f"gsplat is not installed here: {error}"
    return torch, rasterization


def frames(setting: Setting) -> Iterator[Finding]:
    """Times alternating frames of gsplat's rasteriser and ours, and their PSNR."""
    found = modules(setting)
    if isinstance(found, str):
        yield Finding("skipped", found)
        return
    for count in setting.sizes:
        yield from compare_frames(setting, count, *found)


def gradients(setting: Setting) -> Iterator[Finding]:
    """Times frames and gradients of gsplat's rasteriser and ours, and compares the gradients."""
    found = modules(setting)
    if isinstance(found, str):
        yield Finding("skipped", found)
        return
    for count in (100_000, *setting.sizes[:1]):
        yield from compare_gradients(setting, count, *found)


def compare_frames(setting: Setting, count: int, torch: Any, rasterization: Any) -> Iterator[Finding]:
    """Times one set with both renderers, alternating.

    Args:
        setting: Device and size.
        count: Number of Gaussians.
        torch: The module.
        rasterization: gsplat's function.
    """
    gaussians, camera = synthetic(count), view(setting, count)
    draw = gsplat_draw(setting, gaussians, camera, torch, rasterization)
    ours = TimedRenderer(ls.RenderConfig(background=(0.0, 0.0, 0.0)), setting.device)
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
    drawing = sum(ms for stage, ms in timed.stage_ms.items() if stage not in HOST_STAGES)
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
    return partial(rasterization, **given, **view_arguments(setting, camera, torch))


def view_arguments(setting: Setting, camera: ls.Camera, torch: Any) -> dict[str, Any]:
    """Returns the arguments of gsplat for a camera, with SH of degree 3."""
    lens = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    return {
        "viewmats": torch.tensor(camera.camera_from_world, dtype=torch.float32, device=setting.device)[None],
        "Ks": torch.tensor([lens], dtype=torch.float32, device=setting.device),
        "width": camera.width,
        "height": camera.height,
        "sh_degree": 3,
        "packed": False,
    }


def columns(gaussians: ls.Gaussians) -> dict[str, np.ndarray]:
    """Returns the arguments of gsplat for a set."""
    return {
        "means": gaussians.means,
        "quats": gaussians.rotations_wxyz,
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        "colors": gaussians.sh,
    }


def compare_gradients(setting: Setting, count: int, torch: Any, rasterization: Any) -> Iterator[Finding]:
    """Times one set with both renderers."""
    gaussians, camera = synthetic(count), view(setting, count)
    pixel_weights = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    leaves = {
        name: torch.tensor(np.ascontiguousarray(values), device=setting.device, requires_grad=True)
        for name, values in columns(gaussians).items()
    }
    of_view = view_arguments(setting, camera, torch)
    weights = torch.tensor(pixel_weights, device=setting.device)[None]
    theirs: list[tuple[float, float]] = []
    for _ in range(WARM + REPEATS):
        for leaf in leaves.values():
            leaf.grad = None
        torch.cuda.synchronize()
        begun = time.perf_counter()
        image = rasterization(**leaves, **of_view)[0]
        torch.cuda.synchronize()
        drawn = time.perf_counter()
        (image * weights).sum().backward()
        torch.cuda.synchronize()
        theirs.append((1e3 * (drawn - begun), 1e3 * (time.perf_counter() - drawn)))
    ours, _, found = stages_of_gradients(setting, None, ls.Scene([gaussians]), camera, pixel_weights)
    forward, backward = (statistics.median(row[k] for row in theirs[WARM:]) for k in (0, 1))
    yield Finding(f"{count:,}: gsplat's frame and derivatives, ms", [round(forward, 2), round(backward, 2)])
    backward_ms = sum(ms for stage, ms in ours.items() if stage.startswith("backward"))
    figure = beside(f"backward pass, {count:,} Gaussians, {camera.width} x {camera.height}", backward_ms, backward)
    yield Finding(f"{count:,}: our stages, ms", rounded(ours), figure=figure)
    alike = np.corrcoef(found.means.ravel(), leaves["means"].grad.cpu().numpy().ravel())[0, 1]
    yield Finding(f"{count:,}: correlation of derivatives by means", round(float(alike), 5))
