"""2D Gaussians, loaded as flat 3D ones, look as in their trainer (Huang et al. 2024, 2D Gaussian Splatting)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.ops.views import world_rays
from support.files.splat_files import FLAT_NAMES, load_gaussians, ply_header

CENTRE = np.array([0.1, -0.2, 4.0])
SCALES = np.array([0.1, 0.05])
OPACITY = 0.8


def tilted(folder: Path, degrees: float) -> tuple[ls.Gaussians, np.ndarray]:
    """Returns a 2D Gaussian rotated about x, loaded from a file, and its axes as columns."""
    half = np.radians(degrees) / 2
    row = [
        *CENTRE,
        1.0,
        0.5,
        -0.5,
        np.log(OPACITY / (1 - OPACITY)),
        *np.log(SCALES),
        np.cos(half),
        np.sin(half),
        0.0,
        0.0,
    ]
    path = folder / "surfel.ply"
    path.write_bytes(ply_header(1, FLAT_NAMES) + np.array([row], dtype="<f4").tobytes())
    cosine, sine = np.cos(2 * half), np.sin(2 * half)
    return load_gaussians(path), np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])


def surfel_alpha(axes: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Returns alpha of rays from the origin: opacity exp(-(u^2 + v^2) / 2) at the Gaussian's plane (equation 3)."""
    distance = (CENTRE @ axes[:, 2]) / (directions @ axes[:, 2])
    offset = directions * distance[:, None] - CENTRE
    u, v = (offset @ axes[:, :2] / SCALES).T
    alpha = OPACITY * np.exp(-0.5 * (u**2 + v**2))
    return np.where(alpha >= 1 / 255, alpha, 0.0)


@pytest.mark.parametrize("degrees", [0.0, 45.0, 75.0])
def test_ray_traced_flat_gaussian_equals_the_surfel_of_2d_gaussian_splatting(tmp_path: Path, degrees: float) -> None:
    """The ray hits the plane of the Gaussian, seen frontally and at an angle."""
    gaussians, axes = tilted(tmp_path, degrees)
    x, y = np.meshgrid(np.linspace(-0.05, 0.1, 40), np.linspace(-0.12, 0.0, 40))
    directions = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = ls.trace_rays(ls.Scene(splats=[gaussians]), np.zeros_like(directions), directions, device="cpu")
    expected = surfel_alpha(axes, directions)
    assert (expected > 0.1).sum() > 50
    # The disc is 0.001 standard deviations thick, and alpha changes by less than 1 per standard deviation.
    np.testing.assert_allclose(1.0 - hits.transmittance, expected, atol=0.004)
    facing = np.abs(hits.normal @ axes[:, 2])[expected > 0.3]
    np.testing.assert_allclose(facing, 1.0, atol=1e-3)


@pytest.mark.parametrize("degrees", [0.0, 45.0, 75.0])
def test_rasterised_flat_gaussian_is_close_to_the_surfel_of_2d_gaussian_splatting(
    tmp_path: Path, degrees: float
) -> None:
    """The linearised projection with its blur of half a pixel gives nearly the same image."""
    gaussians, axes = tilted(tmp_path, degrees)
    camera = ls.Camera.look_at((0, 0, 0), tuple(CENTRE), (0, -1, 0), width=240, height=180, fov_y=0.15)
    frame = ls.render(ls.Scene(splats=[gaussians]), camera, device="cpu")
    expected = surfel_alpha(axes, world_rays(camera)[1].reshape(-1, 3)).reshape(frame.alpha.shape)
    # At one standard deviation, the tilted disc is 0.07 of 4 units nearer than its centre: 2 % of its size.
    np.testing.assert_allclose(frame.alpha, expected, atol=0.03)
    normals = np.abs(frame.normal @ axes[:, 2])[expected > 0.3]
    np.testing.assert_allclose(normals, 1.0, atol=1e-3)
