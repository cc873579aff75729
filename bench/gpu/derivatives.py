"""Gradient steps of `bench.gpu`: against the CPU and beside gsplat; and times of training."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

import lumisplat as ls
from bench.gpu.times import beside, columns, rounded, view
from bench.gpu.worker import Finding, Setting
from bench.presets import synthetic
from bench.training import stages_of
from support.scenes import raster_scenes

FAR_APART = 1e-3
"""Largest norm of a gradient's difference from the CPU's, relative to its norm."""
WARM, REPEATS = 3, 8
TRAINED = (10_000, 100_000)
BACKENDS = {
    "raster": ls.RenderConfig(),
    "raster, unscented": ls.RenderConfig(raster=ls.RasterConfig(projection=ls.config.Projection.UNSCENTED)),
    "trace": ls.RenderConfig(pipeline=ls.Pipeline.TRACE),
}
"""Settings of the frames that are differentiated."""
PARAMETERS = ("means", "rotations_wxyz", "scales", "opacities", "sh")


def gradients(setting: Setting) -> Iterator[Finding]:
    """Checks gradients of frames: rasterised, unscented and ray traced."""
    for backend, config in BACKENDS.items():
        worst = 0.0
        for seed, degree in ((3, 2), (4, 0)):
            scene = ls.Scene([raster_scenes.random_gaussians(seed, 400, degree=degree)])
            camera = raster_scenes.front_camera()
            pixel_weights = np.random.default_rng(seed).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
            here, there = (
                derivatives(scene, camera, config, pixel_weights, device) for device in (setting.device, "cpu")
            )
            for name, expected in there.items():
                apart = float(np.linalg.norm(here[name] - expected) / max(float(np.linalg.norm(expected)), 1e-20))
                worst = max(worst, apart)
                if not apart < FAR_APART:
                    yield Finding(
                        f"{backend}, degree {degree}, {name}", f"relative difference {apart:.1e}", is_wrong=True
                    )
        yield Finding(f"{backend}: largest relative difference", f"{worst:.1e}")


def derivatives(
    scene: ls.Scene, camera: ls.Camera, config: ls.RenderConfig, pixel_weights: np.ndarray, device: str
) -> dict[str, np.ndarray]:
    """Returns the gradient of a frame with respect to the parameters of its only Gaussian set."""
    renderer = ls.DifferentiableRenderer(config, device)
    renderer.render(scene, camera)
    found = renderer.gradients(pixel_weights).sets[0]
    return {name: np.asarray(getattr(found, name), np.float64) for name in PARAMETERS}


def training_times(setting: Setting) -> Iterator[Finding]:
    """Times the stages of an iteration at 640 x 360, waiting after each."""
    for count in TRAINED[:1] if setting.device == "cpu" else TRAINED:
        yield Finding(f"{count:,}: stages of a step, ms", rounded(stages_of(synthetic(count), setting.device)))


def gradients_beside_gsplat(setting: Setting) -> Iterator[Finding]:
    """Times frames and gradients of gsplat's rasteriser and ours, and compares the gradients."""
    if setting.device == "cpu":
        yield Finding("skipped", "gsplat rasterises on CUDA only")
        return
    try:
        import torch  # pyright: ignore[reportMissingImports]
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        yield Finding("skipped", f"gsplat is not installed here: {error}")
        return
    for count in (100_000, *setting.sizes[:1]):
        yield from _turns(setting, count, torch, rasterization)


def _turns(setting: Setting, count: int, torch: Any, rasterization: Any) -> Iterator[Finding]:
    """Times one set with both renderers."""
    gaussians, camera = synthetic(count), view(setting, count)
    pixel_weights = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    leaves = {
        name: torch.tensor(np.ascontiguousarray(values), device=setting.device, requires_grad=True)
        for name, values in columns(gaussians).items()
    }
    pose = torch.tensor(camera.camera_from_world, dtype=torch.float32, device=setting.device)[None]
    lens = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    lenses = torch.tensor([lens], dtype=torch.float32, device=setting.device)
    weights = torch.tensor(pixel_weights, device=setting.device)[None]
    size: Any = {"width": camera.width, "height": camera.height}
    theirs: list[tuple[float, float]] = []
    for _ in range(WARM + REPEATS):
        for leaf in leaves.values():
            leaf.grad = None
        torch.cuda.synchronize()
        begun = time.perf_counter()
        image = rasterization(**leaves, viewmats=pose, Ks=lenses, **size, sh_degree=3, packed=False)[0]
        torch.cuda.synchronize()
        drawn = time.perf_counter()
        (image * weights).sum().backward()
        torch.cuda.synchronize()
        theirs.append((1e3 * (drawn - begun), 1e3 * (time.perf_counter() - drawn)))
    ours, found = _ours(setting, ls.Scene([gaussians]), camera, pixel_weights)
    forward, backward = (statistics.median(row[k] for row in theirs[WARM:]) for k in (0, 1))
    yield Finding(f"{count:,}: gsplat's frame and derivatives, ms", [round(forward, 2), round(backward, 2)])
    backward_ms = sum(ms for stage, ms in ours.items() if stage.startswith("backward"))
    figure = beside(f"backward pass, {count:,} Gaussians, {camera.width} x {camera.height}", backward_ms, backward)
    yield Finding(f"{count:,}: our stages, ms", rounded(ours), figure=figure)
    alike = np.corrcoef(found.means.ravel(), leaves["means"].grad.cpu().numpy().ravel())[0, 1]
    yield Finding(f"{count:,}: correlation of derivatives by means", round(float(alike), 5))


def _ours(
    setting: Setting, scene: ls.Scene, camera: ls.Camera, pixel_weights: np.ndarray
) -> tuple[dict[str, float], ls.gradients.SetGradient]:
    """Returns the stage times of our frame and its gradient, and the gradient."""
    renderer = ls.DifferentiableRenderer(None, setting.device)
    renderer._launcher.profile = True
    rows: list[dict[str, float]] = []
    found: list[ls.gradients.SetGradient] = []
    for _ in range(WARM + REPEATS):
        renderer.render(scene, camera)
        found = [*renderer.gradients(pixel_weights).sets]
        rows.append(dict(renderer._launcher.stage_ms))
    stage_names = [name for name in rows[-1] if name not in ("sync", "download")]
    return {name: statistics.median(row[name] for row in rows[WARM:]) for name in stage_names}, found[0]
