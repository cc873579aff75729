"""Lights and materials that change with time: interpolation, and the scene of an animation at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.lights import LightPath, MaterialPath
from lumisplat.scene.lights import Light

BULB = ls.LightPoint((0.0, 2.0, 0.0), (1.0, 0.0, 0.0), 4.0)
SUN = ls.LightDirectional((0.0, -1.0, 0.0), angle=0.005)


def test_light_between_two_keys_has_linear_numbers_and_turned_directions() -> None:
    """A quarter of the time is a quarter of the way, of the intensity in linear light, and of the angle."""
    bulb: Any = LightPath([BULB, replace(BULB, position=(4.0, 2.0, 0.0), color=(0.0, 0.0, 1.0), intensity=8.0)]).at(
        0.25
    )
    assert bulb.position == (1.0, 2.0, 0.0) and bulb.color == (0.75, 0.0, 0.25) and bulb.intensity == 5.0
    sun: Any = LightPath([SUN, replace(SUN, direction=(1.0, 0.0, 0.0))], [0.0, 2.0]).at(0.5)
    np.testing.assert_allclose(sun.direction, (math.sin(math.pi / 8), -math.cos(math.pi / 8), 0.0), atol=1e-15)
    back: Any = LightPath([SUN, replace(SUN, direction=(0.0, 1.0, 0.0))]).at(0.5)
    assert abs(back.direction[1]) < 1e-15  # opposite directions turn about some normal


def test_light_before_its_first_and_after_its_last_key_is_that_of_the_key() -> None:
    """The objects stay the same, so that nothing is rebuilt."""
    path = LightPath([BULB, replace(BULB, intensity=1.0)], [1.0, 2.0])
    assert [path.at(time) for time in (-3.0, 1.0, 2.0, 9.0)] == [path.lights[k] for k in (0, 0, 1, 1)]
    assert path.duration == 2.0


def test_light_with_targets_aims_at_the_target_between_keys_too() -> None:
    """A spot and a rectangle that pass a fixed point face it all the way; directions alone would not."""
    sides = [(-3.0, 1.0, 0.0), (1.0, 1.0, 0.0)]
    makers: list[Callable[..., Light]] = [ls.LightSpot, partial(ls.LightRect, size=(0.5, 0.2))]
    for make in makers:
        lights = [make(side, target=(0.0, 0.0, 0.0)) for side in sides]
        for path, is_exact in ((LightPath(lights, targets=np.zeros((2, 3))), True), (LightPath(lights), False)):
            light: Any = path.at(0.5)
            axis = light.direction if light.kind == "spot" else light.area_vector / 0.1
            error = np.abs(np.array(axis) - (math.sqrt(0.5), -math.sqrt(0.5), 0.0)).max()
            assert (error < 1e-12) == is_exact, light.kind


def test_light_with_targets_aims_at_them_at_its_keys_and_if_nothing_else_changes() -> None:
    """One spot at both keys follows its target, and one turned away at a key faces the key's target."""
    spot = ls.LightSpot((0.0, 5.0, 0.0), direction=(0.0, -1.0, 0.0))
    path = LightPath([spot, spot], [0.0, 1.0], targets=[(5.0, 0.0, 0.0), (0.0, 0.0, 5.0)])
    for time, target in ((-1.0, (5, 0, 0)), (0.0, (5, 0, 0)), (0.5, (2.5, 0, 2.5)), (1.0, (0, 0, 5)), (9.0, (0, 0, 5))):
        light: Any = path.at(time)
        towards = np.subtract(target, spot.position)
        np.testing.assert_allclose(light.direction, towards / np.linalg.norm(towards), atol=1e-12)
    panel = ls.LightRect((0.0, 5.0, 0.0), (0.4, 0.0, 0.0), (0.0, 0.0, 0.2))
    turned: Any = LightPath([panel], targets=[(5.0, 0.0, 0.0)]).at(0.0)
    np.testing.assert_allclose(turned.area_vector / 0.08, np.array([1.0, -1.0, 0.0]) / math.sqrt(2.0), atol=1e-12)


def test_rectangle_between_two_keys_turns_without_shrinking_or_shearing() -> None:
    """Halfway of a quarter turn about its edge, the edges are as long and as square as at the keys."""
    first = ls.LightRect((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    light: Any = LightPath([first, replace(first, edge_v=(0.0, 0.0, 1.0))]).at(0.5)
    np.testing.assert_allclose(light.edge_u, (2.0, 0.0, 0.0), atol=1e-7)
    np.testing.assert_allclose(light.edge_v, (0.0, math.sqrt(0.5), math.sqrt(0.5)), atol=1e-7)


def test_environment_turns_and_fades_with_its_image_unchanged() -> None:
    """A quarter turn about y, halfway, is an eighth; the image is one object, so that it is uploaded once."""
    first = ls.LightEnvironment(np.ones((2, 4, 3)), intensity=1.0)
    half = math.sqrt(0.5)
    path = LightPath([first, replace(first, intensity=3.0, rotation_wxyz=(half, 0.0, half, 0.0))])
    light: Any = path.at(0.5)
    eighth = math.pi / 8
    np.testing.assert_allclose(light.rotation_wxyz, (math.cos(eighth), 0.0, math.sin(eighth), 0.0), atol=1e-12)
    assert light.intensity == 2.0 and light.image is first.image


@pytest.mark.parametrize(
    ("lights", "settings", "problem"),
    [
        ([], {}, "a light path without lights, expected at least one"),
        ([BULB, SUN], {}, "light 1 of the path is a directional light, but the first is a point light"),
        ([BULB, replace(BULB, enabled=False)], {}, "differ in enabled (light 1), which cannot change with time"),
        ([BULB, replace(BULB, range=3.0)], {}, "differ in range (light 1), which cannot change with time"),
        ([BULB, BULB], {"times": [1.0, 1.0]}, "times must increase, but 1 follows 1 (key 1)"),
        ([BULB, BULB], {"targets": np.zeros((2, 3))}, "expected spots, disks or rectangles"),
    ],
)
def test_light_path_refuses_lights_that_cannot_be_interpolated(
    lights: list[Light], settings: dict[str, Any], problem: str
) -> None:
    """The message says which light, and what about it."""
    with pytest.raises(ls.SceneError) as error:
        LightPath(lights, **settings)
    assert problem in str(error.value)


def test_scene_of_an_animation_has_its_lights_in_one_order_at_all_times() -> None:
    """Static lights come first, then moving ones; real-time histories know a light by its place in the list."""
    lights = [LightPath([BULB, replace(BULB, intensity=2.0)]), lambda time: replace(SUN, intensity=time)]
    moving = ls.Animation(ls.Scene(lights=[SUN]), lights=lights, frame_count=3, fps=2.0)
    found: Any = [moving.scene_at(time).lights for time in moving.times]
    assert [[light.kind for light in at] for at in found] == 3 * [["directional", "point", "directional"]]
    assert [(at[0] is SUN, at[1].intensity, at[2].intensity) for at in found] == [
        (True, 4.0, 0.0),
        (True, 3.0, 0.5),
        (True, 2.0, 1.0),
    ]
    for wrong, problem in (
        ([SUN], "put lights that do not change into the scene"),
        ([lambda time: 3], "returned a int"),
    ):
        with pytest.raises(ls.SceneError, match=problem):
            ls.Animation(ls.Scene(), lights=wrong).scene_at(0.0)  # pyright: ignore[reportArgumentType]


def test_material_of_a_name_changes_with_time_on_all_its_objects() -> None:
    """Other materials, and the positions of the mesh, stay the same objects."""
    red, other = ls.MaterialPbr(name="red", roughness=1.0), ls.MaterialPbr(name="other")
    box = ls.box(1.0)
    meshes = [replace(box, material=red), replace(box, material=other)]
    path = MaterialPath("red", [0.0, 1.0], {"base_color": [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)], "roughness": [1.0, 0.5]})
    moving = ls.Animation(ls.Scene(meshes=[*meshes, meshes[0]]), materials=[path])
    first, still, again = moving.scene_at(0.25).meshes
    material: Any = first.mesh.material
    assert material.base_color == (0.75, 0.0, 0.25) and material.roughness == 0.875 and again.mesh is first.mesh
    assert first.mesh.positions is meshes[0].positions and still.mesh is meshes[1]
    with pytest.raises(ls.SceneError, match="material 'red' is a MaterialPbr, which has no shininess"):
        replace(moving, materials=[MaterialPath("red", [0.0], {"shininess": [1.0]})]).scene_at(0.0)


def test_material_path_asks_for_a_list_where_one_number_is_given() -> None:
    """A number without its list has no key."""
    with pytest.raises(ls.SceneError, match=r"roughness has shape \(\), expected a list of 1 numbers or colours"):
        MaterialPath("red", [0.0], {"roughness": 0.5})
