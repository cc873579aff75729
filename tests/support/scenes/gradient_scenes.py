"""Builds small clouds, a view and gradients of its pixels, for tests of gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

import lumisplat as ls

SIZE = 36, 30
BACKGROUND = (0.3, 0.5, 0.2)


def cloud(seed: int = 3, count: int = 16, degree: int = 1, *, antialiased: bool = False) -> ls.Gaussians:
    """Returns Gaussians of all shapes in a unit box; some are opaque enough to terminate pixels."""
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
    """Returns a camera that looks along no axis, so that no gradient vanishes by symmetry."""
    return ls.Camera.look_at(
        (0.3, -0.2, -3.0), (0.0, 0.0, 0.0), (0.1, -1.0, 0.0), width=width, height=height, fov_y=0.8
    )


def by_pixels(camera: ls.Camera, seed: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Returns random gradients of a loss with respect to colour and alpha, in float32."""
    rng = np.random.default_rng(seed)
    shape = camera.height, camera.width
    return rng.normal(size=(*shape, 3)).astype(np.float32), rng.normal(size=shape).astype(np.float32)


def vars_of(found: ls.gradients.SplatGradients | ls.gradients.RayGradients) -> dict[str, np.ndarray]:
    """Returns the gradients with respect to the first Gaussian set, by name."""
    return {name: getattr(found.sets[0], name) for name in ("means", "rotations_wxyz", "scales", "opacities", "sh")}


def check_instances(
    gaussians: ls.Gaussians, place: np.ndarray, find: Callable[[ls.Scene], ls.gradients.SplatGradients]
) -> None:
    """Asserts that the gradients of two instances of one set add up to the set's gradient.

    The camera's gradient must not depend on whether instances share a set.

    Args:
        gaussians: The set.
        place: Transform of the first instance.
        find: Computes the gradients of a scene.
    """
    other = np.eye(4)
    other[:3, :3] = 0.9 * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    other[:3, 3] = -0.3, 0.25, -0.2
    copy = ls.transform(gaussians, np.eye(4))
    together = find(ls.Scene([ls.SplatInstance(gaussians, place), ls.SplatInstance(gaussians, other)]))
    apart = find(ls.Scene([ls.SplatInstance(gaussians, place), ls.SplatInstance(copy, other)]))
    baked = find(ls.Scene([ls.merge([ls.transform(gaussians, place), ls.transform(copy, other)])]))
    assert (len(together.sets), len(apart.sets)) == (1, 2)
    for name in ("means", "rotations_wxyz", "scales", "opacities", "sh"):
        first, second = (getattr(one, name) for one in apart.sets)
        assert 0.2 < np.abs(first).mean() / np.abs(second).mean() < 5.0, name
        check_close(getattr(together.sets[0], name), first + second)
    for found in (together, apart):
        assert found.camera_from_world is not None and baked.camera_from_world is not None
        check_close(found.camera_from_world, baked.camera_from_world)


def check_close(value: np.ndarray, expected: np.ndarray) -> None:
    """Asserts equality up to the rounding of float32."""
    assert np.abs(value - expected).max() < 3e-4 * np.abs(expected).mean()


def opaque(count: int = 700) -> ls.Gaussians:
    """Returns opaque Gaussians, so many that every pixel of a view terminates long before the last Gaussian."""
    base = cloud(21, count)
    return replace(base, means=1.3 * base.means, scales=2.0 * base.scales, opacities=np.full(count, 0.98))
