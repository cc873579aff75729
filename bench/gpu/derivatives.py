"""Gradients of frames on a GPU: against the CPU, and their times."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator

import numpy as np

import lumisplat as ls
from bench.gpu.frames import HOST_STAGES
from bench.gpu.worker import Finding, Setting
from support.scenes import raster_scenes

FAR_APART = 1e-3
"""Largest norm of a gradient's difference from the CPU's, relative to its norm."""
WARM, REPEATS = 3, 8
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


def stages_of_gradients(
    setting: Setting, config: ls.RenderConfig | None, scene: ls.Scene, camera: ls.Camera, pixel_weights: np.ndarray
) -> tuple[dict[str, float], float, ls.gradients.SetGradient]:
    """Returns stage times of a frame and its gradient, the time of the call for gradients, ms, and the gradient."""
    renderer = ls.DifferentiableRenderer(config, setting.device)
    renderer._launcher.profile = True
    rows: list[dict[str, float]] = []
    walls: list[float] = []
    found: list[ls.gradients.SetGradient] = []
    for _ in range(WARM + (2 if setting.device == "cpu" else REPEATS)):
        renderer.render(scene, camera)
        begun = time.perf_counter()
        found = [*renderer.gradients(pixel_weights).sets]
        walls.append(1e3 * (time.perf_counter() - begun))
        rows.append(dict(renderer._launcher.stage_ms))
    names = [name for name in rows[-1] if name not in HOST_STAGES]
    stages = {name: statistics.median(row[name] for row in rows[WARM:]) for name in names}
    return stages, statistics.median(walls[WARM:]), found[0]
