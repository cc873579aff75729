"""OpenUSD lights, with units worked out by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.images.exr import write_exr
from lumisplat.scene.lights import Light
from support.files.usd_files import usd_core, write_usda
from support.kinds import expect_kind

AT = """double3 xformOp:translate = (1, 2, 3)
        uniform token[] xformOpOrder = ["xformOp:translate"]"""


def light(path: Path, kind: str, inputs: str, head: str = 'upAxis = "Y"', schemas: str = "") -> Light:
    """Writes a stage with one light of these inputs, and returns the loaded light."""
    applied = f"( prepend apiSchemas = [{schemas}] )" if schemas else ""
    body = f'def {kind} "lamp" {applied} {{\n{inputs}\n}}'
    (found,) = expect_kind(ls.Scene, ls.load(write_usda(path / "a.usda", body, head))).lights
    assert found.name == "lamp"
    return found


def test_usd_sphere_light_intensity_and_exposure_give_radiance(tmp_path: Path) -> None:
    """Intensity 3 with exposure 2 is a radiance of 12."""
    loaded = expect_kind(
        ls.LightSphere,
        light(
            tmp_path,
            "SphereLight",
            f"{AT}\nfloat inputs:intensity = 3\nfloat inputs:exposure = 2\nfloat inputs:radius = 0.25",
        ),
    )
    assert (loaded.intensity, loaded.radius, loaded.position) == (12.0, 0.25, (1.0, 2.0, 3.0))


def test_normalized_usd_sphere_light_has_the_same_candela_at_any_radius(tmp_path: Path) -> None:
    """Radiance 8 / (4 pi r^2) on a visible disk of pi r^2 is 2 candela."""
    inputs = "float inputs:intensity = 8\nbool inputs:normalize = 1\nfloat inputs:radius = {}"
    for radius in (0.1, 2.0):
        loaded = expect_kind(ls.LightPoint, light(tmp_path, "SphereLight", inputs.format(radius)))
        assert loaded.intensity == pytest.approx(2.0) and loaded.radius == radius


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_normalized_usd_lights_are_equally_bright_in_any_unit(tmp_path: Path, unit: float) -> None:
    """Areas are in square stage units: 8 / (4 pi r^2) nits for a sphere, 12 / 6 nits for a 2 x 3 rectangle."""
    head = f'upAxis = "Y"\nmetersPerUnit = {unit}'
    ball = "float inputs:intensity = 8\nbool inputs:normalize = 1\nfloat inputs:radius = 5"
    point = expect_kind(ls.LightPoint, light(tmp_path, "SphereLight", ball, head))
    radiance = 8.0 / (4.0 * math.pi * 5.0**2)
    assert point.intensity == pytest.approx(radiance * math.pi * (5.0 * unit) ** 2)
    sheet = "float inputs:intensity = 12\nbool inputs:normalize = 1\nfloat inputs:width = 2\nfloat inputs:height = 3"
    assert light(tmp_path, "RectLight", sheet, head).intensity == pytest.approx(2.0)


def test_usd_sphere_light_treated_as_point_becomes_a_point_light(tmp_path: Path) -> None:
    """Radiance 2 at radius 0.5 is 2 pi 0.25 candela; in centimetres, a ten-thousandth of that."""
    inputs = "float inputs:intensity = 2\nfloat inputs:radius = 0.5\nbool treatAsPoint = 1"
    loaded = expect_kind(ls.LightPoint, light(tmp_path, "SphereLight", inputs))
    assert loaded.intensity == pytest.approx(2.0 * math.pi * 0.25) and loaded.radius == 0.0
    small = light(tmp_path, "SphereLight", inputs, 'upAxis = "Y"\nmetersPerUnit = 0.01')
    assert small.intensity == pytest.approx(2.0 * math.pi * 0.25e-4)


def test_usd_sphere_light_with_a_cone_becomes_a_spot_light(tmp_path: Path) -> None:
    """The spot shines along -z, fades within the outer 40 % of 30 degrees, and has the candela of its sphere."""
    inputs = """float inputs:shaping:cone:angle = 30
        float inputs:shaping:cone:softness = 0.4
        float inputs:intensity = 4
        bool inputs:normalize = 1
        float3 xformOp:rotateXYZ = (-90, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:rotateXYZ"]"""
    loaded = expect_kind(ls.LightSpot, light(tmp_path, "SphereLight", inputs, schemas='"ShapingAPI"'))
    np.testing.assert_allclose(loaded.direction, (0.0, -1.0, 0.0), atol=1e-7)
    assert loaded.outer_angle == pytest.approx(math.radians(30.0))
    assert loaded.inner_angle == pytest.approx(math.radians(18.0))
    assert loaded.intensity == pytest.approx(1.0)


def test_usd_distant_light_is_read_in_lux(tmp_path: Path) -> None:
    """50,000 nits over 0.53 degrees give pi sin(0.265 deg)^2 times that; normalized, the intensity is in lux."""
    sun = expect_kind(ls.LightDirectional, light(tmp_path, "DistantLight", ""))
    assert sun.intensity == pytest.approx(50000.0 * math.pi * math.sin(math.radians(0.265)) ** 2)
    assert sun.angle == pytest.approx(math.radians(0.265)) and sun.direction == (0.0, 0.0, -1.0)
    lux = "float inputs:intensity = 7\nbool inputs:normalize = 1"
    assert light(tmp_path, "DistantLight", lux).intensity == pytest.approx(7.0)
    wide = "float inputs:angle = 270\nfloat inputs:intensity = 1"  # wider than a hemisphere: 2 - sin(135 deg)^2
    assert light(tmp_path, "DistantLight", wide).intensity == pytest.approx(1.5 * math.pi)
    parallel = "float inputs:intensity = 7\nfloat inputs:angle = 0"
    assert light(tmp_path, "DistantLight", parallel).intensity == pytest.approx(7.0)


def test_usd_rect_light_has_radiance_and_shines_along_minus_z(tmp_path: Path) -> None:
    """Normalized radiance is divided by the world area; a mirrored light shines along -z, too."""
    inputs = "float inputs:width = 2\nfloat inputs:height = 3\nfloat inputs:intensity = 12"
    loaded = expect_kind(ls.LightRect, light(tmp_path, "RectLight", inputs))
    assert loaded.intensity == 12.0
    np.testing.assert_allclose(np.cross(loaded.edge_u, loaded.edge_v), (0.0, 0.0, -6.0))
    scaled = '\ndouble3 xformOp:scale = (-2, 1, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    mirrored = expect_kind(ls.LightRect, light(tmp_path, "RectLight", f"{inputs}\nbool inputs:normalize = 1{scaled}"))
    np.testing.assert_allclose(np.cross(mirrored.edge_u, mirrored.edge_v), (0.0, 0.0, -12.0))
    assert mirrored.intensity == pytest.approx(1.0)


def test_usd_disk_light_has_radiance_and_shines_along_minus_z(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Normalized radiance is divided by the world area; a mirrored light shines along -z, too."""
    inputs = "float inputs:radius = 2\nfloat inputs:intensity = 12"
    loaded = expect_kind(ls.LightDisk, light(tmp_path, "DiskLight", inputs))
    assert (loaded.radius, loaded.intensity, loaded.direction) == (2.0, 12.0, (0.0, 0.0, -1.0))
    scaled = '\ndouble3 xformOp:scale = (-3, 3, 3)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    mirrored = expect_kind(ls.LightDisk, light(tmp_path, "DiskLight", f"{inputs}\nbool inputs:normalize = 1{scaled}"))
    assert (mirrored.radius, mirrored.direction) == (pytest.approx(6.0), (0.0, 0.0, -1.0))
    assert mirrored.intensity == pytest.approx(12.0 / (math.pi * 36.0))
    assert not caplog.text


def test_stretched_usd_disk_lights_become_round_with_equal_area(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A remark reports the change."""
    scaled = '\ndouble3 xformOp:scale = (4, 1, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    loaded = expect_kind(ls.LightDisk, light(tmp_path, "DiskLight", f"float inputs:radius = 2{scaled}"))
    assert loaded.radius == pytest.approx(4.0)
    assert "stretched disk lights, read as round disks of the same area (/lamp)" in caplog.text


def test_usd_colour_temperature_multiplies_the_colour_of_a_light(tmp_path: Path) -> None:
    """The colour of 3,000 K is orange."""
    inputs = """color3f inputs:color = (1, 0.5, 0.5)
        bool inputs:enableColorTemperature = 1
        float inputs:colorTemperature = 3000"""
    red, green, blue = light(tmp_path, "SphereLight", inputs).color
    black = usd_core("UsdLux").BlackbodyTemperatureAsRgb(3000.0)
    np.testing.assert_allclose((red, green, blue), np.multiply(black, (1.0, 0.5, 0.5)), rtol=1e-6)
    assert red > 2.0 * green > 4.0 * blue


@pytest.mark.parametrize(
    ("head", "kind", "extra", "expected"),
    [
        ('upAxis = "Y"', "DomeLight", "", (0.0, 0.0, 1.0)),
        ('upAxis = "Y"', "DomeLight_1", "", (0.0, 0.0, 1.0)),
        ('upAxis = "Z"', "DomeLight_1", "", (0.0, 0.0, 1.0)),  # -y in the stage is +z in the world
        ('upAxis = "Y"', "DomeLight_1", 'uniform token poleAxis = "Z"', (0.0, -1.0, 0.0)),
    ],
)
def test_usd_dome_light_image_is_centred_on_plus_z(
    tmp_path: Path, head: str, kind: str, extra: str, expected: tuple[float, ...]
) -> None:
    """The image's middle is +z with +x to its left, or -y for pole axis z."""
    usd_core()
    image = np.zeros((4, 8, 3), np.float32)
    image[1:3, 3:5] = 5.0
    write_exr(tmp_path / "sky.exr", {name: image[:, :, k] for k, name in enumerate("RGB")})
    inputs = f"asset inputs:texture:file = @./sky.exr@\nfloat inputs:intensity = 2\n{extra}"
    environment = expect_kind(ls.LightEnvironment, light(tmp_path, kind, inputs, head))
    assert environment.image is not None and environment.intensity == 2.0
    np.testing.assert_array_equal(environment.image, image)
    w, x, y, z = np.asarray(environment.rotation_wxyz)
    forward = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    np.testing.assert_allclose(-forward, expected, atol=1e-6)  # images of LightEnvironment have -z in the middle


def test_point_a_quarter_along_a_usd_dome_light_image_shows_the_direction_plus_x(tmp_path: Path) -> None:
    """The direction a quarter of the width from the left edge is +x."""
    usd_core()
    image = np.zeros((2, 4, 3), np.float32)
    image[:, :2] = 1.0  # the left half of the image
    write_exr(tmp_path / "sky.exr", {name: image[:, :, k] for k, name in enumerate("RGB")})
    dome = light(tmp_path, "DomeLight", "asset inputs:texture:file = @./sky.exr@")
    environment = expect_kind(ls.LightEnvironment, dome)
    w, x, y, z = np.asarray(environment.rotation_wxyz)
    right = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    np.testing.assert_allclose(
        -right, (1.0, 0.0, 0.0), atol=1e-6
    )  # images of LightEnvironment have +x right of the middle


def test_usd_shadow_settings_and_visibility_of_lights_are_read(tmp_path: Path) -> None:
    """One light casts no shadows, one has a shadow distance, and a hidden one is disabled."""
    api = '"ShadowAPI"'
    assert not light(tmp_path, "SphereLight", "bool inputs:shadow:enable = 0", schemas=api).casts_shadow
    sun = light(tmp_path, "DistantLight", "float inputs:shadow:distance = 4", schemas=api)
    assert expect_kind(ls.LightDirectional, sun).shadow_distance == 4.0
    assert not light(tmp_path, "SphereLight", 'token visibility = "invisible"').enabled


def test_unsupported_usd_light_features_are_logged_in_one_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """These are light types, shaping focus, and diffuse and specular multipliers."""
    body = """def CylinderLight "tube" {
    }
    def SphereLight "odd" ( prepend apiSchemas = ["ShapingAPI"] ) {
        float inputs:diffuse = 0.5
        float inputs:shaping:focus = 3
    }"""
    ls.load(write_usda(tmp_path / "a.usda", body))
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.endswith(
        "not read, or read differently: lights of type CylinderLight (/tube); diffuse and specular multipliers of "
        "lights (/odd); shaping:focus of lights (/odd)"
    )
