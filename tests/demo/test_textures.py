"""Procedural textures: valid, seamless, repeatable."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from lumisplat.demo import textures
from lumisplat.math.color import decode_srgb

SEAMLESS: dict[str, Callable[[np.random.Generator], textures.Texture]] = {
    "plaster": lambda rng: textures.plaster((0.4, 0.5, 0.5), rng, size=128),
    "marble": lambda rng: textures.marble((0.8, 0.8, 0.7), (0.2, 0.2, 0.2), rng, size=128),
    "travertine": lambda rng: textures.travertine((0.7, 0.6, 0.4), (0.5, 0.4, 0.3), rng, size=128),
}


@pytest.mark.parametrize("name", SEAMLESS)
def test_demo_textures_repeat_without_a_seam(name: str) -> None:
    """Across the border, neighbouring texels differ no more than inside."""
    linear = decode_srgb(SEAMLESS[name](np.random.default_rng(1)) / 255.0)
    for axis in (0, 1):
        steps = np.abs(np.diff(linear, axis=axis)).mean()
        seam = np.abs(np.take(linear, 0, axis) - np.take(linear, -1, axis)).mean()
        assert seam < 2.5 * steps


@pytest.mark.parametrize("name", SEAMLESS)
def test_demo_textures_with_equal_seeds_are_equal(name: str) -> None:
    """Another seed gives another texture."""
    one, same, other = (SEAMLESS[name](np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_plaster_texture_has_the_requested_mean_colour() -> None:
    """The mean is over linear texels."""
    linear = decode_srgb(textures.plaster((0.2, 0.4, 0.3), np.random.default_rng(0)) / 255.0)
    np.testing.assert_allclose(linear.mean(axis=(0, 1)), (0.2, 0.4, 0.3), atol=0.02)


def test_herringbone_texture_has_planks_and_narrow_joints() -> None:
    """The joints cover 3 to 20 % of the texture."""
    texture = textures.herringbone((200, 300), 20.0, (0.5, 0.5, 0.5), (0.5, 0.5, 0.5), np.random.default_rng(0))
    assert texture.shape == (200, 300, 3)
    dark = (texture[..., 0] < 170).mean()
    # Joints of about 2 texels around planks of 20 by 100 texels: at most a fifth of the area.
    assert 0.03 < dark < 0.2


def test_painted_vase_and_stripes_contain_both_their_colours() -> None:
    """Each texture shows a substantial amount of ground and of paint."""
    rng = np.random.default_rng(0)
    vase = textures.painted_vase((0.8, 0.8, 0.8), (0.0, 0.0, 0.3), rng, height=256, width=256)
    painted = (vase[..., 0] < 90).mean()
    assert 0.1 < painted < 0.5
    ball = textures.stripes(((1.0, 1.0, 1.0), (1.0, 0.0, 0.0)), 2, rng, size=64)
    assert 0.3 < (ball[..., 1] > 128).mean() < 0.7
