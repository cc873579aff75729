"""The light table that kernels read: order, units, names, and uploads."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from lumisplat.device.light.light import (
    LIGHT_DIRECTIONAL,
    LIGHT_DISK,
    LIGHT_ENVIRONMENT,
    LIGHT_HEADLIGHT,
    LIGHT_POINT,
    LIGHT_RECT,
    LIGHT_SPOT,
)
from lumisplat.renderer.scene import lights as render_lights
from lumisplat.renderer.scene.lights import LightTable, environment_cdfs
from lumisplat.runtime.buffers import Buffers
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import (
    Light,
    LightDirectional,
    LightDisk,
    LightEnvironment,
    LightPoint,
    LightRect,
    LightSphere,
    LightSpot,
)
from lumisplat.scene.scene import Scene

CAMERA = Camera.look_at((1.0, 2.0, 5.0), (0.0, 0.0, 0.0), width=8, height=8)
IMAGE = np.random.default_rng(0).random((4, 8, 3), dtype=np.float32)


class Rig:
    """A light table, with the buffers that a renderer would have."""

    def __init__(self) -> None:
        self.table = LightTable()
        self.buffers = Buffers("cpu")

    def sync(self, *lights: Light, camera: Camera = CAMERA) -> np.ndarray:
        """Returns the table rows of the given lights."""
        self.table.sync(Scene(lights=lights), camera, self.buffers)
        return self.table.lights.numpy()


@pytest.fixture
def rig() -> Rig:
    """Returns a rig with an empty table."""
    return Rig()


def test_light_table_stores_candela_lux_and_radiance_times_colour(rig: Rig) -> None:
    """Spheres are stored in candela, angles as versines, and rectangles with their normals."""
    rows = rig.sync(
        LightPoint((1, 2, 3), (1.0, 0.5, 0.0), 8.0, range=7.0, radius=0.25),
        LightSpot((0, 1, 0), (0, -3, 0), intensity=2.0, inner_angle=0.2, outer_angle=1.0, radius=0.1),
        LightDirectional((0, 0, 5), (0.5, 0.5, 0.5), 10.0, 0.02),
        LightSphere((4, 5, 6), 0.5, intensity=3.0),
        LightRect((0, 3, 0), (2, 0, 0), (0, 0, 1), intensity=4.0, casts_shadow=False),
        LightEnvironment(IMAGE, intensity=2.0),
        LightDisk((7, 8, 9), (0, 2, 0), 0.75, (1.0, 0.5, 0.0), 6.0),
    )
    kinds = [LIGHT_POINT, LIGHT_SPOT, LIGHT_DIRECTIONAL, LIGHT_POINT, LIGHT_RECT, LIGHT_ENVIRONMENT, LIGHT_DISK]
    assert rows["kind"].tolist() == [int(kind) for kind in kinds]
    power = [(8, 4, 0), (2, 2, 2), (5, 5, 5), (0.75 * math.pi,) * 3, (4, 4, 4), (2, 2, 2), (6, 3, 0)]
    np.testing.assert_allclose(rows["power"], power, rtol=1e-6)
    np.testing.assert_allclose(
        rows["position"][[0, 1, 3, 4, 6]], [(1, 2, 3), (0, 1, 0), (4, 5, 6), (0, 3, 0), (7, 8, 9)]
    )
    np.testing.assert_allclose(rows["direction"][[1, 2, 4, 6]], [(0, -1, 0), (0, 0, 1), (0, -1, 0), (0, 1, 0)])
    np.testing.assert_allclose(rows["radius"], [0.25, 0.1, 0.02, 0.5, 0.0, 0.0, 0.75], rtol=1e-6)
    np.testing.assert_allclose([rows["inner"][1], rows["outer"][1]], 1.0 - np.cos([0.2, 1.0]), rtol=1e-6)
    assert rows["range"][0] == 7.0
    assert np.isinf(rows["range"][1:]).all()
    np.testing.assert_array_equal(rows["edge_u"][4], (2, 0, 0))
    np.testing.assert_array_equal(rows["edge_v"][4], (0, 0, 1))
    assert rows["casts_shadow"].tolist() == [1, 1, 1, 1, 0, 1, 1]


def test_light_table_lists_enabled_lights_in_scene_order_with_unique_names(rig: Rig) -> None:
    """Unnamed lights are named by their index."""
    point = LightPoint((0, 0, 0), intensity=1.0)
    rows = rig.sync(
        point,
        LightPoint((0, 0, 0), intensity=2.0, enabled=False),
        LightEnvironment(name="sky", intensity=3.0),
        LightPoint((0, 0, 0), intensity=4.0, name="lamp"),
        LightPoint((0, 0, 0), intensity=5.0, name="lamp_5"),
        LightPoint((0, 0, 0), intensity=6.0, name="lamp"),
        LightPoint((0, 0, 0), intensity=7.0, name="light0"),
    )
    assert rig.table.count == 6
    assert rows["power"][:, 0].tolist() == [1.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    names = rig.table.names
    assert names[:4] == ("light0", "sky", "lamp", "lamp_5")
    assert len(set(names)) == 6


def test_light_table_of_a_scene_without_lights_has_a_headlight(rig: Rig) -> None:
    """The headlight is at the eye, with irradiance pi and no shadow. A scene with only disabled lights has none."""
    rows = rig.sync()
    assert (rig.table.count, rig.table.names) == (1, ("headlight",))
    assert rows["kind"][0] == int(LIGHT_HEADLIGHT)
    np.testing.assert_allclose(rows["position"][0], (1.0, 2.0, 5.0), rtol=1e-6)
    np.testing.assert_allclose(rows["power"][0], math.pi, rtol=1e-6)
    assert not rows["casts_shadow"][0]
    assert len(rig.sync(LightPoint((0, 0, 0), enabled=False))) == 1
    assert (rig.table.count, rig.table.names) == (0, ())


def test_light_table_of_a_scene_without_environment_has_arrays_of_one_element(rig: Rig) -> None:
    """A flag tells kernels that there is no environment."""
    rig.sync(LightPoint((0, 0, 0)))
    data = rig.table.environment
    assert not data.exists
    assert [data.texels.size, data.row_ends.size, data.column_ends.size, data.width, data.height] == [1] * 5


def test_light_table_stores_the_environments_image_factor_rotation_and_visibility(rig: Rig) -> None:
    """The rotation is stored as a matrix from environment to world space."""
    rig.sync(LightEnvironment(IMAGE, (1.0, 0.5, 0.25), 2.0, (0.0, 1.0, 0.0, 0.0), visible=False))
    data = rig.table.environment
    assert (data.exists, data.visible, data.width, data.height) == (1, 0, 8, 4)
    np.testing.assert_array_equal(data.texels.numpy().reshape(IMAGE.shape), IMAGE)
    np.testing.assert_allclose(np.array(data.power), (2.0, 1.0, 0.5))
    np.testing.assert_allclose(
        np.array(data.world_from_environment).reshape(3, 3), np.diag([1.0, -1.0, -1.0]), atol=1e-7
    )
    rig.sync(LightEnvironment(rotation_wxyz=(math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))))
    turned = np.array(data.world_from_environment).reshape(3, 3)
    np.testing.assert_allclose(turned @ (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), atol=1e-7)  # about z, x goes to y
    np.testing.assert_array_equal(data.texels.numpy(), [(1.0, 1.0, 1.0)])


def test_environment_image_is_uploaded_to_the_light_table_once(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same image object is not uploaded again, whatever else changes, also after the light was disabled."""
    uploads = []
    monkeypatch.setattr(render_lights, "environment_cdfs", lambda i: uploads.append(i) or environment_cdfs(i))
    environment = LightEnvironment(IMAGE)
    image: Any = environment.image
    for light in (
        environment,
        environment,
        LightEnvironment(image, intensity=3.0),
        LightEnvironment(image, enabled=False),
    ):
        rig.sync(light)
    rig.sync(LightPoint((0, 0, 0)))
    rig.sync(environment)
    assert len(uploads) == 1
    rig.sync(LightEnvironment(IMAGE + 1.0))
    assert len(uploads) == 2
    np.testing.assert_array_equal(rig.table.environment.texels.numpy().reshape(IMAGE.shape), IMAGE + 1.0)


def test_light_table_clamps_large_values_to_finite_float32(rig: Rig) -> None:
    """Values beyond float32 become the largest finite ones, but an infinite range stays infinite."""
    rows = rig.sync(
        LightPoint((1e30, 0, 0), intensity=3e38, range=1e300, radius=3e38),
        LightSphere((0, 0, 0), 3e38, intensity=3e38),
        LightRect((0, 0, 0), (1e30, 0, 0), (0, 1e30, 0), intensity=3e38),
        LightEnvironment(np.full((2, 2, 3), 1e30, dtype=np.float32), intensity=1e20),
    )
    for name in ("position", "power", "radius", "edge_u", "edge_v", "direction"):
        assert np.isfinite(rows[name]).all(), name
    assert np.isinf(rows["range"]).all()
    assert np.isfinite(np.array(rig.table.environment.power)).all()
    assert max(rig.table.environment.power) * 1e30 <= 1.01e30


def test_environment_row_sampling_probabilities_follow_the_solid_angle() -> None:
    """Of two equally bright rows, the one with the larger solid angle has the higher probability."""
    image = np.ones((3, 2, 3), dtype=np.float32)
    rows, columns = environment_cdfs(image)
    np.testing.assert_allclose(rows, (0.25, 0.75, 1.0), rtol=1e-6)  # 0.25 is (1 - cos 60 degrees) / 2
    np.testing.assert_allclose(columns, [(0.5, 1.0)] * 3)
    image[0] = 0.0
    image[2] = 0.0
    rows, _ = environment_cdfs(image)  # bilinear cell means: 3/4 in the bright row, 1/8 in its neighbours
    np.testing.assert_allclose(rows, np.cumsum([0.125 * 0.25, 0.75 * 0.5, 0.125 * 0.25]) / 0.4375, rtol=1e-6)
