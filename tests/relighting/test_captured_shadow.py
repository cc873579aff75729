"""Shadows of several lights darken captured colours by factors computed by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.color import decode_srgb
from lumisplat.relighting.actors import ActorShadows
from lumisplat.scene.lights import facing_irradiance
from support.scenes.light_room import captured


def receivers(points: npt.ArrayLike, linear: tuple[float, float, float] = (0.4, 0.4, 0.4)) -> ls.Gaussians:
    """Returns Gaussians of one linear colour at points."""
    return captured(np.atleast_2d(points), np.array(linear))


def linear(gaussians: ls.Gaussians) -> npt.NDArray[np.floating]:
    """Returns the mean colours of Gaussians in linear light, shape (N, 3)."""
    return decode_srgb(gaussians.sh[:, 0].astype(np.float64) * SH_C0 + 0.5)


def test_shadow_of_a_single_light_multiplies_captured_colours_by_its_transmittance() -> None:
    """A transmittance of 1 leaves the SH coefficients identical."""
    transmittance = np.array([0.0, 0.25, 0.5, 1.0])
    lit = receivers(np.eye(4)[:, :3])
    dark = ls.avatars.shadowed(lit, [ls.LightPoint((0, 0, 5))], transmittance[None])
    np.testing.assert_allclose(linear(dark), 0.4 * transmittance[:, None] * np.ones(3), atol=1e-5)
    np.testing.assert_array_equal(dark.sh[3], lit.sh[3])


def test_shadows_of_several_lights_are_weighted_by_irradiance_per_channel() -> None:
    """A red light at distance 2 has 1/5 of the red irradiance; a white one at distance 1 has all other irradiance."""
    red, white = ls.LightPoint((2, 0, 0), (1, 0, 0), 4.0), ls.LightPoint((0, 1, 0), (1, 1, 1), 4.0)
    lit = receivers((0.0, 0.0, 0.0))
    dark = linear(ls.avatars.shadowed(lit, [red, white], [[0.0], [1.0]]))[0] / 0.4
    np.testing.assert_allclose(dark, [0.8, 1.0, 1.0], atol=1e-5)
    dark = linear(ls.avatars.shadowed(lit, [red, white], [[0.5], [0.1]], direct=0.5))[0] / 0.4
    np.testing.assert_allclose(dark, 1.0 - 0.5 * np.array([0.2 * 0.5 + 0.8 * 0.9, 0.9, 0.9]), atol=1e-5)


def test_shadows_do_not_change_captured_colours_that_no_light_reaches() -> None:
    """Gaussians outside a spot's cone, and channels without light, keep their bits."""
    spot = ls.LightSpot((0, 0, 0), (0, 0, 1), color=(1, 1, 0), intensity=3.0)
    lit = receivers([(0, 0, -1), (0, 0, 1)])
    dark = ls.avatars.shadowed(lit, [spot], [[0.0, 0.0]])
    np.testing.assert_array_equal(dark.sh[0], lit.sh[0])
    np.testing.assert_array_equal(dark.sh[1, :, 2], lit.sh[1, :, 2])
    assert linear(dark)[1, :2].max() < 1e-5


def test_irradiance_that_weights_shadows_is_computed_at_transformed_positions() -> None:
    """Irradiances are computed at world positions; the instance keeps everything but its colours."""
    pose = np.diag([2.0, 2.0, 2.0, 1.0])
    pose[0, 3] = 1.0
    instance = ls.SplatInstance(receivers((1.0, 0.0, 0.0)), pose, name="floor", sh_degree=1)
    lights = [ls.LightPoint((2.0, 0, 0)), ls.LightPoint((5.0, 0, 0))]
    dark = ls.avatars.shadowed(instance, lights, [[0.0], [1.0]])
    np.testing.assert_allclose(linear(dark.gaussians)[0], 0.4 * 0.2, atol=1e-5)
    assert dark.name == "floor" and dark.sh_degree == 1
    np.testing.assert_array_equal(dark.transform, pose)


def test_capture_without_any_shadow_is_returned_as_the_same_object() -> None:
    """Weights of seven lights that sum to 1 only up to rounding change nothing."""
    rng = np.random.default_rng(0)
    lit = receivers(rng.random((1000, 3)))
    lights = [ls.LightPoint(tuple(rng.normal(size=3) * 3), tuple(rng.random(3)), 1.0 + rng.random()) for _ in range(7)]
    assert ls.avatars.shadowed(lit, lights, np.ones((7, 1000))) is lit
    instance = ls.SplatInstance(lit)
    assert ls.avatars.shadowed(instance, lights, np.ones((7, 1000))) is instance
    # With all lights blocked, factors are 0 and not negative.
    dark = ls.avatars.shadowed(lit, lights, np.zeros((7, 1000)))
    assert np.abs(dark.sh[:, 0] * SH_C0 + 0.5).max() < 1e-6


@pytest.mark.parametrize(
    ("light", "expected"),
    [
        (ls.LightPoint((0, 3, 0), (1, 0.5, 0), 18.0), 2.0),
        (ls.LightPoint((0, 3, 0), (1, 0.5, 0), 18.0, range=6.0), 2.0 * (1.0 - 0.5**4)),
        (ls.LightPoint((0, 3, 0), (1, 0.5, 0), 18.0, range=2.0), 0.0),
        (ls.LightSphere((0, 3, 0), 0.5, (1, 0.5, 0), 8.0), 8.0 * math.pi * 0.25 / 9.0),
        (ls.LightDirectional((0, 1, 0), (1, 0.5, 0), 7.0), 7.0),
        (ls.LightRect((0, 3, 0), (2, 0, 0), (0, 0, 3), (1, 0.5, 0), 1.5), 1.5 * 6.0 / 9.0),
        (ls.LightRect((0, 3, 0), (0, 0, 3), (2, 0, 0), (1, 0.5, 0), 1.5), 0.0),
        (ls.LightSpot((3, 3, 0), (0, -1, 0), (1, 0.5, 0), 18.0, inner_angle=0.5, outer_angle=1.0),
         ((math.cos(math.pi / 4) - math.cos(1.0)) / (math.cos(0.5) - math.cos(1.0))) ** 2),
    ],
)  # fmt: skip
def test_irradiance_of_each_light_type_equals_its_definition(light: ls.LightPoint, expected: float) -> None:
    """The irradiance at the origin, facing the light, is computed by hand for each light type."""
    np.testing.assert_allclose(facing_irradiance(light, np.zeros((1, 3)))[0], np.array([1, 0.5, 0]) * expected)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"transmittances": np.ones((1, 3))}, ls.SceneError, r"shape \(1, 3\), expected \(1, 2\)"),
        ({"transmittances": [[0.5, 1.5]]}, ls.SceneError, "1 of 2 are outside 0..1"),
        ({"transmittances": [[0.5, np.nan]]}, ls.SceneError, "1 non-finite"),
        ({"lights": [], "transmittances": np.ones((0, 2))}, ls.SceneError, "at least one light"),
        ({"lights": [ls.LightEnvironment()]}, ls.SceneError, "lights holds an environment"),
        ({"receivers": 3}, ls.SceneError, "got a int"),
        ({"lights": [3]}, ls.SceneError, "lights holds a int"),
        ({"lights": ls.LightPoint((0, 0, 3))}, ls.SceneError, "lights is a LightPoint, expected a list"),
        ({"direct": 1.5}, ls.ConfigError, "direct is 1.5"),
    ],
)
def test_error_for_an_invalid_argument_of_shadowed_names_the_argument(
    change: dict[str, Any], error: type[Exception], message: str
) -> None:
    """The error names the argument and what was expected."""
    arguments: dict[str, Any] = {
        "receivers": receivers([(0, 0, 0), (1, 0, 0)]),
        "lights": [ls.LightPoint((0, 0, 3))],
        "transmittances": [[0.5, 0.5]],
    } | change
    with pytest.raises(error, match=message):
        ls.avatars.shadowed(**arguments)


def test_shadow_on_a_capture_in_map_coordinates_equals_that_near_the_origin() -> None:
    """A ball casts the same shadow on a floor at 5e6, where float32 numbers are 0.5 apart."""
    rng = np.random.default_rng(6)
    floor = np.column_stack([rng.uniform(-1.0, 1.0, (300, 2)), np.zeros(300)])
    ball = 0.2 * rng.normal(size=(80, 3)) / 2.0
    config = ls.config.AvatarLightingConfig(shadow_map=ls.config.DeepShadowConfig(resolution=64, bins=16))
    found = []
    for position in (np.zeros(3), np.array([5e6, -3e5, 1e5])):
        ground = [ls.SplatInstance(receivers(floor), position=position)]
        lights = [ls.LightPoint(position + np.array([0.2, 0.1, 2.0]))]
        shadows = ActorShadows(ground, lights, [], config=config, device="cpu")
        actor = ls.SplatInstance(receivers(ball), position=position + np.array([0.0, 0.0, 0.5]))
        found.append(linear(shadows.darken([actor])[0].gaussians))
    assert found[0].min() < 0.5 * found[0].max()
    np.testing.assert_allclose(found[1], found[0], atol=2e-3)
