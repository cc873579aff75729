"""Lights are normalised and validated, alone and in scenes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.lights import facing_irradiance, move_light
from support.scenes.raster_scenes import quad, random_gaussians

ORIGIN = (0.0, 0.0, 0.0)
DOWN = (0.0, -1.0, 0.0)

REQUIRED: dict[type, dict[str, Any]] = {
    ls.LightPoint: {"position": ORIGIN},
    ls.LightSpot: {"position": ORIGIN, "direction": DOWN},
    ls.LightDirectional: {"direction": DOWN},
    ls.LightSphere: {"position": ORIGIN, "radius": 1.0},
    ls.LightRect: {"position": ORIGIN, "edge_u": (1.0, 0.0, 0.0), "edge_v": (0.0, 0.0, 1.0)},
    ls.LightDisk: {"position": ORIGIN, "direction": DOWN},
    ls.LightEnvironment: {},
}


@pytest.mark.parametrize("kind", REQUIRED, ids=lambda kind: kind.__name__)
def test_default_light_is_white_and_casts_shadows(kind: type) -> None:
    """A light with only a position is white, has intensity 1, is enabled and casts shadows."""
    light = kind(**REQUIRED[kind])
    assert (light.color, light.intensity, light.enabled, light.casts_shadow) == ((1.0, 1.0, 1.0), 1.0, True, True)


def test_light_directions_become_unit_vectors() -> None:
    """A direction may have any length, and be any kind of sequence."""
    spot = ls.LightSpot(position=[1, 2, 3], direction=np.array([0, 3, -4]))
    assert spot.position == (1.0, 2.0, 3.0)
    np.testing.assert_allclose(spot.direction, (0.0, 0.6, -0.8))
    np.testing.assert_allclose(ls.LightDirectional((2.0, 0.0, 0.0)).direction, (1.0, 0.0, 0.0))


def test_transform_moves_rotates_and_scales_a_disk_light() -> None:
    """Position, direction and radius follow a quarter turn about x, a scale of 2 and a translation."""
    matrix = np.array([[2, 0, 0, 1], [0, 0, -2, 0], [0, 2, 0, 0], [0, 0, 0, 1]], np.float64)
    disk = move_light(ls.LightDisk((0, 3, 0), (0, -1, 0), 0.25), matrix)
    assert isinstance(disk, ls.LightDisk)
    np.testing.assert_allclose([disk.position, disk.direction], [(1, 0, 6), (0, 0, -1)], atol=1e-12)
    assert disk.radius == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("light", "size"),
    [
        (ls.LightPoint((0, 3, 0), radius=0.25), 0.25),
        (ls.LightSpot((0, 3, 0), (0, -1, 0), radius=0.25), 0.25),
        (ls.LightSphere((0, 3, 0), 0.25), 0.25),
        (ls.LightDisk((0, 3, 0), (0, -1, 0), 0.25), 0.25),
        (ls.LightRect((0, 3, 0), (0.5, 0, 0), (0, 0, 0.5)), 0.5),
    ],
    ids=lambda value: getattr(value, "kind", ""),
)
def test_transform_scales_the_extent_of_a_light_but_not_its_intensity(light: Any, size: float) -> None:
    """Extents of all lights scale with the transform; the intensity does not change."""
    moved: Any = move_light(light, np.diag([2.0, 2.0, 2.0, 1.0]))
    extent = np.linalg.norm(moved.edge_u) if isinstance(moved, ls.LightRect) else moved.radius
    assert extent == pytest.approx(2.0 * size)
    assert (moved.position, moved.intensity) == ((0.0, 6.0, 0.0), light.intensity)


FLAT = [
    (ls.LightRect((0, 2, 0), (0.8, 0, 0), (0, 0, 0.6)), 0.48),
    (ls.LightDisk((0, 2, 0), (0, -1, 0), 0.4), math.pi * 0.16),
]


@pytest.mark.parametrize(("light", "area"), FLAT, ids=lambda value: getattr(value, "kind", ""))
def test_rect_and_disk_lights_emit_from_one_side_only(light: ls.LightRect | ls.LightDisk, area: float) -> None:
    """Rays from below hit a flat light in proportion to its area; rays from above miss it."""
    rng = np.random.default_rng(3)
    assert light.boundary()[:, 1] == pytest.approx(2.0)
    starts = np.stack([rng.uniform(-0.5, 0.5, 40000), np.zeros(40000), rng.uniform(-0.5, 0.5, 40000)], axis=1)
    up = np.tile((0.0, 1.0, 0.0), (40000, 1))
    distances = light.distances(starts, up)
    assert np.isfinite(distances).mean() == pytest.approx(area, rel=0.02)
    np.testing.assert_allclose(distances[np.isfinite(distances)], 2.0)
    assert np.isinf(light.distances(starts + 4.0 * up, -up)).all()
    np.testing.assert_allclose(light.area_vector, (0.0, -area, 0.0), atol=1e-12)
    # The irradiance is half at 60 degrees off the axis, and 0 behind the light.
    below = facing_irradiance(light, np.array([(0, -8, 0), (10 * math.sin(math.pi / 3), -3, 0), (0, 3, 0)]))[:, 0]
    np.testing.assert_allclose(below, (area / 100, 0.5 * area / 100, 0.0), atol=1e-12)


def test_environment_light_converts_its_image_and_rotation() -> None:
    """The image becomes read-only float32, the rotation a unit quaternion."""
    image = np.ones((2, 4, 3))
    light = ls.LightEnvironment(image=image, rotation_wxyz=(0, 2, 0, 0))
    assert light.image is not None and light.image.dtype == np.float32 and not light.image.flags.writeable
    image[:] = 0.0
    assert light.image.all()
    assert light.rotation_wxyz == (0.0, 1.0, 0.0, 0.0)


NEGATIVE = np.ones((2, 4, 3))
NEGATIVE[0, 1:3, 2] = -1.0


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        *((kind, {"intensity": -1.0}, "intensity is -1.0, expected a number at least 0") for kind in REQUIRED),
        *((kind, {"color": (1.0, -0.5, 1.0)}, "color is .* expected three numbers of at least 0") for kind in REQUIRED),
        *((kind, {"enabled": 1}, "enabled is 1, expected True or False") for kind in REQUIRED),
        (ls.LightPoint, {"intensity": math.nan}, "intensity is nan"),
        (ls.LightPoint, {"intensity": math.inf}, "intensity is inf"),
        (ls.LightPoint, {"intensity": True}, "intensity is True"),
        (ls.LightPoint, {"intensity": 1e39}, r"intensity is 1e\+39"),
        (ls.LightPoint, {"radius": 1e39}, r"radius is 1e\+39"),
        (ls.LightPoint, {"position": (0.0, math.nan, 0.0)}, "position has 1 non-finite"),
        (ls.LightPoint, {"position": (0.0, 0.0)}, r"position has shape \(2,\), expected three numbers"),
        (ls.LightPoint, {"position": "here"}, "position is not an array of numbers"),
        (ls.LightPoint, {"range": 0.0}, "range is 0.0, expected a number above 0"),
        (ls.LightPoint, {"radius": -1.0}, "radius is -1.0"),
        (ls.LightPoint, {"casts_shadow": None}, "casts_shadow is None"),
        (ls.LightSpot, {"direction": ORIGIN}, "needs a direction or a target"),
        (ls.LightSpot, {"inner_angle": 0.8}, "inner_angle is 0.8 and its outer_angle 0.785"),
        (ls.LightSpot, {"outer_angle": 1.6}, r"outer_angle is 1.6, expected 0.0 to 1.570797 \(radians\)"),
        (ls.LightSpot, {"inner_angle": -0.1}, "inner_angle is -0.1"),
        (ls.LightDirectional, {"angle": 1.7}, r"angle is 1.7, expected 0.0 to 1.570797 \(radians\)"),
        (ls.LightDirectional, {"shadow_distance": 0.0}, "shadow_distance is 0.0, expected a number above 0"),
        (
            ls.LightEnvironment,
            {"rotation_wxyz": np.zeros((5, 5))},
            r"^rotation_wxyz is array\(.*\), expected four numbers",
        ),
        (ls.LightEnvironment, {"shadow_distance": math.nan}, "shadow_distance is nan, expected a number above 0"),
        (ls.LightSphere, {"radius": 0.0}, "radius is 0.0, expected a number above 0"),
        (ls.LightDisk, {"radius": 0.0}, "radius is 0.0, expected a number above 0"),
        (ls.LightDisk, {"direction": ORIGIN}, "a disk needs a direction or a target"),
        (ls.LightRect, {"edge_v": (2.0, 0.0, 0.0)}, "span no area"),
        (ls.LightRect, {"edge_u": ORIGIN}, "span no area"),
        (ls.LightEnvironment, {"image": np.ones((4, 3))}, r"image has shape \(4, 3\), expected \(H, W, 3\)"),
        (ls.LightEnvironment, {"image": NEGATIVE}, "image has 2 negative values"),
        (ls.LightEnvironment, {"image": np.full((2, 4, 3), np.inf)}, "24 non-finite values"),
        (ls.LightEnvironment, {"rotation_wxyz": (0, 0, 0, 0)}, "rotation_wxyz is .* not all 0"),
        (ls.LightEnvironment, {"visible": "no"}, "visible is 'no', expected True or False"),
    ],
)
def test_error_for_an_invalid_value_of_a_light_names_the_value(
    kind: type, changes: dict[str, Any], message: str
) -> None:
    """The error names the invalid value."""
    with pytest.raises(ls.SceneError, match=message):
        kind(**(REQUIRED[kind] | changes))


def test_scene_refuses_a_second_enabled_environment_light() -> None:
    """Further environments must be disabled; the number of other lights is not limited."""
    on, off = ls.LightEnvironment(), ls.LightEnvironment(enabled=False)
    lights = [on, off, ls.LightPoint(ORIGIN), ls.LightPoint(ORIGIN)]
    assert ls.Scene(lights=lights).lights == tuple(lights)
    with pytest.raises(ls.SceneError, match="two enabled environments"):
        ls.Scene(lights=[on, ls.LightEnvironment()])


@pytest.mark.parametrize(
    ("lights", "message"),
    [([quad(1.0)], "lights holds a Mesh"), (ls.LightPoint(ORIGIN), "lights is a LightPoint, expected a list")],
)
def test_scene_refuses_lights_that_are_not_a_list_of_lights(lights: Any, message: str) -> None:
    """``lights`` must be a list of lights."""
    with pytest.raises(ls.SceneError, match=message):
        ls.Scene(lights=lights)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"material": "shiny"}, "material is a str, expected a MaterialPbr or MaterialSimple"),
        ({"sh_degree": 4}, "sh_degree is 4, expected a whole number from 0 to 3"),
        ({"sh_degree": True}, "sh_degree is True"),
        ({"sh_degree": 1.0}, "sh_degree is 1.0"),
        ({"shadow_catcher": 1}, "shadow_catcher is 1, expected True or False"),
    ],
)
def test_splat_instance_refuses_settings_of_wrong_types(settings: dict[str, Any], message: str) -> None:
    """Material, SH degree and ``shadow_catcher`` of an instance must have the right types."""
    with pytest.raises(ls.SceneError, match=message):
        ls.SplatInstance(random_gaussians(0, 3), **settings)
