"""Stores values of Mitsuba's rough dielectric BSDF for tests/device/test_device_rough_glass.py.

Needs the extra [bench]: python tools/make_mitsuba_glass_reference.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

TARGET = Path(__file__).resolve().parents[1] / "tests" / "reference" / "mitsuba_rough_dielectric.npz"
ALPHAS, IOR, COUNT = (0.1, 0.3, 0.7), 1.5, 120


def directions(rng: np.random.Generator, lowest: float) -> np.ndarray:
    """Returns unit vectors that avoid the tangent plane, shape (COUNT, 3)."""
    z = rng.uniform(lowest, 1.0, COUNT)
    z = np.where(np.abs(z) < 0.1, 0.1, z)
    turn = rng.uniform(0.0, 2.0 * np.pi, COUNT)
    sine = np.sqrt(1.0 - z**2)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), z], axis=1).astype(np.float32)


def values(alpha: float, views: np.ndarray, lights: np.ndarray, *, inside: bool) -> np.ndarray:
    """Returns BSDF times cosine, shape (COUNT,); from inside, both directions are mirrored across the surface."""
    import mitsuba  # pyright: ignore[reportMissingImports]

    mi: Any = mitsuba
    settings: dict[str, Any] = {"type": "roughdielectric", "distribution": "ggx", "alpha": alpha, "int_ior": IOR}
    bsdf, context = mi.load_dict(settings | {"ext_ior": 1.0}), mi.BSDFContext()
    found = []
    side = np.array([1.0, 1.0, -1.0 if inside else 1.0])
    for view, light in zip(views.astype(np.float64) * side, lights.astype(np.float64) * side, strict=True):
        point = mi.SurfaceInteraction3f()
        point.wi, point.n = mi.Vector3f(*view), mi.Normal3f(0, 0, 1)
        point.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
        found.append(float(bsdf.eval(context, point, mi.Vector3f(*light))[1]))
    return np.array(found)


def main() -> None:
    """Writes the file."""
    import mitsuba  # pyright: ignore[reportMissingImports]

    mitsuba.set_variant("scalar_rgb")
    rng = np.random.default_rng(0)
    views, lights = directions(rng, 0.15), directions(rng, -1.0)
    table = [[values(alpha, views, lights, inside=inside) for inside in (False, True)] for alpha in ALPHAS]
    version = str(mitsuba.__version__)
    np.savez_compressed(
        TARGET, views=views, lights=lights, values=np.array(table), alphas=ALPHAS, ior=IOR, version=version
    )


if __name__ == "__main__":
    main()
