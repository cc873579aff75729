"""Writes tests/reference/mitsuba_*.npz: Gaussians ray traced by Mitsuba, as an independent reference.

Its integrator ``volprim_rf_basic`` sorts Gaussians by their entry points, cuts them off at alpha 0.01, and stops at a
transmittance of 0.01. Needs the extra ``bench`` and, on Debian, ``libllvm19``::

    pip install -e '.[bench]' && python tools/make_mitsuba_reference.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "tests")]

from bench.mitsuba_peer import describe, load_mitsuba  # noqa: E402

from support.scenes.raster_scenes import mitsuba_frames  # noqa: E402

SAMPLES = 1024
STEPS = 4096
"""Quantisation: stored values are multiples of 1/4096, far finer than the comparison, and compress well."""


def main() -> None:
    """Renders and stores every frame."""
    mi = load_mitsuba()
    for name, (gaussians, camera) in mitsuba_frames().items():
        image = np.array(mi.render(mi.load_dict(describe(mi, gaussians, camera)), spp=SAMPLES))[..., :3]
        path = REPOSITORY / "tests" / "reference" / f"mitsuba_{name}.npz"
        stored = np.round(np.clip(image, 0.0, 8.0) * STEPS).astype(np.uint16)
        np.savez_compressed(path, image=stored, steps=STEPS, made_with=f"mitsuba {mi.__version__}")
        print(path, stored.shape, f"{path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
