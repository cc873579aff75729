"""What stochastic shadows cost and how they converge: ``python -m bench.shadow_quality SCENE`` prints one JSON object.

With hard shadows and all samples through the pixel centres: decibels of the share of each light that arrives, as the
mean of stochastic samples against the exact one, over all pixels that the light could reach; and milliseconds of the
shadow stage a sample, of all lights together. SCENE is the file of `bench.light_presets.store_demo`.
"""

from __future__ import annotations

import json
import statistics
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

SAMPLES = (1, 4, 16, 64)
TIMED = 8
"""Samples a frame that is timed."""
REPEATS = 5


def main(path: str) -> None:
    """Prints one row a scene."""
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    print(json.dumps({name: row(*case) for name, case in scenes(path).items()}))


def scenes(path: str) -> dict:
    """By name: a scene, its camera, and the number of lights whose shares are compared.

    The share of the sky has no exact value, as its rays go in other directions with each sample.
    """
    import lumisplat as ls
    from bench.light_presets import camera, stored_demo
    from bench.presets import BIKER, TRACE, load_capture

    found = {"demo": (stored_demo(Path(path)), camera(), 2)}
    if BIKER.is_file():
        material = ls.MaterialSimple(emissive=(0.2, 0.2, 0.2), diffuse=(0.8, 0.8, 0.8))
        biker = ls.SplatInstance(load_capture(BIKER), material=material)
        light = ls.LightPoint((-1.5, -4.5, -2.5), intensity=30.0)
        found["biker"] = (ls.Scene(splats=[biker], lights=[light]), TRACE[0].camera(), 1)
    return found


def row(scene, camera, count: int) -> dict:
    """Decibels by number of samples, and milliseconds a sample by method."""
    import lumisplat as ls
    from bench.presets import stage_ms

    compared = replace(scene, lights=scene.lights[:count])
    exact = shares(compared, camera, ls.ShadowMethod.EXACT, 1)
    reached = exact >= 0.0
    decibels = {}
    for samples in SAMPLES:
        error = shares(compared, camera, ls.ShadowMethod.STOCHASTIC, samples)[reached] - exact[reached]
        decibels[str(samples)] = float(-10.0 * np.log10(np.mean(np.square(error))))
    methods = (ls.ShadowMethod.EXACT, ls.ShadowMethod.STOCHASTIC)
    renderers = {method: start(method, TIMED) for method in methods}
    times: dict = {method: [] for method in methods}
    for turn in range(REPEATS + 1):
        for method, renderer in renderers.items():
            stage = stage_ms(renderer.render(scene, camera))["shadow"]
            if turn > 0:
                times[method].append(stage / TIMED)
    return {"psnr_db": decibels, "sample_ms": {m.value: statistics.median(t) for m, t in times.items()}}


def shares(scene, camera, method, samples: int) -> np.ndarray:
    """Share of each light that arrives, (L, H, W, 3); -1 where no light would arrive anyway."""
    frame = start(method, samples, aovs=("lights",)).render(scene, camera)
    assert frame.light_direct is not None and frame.light_shadow is not None
    return np.where(frame.light_direct > 0.0, frame.light_shadow, -1.0)


def start(method, samples: int, aovs: tuple[str, ...] = ()):
    """A renderer of hybrid frames without mirrors, so that all shadow rays are those of pixels."""
    import lumisplat as ls

    config = ls.RenderConfig(
        pipeline=ls.Pipeline.HYBRID,
        max_bounces=0,
        samples=samples,
        shadow_rays=ls.ShadowConfig(method=method),
        jitter=False,
        aovs=aovs,
    )
    return ls.create_renderer(config, device="cpu")


if __name__ == "__main__":
    main(sys.argv[1])
