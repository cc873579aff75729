"""What terms of stage 1 do for materials: captures of one set of photographs whose truth is known, learnt by each.

``python -m bench.relightable.stage_one SET [--iterations 3000] [--cap 15000] [--only NAME ...]`` prints a JSON object
each: PSNR of what was held out, how far alpha is off in the outermost pixels of the object, and the figures of
`lumisplat evaluate --materials` once materials are found, relit by the hybrid pipeline and by paths.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion

import lumisplat as ls
from bench.timing import device_name, parser, quiet_warp
from lumisplat.relighting.relightable_set import RelightableSet
from lumisplat.renderer.splat_gradients import DifferentiableRenderer

FLAT = {"flatness": 0.3, "normals": 0.05, "depth_spread": 0.3}
ADAPTIVE = {"densification": ls.config.Densification.ADAPTIVE}
CHOICES: dict[str, dict[str, Any]] = {
    "flat": {},
    "alpha": {"alpha": 1.0},
    "entropy": {"mask_entropy": 0.1},
    "background": {"random_background": True},
    "background, entropy": {"random_background": True, "mask_entropy": 0.1},
    "smooth 0.01": {"normal_smoothness": 0.01},
    "smooth 0.05": {"normal_smoothness": 0.05},
    "entropy, smooth 0.05": {"mask_entropy": 0.1, "normal_smoothness": 0.05},
    "adaptive": ADAPTIVE,
    "adaptive, turns 0.02": ADAPTIVE | {"grow_turn": 0.02},
    "adaptive, turns 0.2": ADAPTIVE | {"grow_turn": 0.2},
}
"""Settings beside those of ``FLAT``."""


def rim(truth: RelightableSet, gaussians: ls.Gaussians, device: str) -> tuple[float, float]:
    """By how much alpha is too high in the outermost pixels of the object, and how far it is off there, on average."""
    renderer = DifferentiableRenderer(ls.RenderConfig(lighting=False), device)
    errors: list[np.ndarray] = []
    for view in truth.views:
        inside, wanted = truth.region(view), view.alpha()
        assert wanted is not None
        outermost = inside & np.logical_not(binary_erosion(inside))
        errors.append((renderer.render(ls.Scene([gaussians]), view.camera).alpha - wanted)[outermost])
    off = np.concatenate(errors)
    return float(off.mean()), float(np.abs(off).mean())


def measured(gaussians: ls.Gaussians, environment: Any, given: argparse.Namespace) -> dict[str, Any]:
    """How near materials are to the truth, and what they look like in other light."""
    told: dict[str, Any] = {}
    for pipeline in (ls.Pipeline.HYBRID, ls.Pipeline.PATH):
        config = ls.RenderConfig(pipeline=pipeline, samples=given.samples)
        score = ls.inverse.evaluate_materials(
            gaussians, given.set, environment=environment, config=config, device=given.device
        )
        told[f"relit, {pipeline.value}"] = {
            name: [round(float(figure), 3) for figure in figures] for name, figures in score.relit.items()
        }
        names = ("albedo_psnr", "normal_mean", "normal_median", "roughness_rmse", "environment_psnr")
        told |= {name: round(float(getattr(score, name)), 3) for name in names}
    return told


def learnt(name: str, given: argparse.Namespace) -> dict[str, Any]:
    """A row: trained, found, compared."""
    photographs, begun = ls.io.load_photographs(given.set), time.perf_counter()
    config = ls.TrainConfig(**{"iterations": given.iterations, "cap": given.cap, **FLAT, **CHOICES[name]})
    result = ls.train(photographs, config, device=given.device)
    trained = time.perf_counter() - begun
    assert result.score is not None
    too_high, off = rim(RelightableSet.open(given.set), result.gaussians, given.device)
    told: dict[str, Any] = {"terms": name, "set": given.set.name, "device": device_name(given.device)}
    told |= {"gaussians": result.gaussians.count, "seconds": round(trained), "psnr": round(result.score.psnr, 2)}
    told |= {"rim": round(too_high, 4), "rim_off": round(off, 4)}
    begun = time.perf_counter()
    found = ls.inverse.find_materials(result.gaussians, photographs, device=given.device)
    told |= {"seconds_of_materials": round(time.perf_counter() - begun)}
    if given.out is not None:
        ls.save(given.out / f"{name.replace(', ', '_').replace(' ', '_')}.ply", found.gaussians)
    return told | measured(found.gaussians, found.environment.image, given)


def main() -> None:
    """Prints a row for each choice of terms."""
    options = parser("stage_one", __doc__)
    options.add_argument("set", type=Path)
    options.add_argument("--iterations", type=int, default=3000)
    options.add_argument("--cap", type=int, default=15_000)
    options.add_argument("--samples", type=int, default=256, help="of relit frames")
    options.add_argument("--only", nargs="*", choices=tuple(CHOICES), help="some of them")
    options.add_argument("--out", type=Path, help="where captures with materials are saved")
    given = options.parse_args()
    quiet_warp()
    for name in given.only or CHOICES:
        print(json.dumps(learnt(name, given)), flush=True)


if __name__ == "__main__":
    main()
