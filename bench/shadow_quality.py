"""What stochastic shadows cost and how they converge: ``python -m bench.shadow_quality SCENE [--device cuda]``.

With hard shadows and all samples through the pixel centres: decibels of the share of each light that arrives, as the
mean of stochastic samples against the exact one, over all pixels that the light could reach; and milliseconds of the
shadow stage a sample, of all lights together. SCENE is the file of `bench.light_presets.store_demo`.
"""

from __future__ import annotations

import json
import statistics
from dataclasses import replace
from pathlib import Path

import numpy as np

SAMPLES = (1, 4, 16, 64)
TIMED = 8
"""Samples a frame that is timed."""
REPEATS = 5


def main() -> None:
    """Prints one JSON object with a row a scene."""
    from bench.timing import parser, quiet_warp

    given = parser("shadow_quality", __doc__)
    given.add_argument("scene", type=Path)
    options = given.parse_args()
    quiet_warp()
    print(json.dumps({name: row(*case, device=options.device) for name, case in scenes(options.scene).items()}))


def scenes(path: Path) -> dict:
    """By name: a scene, its camera, and the number of lights whose shares are compared.

    The share of the sky has no exact value, as its rays go in other directions with each sample.
    """
    import lumisplat as ls
    from bench.light_presets import camera, stored_demo
    from bench.presets import BIKER, TRACE, load_capture

    found = {"demo": (stored_demo(path), camera(), 2)}
    if BIKER.is_file():
        material = ls.MaterialSimple(emissive=(0.2, 0.2, 0.2), diffuse=(0.8, 0.8, 0.8))
        biker = ls.SplatInstance(load_capture(BIKER), material=material)
        light = ls.LightPoint((-1.5, -4.5, -2.5), intensity=30.0)
        found["biker"] = (ls.Scene(splats=[biker], lights=[light]), TRACE[0].camera(), 1)
    return found


def row(scene, camera, count: int, *, device: str) -> dict:
    """Decibels by number of samples, and milliseconds a sample by method."""
    import lumisplat as ls
    from bench.timing import TimedRenderer

    compared = replace(scene, lights=scene.lights[:count])
    exact = shares(compared, camera, ls.config.ShadowMethod.EXACT, 1, device)
    reached = exact >= 0.0
    decibels = {}
    for samples in SAMPLES:
        error = shares(compared, camera, ls.config.ShadowMethod.STOCHASTIC, samples, device)[reached] - exact[reached]
        decibels[str(samples)] = float(-10.0 * np.log10(np.mean(np.square(error))))
    methods = (ls.config.ShadowMethod.EXACT, ls.config.ShadowMethod.STOCHASTIC)
    renderers = {method: TimedRenderer(config_of(method, TIMED), device) for method in methods}
    times: dict = {method: [] for method in methods}
    for turn in range(REPEATS + 1):
        for method, renderer in renderers.items():
            stage = renderer.render(scene, camera).stage_ms["shadow"]
            if turn > 0:
                times[method].append(stage / TIMED)
    return {"psnr_db": decibels, "sample_ms": {m.value: statistics.median(t) for m, t in times.items()}}


def shares(scene, camera, method, samples: int, device: str) -> np.ndarray:
    """Share of each light that arrives, (L, H, W, 3); -1 where no light would arrive anyway."""
    import lumisplat as ls

    frame = ls.render(scene, camera, config_of(method, samples, aovs=("lights",)), device=device)
    assert frame.light_direct is not None and frame.light_shadow is not None
    return np.where(frame.light_direct > 0.0, frame.light_shadow, -1.0)


def config_of(method, samples: int, aovs: tuple[str, ...] = ()):
    """Settings of hybrid frames without mirrors, so that all shadow rays are those of pixels."""
    import lumisplat as ls

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
