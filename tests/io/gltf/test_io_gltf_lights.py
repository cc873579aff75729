"""KHR_lights_punctual: light properties, node transforms, and refused lights."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.files.mesh_files import Gltf, quad_gltf
from support.kinds import expect_kind

HALF = math.sqrt(0.5)
LOOK_DOWN = [-HALF, 0.0, 0.0, HALF]
"""Quaternion x, y, z, w of a quarter turn about x that maps -z to -y."""


def light_gltf(light: dict[str, Any], **node: Any) -> Gltf:
    """Returns a document with a single light."""
    gltf = Gltf()
    gltf.json["extensions"] = {"KHR_lights_punctual": {"lights": [light]}}
    gltf.json["extensionsUsed"] = ["KHR_lights_punctual"]
    gltf.add("nodes", extensions={"KHR_lights_punctual": {"light": 0}}, **node)
    return gltf


def read(tmp_path: Path, gltf: Gltf) -> ls.Scene:
    """Returns the scene of a document."""
    (tmp_path / "a.glb").write_bytes(gltf.glb())
    scene = ls.load(tmp_path / "a.glb")
    assert isinstance(scene, ls.Scene)
    return scene


def test_gltf_point_light_has_colour_candela_and_range(tmp_path: Path) -> None:
    """A file with only lights loads."""
    light = {"type": "point", "color": [1.0, 0.5, 0.25], "intensity": 40.0, "range": 7.0, "name": "bulb"}
    scene = read(tmp_path, light_gltf(light, translation=[1, 2, 3]))
    assert not scene.meshes
    (point,) = scene.lights
    assert isinstance(point, ls.LightPoint)
    assert point.position == (1.0, 2.0, 3.0)
    assert (point.color, point.intensity, point.range, point.name) == ((1.0, 0.5, 0.25), 40.0, 7.0, "bulb")
    assert point.radius == 0.0 and point.enabled and point.casts_shadow


def test_missing_gltf_light_properties_have_the_defaults_of_the_extension(tmp_path: Path) -> None:
    """A light is white with 1 candela and infinite range, and a spot's cone fades from its axis to 45 degrees."""
    (spot,) = read(tmp_path, light_gltf({"type": "spot", "spot": {}})).lights
    assert isinstance(spot, ls.LightSpot)
    assert (spot.color, spot.intensity, spot.range) == ((1.0, 1.0, 1.0), 1.0, math.inf)
    assert (spot.inner_angle, spot.outer_angle) == (0.0, math.pi / 4)
    assert spot.direction == (0.0, 0.0, -1.0)


@pytest.mark.parametrize("scale", [[1, 1, 1], [3, 3, 3], [1, 2, 5]])
def test_gltf_spot_shines_along_minus_z_of_its_node(tmp_path: Path, scale: list[float]) -> None:
    """Node scales move the spot, but change neither intensity nor range."""
    light = {"type": "spot", "intensity": 9.0, "range": 4.0, "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.5}}
    gltf = light_gltf(light, translation=[0, 1, 0], rotation=LOOK_DOWN, name="over the table")
    gltf.add("nodes", children=[0], translation=[10, 0, 0], scale=scale, rotation=[0, 0, 1, 0])
    (spot,) = read(tmp_path, gltf).lights
    assert isinstance(spot, ls.LightSpot)
    # The parent's half turn about z points its y down: the spot, at y = 1, is below it and shines up.
    np.testing.assert_allclose(spot.position, (10.0, -scale[1], 0.0), atol=1e-12)
    np.testing.assert_allclose(spot.direction, (0.0, 1.0, 0.0), atol=1e-12)
    assert (spot.intensity, spot.range, spot.name) == (9.0, 4.0, "over the table")
    assert (spot.inner_angle, spot.outer_angle) == (0.1, 0.5)


def test_gltf_directional_light_has_a_direction_and_lux(tmp_path: Path) -> None:
    """The light shines along -z of its node, and has no position."""
    (sun,) = read(tmp_path, light_gltf({"type": "directional", "intensity": 5.0}, rotation=LOOK_DOWN)).lights
    assert isinstance(sun, ls.LightDirectional)
    np.testing.assert_allclose(sun.direction, (0.0, -1.0, 0.0), atol=1e-12)
    assert sun.intensity == 5.0


def test_gltf_nodes_may_share_a_light(tmp_path: Path) -> None:
    """Lights of other scenes and hidden nodes are skipped."""
    gltf = quad_gltf()
    gltf.json["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point"}, {"type": "directional"}]}}
    for which, keys in enumerate([{"translation": [1, 0, 0]}, {"translation": [2, 0, 0]}, {"scale": [0, 0, 0]}, {}]):
        gltf.add("nodes", extensions={"KHR_lights_punctual": {"light": int(which == 3)}}, **keys)
    gltf.json |= {"scenes": [{"nodes": [0, 1, 2, 3]}], "scene": 0}
    scene = read(tmp_path, gltf)
    assert len(scene.meshes) == 1
    assert [expect_kind(ls.LightPoint, light).position[0] for light in scene.lights] == [1.0, 2.0]


@pytest.mark.parametrize(
    ("inner", "outer"),
    [(0.5, 0.5), (0.5000004, 0.5), (math.pi / 2, math.pi / 2), (0.4, None), (0.0, 0.0), (1.5709, 1.5709)],
)
def test_gltf_spot_light_with_equal_cone_angles_gets_the_narrowest_soft_edge(
    tmp_path: Path, inner: float, outer: float | None, caplog
) -> None:
    """Lumisplat's narrowest edge is a thousandth of a radian; angles in the wrong order by rounding are accepted."""
    cone = {"innerConeAngle": inner} | ({"outerConeAngle": outer} if outer is not None else {})
    scene = read(tmp_path, light_gltf({"type": "spot", "name": "bulb", "spot": cone}))
    spot = expect_kind(ls.LightSpot, scene.lights[0])
    wanted = math.pi / 4 if outer is None else outer
    assert abs(spot.outer_angle - wanted) < 2.1e-3
    assert 0.0 <= spot.inner_angle < spot.outer_angle and abs(spot.inner_angle - inner) < 2.1e-3
    assert ("lights[0] 'bulb': its cone from" in caplog.text) == (outer is not None)


@pytest.mark.parametrize("kind", ["point", "spot"])
@pytest.mark.parametrize("reach", [0.0, -0.0, -1.0])
def test_gltf_light_range_of_zero_or_less_is_read_as_infinite(tmp_path: Path, kind: str, reach: float, caplog) -> None:
    """Programs such as three.js write 0; a log line reports the infinite range."""
    (light,) = read(tmp_path, light_gltf({"type": kind, "name": "bulb", "range": reach})).lights
    assert isinstance(light, ls.LightPoint | ls.LightSpot) and light.range == math.inf
    assert f"lights[0] 'bulb': range {reach:g} is read as infinite" in caplog.text


@pytest.mark.parametrize(
    ("light", "message"),
    [
        ({"type": "point", "intensity": -3.0}, r"lights\[0\] 'bulb': intensity is -3.0, expected a number at least 0"),
        ({"type": "point", "intensity": "bright"}, r"lights\[0\] 'bulb': intensity is 'bright'"),
        ({"type": "point", "intensity": math.nan}, r"lights\[0\] 'bulb': intensity is nan"),
        (
            {"type": "point", "color": [1, -1, 0]},
            r"lights\[0\] 'bulb': color is .* expected three numbers of at least 0",
        ),
        ({"type": "point", "color": [1, 1]}, r"lights\[0\] 'bulb': color is \[1, 1\], expected three numbers"),
        ({"type": "point", "range": "far"}, r"lights\[0\] 'bulb': range is 'far', expected a number above 0"),
        ({"type": "area"}, r"lights\[0\] 'bulb': type is 'area', expected point, spot or directional"),
        ({}, r"lights\[0\] 'bulb': type is None"),
        (
            {"type": "spot", "spot": {"innerConeAngle": 0.9, "outerConeAngle": 0.5}},
            r"lights\[0\] 'bulb': a spot's inner_angle is 0.9 and its outer_angle 0.5, expected 0 <= inner < outer",
        ),
        ({"type": "spot", "spot": {"outerConeAngle": 3.0}}, r"lights\[0\] 'bulb': outer_angle is 3.0, expected"),
        ({"type": "spot", "spot": {"innerConeAngle": -0.1}}, r"lights\[0\] 'bulb': inner_angle is -0.1"),
    ],
)
def test_error_for_an_invalid_gltf_light_names_the_light(tmp_path: Path, light: dict[str, Any], message: str) -> None:
    """The error is one line."""
    with pytest.raises(ls.FormatError, match=message) as caught:
        read(tmp_path, light_gltf({"name": "bulb", **light}))
    assert str(caught.value).startswith(f"{tmp_path / 'a.glb'}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("node", "message"),
    [
        ({"extensions": {"KHR_lights_punctual": {"light": 4}}}, r"nodes\[0\] refers to lights\[4\], but there are 1"),
        ({"extensions": {"KHR_lights_punctual": {"light": -1}}}, r"nodes\[0\] refers to lights\[-1\]"),
        ({"extensions": {"KHR_lights_punctual": {}}}, r"nodes\[0\] refers to lights\[None\]"),
        ({"translation": [0, math.nan, 0]}, r"nodes\[0\] has translation .* expected 3 finite numbers"),
        ({"children": [0]}, r"nodes\[0\] is its own ancestor"),
    ],
)
def test_invalid_gltf_nodes_are_refused(tmp_path: Path, node: dict[str, Any], message: str) -> None:
    """Errors are bad references, NaN in a transform, and a node that is its own ancestor."""
    gltf = light_gltf({"type": "point"})
    gltf.json["nodes"][0] |= node
    with pytest.raises(ls.FormatError, match=message):
        read(tmp_path, gltf)


def test_gltf_without_gaussians_mesh_light_or_camera_is_refused(tmp_path: Path) -> None:
    """The file has one empty node."""
    gltf = Gltf()
    gltf.add("nodes", name="empty")
    with pytest.raises(ls.FormatError, match="no Gaussians, triangle mesh, light or camera"):
        read(tmp_path, gltf)
