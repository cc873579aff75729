"""Measures how stochastic frames and shadows converge to exact ones, and BVH build times (2 minutes).

``python -m bench.convergence trace`` prints one JSON object: PSNR of the mean of stochastic frames against the sorted
frame, and seconds to build a BVH of a million Gaussians. ``python -m bench.convergence shadows DEMO`` prints a row per
scene with hard shadows and all samples through the pixel centres: PSNR of the mean shadow factor of each light against
the exact one, over all pixels that the light could reach, and milliseconds of the shadow stage per sample, for all
lights. DEMO is the file of `bench.presets.store_demo`.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np

import lumisplat as ls
from bench.presets import BIKER, TRACE, lit_camera, load_capture, stage_ms, stored_demo, synthetic
from bench.timing import TimedRenderer, parser, quiet_warp

TRACE_SAMPLES = {"stochastic-hit": (1, 4, 16, 64, 256), "stochastic-pass": (1, 4, 16, 64)}
SHADOW_SAMPLES = (1, 4, 16, 64)
TIMED, REPEATS = 8, 5
"""Samples per frame whose shadows are timed, and number of such frames."""
TREE_COUNT = 1_000_000


def main() -> None:
    """Prints one JSON object."""
    given = parser("convergence", __doc__)
    given.add_argument("what", choices=("trace", "shadows"))
    given.add_argument("demo", type=Path, nargs="?")
    options = given.parse_args()
    quiet_warp()
    if options.what == "trace":
        found = tree_seconds(options.device) | {"psnr_db": frames(options.device)}
    else:
        found = {name: shadow_row(*case, device=options.device) for name, case in lit_scenes(options.demo).items()}
    print(json.dumps(found))


def frames(device: str) -> dict[str, dict[str, float]]:
    """Returns PSNR against the sorted frame by strategy and number of samples, all through the pixel centres."""
    if not BIKER.is_file():
        return {}
    scene, camera = ls.Scene(splats=[load_capture(BIKER)]), TRACE[0].camera()
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, jitter=False)
    exact = ls.render(scene, camera, config, device=device).color
    rows = {}
    for name, counts in TRACE_SAMPLES.items():
        strategy = ls.config.TraceStrategy(name)
        rows[name] = row = {}
        frame = None
        for samples in counts:
            more = samples - (frame.samples if frame else 0)
            settings = replace(config, trace=ls.TraceConfig(strategy=strategy), samples=more)
            renderer = ls.create_renderer(settings, device)
            frame = renderer.render(scene, camera, resume=frame)
            row[str(samples)] = float(-10.0 * np.log10(np.mean((frame.color - exact) ** 2)))
    return rows


def tree_seconds(device: str) -> dict[str, float]:
    """Returns seconds for a large BVH: built, refitted after a common motion, and after random motions."""
    gaussians = synthetic(TREE_COUNT)
    # Rays traverse BVHs if they start on a lens.
    camera = replace(TRACE[0].camera().scaled(width=16), aperture=1e-6, focus_distance=3.0)
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE), device, profile=True)
    random = np.random.default_rng(3)
    times: dict[str, list[float]] = {"build_s": [], "refit_s": [], "strew_s": []}

    def build(name: str, capture: ls.Gaussians) -> None:
        times[name].append(stage_ms(renderer.render(ls.Scene(splats=[capture]), camera))["build"])

    for repeat in range(3):
        # Another size, so that the next set counts as new and not as moved.
        renderer.render(ls.Scene(splats=[gaussians.subset(np.arange(TREE_COUNT - repeat - 1))]), camera)
        build("build_s", gaussians)
        build("refit_s", replace(gaussians, means=gaussians.means * np.float32(1.0 + 0.01 * repeat) + np.float32(0.01)))
        steps = random.standard_normal((TREE_COUNT, 3), dtype=np.float32)
        apart = gaussians.means + 0.5 * gaussians.scales.mean(axis=1, keepdims=True) * steps
        build("strew_s", replace(gaussians, means=apart))
    return {name: 1e-3 * median(values) for name, values in times.items()}


def lit_scenes(demo: Path) -> dict[str, tuple[ls.Scene, ls.Camera, int]]:
    """Returns scenes by name, each with its camera and the number of lights that are compared.

    The shadow factor of the environment has no exact value, because its rays change direction with each sample.
    """
    found = {"demo": (stored_demo(demo), lit_camera(), 2)}
    if BIKER.is_file():
        material = ls.MaterialSimple(emissive=(0.2, 0.2, 0.2), diffuse=(0.8, 0.8, 0.8))
        biker = ls.SplatInstance(load_capture(BIKER), material=material)
        light = ls.LightPoint((-1.5, -4.5, -2.5), intensity=30.0)
        found["biker"] = (ls.Scene(splats=[biker], lights=[light]), TRACE[0].camera(), 1)
    return found


def shadow_row(scene: ls.Scene, camera: ls.Camera, count: int, *, device: str) -> dict[str, dict[str, float]]:
    """Returns PSNR by number of samples, and milliseconds per sample by method."""
    exact_method, stochastic = ls.config.ShadowMethod.EXACT, ls.config.ShadowMethod.STOCHASTIC
    compared = replace(scene, lights=scene.lights[:count])
    exact = shares(compared, camera, exact_method, 1, device)
    reached = exact >= 0.0
    decibels = {}
    for samples in SHADOW_SAMPLES:
        error = shares(compared, camera, stochastic, samples, device)[reached] - exact[reached]
        decibels[str(samples)] = float(-10.0 * np.log10(np.mean(np.square(error))))
    renderers = {method: TimedRenderer(shadow_config(method, TIMED), device) for method in (exact_method, stochastic)}
    times: dict = {method: [] for method in renderers}
    for repeat in range(REPEATS + 1):
        for method, renderer in renderers.items():
            stage = renderer.render(scene, camera).stage_ms["shadow"]
            if repeat > 0:
                times[method].append(stage / TIMED)
    return {"psnr_db": decibels, "sample_ms": {method.value: median(row) for method, row in times.items()}}


def shares(scene: ls.Scene, camera: ls.Camera, method: ls.config.ShadowMethod, samples: int, device: str) -> np.ndarray:
    """Returns the shadow factor of each light, (L, H, W, 3); -1 where the light does not reach the surface anyway."""
    frame = ls.render(scene, camera, shadow_config(method, samples, aovs=("lights",)), device=device)
    assert frame.light_direct is not None and frame.light_shadow is not None
    return np.where(frame.light_direct > 0.0, frame.light_shadow, -1.0)


def shadow_config(method: ls.config.ShadowMethod, samples: int, aovs: tuple[str, ...] = ()) -> ls.RenderConfig:
    """Returns settings of hybrid frames without bounces, so that all shadow rays belong to primary hits."""
    return ls.RenderConfig(
        pipeline=ls.Pipeline.HYBRID,
        max_bounces=0,
        samples=samples,
        shadow_rays=ls.ShadowConfig(method=method),
        jitter=False,
        aovs=aovs,
    )


if __name__ == "__main__":
    main()
