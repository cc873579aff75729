"""Gradients compared with gsplat's projection and SH in PyTorch: the arrays of tools/make_gsplat_gradients.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls

REFERENCE = Path(__file__).resolve().parents[2] / "reference" / "gsplat_gradients.npz"


@pytest.fixture(scope="module")
def stored() -> dict[str, np.ndarray]:
    """Returns the stored scene, the weights of the loss, and the gradients."""
    with np.load(REFERENCE) as file:
        assert str(file["made_with"]).startswith("gsplat 1.5.3")
        return dict(file)


@pytest.mark.parametrize("name", ["classic", "antialiased"])
def test_raster_gradients_equal_gsplat(stored: dict[str, np.ndarray], name: str) -> None:
    """Over all parameters, background and pose, the median error is 5e-6 of the mean magnitude, the worst 1e-4."""
    sets = ("means", "rotations_wxyz", "scales", "opacities", "sh")
    gaussians = ls.Gaussians(*(stored[key] for key in sets), antialiased=name == "antialiased")
    np.testing.assert_array_equal(gaussians.rotations_wxyz, stored["rotations_wxyz"])
    height, width = stored["by_alpha"].shape
    fx, fy, cx, cy = stored["intrinsics"]
    pose = stored["camera_from_world"]
    camera = ls.Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, camera_from_world=pose)
    renderer = ls.DifferentiableRenderer(ls.RenderConfig(background=tuple(stored["background"])), "cpu")
    frame = renderer.render(ls.Scene([gaussians]), camera)
    value = (frame.color * stored["by_color"]).sum() + (frame.alpha * stored["by_alpha"]).sum()
    assert abs(value - stored[f"{name}_value"]) < 1e-4
    gradients = renderer.gradients(stored["by_color"], stored["by_alpha"], pose=True)
    found = {key: getattr(gradients.sets[0], key) for key in sets}
    assert gradients.camera_from_world is not None
    found |= {"background": gradients.background, "camera_from_world": gradients.camera_from_world}
    for key, actual in found.items():
        expected = stored[f"{name}_{key}"]
        rows = slice(3) if key == "camera_from_world" else slice(None)  # its last row is no parameter
        error = np.abs(actual - expected)[rows] / np.abs(expected).mean()
        assert np.median(error) < 5e-6 and error.max() < 1e-4, (key, np.median(error), error.max())
