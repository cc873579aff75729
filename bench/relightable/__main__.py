"""Our estimator of materials and R3DG's on one set of photographs whose truth is known, and one capture of it.

``python -m bench.relightable SET CAPTURE.ply [--steps 10000] [--out FOLDER]`` prints a JSON object each; SET is one of
tools/make_relightable_set.py, CAPTURE a result of `lumisplat train SET`, which stands for stage 1 of both. Figures are
those of `lumisplat evaluate --materials`, of what our renderer shows; ``relit_by_r3dg`` is PSNR of what R3DG's own
formulas show of R3DG's materials, in the same pixels, albedo scaled alike.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import lumisplat as ls
from bench.relightable.r3dg import R3dgFit, relit_pictures
from bench.timing import device_name, parser, quiet_warp
from lumisplat.math.arrays import FloatArray
from lumisplat.relighting.relightable_set import RelightableSet
from lumisplat.renderer.splat_gradients import DifferentiableRenderer
from lumisplat.training.materials.lit_gaussians import seen_normals
from lumisplat.training.views import TrainingView

SAMPLES = 64
"""Of relit frames, as the command has them."""
Found = tuple[ls.Gaussians, FloatArray]
"""A capture with materials, and the environment."""


def by_ours(capture: ls.Gaussians, folder: Path, given: argparse.Namespace) -> Found:
    """`lumisplat.inverse.find_materials`."""
    found = ls.inverse.find_materials(capture, folder, device=given.device)
    assert found.environment.image is not None
    return found.gaussians, found.environment.image


def by_r3dg(capture: ls.Gaussians, folder: Path, given: argparse.Namespace) -> Found:
    """R3DG's second stage, on the same normals."""
    views = [TrainingView.of(photograph) for photograph in ls.io.load_photographs(folder).training]
    renderer = DifferentiableRenderer(ls.RenderConfig(lighting=False), given.device)
    normals, _ = seen_normals(capture, [view.camera for view in views], renderer, _say_nothing)
    fit = R3dgFit(capture, normals, views, given.device)
    for step in range(given.steps):
        loss = fit.step()
        if (step + 1) % 1000 == 0:
            print(f"step {step + 1}: L1 {loss.l1:.4f}, SSIM {loss.ssim:.4f}", flush=True)
    found = fit.parameters
    materials = {"albedo": found.albedo_value, "roughness": found.roughness_value, "normals": normals}
    found_capture = replace(
        capture, incident=found.local.astype(np.float32), **{k: v.astype(np.float32) for k, v in materials.items()}
    )
    return found_capture, fit.environment()


def relit_psnr(found: ls.Gaussians, folder: Path, scale: tuple[float, ...], device: str) -> dict[str, float]:
    """PSNR of what R3DG's formulas show in environments not seen, where the object is, by name."""
    truth = RelightableSet.open(folder)
    assert found.albedo is not None
    scaled = replace(found, albedo=np.clip(found.albedo * np.array(scale), 0.0, 1.0))
    skies = {name: ls.io.load_radiance(folder / "relit" / f"{name}.exr") for name in truth.unseen}
    figures: dict[str, float] = {}
    for name, pictures in relit_pictures(scaled, skies, [view.camera for view in truth.views], device).items():
        errors = [
            np.square(picture - truth.relit(name, view))[truth.region(view)].mean()
            for picture, view in zip(pictures, truth.views, strict=True)
        ]
        figures[name] = round(float(np.mean(-10.0 * np.log10(errors))), 2)
    return figures


def measured(found: Found, folder: Path, device: str) -> dict[str, Any]:
    """How near it is to the truth."""
    gaussians, environment = found
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=SAMPLES)
    score = ls.inverse.evaluate_materials(gaussians, folder, environment=environment, config=config, device=device)
    told: dict[str, Any] = {
        name: round(float(getattr(score, name)), 3) for name in ("albedo_psnr", "roughness_rmse", "normal_mean")
    }
    told |= {"environment_psnr": round(float(score.environment_psnr), 2)}
    told["relit"] = {name: [round(float(x), 3) for x in figures] for name, figures in score.relit.items()}
    told["relit_by_r3dg"] = relit_psnr(gaussians, folder, score.albedo_scale, device)
    return told


def main() -> None:
    """Compares them."""
    options = parser("relightable", __doc__)
    options.add_argument("set", type=Path)
    options.add_argument("capture", type=Path)
    options.add_argument("--steps", type=int, default=10_000, help="of R3DG's second stage")
    options.add_argument("--only", choices=("ours", "r3dg"), help="one of them")
    options.add_argument("--out", type=Path, help="where captures with materials are saved")
    given = options.parse_args()
    quiet_warp()
    capture = ls.load(given.capture)
    assert isinstance(capture, ls.Gaussians)
    for name, estimator in (("ours", by_ours), ("r3dg", by_r3dg)):
        if given.only in (None, name):
            began, began_cpu = time.perf_counter(), time.process_time()
            found = estimator(capture, given.set, given)
            told: dict[str, Any] = {"estimator": name, "set": given.set.name, "device": device_name(given.device)}
            told |= {"seconds": round(time.perf_counter() - began), "cpu": round(time.process_time() - began_cpu)}
            if given.out is not None:
                ls.save(given.out / f"{name}.ply", found[0])
            print(json.dumps(told | measured(found, given.set, given.device)), flush=True)


def _say_nothing(label: str, fraction: float) -> None:
    """Progress that nobody asked for."""


if __name__ == "__main__":
    main()
