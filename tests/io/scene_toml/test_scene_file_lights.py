"""Lights and environments of scene files, and lights in their glTF files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.hdr_files import write_hdr
from support.files.mesh_files import Gltf, png_bytes, quad_gltf
from support.files.scene_files import load_scene, refuses

ALL = """
[[lights]]
type = "point"
name = "bulb"
position = [1, 2, 3]
color = [1.0, 0.5, 0.25]
intensity = 40
range = 7.5
radius = 0.1
casts_shadow = false

[[lights]]
type = "spot"
position = [0, 5, 0]
direction = [0, -2, 0]
inner_angle_degrees = 20
outer_angle_degrees = 30.0

[[lights]]
type = "directional"
direction = [0, -1, 0]
angle_degrees = 0.25
enabled = false

[[lights]]
type = "sphere"
position = [0, 0, 1]
radius = 0.5

[[lights]]
type = "rect"
position = [0, 0, 2]
edge_u = [1, 0, 0]
edge_v = [0, 1, 0]
intensity = 3.0

[[lights]]
type = "disk"
position = [0, 0, 2]
target = [0, 3, 2]
radius = 0.25
intensity = 4
"""


def test_every_light_type_of_a_scene_file_is_read(tmp_path: Path) -> None:
    """Keys and defaults are those of the Python classes; angles are in degrees."""
    point, spot, sun, sphere, rect, disk = load_scene(tmp_path, ALL).lights
    assert isinstance(point, ls.LightPoint)
    assert (point.name, point.position, point.color) == ("bulb", (1.0, 2.0, 3.0), (1.0, 0.5, 0.25))
    assert (point.intensity, point.range, point.radius, point.casts_shadow) == (40, 7.5, 0.1, False)
    assert isinstance(spot, ls.LightSpot)
    assert spot.direction == (0.0, -1.0, 0.0) and spot.range == math.inf
    assert (spot.inner_angle, spot.outer_angle) == pytest.approx((math.pi / 9, math.pi / 6))
    assert isinstance(sun, ls.LightDirectional)
    assert sun.angle == pytest.approx(math.radians(0.25)) and not sun.enabled
    assert isinstance(sphere, ls.LightSphere) and sphere.radius == 0.5
    assert isinstance(rect, ls.LightRect) and (rect.edge_v, rect.intensity) == ((0.0, 1.0, 0.0), 3.0)
    assert isinstance(disk, ls.LightDisk)
    assert (disk.direction, disk.radius, disk.intensity) == ((0.0, 1.0, 0.0), 0.25, 4)


def test_scene_file_spot_may_have_an_outer_angle_of_90_degrees(tmp_path: Path) -> None:
    """The outer angle may also be 0.5 degrees without an inner angle."""
    text = '[[lights]]\ntype = "spot"\nposition = [0, 0, 0]\ndirection = [0, 0, 1]\nouter_angle_degrees = {}\n'
    for degrees in (0.5, 90):
        (spot,) = load_scene(tmp_path, text.format(degrees)).lights
        assert isinstance(spot, ls.LightSpot) and spot.outer_angle == pytest.approx(math.radians(degrees))


def test_scene_file_environment_image_is_read_relative_to_the_file(tmp_path: Path) -> None:
    """Its colour, intensity, rotation and visibility are read."""
    image = np.array([[[1.0, 0.5, 0.25]] * 4] * 2)
    write_hdr(tmp_path / "sky.hdr", image)
    text = '[environment]\npath = "sky.hdr"\ncolor = [1, 1, 0.5]\nintensity = 0.5\n'
    text += "rotation_wxyz = [0, 1, 0, 0]\nvisible = false\n"
    (light,) = load_scene(tmp_path, text).lights
    assert isinstance(light, ls.LightEnvironment)
    np.testing.assert_array_equal(light.image, image)
    assert (light.color, light.intensity, light.rotation_wxyz) == ((1.0, 1.0, 0.5), 0.5, (0.0, 1.0, 0.0, 0.0))
    assert not light.visible


def test_scene_file_environment_may_be_a_constant_colour(tmp_path: Path) -> None:
    """The environment needs no image, and follows all other lights in the scene."""
    lights = load_scene(tmp_path, "[environment]\ncolor = [0.1, 0.2, 0.3]\n" + ALL).lights
    assert isinstance(lights[-1], ls.LightEnvironment) and len(lights) == 7
    assert lights[-1].image is None and lights[-1].color == (0.1, 0.2, 0.3)


def point_light_gltf() -> Gltf:
    """Returns a quad with a point light above it and a spot that points down at it."""
    gltf = quad_gltf()
    spot = {"type": "spot", "intensity": 9.0, "range": 4.0, "spot": {}}
    gltf.json["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point", "name": "bulb"}, spot]}}
    half = math.sqrt(0.5)
    gltf.add("nodes", extensions={"KHR_lights_punctual": {"light": 0}}, translation=[0, 1, 0])
    gltf.add("nodes", extensions={"KHR_lights_punctual": {"light": 1}}, rotation=[-half, 0, 0, half])
    return gltf


def test_lights_of_a_mesh_file_move_with_its_scene_file_entry(tmp_path: Path) -> None:
    """Position and direction are transformed, intensity and range are not; lights of mesh files come last."""
    (tmp_path / "lamp.glb").write_bytes(point_light_gltf().glb())
    entry = '[[meshes]]\npath = "lamp.glb"\nposition = [10, 0, 0]\nrotation_wxyz = [0, 1, 0, 0]\nscale = 3\n'
    scene = load_scene(tmp_path, entry + '[[lights]]\ntype = "directional"\ndirection = [0, 0, 1]\n')
    sun, bulb, spot = scene.lights
    assert isinstance(sun, ls.LightDirectional) and isinstance(bulb, ls.LightPoint) and isinstance(spot, ls.LightSpot)
    np.testing.assert_allclose(bulb.position, (10.0, -3.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(spot.position, (10.0, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(spot.direction, (0.0, 1.0, 0.0), atol=1e-12)
    assert (spot.intensity, spot.range, bulb.name) == (9.0, 4.0, "bulb")
    assert len(scene.meshes) == 1


def test_scene_file_entry_can_exclude_the_lights_of_its_mesh_file(tmp_path: Path) -> None:
    """``lights = false`` applies to one entry only."""
    (tmp_path / "lamp.glb").write_bytes(point_light_gltf().glb())
    scene = load_scene(tmp_path, '[[meshes]]\npath = "lamp.glb"\nlights = false\n[[meshes]]\npath = "lamp.glb"\n')
    assert (len(scene.meshes), len(scene.lights)) == (2, 2)


POINT = '[[lights]]\ntype = "point"\nposition = [0, 0, 0]\n'
SPOT = '[[lights]]\ntype = "spot"\nposition = [0, 0, 0]\ndirection = [0, 0, 1]\n'


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[[lights]]\nposition = [0, 0, 0]", "line 1, lights[0]: lacks type, expected point, spot, directional"),
        ('[[lights]]\ntype = "poitn"', "line 2, lights[0]: type is 'poitn', did you mean 'point'?"),
        ("[[lights]]\ntype = 3", "line 2, lights[0]: type is 3, expected point, spot"),
        ('[[lights]]\ntype = "environment"', "write it as a table of its own, [environment]"),
        ('[[lights]]\ntype = "point"', "line 1, lights[0]: lacks position, three numbers"),
        ('[[lights]]\ntype = "sphere"\nposition = [0, 0, 0]', "line 1, lights[0]: lacks radius, a number"),
        (POINT + "intensity = -3", "line 4, lights[0]: intensity is -3, expected a number at least 0"),
        (POINT + "intensity = nan", "line 4, lights[0]: intensity is nan"),
        (POINT + 'intensity = "bright"', "line 4, lights[0]: intensity is 'bright', expected a number"),
        (POINT + "color = [1, 1]", "line 4, lights[0]: color is [1, 1], expected a number or three"),
        (POINT + "color = [1, -1, 0]", "line 4, lights[0]: color is [1, -1, 0], expected three numbers of at least 0"),
        (POINT + "range = 0", "line 4, lights[0]: range is 0, expected a number above 0"),
        (POINT + "enabled = 1", "line 4, lights[0]: enabled is 1, expected true or false"),
        (POINT + "direction = [0, 0, 1]", "line 4, lights[0]: unknown 'direction'"),
        ('[[lights]]\ntype = "sun"', "line 2, lights[0]: type is 'sun', did you mean 'directional'?"),
        (SPOT + "outer = 1", "line 5, lights[0]: unknown 'outer', did you mean 'outer_angle_degrees'?"),
        (POINT + "radus = 1", "line 4, lights[0]: unknown 'radus', did you mean 'radius'?"),
        (SPOT + "outer_angle = 0.5", "line 5, lights[0]: unknown 'outer_angle', did you mean 'outer_angle_degrees'?"),
        (SPOT + "outer_angle_degrees = 100", "line 5, lights[0]: outer_angle_degrees is 100, expected 0 to 90 degrees"),
        (SPOT + "inner_angle_degrees = -1", "line 5, lights[0]: inner_angle_degrees is -1, expected 0 to 90"),
        (
            SPOT + "outer_angle_degrees = 30\ninner_angle_degrees = 40",
            "line 6, lights[0]: inner_angle_degrees is 40, expected less than outer_angle_degrees, 30",
        ),
        (SPOT + "outer_angle_degrees = 0", "line 5, lights[0]: inner_angle_degrees is 0, expected less than"),
        (
            '[[lights]]\ntype = "directional"\ndirection = [0, 0, 0]',
            "line 3, lights[0]: direction has no length: ",
        ),
        (POINT + POINT + "radius = -1", "line 7, lights[1]: radius is -1"),
        ("[lights]\ntype = 'point'", "line 1: lights must be written with double brackets: [[lights]]"),
        (
            "[[environment]]\n[[environment]]\n",
            "line 1: environment may appear only once: write it with single brackets",
        ),
        (
            "[environment]\nintensity = 1\n[environment]\n",
            "is not valid TOML: Cannot declare ('environment',) twice (at line 3",
        ),
        ("environment = 3", "line 1: environment is 3, expected a table, [environment]"),
        ("[environment]\npath = 'lost.hdr'", "line 2, environment: path is 'lost.hdr', no such file"),
        ("[environment]\nimage = 'sky.hdr'", "line 2, environment: unknown 'image'"),
        ("[environment]\nintensity = inf", "line 2, environment: intensity is inf"),
        ("[environment]\nrotation_wxyz = [0, 0, 0, 0]", "line 2, environment: rotation_wxyz is"),
        ("[environment]\nvisible = 'no'", "line 2, environment: visible is 'no', expected true or false"),
    ],
)
def test_error_for_an_invalid_light_of_a_scene_file_names_line_and_key(tmp_path: Path, text: str, problem: str) -> None:
    """The one-line error also names the file."""
    with pytest.raises(ls.FormatError) as caught:
        load_scene(tmp_path, text)
    refuses(caught, tmp_path, problem)


def test_scene_file_refuses_an_8_bit_image_as_environment(tmp_path: Path) -> None:
    """The error names the image file."""
    (tmp_path / "sky.png").write_bytes(png_bytes())
    with pytest.raises(ls.FormatError, match=r"sky\.png: is a PNG image with 8 bits per channel"):
        load_scene(tmp_path, '[environment]\npath = "sky.png"\n')
