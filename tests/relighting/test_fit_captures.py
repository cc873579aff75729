"""Light fits ignore pixels of unlit captures, and fit the colour of captures with a material."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.color import encode_srgb
from lumisplat.scene.ops.colors import base_colors
from support.scenes.fit_rooms import DIRECT, assert_powers, closed, image_of, initial_lights, noisy, three_lights, view

HYBRID = replace(DIRECT, pipeline=ls.Pipeline.HYBRID)
GAINS = np.array([0.5, 0.9, 1.4])
"""Factors per channel between the true and the initial colour of the capture."""
SMALL = view(64, 48)


def room_with_capture(*, has_albedo: bool = True) -> ls.Scene:
    """Returns the closed room whose ball is a capture, orange on one side and blue on the other."""
    room = closed(*three_lights())
    ball = ls.gaussians_from_mesh(room.meshes[-2].mesh, 250)
    left = ball.means[:, :1] < ball.means[:, 0].mean()
    colors = np.where(left, (0.6, 0.4, 0.2), (0.2, 0.3, 0.6))
    sh = (encode_srgb(colors)[:, None] - 0.5) / SH_C0
    gaussians = replace(ball, sh=sh, albedo=colors) if has_albedo else replace(ball, sh=sh, albedo=None)
    capture = ls.SplatInstance(gaussians, material=ls.MaterialPbr(roughness=1.0, specular=0.0), name="ball")
    return replace(room, splats=(capture,), meshes=(*room.meshes[:-2], room.meshes[-1]))


def recolored(scene: ls.Scene, gains: np.ndarray) -> ls.Scene:
    """Returns the scene with the colours of its capture multiplied by a factor per channel."""
    (capture,) = scene.splats
    given = capture.gaussians
    if given.albedo is None:
        return replace(
            scene, splats=(replace(capture, gaussians=ls.editing.scale_light(given, [gains] * given.count)),)
        )
    return replace(scene, splats=(replace(capture, gaussians=replace(given, albedo=given.albedo * gains)),))


def fitted(scene: ls.Scene, image: np.ndarray, **options) -> ls.inverse.LightFit:
    """Fits lights without bounces."""
    options = {"config": HYBRID, "environment_degree": None, "device": "cpu"} | options
    return ls.fit_lights(scene, SMALL, image, **options)


@pytest.mark.parametrize("has_albedo", [True, False])
def test_light_fit_scales_each_channel_of_a_capture_to_its_true_colour(has_albedo):
    """A capture that starts with wrong red, green and blue gets its two true colours, and the lights are recovered."""
    truth = room_with_capture(has_albedo=has_albedo)
    image = image_of(truth, SMALL, HYBRID)
    start = replace(recolored(truth, GAINS), lights=initial_lights(*three_lights()))
    found = fitted(start, image, base_colors=["ball"])
    assert_powers(found.lights, three_lights(), 0.01)
    fitted_colors, expected = (base_colors(scene.splats[0].gaussians) for scene in (found.scene, truth))
    np.testing.assert_allclose(fitted_colors, expected, atol=0.01)
    np.testing.assert_allclose(found.base_colors["ball"], expected.mean(axis=0), atol=0.01)
    assert np.abs(base_colors(start.splats[0].gaussians) - expected).max() > 0.2
    for name in ("means", "rotations_wxyz", "scales", "opacities", "normals"):
        assert getattr(found.scene.splats[0].gaussians, name) is getattr(truth.splats[0].gaussians, name)
    assert not found.remarks


def test_light_fit_of_all_base_colours_includes_captures_that_have_a_material():
    """A remark reports that lights and colours are determined up to one factor; captures without a material stay."""
    truth = room_with_capture()
    kept = replace(truth, splats=(*truth.splats, replace(truth.splats[0], material=None, name="kept")))
    found = fitted(kept, image_of(kept, SMALL, HYBRID), base_colors=True, size=24)
    assert "ball" in found.base_colors and "kept" not in found.base_colors
    assert any("up to one factor" in line for line in found.remarks)
    assert found.scene.splats[1] is kept.splats[1]


def test_light_fit_makes_no_colour_of_a_capture_brighter_than_white():
    """The image is three times too bright: fitted albedo ends at 1, and a remark counts the white Gaussians."""
    truth = room_with_capture()
    bright = replace(truth, lights=[replace(light, intensity=3.0 * light.intensity) for light in three_lights()])
    linear = ls.render(bright, SMALL, HYBRID, device="cpu").color
    found = fitted(truth, linear, linear=True, intensities=False, base_colors=["ball"])
    albedo = found.scene.splats[0].gaussians.albedo
    assert albedo is not None and albedo.max() == 1.0
    assert any(line.startswith("ball: ") and "are white" in line for line in found.remarks)


def test_light_fit_uses_pixels_of_relit_captures_but_not_of_unlit_ones():
    """Lights are within 5 %, with noise, for a relit ball beside an unlit box."""
    truth = room_with_capture()
    box = ls.gaussians_from_mesh(truth.meshes[-1].mesh, 300)
    shown = replace(truth, splats=(*truth.splats, ls.SplatInstance(box)), meshes=truth.meshes[:-1])
    image = noisy(image_of(shown, SMALL, HYBRID), 0.01)
    found = fitted(replace(shown, lights=initial_lights(*three_lights())), image)
    assert_powers(found.lights, three_lights(), 0.05)
    unlit_weight = ls.render(shown, SMALL, HYBRID, device="cpu").captured_weight
    assert unlit_weight is not None and (unlit_weight > 0.5).mean() > 0.02
    assert (found.views[0].weights[unlit_weight > 0.5] == 0.0).all()
