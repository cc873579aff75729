"""Materials take factors per channel and textures, and refuse invalid values."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls

TEXELS = np.zeros((2, 2, 3), np.uint8)


def test_one_number_as_material_colour_sets_all_three_channels() -> None:
    """A colour may be given as one number for all three channels."""
    material = ls.MaterialSimple(diffuse=0.5, emissive=2)
    assert (material.diffuse, material.emissive) == ((0.5, 0.5, 0.5), (2.0, 2.0, 2.0))
    assert ls.MaterialPbr(base_color=np.float32(0.5)).base_color == (0.5, 0.5, 0.5)


def test_default_simple_material_emits_captured_colours_and_reflects_no_light() -> None:
    """A capture with the default material looks like one without material: emission is 1, and no light is reflected."""
    material = ls.MaterialSimple()
    assert material.emissive == material.base_color == (1.0, 1.0, 1.0)
    assert material.ambient == material.diffuse == material.specular == (0.0, 0.0, 0.0)


def test_pbr_materials_of_roughness_0_are_smooth_and_no_other_materials() -> None:
    """Only PBR materials with roughness 0 reflect or refract rays."""
    assert ls.MaterialPbr(roughness=0.0).is_smooth
    assert not ls.MaterialPbr(roughness=1e-3).is_smooth
    assert not ls.MaterialSimple(shininess=1e4).is_smooth


@pytest.mark.parametrize(
    "name",
    [f"{kind}_texture" for kind in ("base_color", "metallic_roughness", "normal", "occlusion", "emissive")],
)
def test_materials_hold_read_only_copies_of_their_textures(name: str) -> None:
    """Each texture is copied and frozen, and must be 8-bit RGB or RGBA."""
    texels = TEXELS.copy()
    stored = getattr(replace(ls.MaterialPbr(), **{name: texels}), name)
    texels[:] = 255
    assert not stored.any() and not stored.flags.writeable
    with pytest.raises(ls.SceneError, match=rf"{name} is float32 \(2, 2, 3\), expected uint8"):
        replace(ls.MaterialPbr(), **{name: texels.astype(np.float32)})


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        (ls.MaterialPbr, {"emissive": (1.0, -1.0, 0.0)}, "emissive is .* expected three numbers of at least 0"),
        (ls.MaterialPbr, {"emissive": np.inf}, "emissive is inf"),
        (ls.MaterialPbr, {"emissive": 1e39}, r"emissive is 1e\+39, expected three numbers of at least 0"),
        (ls.MaterialPbr, {"occlusion_strength": 1.5}, "occlusion_strength is 1.5, expected 0.0 to 1.0"),
        (ls.MaterialPbr, {"normal_scale": np.nan}, "normal_scale is nan, expected a finite number"),
        (ls.MaterialPbr, {"ior": True}, "ior is True"),
        (ls.MaterialPbr, {"base_color": ("1", "1", "1")}, "base_color is .* expected three numbers"),
        (ls.MaterialSimple, {"diffuse": 1.5}, "diffuse is 1.5, expected three numbers in 0..1"),
        (ls.MaterialSimple, {"specular": (0.0, 0.0, 2.0)}, "specular is .* expected three numbers in 0..1"),
        (ls.MaterialSimple, {"ambient": -0.1}, "ambient is -0.1"),
        (ls.MaterialSimple, {"shininess": 2e4}, "shininess is 20000.0, expected 0.0 to 10000.0"),
        (ls.MaterialSimple, {"shininess": np.nan}, "shininess is nan"),
        (ls.MaterialSimple, {"base_color_texture": TEXELS[0]}, "base_color_texture is uint8"),
    ],
)
def test_materials_refuse_invalid_factors_and_textures(kind: type, changes: dict[str, Any], message: str) -> None:
    """The error names values outside of their physical range."""
    with pytest.raises(ls.SceneError, match=message):
        kind(**changes)
