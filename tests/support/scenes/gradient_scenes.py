"""Small clouds, a view, and derivatives by its pixels, for tests of gradients."""

from __future__ import annotations

import numpy as np

import lumisplat as ls

SIZE = 36, 30
BACKGROUND = (0.3, 0.5, 0.2)


def cloud(seed: int = 3, count: int = 16, degree: int = 1, *, antialiased: bool = False) -> ls.Gaussians:
    """Gaussians of all shapes in a unit box; some are opaque enough to end pixels."""
    rng = np.random.default_rng(seed)
    return ls.Gaussians(
        means=rng.uniform(-1.0, 1.0, (count, 3)) * (1.0, 1.0, 0.6),
        rotations_wxyz=rng.normal(size=(count, 4)),
        scales=np.exp(rng.uniform(-2.6, -1.2, (count, 3))),
        opacities=1.0 / (1.0 + np.exp(-rng.uniform(-1.5, 6.0, count))),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.5 + 0.2,
        antialiased=antialiased,
    )


def view(width: int = SIZE[0], height: int = SIZE[1]) -> ls.Camera:
    """Not along an axis, so that no derivative is 0 by symmetry."""
    return ls.Camera.look_at(
        (0.3, -0.2, -3.0), (0.0, 0.0, 0.0), (0.1, -1.0, 0.0), width=width, height=height, fov_y=0.8
    )


def by_pixels(camera: ls.Camera, seed: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by colour and alpha, of no pattern, as float32 has them."""
    rng = np.random.default_rng(seed)
    shape = camera.height, camera.width
    return rng.normal(size=(*shape, 3)).astype(np.float32), rng.normal(size=shape).astype(np.float32)


def vars_of(found: ls.SplatGradients | ls.RayGradients) -> dict[str, np.ndarray]:
    """The derivatives by the first set, by name."""
    return {name: getattr(found.sets[0], name) for name in ("means", "rotations_wxyz", "scales", "opacities", "sh")}
