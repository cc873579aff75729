"""Textures of transmission and layers, and texture wrapping: each half of a texture equals a material of its texel.

The left half of each wall's texture has one texel value, and the right half another.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.color import decode_srgb
from lumisplat.math.reflectance import SHEEN_CURVES, albedo_curves, sheen_albedo
from support.scenes.path_scenes import quad
from support.scenes.pipelines import DIRECT

VIEW = ls.Camera.look_at((0, 0, -2), (0, 0, 0), width=16, height=8, fov_y=0.3)
LIGHT = ls.LightPoint((0.2, -0.6, -1.5), intensity=5.0)
VARNISH = ls.MaterialPbr(base_color=(0.5, 0.1, 0.1), roughness=0.8, wrap_u=ls.TextureWrap.CLAMP)
GLASS = replace(VARNISH, base_color=(0.9, 0.6, 0.3), roughness=0.0, transmission=0.8, thin_walled=True)
EMITTER = ls.MaterialPbr(base_color=(0.0, 0.0, 0.0), specular=0.0, emissive=(1.0, 1.0, 1.0))
LOW, HIGH = 51, 204
"""Texel values that give the factors 0.2 and 0.8."""


def halves(channel: int) -> ls.MaterialPbr | Any:
    """Returns a texture of 16 x 2 texels, with LOW and HIGH in one channel and 128 in the others."""
    texels = np.full((2, 16, 4), 128, np.uint8)
    texels[:, :8, channel], texels[:, 8:, channel] = LOW, HIGH
    return texels


def wall(material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a square that fills the view, textured once over the visible width, with x to the left."""
    uvs = 0.5 + np.array([[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]]) * 0.5 / 0.6
    corners = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    return ls.Mesh(np.array(corners, np.float64), [[0, 2, 1], [0, 3, 2]], uvs=uvs, material=material)


def seen(mesh: ls.Mesh, pipeline: ls.Pipeline, samples: int = 1, others: Any = (), **changes: Any) -> np.ndarray:
    """Returns the colour of a mesh under a light."""
    scene = ls.Scene(meshes=[mesh, *others], lights=[LIGHT])
    settings = ls.RenderConfig(pipeline=pipeline, samples=samples, jitter=False, lighting=True, **changes)
    return ls.render(scene, VIEW, settings, device="cpu").color


def assert_halves(textured: ls.MaterialPbr, name: str, factors: tuple[Any, Any], show: Any) -> None:
    """Asserts that either half of a textured material renders like the field multiplied by its factor."""
    found = show(textured)
    field = np.asarray(getattr(textured, name))
    plain = replace(textured, **{f"{name}_texture": None})
    low, high = (show(replace(plain, **{name: (field * factor).tolist()})) for factor in factors)
    np.testing.assert_allclose(found[:, :7], low[:, :7], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found[:, 9:], high[:, 9:], rtol=1e-4, atol=1e-6)
    assert np.abs(low - high).max() > 0.002


@pytest.mark.parametrize("pipeline", [*DIRECT, ls.Pipeline.PATH])
@pytest.mark.parametrize(
    ("name", "channel"), [("clearcoat", 0), ("clearcoat_roughness", 1), ("sheen_color", 0), ("sheen_roughness", 3)]
)
def test_clearcoat_and_sheen_textures_multiply_the_factors_of_the_material(
    name: str, channel: int, pipeline: ls.Pipeline
) -> None:
    """Each layer reads a separate channel; the colour of sheen is decoded from sRGB."""
    layers: dict[str, Any] = {"clearcoat": 0.9, "clearcoat_roughness": 0.9}
    factors: Any = (0.2, 0.8)
    if name.startswith("sheen"):
        layers = {"sheen_color": (0.9, 0.6, 0.5), "sheen_roughness": 0.9}
    if name == "sheen_color":
        factors = [decode_srgb(np.array([texel, 128, 128]) / 255.0) for texel in (LOW, HIGH)]
    textured = replace(VARNISH, **layers, **{f"{name}_texture": halves(channel)})
    if name != "sheen_roughness":
        assert_halves(textured, name, factors, lambda material: seen(wall(material), pipeline, max_bounces=0))
        return
    found = seen(wall(textured), pipeline, max_bounces=0)
    for side, factor in ((np.s_[:, :7], 0.2), (np.s_[:, 9:], 0.8)):
        constant = replace(textured, sheen_roughness=0.9 * factor, sheen_roughness_texture=None)
        # The interpolated sheen albedo, which scales the layer below, is accurate to 1.5 %.
        np.testing.assert_allclose(found[side], seen(wall(constant), pipeline, max_bounces=0)[side], rtol=0.015)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.HYBRID])
@pytest.mark.parametrize("lighting", [True, False])
def test_transmission_texture_multiplies_the_transmission_of_smooth_glass(
    pipeline: ls.Pipeline, lighting: bool
) -> None:
    """Smooth glass is in front of an emitting wall, lit and unlit."""
    behind = quad((-9, -9, 1.0), (18, 0, 0), (0, 18, 0), EMITTER)
    textured = replace(GLASS, transmission_texture=halves(0))

    def show(material: ls.MaterialPbr) -> np.ndarray:
        scene = ls.Scene(meshes=[wall(material), behind], lights=[LIGHT])
        settings = ls.RenderConfig(pipeline=pipeline, jitter=False, lighting=lighting)
        return ls.render(scene, VIEW, settings, device="cpu").color

    assert_halves(textured, "transmission", (0.2, 0.8), show)


def test_transmission_texture_of_a_pane_scales_the_light_that_passes_to_surfaces_behind() -> None:
    """Each half of the glass transmits another fraction to the lit surface."""
    floor = quad((-9, -9, 0.3), (0, 18, 0), (18, 0, 0), ls.MaterialPbr(roughness=1.0, specular=0.0))
    pane = wall(replace(GLASS, ior=1.0, transmission_texture=halves(0)))
    far = ls.LightDirectional((0.0, 0.0, 1.0), intensity=np.pi)
    camera = ls.Camera.look_at((0.0, 0.0, 0.2), (0.0, 0.0, 0.3), width=16, height=8, fov_y=2.4)
    settings = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, jitter=False, lighting=True)
    shown = ls.render(ls.Scene(meshes=[floor, pane], lights=[far]), camera, settings, device="cpu").color
    share = 0.8 * np.array([0.9, 0.6, 0.3])
    np.testing.assert_allclose(shown[4, 5], 0.8 * 0.2 * share, rtol=1e-4)
    np.testing.assert_allclose(shown[4, 10], 0.8 * 0.8 * share, rtol=1e-4)


def test_transmission_texture_multiplies_the_transmission_of_rough_glass() -> None:
    """In path tracing, equal random numbers give equal noise."""
    behind = quad((-9, -9, 1.0), (18, 0, 0), (0, 18, 0), EMITTER)
    textured = replace(GLASS, roughness=0.4, transmission_texture=halves(0))
    assert_halves(
        textured,
        "transmission",
        (0.2, 0.8),
        lambda material: seen(wall(material), ls.Pipeline.PATH, 8, [behind], max_bounces=2),
    )


@pytest.mark.parametrize("pipeline", [*DIRECT, ls.Pipeline.PATH])
def test_base_colour_and_emission_textures_have_separate_wrap_modes(pipeline: ls.Pipeline) -> None:
    """Beyond the right edge, the base colour repeats and the emission is clamped, or the reverse."""
    texels = np.zeros((2, 16, 3), np.uint8)
    texels[:, :8], texels[:, 8:] = LOW, HIGH
    low, high = (decode_srgb(np.array(texel / 255.0)) for texel in (LOW, HIGH))
    uvs = np.array([[1.25, 0.5]] * 4) + np.array([[0.0, 0.0], [0.01, 0.0], [0.01, 0.01], [0.0, 0.01]])
    material = ls.MaterialPbr(
        base_color=(1.0, 1.0, 1.0),
        specular=0.0,
        emissive=(1.0, 1.0, 1.0),
        base_color_texture=texels,
        emissive_texture=texels,
    )
    far = ls.LightDirectional((0.0, 0.0, 1.0), intensity=np.pi)
    settings = ls.RenderConfig(pipeline=pipeline, jitter=False, lighting=True, max_bounces=0)
    shown = []
    wrapping: list[Any] = [{"emissive_texture": ("clamp", "repeat")}, {"base_color_texture": "clamp"}]
    for wraps in wrapping:
        mesh = replace(wall(replace(material, texture_wraps=wraps)), uvs=uvs)
        emitted, both = (
            ls.render(ls.Scene(meshes=[mesh], lights=[light]), VIEW, settings, device="cpu").color[4, 8, 0]
            for light in (replace(far, enabled=False), far)
        )
        shown.append((both - emitted, emitted))
    rtol = 0.03 if pipeline is ls.Pipeline.PATH else 1e-3  # a path chooses the wall or the light at random
    np.testing.assert_allclose(shown, [(low, high), (high, low)], rtol=rtol)


def test_sheen_albedo_interpolated_between_table_entries_is_close_to_quadrature() -> None:
    """For roughnesses between two table entries, the curve is close to the albedo and hardly below it."""
    curves = albedo_curves()
    for index in np.linspace(0.5, SHEEN_CURVES - 0.5, 9):
        k = int(index)
        roughness = 0.1 + 0.9 * (index / SHEEN_CURVES) ** 2
        curve = curves[k] + (index - k) * (curves[k + 1] - curves[k])
        for cosine in (0.05, 0.2, 0.5, 0.9):
            truth = min(sheen_albedo(cosine, roughness**2), 1.0)
            found = min(float(np.exp(curve @ cosine ** np.arange(4))), 1.0)
            assert -0.005 < found - truth < 0.06


@pytest.mark.parametrize(
    ("wraps", "message"),
    [
        ({"bump_texture": "clamp"}, r"texture_wraps names 'bump_texture', expected one of base_color_texture, "),
        ({"normal_texture": "tile"}, r"texture_wraps of normal_texture is 'tile', expected one of 'repeat', 'mirror'"),
        ({"normal_texture": ["clamp"]}, r"texture_wraps of normal_texture is \['clamp'\], expected .* or two of them"),
        ({"normal_texture": 3}, r"texture_wraps of normal_texture is 3, expected"),
    ],
)
def test_textures_with_unknown_wrap_modes_are_refused(wraps: Any, message: str) -> None:
    """The message lists the wrap modes."""
    with pytest.raises(ls.SceneError, match=message):
        ls.MaterialPbr(texture_wraps=wraps)
