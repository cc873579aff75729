"""Light estimation finds lamps in a captured room by their scores: positions, colours and order.

No lamp lights this room; test_light_evidence.py tests the evidence of shading.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.color import decode_srgb
from lumisplat.relighting.light_estimation import surrounding_scores
from lumisplat.scene.lights import facing_irradiance
from lumisplat.scene.ops.colors import colors_along
from support.scenes.light_room import SIZE, bright_wall, captured, highlight, light_ball, room_with, walls

CENTER = 0.5 * SIZE
POSITIONS = ((1.0, 2.8, 1.2), (3.2, 2.5, 3.6), (0.4, 1.2, 4.2))
COLORS = ((1.0, 0.9, 0.7), (0.5, 0.7, 0.8), (0.6, 0.2, 0.1))
"""Colours of the lamps in decreasing luminance."""


looks = partial(ls.config.LightEstimationConfig, evidence=0.0)


def three_lamps() -> ls.Gaussians:
    """Returns the room with the three lamps, stored in another order than by luminance."""
    return room_with(*(light_ball(POSITIONS[i], COLORS[i]) for i in (2, 0, 1)))


def assert_at(light: ls.LightPoint, position: tuple[float, float, float], radius: float = 0.08) -> None:
    """Asserts that a light is inside the lamp of this position and radius."""
    assert np.linalg.norm(np.subtract(light.position, position)) < radius + 1e-5, light


def test_light_estimation_finds_the_three_lamps_of_a_scene_brightest_first() -> None:
    """Three lamps are found at their positions with their linear colours."""
    found = ls.inverse.estimate_lights(three_lamps(), CENTER, 3, config=looks())
    for light, position, color in zip(found.lights, POSITIONS, COLORS, strict=True):
        assert_at(light, position)
        np.testing.assert_allclose(light.color, np.array(color) / max(color), atol=2e-3)
    assert (np.diff(found.scores) < 0.0).all() and (found.peakness > 2.0).all()
    assert [light.name for light in found.lights] == ["estimated-1", "estimated-2", "estimated-3"]


def test_light_estimate_reports_the_gaussian_at_each_light() -> None:
    """The reported instance and index identify the Gaussian at the light's position."""
    room = three_lamps()
    found = ls.inverse.estimate_lights(ls.Scene(splats=[walls(seed=9), room]), CENTER, 2, config=looks())
    assert found.instances.tolist() == [1, 1]
    np.testing.assert_allclose([light.position for light in found.lights], room.means[found.indices], atol=1e-6)


def test_estimated_lights_give_the_requested_irradiance_at_the_centre_of_the_search() -> None:
    """The irradiances of all lights sum to pi by default, in proportion to score over squared distance."""
    found = ls.inverse.estimate_lights(three_lamps(), CENTER, 3, config=looks())
    arriving = sum(light.intensity / np.sum(np.subtract(light.position, CENTER) ** 2) for light in found.lights)
    assert arriving == pytest.approx(np.pi)
    dim = ls.inverse.estimate_lights(three_lamps(), CENTER, 3, config=looks(irradiance=0.5))
    ratios = [a.intensity / b.intensity for a, b in zip(found.lights, dim.lights, strict=True)]
    np.testing.assert_allclose(ratios, 2.0 * np.pi)
    assert facing_irradiance(dim.lights[0], CENTER[None]).max() < 0.5


def test_light_estimation_does_not_mistake_a_bright_wall_for_a_light(caplog: pytest.LogCaptureFixture) -> None:
    """The wall is as bright as the lamp; a warning reports that fewer lights than requested were found."""
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        found = ls.inverse.estimate_lights(
            room_with(bright_wall(), light_ball(POSITIONS[1], (0.9, 0.9, 0.9))), CENTER, 3, config=looks()
        )
    assert len(found.lights) == 1
    assert_at(found.lights[0], POSITIONS[1])
    assert "found 1 light of the 3 requested" in caplog.text


def test_light_estimation_with_compactness_0_accepts_broad_emitters() -> None:
    """By default, a bright wall alone is refused with advice; with compactness 0, it is a light that ranks last."""
    room = room_with(bright_wall())
    with pytest.raises(ls.SceneError, match=r"nothing bright stands out.*compactness=0 to accept"):
        ls.inverse.estimate_lights(room, CENTER, 2, config=looks())
    broad = looks(compactness=0.0, weakest=0.0)
    (light,) = ls.inverse.estimate_lights(room, CENTER, 1, config=broad).lights
    assert light.position[2] == pytest.approx(0.01)
    both = ls.inverse.estimate_lights(
        room_with(bright_wall(), light_ball(POSITIONS[1], (0.7, 0.7, 0.7))), CENTER, 2, config=broad
    )
    assert_at(both.lights[0], POSITIONS[1])


def test_light_estimation_prefers_a_lamp_to_a_view_dependent_highlight() -> None:
    """A highlight that is bright from one viewpoint only ranks after a lamp of half its luminance."""
    position = np.array(POSITIONS[0])
    glint = highlight(POSITIONS[0], position - CENTER)
    room = room_with(glint, light_ball(POSITIONS[1], (0.6, 0.6, 0.6)))
    found = ls.inverse.estimate_lights(room, CENTER, 2, config=looks(weakest=0.0))
    assert_at(found.lights[0], POSITIONS[1])
    assert_at(found.lights[1], POSITIONS[0])
    # Seen from the centre, the highlight is brighter than the lamp.
    away = (glint.means - CENTER) / np.linalg.norm(glint.means - CENTER, axis=1, keepdims=True)
    assert decode_srgb(colors_along(glint, away)).min() > 1.1


def test_light_estimation_prefers_lamps_of_equal_colour_from_all_viewpoints() -> None:
    """Of two lamps whose colours vary equally over all directions, the one that varies less over viewpoints wins."""
    positions = np.array([(1.2, 1.5, 2.5), (2.8, 1.5, 2.5)])
    # The colours of both lamps vary equally: of the first along the viewing direction, where viewpoints hardly matter,
    # of the second across it. The second lamp is 3 % brighter in mean and maximum luminance.
    steady, unsteady = (
        light_ball(tuple(positions[0]), (0.67, 0.67, 0.67)),
        light_ball(tuple(positions[1]), (0.8, 0.8, 0.8)),
    )
    steady_sh, unsteady_sh = steady.sh.copy(), unsteady.sh.copy()
    steady_sh[:, 3], unsteady_sh[:, 2] = 0.2, 0.2
    room = room_with(replace(unsteady, sh=unsteady_sh), replace(steady, sh=steady_sh))
    wide = looks(viewpoint_distance=0.6, emitter_size=0.25)
    found = ls.inverse.estimate_lights(room, CENTER, 2, config=wide)
    assert_at(found.lights[0], tuple(positions[0]))


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.98, 0.0), (0.98, 0.98), (-0.98, 0.4)])
def test_light_estimation_scores_surrounding_brightness_high_on_walls_and_low_at_lamps(x: float, y: float) -> None:
    """At any point of a bright wall, some octant around it is as bright as the wall; around a lamp, none is."""
    steps = np.linspace(-1.0, 1.0, 81)
    wall = np.stack(np.meshgrid(steps, steps, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    around = np.random.default_rng(0).uniform(-2.0, 2.0, (9000, 3))
    points = np.concatenate([wall, around, [[0.0, 0.0, 1.5], [x, y, 0.0]]])
    scores = np.concatenate([np.ones(len(wall)), np.full(len(around), 0.1), [1.0, 1.0]])
    lamp_level, wall_level = surrounding_scores(points, scores, np.array([len(points) - 2, len(points) - 1]), 0.15)
    assert wall_level > 0.8 and lamp_level < 0.11


def test_size_of_gaussians_does_not_change_how_light_estimation_scores_them() -> None:
    """Gaussians ten times larger have the same score."""
    room = three_lamps()
    large = replace(room, scales=room.scales * np.where(np.arange(room.count) % 2, 10.0, 1.0)[:, None])
    one, other = (ls.inverse.estimate_lights(each, CENTER, 3, config=looks()) for each in (room, large))
    np.testing.assert_array_equal(one.indices, other.indices)
    np.testing.assert_array_equal(one.scores, other.scores)


def test_light_estimation_finds_lamps_of_a_transformed_instance_in_world_space() -> None:
    """Lamps of a rotated, scaled and moved capture are found at their new positions with equal colours."""
    angle = 0.7
    pose = np.eye(4)
    pose[:3, :3] = 1.5 * np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    pose[:3, 3] = (3.0, -1.0, 7.0)
    placed = ls.SplatInstance(three_lamps(), pose)
    center = pose[:3, :3] @ CENTER + pose[:3, 3]
    here, there = (
        ls.inverse.estimate_lights(three_lamps(), CENTER, 3, config=looks()),
        ls.inverse.estimate_lights(placed, center, 3, config=looks()),
    )
    for a, b in zip(here.lights, there.lights, strict=True):
        expected = pose[:3, :3] @ np.array(a.position) + pose[:3, 3]
        assert np.linalg.norm(expected - b.position) < 2 * 1.5 * 0.08
        np.testing.assert_allclose(a.color, b.color, atol=1e-5)


def test_light_estimation_is_deterministic() -> None:
    """Scores and positions of two runs are equal to the bit."""
    one, other = (ls.inverse.estimate_lights(three_lamps(), CENTER, 3, config=looks()) for _ in range(2))
    np.testing.assert_array_equal(one.scores, other.scores)
    assert [light.position for light in one.lights] == [light.position for light in other.lights]


def test_light_estimation_finds_no_light_beyond_its_radius_and_none_too_close_together() -> None:
    """No light is beyond the radius, and no two lights are closer than the separation."""
    near = looks(radius=2.1, emitter_size=0.25)
    distances = [np.linalg.norm(np.subtract(position, CENTER)) for position in POSITIONS]
    found = ls.inverse.estimate_lights(three_lamps(), CENTER, 3, config=near)
    assert len(found.lights) == sum(distance < 2.1 for distance in distances) < 3
    wide = looks(separation=100.0)
    assert len(ls.inverse.estimate_lights(three_lamps(), CENTER, 3, config=wide).lights) == 1


def test_light_estimation_finds_lamps_also_beside_one_very_bright_gaussian() -> None:
    """One Gaussian a hundred times brighter than white becomes a light, and the lamps are found as well."""
    stray = captured(np.array([[2.0, 0.5, 0.5]]), np.full(3, 100.0))
    found = ls.inverse.estimate_lights(
        room_with(stray, *(light_ball(p, c) for p, c in zip(POSITIONS, COLORS, strict=True))), CENTER, 4, config=looks()
    )
    assert len(found.lights) == 4
    for light, position in zip(found.lights[1:], POSITIONS, strict=True):
        assert_at(light, position)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"center": (100.0, 0.0, 0.0), "config": looks(radius=1.0)}, "no Gaussians within 1 of"),
        (
            {"center": (100 / 3, 1e-7 / 3, 0.0), "config": looks(radius=1 / 3)},
            r"no Gaussians within 0\.333 of \(33\.3, 3\.33e-08, 0\): the nearest is \d\d\.\d away",
        ),
        ({"center": (0.0, 0.0)}, "center has shape"),
        ({"center": (np.nan, 0.0, 0.0)}, "1 non-finite"),
        ({"scene": ls.Scene()}, "the scene has none"),
        ({"scene": 3}, "got a int"),
        ({"scene": captured(np.random.default_rng(0).random((100, 3)), np.zeros(3))}, "nothing bright stands out"),
    ],
)
def test_light_estimation_refuses_scenes_and_regions_without_lights(change: dict[str, Any], message: str) -> None:
    """Regions without Gaussians, scenes without captures, and dark captures are refused."""
    with pytest.raises(ls.SceneError, match=message):
        ls.inverse.estimate_lights(**{"scene": walls(100), "center": CENTER} | change)


def test_light_estimation_refuses_settings_of_another_type() -> None:
    """Only a LightEstimationConfig, or None for the defaults, is accepted."""
    with pytest.raises(ls.ConfigError, match="config is 0, expected a LightEstimationConfig"):
        ls.inverse.estimate_lights(walls(100), CENTER, config=0)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("count", [0, True, 2.0])
def test_light_estimation_refuses_an_invalid_number_of_lights(count: Any) -> None:
    """The number must be whole, and at least 1."""
    with pytest.raises(ls.ConfigError, match="expected a whole number"):
        ls.inverse.estimate_lights(walls(100), CENTER, count, config=looks())
