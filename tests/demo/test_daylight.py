"""Baked daylight: sun, sky and shadow follow the geometry."""

from __future__ import annotations

import numpy as np

from lumisplat.demo.daylight import Daylight, irradiance

SUN_ONLY = Daylight(
    sun_direction=(0.0, 1.0, 0.0), sun_color=(0.5, 0.4, 0.3), sky_color=(0, 0, 0), bounce_color=(0, 0, 0)
)
SKY_ONLY = Daylight(
    sun_direction=(0.0, 1.0, 0.0), sun_color=(0, 0, 0), sky_color=(0.5, 0.5, 0.5), bounce_color=(0, 0, 0)
)


def grid(half: float, y: float) -> np.ndarray:
    """Returns points every 1.5 cm of a level square of side ``2 * half`` at height ``y``."""
    line = np.arange(-half, half, 0.015)
    x, z = np.meshgrid(line, line)
    return np.stack([x.ravel(), np.full(x.size, y), z.ravel()], axis=1)


def lit(casters: np.ndarray, points: np.ndarray, normal: tuple[float, float, float], light: Daylight) -> np.ndarray:
    """Returns the irradiance of daylight at points with one normal, shadowed by ``casters``."""
    return irradiance(casters, points, np.tile(normal, (len(points), 1)), light)


def test_baked_sunlight_follows_the_cosine_without_self_shadowing() -> None:
    """A free plane gets sun times cosine everywhere, and nothing from behind."""
    plane = grid(0.5, 0.0)
    for tilt in (0.0, 0.5, 1.0):
        light = Daylight(
            sun_direction=(np.sin(tilt), np.cos(tilt), 0.0),
            sun_color=(0.5, 0.4, 0.3),
            sky_color=(0, 0, 0),
            bounce_color=(0, 0, 0),
        )
        expected = np.cos(tilt) * np.array([[0.5, 0.4, 0.3]])
        np.testing.assert_allclose(lit(plane, plane, (0, 1, 0), light), np.tile(expected, (len(plane), 1)), atol=1e-3)
    assert lit(plane, plane, (0, -1, 0), SUN_ONLY).max() == 0.0


def test_roof_casts_a_shadow_of_its_own_size_in_baked_daylight() -> None:
    """The floor is dark below the roof and bright beside it; the edge is within 4 cm."""
    floor, roof = grid(0.6, 0.0), grid(0.25, 0.5)
    light = lit(np.concatenate([floor, roof]), floor, (0, 1, 0), SUN_ONLY)[:, 0]
    distance = np.abs(floor).max(axis=1)
    assert light[distance < 0.21].max() < 0.01
    assert light[distance > 0.29].min() > 0.49


def test_baked_sky_light_is_the_integral_over_the_hemisphere() -> None:
    """A horizontal surface gets all of the sky, a wall half of it; a wide roof hides all but the rim."""
    point = np.zeros((1, 3))
    far = np.array([[5.0, -5.0, 5.0]])
    assert abs(lit(far, point, (0, 1, 0), SKY_ONLY)[0, 0] - 0.5) < 0.01
    assert abs(lit(far, point, (1, 0, 0), SKY_ONLY)[0, 0] - 0.25) < 0.01
    # The form factor of a disc of radius r at height h is r^2 / (r^2 + h^2); a square of half side 1 is a bit more.
    roofed = lit(np.concatenate([grid(1.0, 0.5), far * 0.2]), point, (0, 1, 0), SKY_ONLY)[0, 0]
    assert roofed < 0.5 * (1.0 - 1.0 / 1.25) + 0.02


def test_baked_bounce_light_is_strongest_on_downward_surfaces_and_weaker_under_a_cover() -> None:
    """Light from the floor is stronger on surfaces that face down, and weaker where the sky is blocked."""
    light = Daylight(sun_direction=(0.0, 1.0, 0.0), sun_color=(0, 0, 0), sky_color=(0, 0, 0))
    point, far = np.zeros((1, 3)), np.array([[5.0, -5.0, 5.0]])
    down, up = (lit(far, point, (0, y, 0), light)[0, 0] for y in (-1, 1))
    covered = lit(np.concatenate([far, grid(0.8, 0.2)]), point, (0, 1, 0), light)[0, 0]
    assert down > 2.0 * up > 3.0 * covered > 0.0


def test_baked_daylight_of_any_strength_increases_and_stays_at_most_1() -> None:
    """Brighter light gives a brighter result, which stays within 0..1."""
    plane = grid(0.1, 0.0)
    values = [
        lit(plane, plane, (0, 1, 0), Daylight(sun_direction=(0, 1, 0), sun_color=(s, s, s)))[:, 0].mean()
        for s in (0.2, 1.0, 10.0, 1000.0)
    ]
    assert values == sorted(values)
    assert values[-1] <= 1.0
