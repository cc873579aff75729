"""Rendered material layers equal the materials of the Gaussians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.relighting.evaluation import LayerRenderer, with_albedo

ALBEDO, ROUGHNESS = (0.6, 0.3, 0.05), 0.35
CAMERA = ls.Camera.look_at((0.3, 3.0, 0.2), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), width=24, height=24, fov_y=0.3)


def sheet() -> ls.Gaussians:
    """Returns a level square of Gaussians of one material that fills the image."""
    plain = ls.gaussians_from_mesh(ls.plane(2.0, 2.0), 500)
    albedo, roughness = np.tile(ALBEDO, (plain.count, 1)), np.full(plain.count, ROUGHNESS)
    return replace(plain, albedo=albedo, roughness=roughness, normals=np.tile([0.0, 1.0, 0.0], (plain.count, 1)))


def test_rendered_material_layers_equal_the_values_of_the_gaussians() -> None:
    """Linear albedo, roughness and normals are exact at any coverage of a pixel."""
    for opacity in (0.9, 0.2):
        some = replace(sheet(), opacities=np.full(500, opacity))
        drawn = LayerRenderer.of(some, "cpu").draw(CAMERA)
        np.testing.assert_allclose(drawn["albedo"], np.broadcast_to(ALBEDO, (24, 24, 3)), atol=2e-3)
        np.testing.assert_allclose(drawn["roughness"], ROUGHNESS, atol=2e-3)
        np.testing.assert_allclose(drawn["normal"], np.broadcast_to((0.0, 1.0, 0.0), (24, 24, 3)), atol=1e-3)


def test_captured_colours_used_as_albedo_are_decoded_to_linear_values() -> None:
    """Display value 0.5 is 0.214 linear; values beyond black and white are clipped."""
    values = np.array([0.5, 1.3, -0.2])
    captured = replace(sheet(), albedo=None, sh=np.tile((values - 0.5) / SH_C0, (500, 1, 1)))
    replaced, stored = with_albedo(captured).albedo, with_albedo(sheet()).albedo
    assert replaced is not None and stored is not None
    np.testing.assert_allclose(replaced, np.tile((0.21404, 1.0, 0.0), (500, 1)), atol=1e-4)
    np.testing.assert_array_equal(stored, sheet().albedo)  # pyright: ignore[reportArgumentType]
