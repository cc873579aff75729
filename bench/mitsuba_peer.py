"""Times Mitsuba 3's ``volprim_rf_basic`` on the capture and camera of a preset, one sample per pixel (a minute).

``python -m bench.mitsuba_peer NAME`` prints one JSON object. The LLVM variant needs a libLLVM that Mitsuba accepts:
Debian's ``libllvm19``, found automatically or by ``DRJIT_LIBLLVM_PATH``.
"""

from __future__ import annotations

import glob
import json
import os
import statistics
import sys
import time

import numpy as np

REPEATS = 5


def main(name: str) -> None:
    """Renders the preset ``REPEATS`` times after a warm-up."""
    import lumisplat as ls
    from bench.presets import BIKER, MITSUBA_T, PRESETS, load_capture, synthetic

    mi = load_mitsuba()
    preset = next(preset for preset in PRESETS if preset.name == name)
    gaussians = synthetic(preset.count) if preset.count else load_capture(BIKER)
    scene = mi.load_dict(describe(mi, gaussians, preset.camera()))
    mi.render(scene, spp=1).numpy()
    walls = []
    for seed in range(REPEATS):
        begun = time.perf_counter()
        mi.render(scene, spp=1, seed=mi.UInt32(seed)).numpy()
        walls.append(1e3 * (time.perf_counter() - begun))
    reference = mi.render(scene, spp=16).numpy()[..., :3]
    scene, camera = ls.Scene(splats=[gaussians]), preset.camera()
    raster = ls.render(scene, camera, device="cpu").color
    # The peer sorts Gaussians by the entry into their hulls, which end at alpha 0.01.
    trace = ls.TraceConfig(hit_distance=ls.config.HitDistance.HULL, transmittance_min=MITSUBA_T, dilation=0.0)
    response = ls.config.ResponseConfig(min_response=0.01)
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, trace=trace, response=response, samples=16)
    traced = ls.render(scene, camera, config, device="cpu").color
    row = {
        "peer": f"mitsuba {mi.__version__}",
        "frame_ms": statistics.median(walls),
        "psnr_db": psnr(raster, reference),
    }
    print(json.dumps(row | {"trace_psnr_db": psnr(traced, reference)}))


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Returns the PSNR of two images clipped to 0..1, dB."""
    return float(-10.0 * np.log10(np.mean((np.clip(image, 0, 1) - np.clip(reference, 0, 1)) ** 2)))


def load_mitsuba():
    """Returns the module, with the variant that has the integrator."""
    found = sorted(glob.glob("/usr/lib/*/libLLVM.so.19*") + glob.glob("/usr/lib/llvm-19/lib/libLLVM.so*"))
    if found:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", found[0])
    import mitsuba as mi  # pyright: ignore[reportMissingImports]

    mi.set_variant("llvm_ad_rgb")
    return mi


def describe(mi, gaussians, camera) -> dict:
    """Returns Mitsuba's scene dictionary; its cameras look along +z with x to the left."""
    count = gaussians.count
    to_world = camera.world_from_camera.copy()
    to_world[:, :2] *= -1.0
    return {
        "type": "scene",
        "integrator": {"type": "volprim_rf_basic", "max_depth": 128, "srgb_primitives": False},
        "splats": {
            "type": "ellipsoids",
            "centers": mi.TensorXf(np.array(gaussians.means)),
            "scales": mi.TensorXf(np.array(gaussians.scales)),
            "quaternions": mi.TensorXf(np.ascontiguousarray(gaussians.rotations_wxyz[:, [1, 2, 3, 0]])),
            "opacities": mi.TensorXf(np.array(gaussians.opacities[:, None])),
            "sh_coeffs": mi.TensorXf(np.array(gaussians.sh.reshape(count, -1))),
            "extent": 3.0,
            "extent_adaptive_clamping": True,
        },
        "sensor": {
            "type": "perspective",
            "fov": float(np.degrees(camera.fov_y)),
            "fov_axis": "y",
            "to_world": mi.ScalarTransform4f(to_world),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "rfilter": {"type": "box"},
                "pixel_format": "rgba",
            },
        },
    }


if __name__ == "__main__":
    main(sys.argv[1])
