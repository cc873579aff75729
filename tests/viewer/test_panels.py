"""What panels show of settings, and what they do to entries."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.viewer.colors import color_of_temperature, linear_from_picked, picked_from_linear
from lumisplat.viewer.hands.gizmo import dragged, grip_of
from lumisplat.viewer.panels.controls import from_shown, to_shown
from lumisplat.viewer.panels.described import Described, described
from lumisplat.viewer.panels.inspector import light_fields, put_field
from lumisplat.viewer.panels.things import on_ground
from lumisplat.viewer.state.extent import Extent

EXTENT = Extent((0.0, 0.0, 0.0), 2.0)


class Kind(Enum):
    """Kinds."""

    ONE = "one"
    """The first. It has more to say."""
    TWO = "two"
    """The second."""


@dataclass(frozen=True)
class Inner:
    """Inner settings."""

    depth: int = 3
    """How deep, 1 to 64."""


@dataclass(frozen=True)
class Sample:
    """Settings that this package does not have."""

    share: float = 0.5
    """A share, 0 (none) to 0.9."""
    count: int | None = None
    """How many, at least 2."""
    kind: Kind = Kind.ONE
    """Which one."""
    base_color: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Its colour."""
    inner: Inner = Inner()
    """What is inside."""
    array: np.ndarray | None = None
    """No control shows this."""


def field(name: str, cls: type = Sample) -> Described:
    """A field of settings by its name."""
    return next(one for one in described(cls) if one.name == name)


def test_fields_say_their_kind_range_and_help() -> None:
    """Of settings that nobody has told the panel of: a new one appears by itself."""
    assert [one.name for one in described(Sample)] == ["share", "count", "kind", "base_color", "inner"]
    assert (field("share").kind, field("share").low, field("share").high) == ("number", 0.0, 0.9)
    assert (field("count").kind, field("count").is_optional, field("count").low) == ("whole", True, 2.0)
    assert field("kind").help == "Which one. one: The first. two: The second."
    assert field("base_color").kind == "color" and field("inner").group is Inner
    assert (field("depth", Inner).low, field("depth", Inner).high) == (1.0, 64.0)


@pytest.mark.parametrize("cls", [ls.RenderConfig, ls.RealtimeConfig, ls.ShadowConfig, ls.MaterialPbr, ls.LightSpot])
def test_every_value_survives_its_control(cls: type) -> None:
    """Defaults of real settings, as they are shown and read back; colours to 8 bits."""
    for one in described(cls):
        if one.kind == "group" or repr(one.default).startswith("<dataclasses._MISSING"):
            continue
        back = from_shown(one, to_shown(one, one.default))
        if one.kind == "color":
            np.testing.assert_allclose(back, one.default or (0.0, 0.0, 0.0), atol=0.005)
        else:
            assert back == one.default, one.name


def test_ranges_of_the_package_are_found() -> None:
    """From docstrings, with thousands and words between."""
    ends = {
        name: (field(name, cls).low, field(name, cls).high)
        for name, cls in (
            ("kernel_degree", ls.ResponseConfig),
            ("shininess", ls.MaterialSimple),
            ("transmittance_threshold", ls.ShadowConfig),
            ("metallic", ls.MaterialPbr),
            ("max_bounces", ls.RenderConfig),
        )
    }
    assert ends == {
        "kernel_degree": (0.0, 5.0),
        "shininess": (0.0, 10000.0),
        "transmittance_threshold": (0.0, 0.99),
        "metallic": (0.0, 1.0),
        "max_bounces": (0.0, 64.0),
    }


@pytest.mark.parametrize(
    ("kelvins", "expected"),
    [(6504.0, (1.0, 1.0, 1.0)), (2856.0, (1.0, 0.447, 0.0807)), (1900.0, (1.0, 0.227, 0.0))],
)
def test_colours_of_black_bodies(kelvins: float, expected: tuple[float, float, float]) -> None:
    """Near daylight nearly white; illuminant A as CIE 15 has its chromaticity; a candle without blue."""
    np.testing.assert_allclose(color_of_temperature(kelvins), expected, atol=0.06)


def test_picked_colours_are_linear_light() -> None:
    """All 256 shades come back; half of linear light is 188."""
    for shade in range(256):
        assert picked_from_linear(linear_from_picked((shade, shade, shade))) == (shade, shade, shade)
    assert picked_from_linear((0.5, 2.0, -1.0)) == (188, 255, 0)


def document() -> ls.SceneDocument:
    """A box that is turned and placed, a floor below it (y is down), and lights."""
    box = ls.MeshInstance(
        ls.box(1.0), position=(1.0, -2.0, 3.0), rotation_degrees=(0.0, 90.0, 0.0), scale_by=2.0, name="box"
    )
    floor = ls.MeshInstance(ls.box(1.0), position=(0.0, 4.0, 0.0), name="floor")
    lights = [
        ls.LightPoint((1, 2, 3)),
        ls.LightSpot((0, -2, 0), (0, 1, 0)),
        ls.LightDirectional((0, 1, 0)),
        ls.LightRect((0, -1, 0), (1, 0, 0), (0, 0, 1)),
        ls.LightEnvironment(),
    ]
    return ls.SceneDocument.of(ls.Scene(meshes=[box, floor], lights=lights, up="y-down"))


def moved(number: int, move: np.ndarray) -> ls.SceneDocument:
    """The document with the grip of an entry moved."""
    start = document()
    grip = grip_of(start.entry(number), np.zeros(3), EXTENT)
    assert grip is not None
    return dragged(start, number, grip.world_from_grip, move @ grip.world_from_grip, EXTENT)


def shift(x: float, y: float, z: float) -> np.ndarray:
    """A translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = (x, y, z)
    return matrix


def test_drags_move_things_as_the_hand_does() -> None:
    """A box keeps its turn and its size; lights go along, a sun on its dome."""
    before = document().scene()
    after = moved(0, shift(0.5, 0.0, -1.0)).scene()
    np.testing.assert_allclose(after.meshes[0].transform, shift(0.5, 0.0, -1.0) @ before.meshes[0].transform, atol=1e-9)
    lights = [moved(number, shift(0.5, 0.0, 0.0)).scene().lights[number - 2] for number in (2, 3, 5)]
    assert [light.position for light in lights] == [(1.5, 2.0, 3.0), (0.5, -2.0, 0.0), (0.5, -1.0, 0.0)]  # pyright: ignore
    sun = moved(4, shift(EXTENT.dome_radius, 0.0, 0.0)).scene().lights[2]
    np.testing.assert_allclose(sun.direction, (-math.sqrt(0.5), math.sqrt(0.5), 0.0), atol=1e-9)  # pyright: ignore
    assert grip_of(document().entry(6), None, EXTENT) is None  # a sky is nowhere


def test_turns_turn_what_shines() -> None:
    """A spot by a quarter about x, from down to along z; a rectangle's edges with it."""
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    spot = moved(3, shift(0, -2, 0) @ turn @ shift(0, 2, 0)).scene().lights[1]
    np.testing.assert_allclose(spot.direction, (0.0, 0.0, 1.0), atol=1e-9)  # pyright: ignore
    rect = moved(5, shift(0, -1, 0) @ turn @ shift(0, 1, 0)).scene().lights[3]
    np.testing.assert_allclose(rect.edge_v, (0.0, -1.0, 0.0), atol=1e-9)  # pyright: ignore


def test_the_inspector_edits_what_it_names() -> None:
    """Place, scale, material and hiding of a box; angles of a spot in degrees."""
    edited = put_field(document(), 0, "position", (0.0, 0.0, 9.0))
    edited = put_field(edited, 0, "scale", 0.5)
    edited = put_field(edited, 0, "material.roughness", 0.25)
    instance = edited.scene().meshes[0]
    assert instance.transform[2, 3] == pytest.approx(9.0) and instance.mesh.material.roughness == 0.25  # pyright: ignore
    np.testing.assert_allclose(np.linalg.norm(instance.transform[:3, :3], axis=0), 0.5)
    assert len(put_field(edited, 0, "hidden", True).scene().meshes) == 1
    angles = {one.name: value for one, value in light_fields(document().scene().lights[1])}
    assert angles["outer_angle_degrees"] == pytest.approx(45.0)
    spot = put_field(document(), 3, "outer_angle_degrees", 30.0).scene().lights[1]
    assert spot.outer_angle == pytest.approx(math.radians(30.0))  # pyright: ignore
    with pytest.raises(ls.SceneError, match="roughness"):
        put_field(edited, 0, "material.roughness", 3.0)


def test_the_ground_is_where_all_others_end() -> None:
    """Below is +y here: the box's lowest point comes to the floor's."""
    stood = on_ground(document(), 0).scene().meshes[0]
    assert stood.bounds()[1][1] == pytest.approx(4.5)
    with pytest.raises(ls.SceneError, match="to the ground"):
        on_ground(document(), 2)
