"""What the ray tracer's noise and trees come to: ``python -m bench.trace_quality [--device cuda]``.

How the mean of stochastic frames nears the sorted one, and how long a tree of a million Gaussians takes.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

SAMPLES = {"stochastic-hit": (1, 4, 16, 64, 256), "stochastic-pass": (1, 4, 16, 64)}
TREE_COUNT = 1_000_000


def main() -> None:
    """Prints one JSON object: decibels by number of samples, and seconds."""
    from bench.timing import parser, quiet_warp

    device = parser("trace_quality", __doc__).parse_args().device
    quiet_warp()
    print(json.dumps(tree_seconds(device) | {"psnr_db": convergence(device)}))


def convergence(device: str) -> dict[str, dict[str, float]]:
    """PSNR against the sorted frame by strategy and number of samples, all through the pixel centres."""
    import lumisplat as ls
    from bench.presets import BIKER, TRACE, load_capture

    if not BIKER.is_file():
        return {}
    scene, camera = ls.Scene(splats=[load_capture(BIKER)]), TRACE[0].camera()
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, jitter=False)
    exact = ls.render(scene, camera, config, device=device).color
    rows = {}
    for name, counts in SAMPLES.items():
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
    """Seconds for the tree of a million Gaussians: built, refitted to all moved alike, and to each moved at random."""
    import lumisplat as ls
    from bench.presets import TRACE, stage_ms, synthetic

    gaussians = synthetic(TREE_COUNT)
    camera = TRACE[0].camera().scaled(width=16)
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE), device, profile=True)
    random = np.random.default_rng(3)
    built, refitted, strewn = [], [], []
    for turn in range(3):
        # Of another size, so that the next one is taken for a new capture, not for one that moved.
        renderer.render(ls.Scene(splats=[gaussians.subset(np.arange(TREE_COUNT - turn - 1))]), camera)
        built.append(stage_ms(renderer.render(ls.Scene(splats=[gaussians]), camera))["build"])
        moved = replace(gaussians, means=gaussians.means * np.float32(1.0 + 0.01 * turn) + np.float32(0.01))
        refitted.append(stage_ms(renderer.render(ls.Scene(splats=[moved]), camera))["build"])
        steps = random.standard_normal((TREE_COUNT, 3), dtype=np.float32)
        apart = gaussians.means + 0.5 * gaussians.scales.mean(axis=1, keepdims=True) * steps
        wild = ls.Scene(splats=[replace(gaussians, means=apart)])
        strewn.append(stage_ms(renderer.render(wild, camera))["build"])
    times = {"build_s": built, "refit_s": refitted, "strew_s": strewn}
    return {name: 1e-3 * float(np.median(values)) for name, values in times.items()}


if __name__ == "__main__":
    main()
