"""Panels display settings in controls, and edit entries of the scene."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, fields, replace
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import pytest
from test_viewer import camera, cloud

import lumisplat as ls
from lumisplat.config.checks import Range
from lumisplat.config.setting import Setting, frozen, given
from lumisplat.io.load_save import USD
from lumisplat.scene.checks import UNIT_COLOR
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.gizmo import Drag, gizmo_pose, with_dragged_entry
from lumisplat.viewer.overlays import grid_outline
from lumisplat.viewer.panels import adding
from lumisplat.viewer.panels.adding import AddPanel, free_name, light_tables, with_environment_image
from lumisplat.viewer.panels.buttons import plain
from lumisplat.viewer.panels.controls import (
    color_bytes_from_linear,
    color_of_temperature,
    control_settings,
    from_control_value,
    hint_of,
    keep_unchanged_numbers,
    label_of,
    linear_from_color_bytes,
    rounded_for_display,
    to_control_value,
)
from lumisplat.viewer.panels.files import command_line
from lumisplat.viewer.panels.inspector import (
    crop_ends,
    crop_ranges,
    crop_table,
    cropped,
    daylight_fields,
    direction_of_angles,
    direction_of_hour,
    light_fields,
    material_fields,
    put_field,
    shading_of,
    sun_angles,
)
from lumisplat.viewer.panels.outliner import tree_html, with_entry_on_ground
from lumisplat.viewer.panels.viewing import selected_sphere
from lumisplat.viewer.scene_extent import BoxCache, Extent, pose_of, world_corners
from lumisplat.viewer.session import Options, Session, State, limit_undo_memory
from support.files.hdr_files import write_hdr
from support.kinds import present
from support.scenes.raster_scenes import random_gaussians

EXTENT = Extent((0.0, 0.0, 0.0), 2.0)


class Kind(Enum):
    """Kinds of a sample."""

    ONE = "one"
    """The first kind. This second sentence is not part of the hint."""
    TWO = "two"
    """The second kind."""


@dataclass(frozen=True)
class Inner:
    """Nested settings of a sample."""

    depth: Annotated[int, Range(1, 64, "layers of paint")] = 3
    """Thickness of the paint."""


@frozen
class Sample:
    """Settings of a dataclass that is not part of the package."""

    share: Annotated[float, Range(0.0, 0.9, "cd")] = 0.5
    """Fraction of light."""
    count: Annotated[int, Range(2)] | None = None
    """Number of samples."""
    kind: Kind = Kind.ONE
    """Kind of the sample."""
    base_color: tuple[float, float, float] = given(converter=UNIT_COLOR, default=(1.0, 0.0, 0.0))
    """Colour of the sample."""
    inner: Inner = Inner()
    """Group of nested settings."""
    array: np.ndarray | None = None
    """Array, which has no control."""


def field(name: str, cls: type = Sample) -> Setting:
    """Returns a setting by its name."""
    return next(one for one in control_settings(cls) if one.name == name)


def test_viewer_controls_of_any_dataclass_have_kind_range_and_help_of_its_fields() -> None:
    """A dataclass that is not part of the package gets its controls from its declarations."""
    assert [one.name for one in control_settings(Sample)] == ["share", "count", "kind", "base_color", "inner"]
    assert (field("share").kind, field("share").low, field("share").high) == ("number", 0.0, 0.9)
    assert (field("count").kind, field("count").is_optional, field("count").low) == ("whole", True, 2.0)
    assert field("kind").help == "Kind of the sample. one: The first kind. two: The second kind."
    assert field("base_color").kind == "color" and field("inner").group is Inner
    assert (field("depth", Inner).low, field("depth", Inner).high) == (1.0, 64.0)
    assert (
        hint_of(field("depth", Inner))
        == "Thickness of the paint. Takes a whole number from 1 to 64, in layers of paint."
    )
    assert [label_of(one) for one in (field("share"), field("depth", Inner))] == ["share (cd)", "depth"]


@pytest.mark.parametrize("cls", [ls.RenderConfig, ls.RealtimeConfig, ls.ShadowConfig, ls.MaterialPbr, ls.LightSpot])
def test_every_default_setting_round_trips_through_its_control(cls: type) -> None:
    """Each default, converted for display and back, is unchanged; colours are kept to 8 bits."""
    for one in control_settings(cls):
        if one.kind == "group" or repr(one.default).startswith("<dataclasses._MISSING"):
            continue
        back = keep_unchanged_numbers(from_control_value(one, to_control_value(one, one.default)), one.default)
        if one.kind == "color":
            np.testing.assert_allclose(back, one.default or (0.0, 0.0, 0.0), atol=0.005)
        else:
            assert back == one.default, one.name


def test_controls_have_the_declared_ranges_of_settings() -> None:
    """Controls have the ranges that the package declares."""
    ends = {
        name: (field(name, cls).low, field(name, cls).high)
        for name, cls in (
            ("kernel_degree", ls.config.ResponseConfig),
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
def test_black_body_colours_match_reference_chromaticities(
    kelvins: float, expected: tuple[float, float, float]
) -> None:
    """Daylight is nearly white, illuminant A has its CIE 15 chromaticity, and candlelight has no blue."""
    np.testing.assert_allclose(color_of_temperature(kelvins), expected, atol=0.06)


def test_colours_picked_in_the_viewer_are_converted_from_srgb_to_linear() -> None:
    """All 256 levels round-trip; linear 0.5 is level 188."""
    for shade in range(256):
        assert color_bytes_from_linear(linear_from_color_bytes((shade, shade, shade))) == (shade, shade, shade)
    assert color_bytes_from_linear((0.5, 2.0, -1.0)) == (188, 255, 0)


def document() -> ls.io.SceneDocument:
    """Returns a document with a rotated box, a floor below it (y down), and lights."""
    box = ls.MeshInstance(
        ls.box(1.0), position=(1.0, -2.0, 3.0), rotation_degrees=(0.0, 90.0, 0.0), scale_by=2.0, name="box"
    )
    floor = ls.MeshInstance(ls.box(1.0), position=(0.0, 4.0, 0.0), name="floor")
    lights = [
        ls.LightPoint((1, 2, 3)),
        ls.LightSpot((0, -2, 0), (0, 1, 0)),
        ls.LightDirectional((0, 1, 0)),
        ls.LightRect((0, -1, 0), (1, 0, 0), (0, 0, 1)),
        ls.LightDisk((0, -1, 0), (0, 1, 0), 0.5),
        ls.LightEnvironment(),
    ]
    return ls.io.SceneDocument.of(ls.Scene(meshes=[box, floor], lights=lights, up="y-down"))


def moved(number: int, move: np.ndarray) -> ls.io.SceneDocument:
    """Returns the document with the gizmo of an entry moved."""
    return with_gizmo_moved(document(), number, move)


def with_gizmo_moved(
    start: ls.io.SceneDocument, number: int, move: np.ndarray, time: float = 0.0
) -> ls.io.SceneDocument:
    """Returns a document with the gizmo of an entry moved at a time."""
    grip = gizmo_pose(start.entry(number), (np.full(3, -1.0), np.full(3, 1.0)), EXTENT, time)
    assert grip is not None
    return with_dragged_entry(
        start, Drag(start.entry(number), grip.world_from_gizmo, time), move @ grip.world_from_gizmo, EXTENT
    )


def shift(x: float, y: float, z: float) -> np.ndarray:
    """Returns a translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = (x, y, z)
    return matrix


def test_dragging_the_gizmo_translates_objects_and_lights() -> None:
    """A box keeps its rotation and size; lights follow the gizmo, and the gizmo of a sun moves on a sphere."""
    before = document().scene()
    after = moved(0, shift(0.5, 0.0, -1.0)).scene()
    np.testing.assert_allclose(after.meshes[0].transform, shift(0.5, 0.0, -1.0) @ before.meshes[0].transform, atol=1e-9)
    lights = [moved(number, shift(0.5, 0.0, 0.0)).scene().lights[number - 2] for number in (2, 3, 5, 6)]
    assert [light.position for light in lights] == [(1.5, 2.0, 3.0), (0.5, -2.0, 0.0), *[(0.5, -1.0, 0.0)] * 2]  # pyright: ignore
    sun = moved(4, shift(EXTENT.dome_radius, 0.0, 0.0)).scene().lights[2]
    np.testing.assert_allclose(sun.direction, (-math.sqrt(0.5), math.sqrt(0.5), 0.0), atol=1e-9)  # pyright: ignore
    assert gizmo_pose(document().entry(7), None, EXTENT) is None  # an environment has no position


def test_rotating_the_gizmo_rotates_the_direction_and_edges_of_lights() -> None:
    """A quarter turn about x rotates a spot from down to +z, and the edges of a rectangle light likewise."""
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    spot = moved(3, shift(0, -2, 0) @ turn @ shift(0, 2, 0)).scene().lights[1]
    np.testing.assert_allclose(spot.direction, (0.0, 0.0, 1.0), atol=1e-9)  # pyright: ignore
    rect = moved(5, shift(0, -1, 0) @ turn @ shift(0, 1, 0)).scene().lights[3]
    np.testing.assert_allclose(rect.edge_v, (0.0, -1.0, 0.0), atol=1e-9)  # pyright: ignore
    disk = moved(6, shift(0, -1, 0) @ turn @ shift(0, 1, 0)).scene().lights[4]
    np.testing.assert_allclose(disk.direction, (0.0, 0.0, 1.0), atol=1e-9)  # pyright: ignore


def test_fields_of_the_inspector_edit_the_selected_scene_entry() -> None:
    """Position, scale, material and visibility of a box, and the angles of a spot in degrees, are applied."""
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


def test_inspector_shows_what_a_material_without_values_stands_for() -> None:
    """Factors of 1 on a capture's own values, else the defaults; and no control that would have no effect."""

    def shown(material: ls.MaterialPbr | ls.MaterialSimple, gaussians: ls.Gaussians | None) -> dict[str, Any]:
        fields = material_fields(material, gaussians)
        assert not any(field.is_optional for field, _ in fields if field.name == "material.roughness")
        return {field.name.removeprefix("material."): value for field, value in fields}

    own = replace(cloud(), roughness=np.full(cloud().count, 0.3))
    expected = {"base_color": (1.0, 1.0, 1.0), "metallic": 0.0, "roughness": 1.0}
    assert expected.items() <= shown(ls.MaterialPbr(), own).items()
    assert (expected | {"roughness": 0.5}).items() <= shown(ls.MaterialPbr(), cloud()).items()
    assert {"base_color": (0.8,) * 3, "roughness": 0.5}.items() <= shown(ls.MaterialPbr(), None).items()
    assert shown(ls.MaterialPbr(roughness=0.25), own)["roughness"] == 0.25
    assert "base_color" not in shown(ls.MaterialSimple(), own) and "base_color" in shown(ls.MaterialSimple(), None)


def test_place_on_ground_puts_an_object_as_low_as_the_lowest_point_of_the_others() -> None:
    """With y down, the box's lowest point moves to that of the floor."""
    stood = with_entry_on_ground(document(), 0).scene().meshes[0]
    assert stood.bounds()[1][1] == pytest.approx(4.5)
    with pytest.raises(ls.SceneError, match="place on ground"):
        with_entry_on_ground(document(), 2)


def walker(folder: Path) -> ls.io.SceneDocument:
    """Returns a document with a ball that rotates and moves from left to right."""
    ls.save(folder / "ball.ply", cloud())
    (folder / "scene.toml").write_text(
        '[[actors]]\npath = "ball.ply"\nscale = 0.5\n'
        "[[actors.keyframes]]\ntime = 0.0\nposition = [-1.0, 0.0, 0.0]\n"
        "[[actors.keyframes]]\ntime = 2.0\nposition = [1.0, 0.0, 0.0]\nrotation_wxyz = [0.0, 0.0, 1.0, 0.0]\n"
    )
    return ls.io.SceneDocument.open(folder / "scene.toml")


@pytest.mark.parametrize("time", [0.0, 1.0, 2.0])
def test_dragging_an_actor_at_one_time_moves_it_at_all_times(tmp_path: Path, time: float) -> None:
    """The actor is at the gizmo at the time of the drag and keeps its size."""
    document = walker(tmp_path)
    before = document.scene(time).splats[0].transform
    move = shift(0.0, -0.5, 0.25)
    after = with_gizmo_moved(document, 0, move, time).scene(time).splats[0].transform
    np.testing.assert_allclose(after, move @ before, atol=1e-9)


def test_bounding_boxes_of_scene_entries_in_the_viewer_enclose_them_and_are_cached(tmp_path: Path) -> None:
    """Boxes are in file coordinates for any pose; only changed assets are measured again."""
    boxes, start = BoxCache(), document()
    box = boxes.of(start.entry(0))
    assert box is not None
    np.testing.assert_allclose(box, [np.full(3, -0.5), np.full(3, 0.5)], atol=1e-6)
    size = boxes.size(start.entry(0))
    assert size is not None and size == pytest.approx(2.0)
    assert boxes.of(moved(0, shift(1.0, 0.0, 0.0)).entry(0)) is not None
    low, high = start.scene().meshes[0].bounds()
    corners = world_corners(box, np.asarray(start.entry(0).world_from_file))
    np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [low, high], atol=1e-6)
    actor = walker(tmp_path).entry(0)
    placed, pose = boxes.of(actor, 1.0), pose_of(actor, 1.0)
    assert placed is not None and pose is not None
    middle = world_corners(placed, pose).mean(axis=0)
    np.testing.assert_allclose(middle, (0.0, 0.0, 0.0), atol=0.05)
    assert boxes.of(start.entry(2)) is None


def test_outliner_escapes_names_from_files(tmp_path: Path) -> None:
    """Names never become tags or scripts; entries that could not be read are listed as not loaded."""
    evil = "<img src=x onerror=alert(1)>"
    mesh = ls.MeshInstance(ls.box(1.0), name=evil)
    text = tree_html(ls.io.SceneDocument.of(ls.Scene(meshes=[mesh])), BoxCache())
    assert evil not in text and "&lt;img" in text and "12 faces · 1 × 1 × 1" in text
    ls.save(tmp_path / "ball.ply", cloud())
    opened = ls.io.SceneDocument.open([tmp_path / "ball.ply", tmp_path / "gone.obj"])
    assert "not loaded: " in tree_html(opened, BoxCache()) and "gone.obj" in tree_html(opened, BoxCache())
    assert plain("![x](http://a) <b>{1}</b> `c`|") == "  x (http://a)  b  1  /b   c  "


def captured() -> ls.io.SceneDocument:
    """Returns a ball of Gaussians of radius 0.5, and one stray Gaussian far away."""
    ball = cloud()
    means = np.array(ball.means)
    means[0] = (50.0, 0.0, 0.0)
    return ls.io.SceneDocument.of(replace(ball, means=means))


def test_crop_sliders_of_the_viewer_remove_gaussians_outside_their_ranges() -> None:
    """An end at its limit removes nothing, not even stray Gaussians; with all ends at their limits there is no crop."""
    start, session = captured(), Session(Options())
    everything, reach = crop_ranges(start, 0, session)
    assert everything[1, 0] == pytest.approx(50.0) and 0.4 < reach[1, 0] < 1.0
    ends = reach.copy()
    ends[0, 1] = 0.0  # keeps y above 0
    half = cropped(start, 0, ends, reach, everything)
    means = np.asarray(half.scene().splats[0].gaussians.means)
    assert means[:, 1].min() >= 0.0 and means[:, 0].max() == pytest.approx(50.0)
    np.testing.assert_allclose(crop_ends(half.entry(0), reach), ends)
    again, wide = crop_ranges(half, 0, session)
    np.testing.assert_array_equal(again, everything)
    np.testing.assert_array_equal(wide, reach)
    assert "crop_low" not in cropped(half, 0, reach, reach, everything).entry(0).table


def test_crop_table_of_the_viewer_lists_both_slider_ends_of_each_axis() -> None:
    """The table has one row for each axis."""
    ends = np.array([[-1.0, 0.25, 1e-3], [2.0, 1000.5, 12.3456]])
    assert crop_table(ends).splitlines()[2:] == ["| x | -1 | 2 |", "| y | 0.25 | 1000 |", "| z | 0.001 | 12.35 |"]


def test_meshes_added_in_the_viewer_have_the_position_and_scale_of_insert() -> None:
    """Beside captures, `ls.insert` gives position and scale; beside meshes, the new mesh does not overlap them."""
    capture = random_gaussians(3, count=200)
    for around in (ls.Scene([capture], up="z-up"), ls.Scene(meshes=[ls.box(1.0)])):
        session = Session(Options())
        session.open(State(ls.io.SceneDocument.of(around), ls.RenderConfig()))
        panel = AddPanel.__new__(AddPanel)
        panel._session = session
        for size in (0.2, 1000.0):
            assert panel._insert("meshes", {"shape": "box", "size": size})
            number = session.selected
            assert number is not None
            added = session.state.document.entry(number).meshes[0]
            if around.splats:
                expected = ls.insert(around, ls.box(size)).meshes[-1].transform
                np.testing.assert_allclose(added.transform, expected, atol=1e-6)
            else:
                low, high = added.bounds()
                assert low[1] == pytest.approx(-0.5) and np.abs(0.5 * (low + high))[[0, 2]].max() > 0.5
                assert float((high - low)[0]) == pytest.approx(0.2 if size < 1.0 else 0.25, rel=0.01)
            session.apply(lambda document, number=number: document.removed(number))


def test_added_environment_image_replaces_the_existing_one(tmp_path: Path) -> None:
    """The entry stays the same and keeps its other keys."""
    for name in ("a.hdr", "b.hdr"):
        write_hdr(tmp_path / name, np.ones((4, 8, 3), np.float32))
    document, number = with_environment_image(ls.io.SceneDocument.of(ls.Scene()), str(tmp_path / "a.hdr"))
    document, again = with_environment_image(document.changed(number, intensity=0.5), str(tmp_path / "b.hdr"))
    assert number == again and len(document.entries) == 1 and document.entry(number).table["path"].endswith("b.hdr")
    assert document.entry(number).table["intensity"] == 0.5


@pytest.mark.parametrize("aspect", [0.46, 1.2, 2.0])
def test_lights_of_every_type_added_in_the_viewer_light_the_scene_centre_equally(aspect: float) -> None:
    """Any page width works; each type gives the same irradiance at the orbit centre, by closed forms."""
    pose = Pose.through(ls.Camera.look_at((1.0, 2.0, -4.0), (0.5, 0.0, 1.0), (0.0, -1.0, 0.0)), 3.0)
    pose = replace(pose, aspect=aspect)
    view, target = pose.camera(100), np.array(pose.target)
    tables = light_tables(pose, np.array((0.0, -1.0, 0.0)))
    for kind, table in tables.items():
        light: Any = ls.io.SceneDocument.of(ls.Scene()).added("lights", {"type": kind, **table})[0].scene().lights[0]
        if kind == "directional":
            assert np.array(light.direction) @ (0.0, 1.0, 0.0) > 0.5, "the sun does not shine from above"
            continue
        local = view.camera_from_world @ (*light.position, 1.0)
        x, y = local[0] / local[2] * view.fx + view.cx, local[1] / local[2] * view.fy + view.cy
        assert 0.2 * view.width < x < 0.8 * view.width and 0.05 * view.height < y < 0.5 * view.height
        distance = np.linalg.norm(target - light.position)
        disk = math.pi * table.get("radius", 0.0) ** 2
        area = {"sphere": disk, "disk": disk, "rect": math.prod(table.get("size", (0.0,)))}
        assert table["intensity"] * area.get(kind, 1.0) / distance**2 == pytest.approx(3.0)


def test_inspector_rejects_a_scale_that_is_not_positive_and_finite() -> None:
    """The error names the scale, not a singular matrix."""
    for scale in (0.0, -2.0, math.inf):
        with pytest.raises(ls.ConfigError, match=f"^scale is {scale:g}, expected a number > 0$"):
            put_field(document(), 0, "scale", scale)


def test_mesh_material_type_can_be_changed_and_restored() -> None:
    """A mesh changes from its file's material to another type and back."""
    start = document()
    looks = [shading_of(start.entry(0))]
    for kind in ("simple", "pbr"):
        changed = start.changed(0, material={"type": kind})
        looks.append(shading_of(changed.entry(0)))
        shown = changed.scene().meshes[0].mesh.material
        assert isinstance(shown, ls.MaterialSimple if kind == "simple" else ls.MaterialPbr)
    assert looks == ["as in the file", "simple", "PBR"]
    assert shading_of(changed.changed(0, material=None).entry(0)) == "as in the file"


def test_ground_grid_of_the_viewer_is_horizontal_with_a_power_of_ten_spacing() -> None:
    """The grid has the requested size."""
    outline = grid_outline((1.0, 2.0, 3.0), (0.0, -1.0, 0.0), 6.0)
    points = np.concatenate(outline.lines)
    np.testing.assert_allclose(points[:, 1], 2.0)
    assert len(outline.lines) == 2 * 7 and np.ptp(points[:, 0]) == pytest.approx(6.0)


def test_inset_images_cover_only_the_lower_right_corner() -> None:
    """The framed insets are in the lower right, side by side; the rest of the image is unchanged."""
    frame = ls.render(ls.Scene(meshes=[ls.box(2.0)]), camera(), device="cpu")
    picture = np.asarray(frame, np.uint8)
    changed = (frame.with_insets(("depth", "normal")) != picture).any(axis=2)
    assert changed.any() and not changed[:60].any() and not changed[:, :60].any() and not changed[:, -8:].any()
    many = (frame.with_insets(("depth", "normal", "index") * 4, picture) != picture).any(axis=2)
    assert many[:, :30].any() and not many[:60].any()


def test_selection_sphere_encloses_the_selected_object() -> None:
    """A light gets a sphere of a fraction of the scene size; without a selection, there is no sphere."""
    session = Session(Options())
    session.open(State(document()))
    assert selected_sphere(session) is None
    session.select(0)
    ball = selected_sphere(session)
    assert ball is not None and ball[1] == pytest.approx(math.sqrt(3.0))
    np.testing.assert_allclose(ball[0], (1.0, -2.0, 3.0), atol=1e-6)
    session.select(2)
    light = selected_sphere(session)
    assert light is not None
    np.testing.assert_allclose(light[0], (1.0, 2.0, 3.0))


@pytest.mark.parametrize("number", [3, 4, 5])
def test_editing_the_direction_of_a_light_replaces_its_target(number: int) -> None:
    """Editing the direction of a light with a target replaces the target."""
    start = document()
    keys = {3: {"direction": None}, 4: {"direction": None, "position": [0, -3, 0]}, 5: {"edge_u": None, "edge_v": None}}
    size = {"size": [1.0, 1.0]} if number == 5 else {}
    aimed = start.changed(number, target=[0.0, 3.0, 0.5], **size, **keys[number])
    name, value = ("edge_u", (0.0, 0.0, 2.0)) if number == 5 else ("direction", (1.0, 0.0, 0.0))
    light = put_field(aimed, number, name, value).scene().lights[number - 2]
    np.testing.assert_allclose(getattr(light, name), value, atol=1e-9)


def test_dragging_a_slider_is_one_undo_step_and_each_choice_is_a_step_by_itself() -> None:
    """Dragging a slider is one undo step; choosing two pipelines is two steps."""
    session = Session(Options())
    session.open(State(document()))
    for value in (1.0, 2.0):
        session.edit(lambda state, value=value: replace(state, exposure=value), merge="exposure")
    assert session.undo() and session.state.exposure == 0.0
    for pipeline in ("hybrid", "path"):
        session.configure(lambda config, pipeline=pipeline: replace(config, pipeline=pipeline))
    assert session.undo() and session.state.config.pipeline is ls.Pipeline.HYBRID
    session.edit(lambda state: replace(state, exposure=1.0), merge="exposure", within=0.0)
    session.edit(lambda state: replace(state, exposure=2.0), merge="exposure", within=-1.0)
    assert session.undo() and session.state.exposure == 1.0


def test_simultaneous_edits_of_several_threads_are_all_applied() -> None:
    """A slow edit that reads a file keeps changes made meanwhile."""
    session, begun, edited = Session(Options()), threading.Event(), threading.Event()
    session.open(State(document()))

    def slow(document: ls.io.SceneDocument) -> ls.io.SceneDocument:
        begun.set()
        edited.wait()
        return document.added("lights", {"type": "point", "position": [0, 0, 0]})[0]

    thread = threading.Thread(target=session.apply, args=(slow,))
    thread.start()
    begun.wait()
    session.configure(lambda config: replace(config, seed=7))
    session.apply(lambda document: document.changed(2, intensity=5.0))
    edited.set()
    thread.join()
    assert session.state.config.seed == 7 and len(session.state.document.entries) == 9
    assert session.state.document.entry(2).lights[0].intensity == 5.0  # pyright: ignore


def test_files_of_every_readable_usd_extension_can_be_added_in_the_viewer() -> None:
    """The upload and file list accept all OpenUSD extensions that the package reads."""
    assert {*USD} <= {*adding._READABLE}


def test_long_names_of_uploads_are_shortened_and_keep_their_extension(tmp_path: Path) -> None:
    """The name fits every file system and keeps its extension."""
    path = free_name(tmp_path, "x" * 400 + ".ply")
    assert path.suffix == ".ply" and len(path.name) <= 100
    path.write_bytes(b"")
    assert free_name(tmp_path, "x" * 400 + ".ply") != path


def test_command_displayed_by_the_viewer_selects_an_existing_animation_frame(tmp_path: Path) -> None:
    """The end of the animation maps to the last frame; if all actors are hidden, the command renders a still image."""
    session = Session(Options())
    session.open(State(walker(tmp_path).with_animation(duration=2.0, fps=5.0)))
    session.set_options(time=2.0)
    pose = Pose((0.0, 0.0, -3.0), (1.0, 0.0, 0.0, 0.0), 0.8, 1.6, 3.0)
    assert "animate" in command_line(Path("a.toml"), pose, session) and "--frames 9 " in command_line(
        Path("a.toml"), pose, session
    )
    session.apply(lambda document: document.changed(0, hidden=True))
    assert command_line(Path("a.toml"), pose, session).startswith("lumisplat render")


def test_undo_history_is_shortened_if_its_captures_take_too_much_memory() -> None:
    """Each crop creates a capture; edits that share captures with the current state cost nothing."""
    capture = ls.gaussians_from_mesh(ls.box(1.0), 1000, seed=0)
    states = [State(ls.io.SceneDocument.of(capture))]
    for number in range(1, 6):
        high = (0.4 - 0.1 * number, 9.0, 9.0)
        states.append(State(states[0].document.changed(0, crop_low=(-9.0, -9.0, -9.0), crop_high=high)))
        states.append(replace(states[-1], exposure=1.0))
    captures = [state.document.entry(0).splats[0].gaussians for state in states]
    most = sum(array.nbytes for capture in (captures[5], captures[7]) for array in arrays_of(capture))
    small = 8192  # bytes of matrices and bounds
    assert limit_undo_memory(states[:-1], states[-1], most + small) == states[-6:-1]
    assert limit_undo_memory(states[:-1], states[-1]) == states[:-1]


def test_memory_limit_of_the_undo_history_includes_environment_images() -> None:
    """Each undo state keeps its own environment image."""
    images = [np.full((32, 64, 3), value, np.float32) for value in (0.5, 1.0, 2.0)]
    states = [State(ls.io.SceneDocument.of(ls.Scene(lights=[ls.LightEnvironment(image=image)]))) for image in images]
    most = images[0].nbytes
    assert limit_undo_memory(states[:-1], states[-1], most + 8192) == states[1:-1]
    assert limit_undo_memory(states[:-1], states[-1], 3 * most) == states[:-1]


def arrays_of(gaussians: ls.Gaussians) -> list[np.ndarray]:
    """Returns all arrays of a capture."""
    return [value for one in fields(gaussians) if isinstance(value := getattr(gaussians, one.name), np.ndarray)]


def test_command_displayed_by_the_viewer_has_the_sample_count_of_the_settings(tmp_path: Path) -> None:
    """Samples accumulated in the image do not count; without a setting there is no option."""
    session = Session(Options())
    session.open(State(ls.io.SceneDocument.of(cloud()), ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=16)))
    pose = Pose((0.0, 0.0, -3.0), (1.0, 0.0, 0.0, 0.0), 0.8, 1.6, 3.0)
    assert " --samples 16 " in command_line(Path("a.toml"), pose, session)
    session.configure(lambda config: replace(config, samples=None))
    assert "--samples" not in command_line(Path("a.toml"), pose, session)


def test_command_displayed_by_the_viewer_has_loading_options_and_the_exact_view(tmp_path: Path) -> None:
    """Files with invalid Gaussians need the option again; scenes far from the origin need all digits."""
    ls.save(tmp_path / "ball.ply", cloud())
    viewer = ls.view(tmp_path / "ball.ply", device="cpu", drop_invalid=True, lod_budget=1000)
    viewer._loader.join()
    pose = Pose((500000.125, 0.0, -5000000.25), (1.0, 0.0, 0.0, 0.0), 0.8, 1.6, 3.0)
    line = command_line(Path("a.toml"), pose, viewer._session)
    assert "--drop-invalid --lod budget=1000" in line and "--eye=500000.125,0,-5000000.25" in line
    viewer.close()


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)])
def test_sun_direction_set_in_the_inspector_follows_from_angles_or_hour(up: tuple[float, float, float]) -> None:
    """Angles round-trip for every up direction; the sun rises in the east at 6 and is highest at 12."""
    for azimuth, elevation in ((0.0, 30.0), (90.0, 5.0), (200.0, -40.0), (359.0, 80.0)):
        direction = direction_of_angles(azimuth, elevation, up)
        assert np.linalg.norm(direction) == pytest.approx(1.0)
        assert sun_angles(direction, up)[:2] == pytest.approx((azimuth, elevation), abs=1e-9)
    heights = [sun_angles(direction_of_hour(hour, up), up)[1] for hour in (6.0, 9.0, 12.0, 15.0, 18.0, 24.0)]
    assert heights == pytest.approx([0.0, 30.0, 45.0, 30.0, 0.0, -45.0], abs=1e-9)
    assert sun_angles(direction_of_hour(6.0, up), up)[0] == pytest.approx(90.0)
    assert sun_angles(direction_of_hour(18.0, up), up)[0] == pytest.approx(270.0)
    assert [sun_angles(direction_of_hour(hour, up), up)[2] for hour in (0.5, 7.0, 12.0, 21.0)] == pytest.approx(
        [0.5, 7.0, 12.0, 21.0]
    )
    noon = ls.frame_camera(ls.Scene(meshes=[ls.MeshInstance(ls.box(1.0))], up=up), elevation=math.pi / 4)
    np.testing.assert_allclose(direction_of_hour(12.0, up), noon.camera_from_world[2, :3], atol=1e-9)


def test_setting_one_sun_angle_in_the_inspector_keeps_the_other() -> None:
    """Setting one angle keeps the other; a sun given by a target gets a direction instead."""
    scene = ls.Scene(
        meshes=[ls.MeshInstance(ls.box(1.0))], lights=[ls.LightDirectional((0.3, 1.0, 0.4))], up=(0, -1, 0)
    )
    start = ls.io.SceneDocument.of(scene)
    start = start.changed(1, direction=None, position=(0.0, -5.0, -5.0), target=(0.0, 0.0, 0.0))
    up = start.scene().up_direction
    edited = put_field(put_field(start, 1, "elevation_degrees", 20.0), 1, "azimuth_degrees", 75.0)
    fields = {one.name: value for one, value in light_fields(edited.scene().lights[0], up)}
    assert fields["azimuth_degrees"] == pytest.approx(75.0, abs=1e-3) and "direction" not in fields
    assert fields["elevation_degrees"] == pytest.approx(20.0, abs=1e-3)
    noon = put_field(edited, 1, "hour", 12.0).scene().lights[0]
    assert sun_angles(noon.direction, up)[1] == pytest.approx(45.0, abs=1e-3)  # pyright: ignore


@pytest.mark.parametrize(
    ("value", "room", "shown"),
    [
        (12.154932, 8, 12.15493),
        (0.0123456789, 8, 0.012346),
        (-0.0123456789, 8, -0.01235),
        (0.22000000000000003, 11, 0.22),
        (4512345.678, 11, 4512345.678),
        (4512345678.25, 8, 4512345678.0),
        (1.5, 8, 1.5),
        (math.inf, 8, math.inf),
    ],
)
def test_numbers_shown_in_the_viewer_are_rounded_to_fit_their_control(value: float, room: int, shown: float) -> None:
    """Numbers are neither cut off nor padded with zeros, and keep all digits before the decimal point."""
    assert rounded_for_display(value, room) == shown


def test_editing_one_vector_component_in_the_viewer_keeps_all_digits_of_the_others() -> None:
    """The other components keep all their digits, although fewer digits are displayed."""
    before = (12.15493217, 0.0123456789, -3.0)
    field = Setting("position", "vector", "")
    given = (to_control_value(field, before)[0], 0.5, -3.0)
    assert keep_unchanged_numbers(given, before) == (12.15493217, 0.5, -3.0)


def test_first_edit_of_a_material_does_not_rebuild_the_inspectors_controls(tmp_path: Path) -> None:
    """The controls stay as long as the material type stays, even if the material was the file's before the edit."""
    viewer = ls.view(ls.MeshInstance(ls.box(1.0)).mesh, height=90, device="cpu")
    viewer._loader.join()
    session, inspector = viewer._session, viewer._outliner._inspector
    session.select(0)
    folder, controls, parts = inspector._material, dict(inspector._controls), list(inspector._parts)
    session.apply(lambda document: put_field(document, 0, "material.metallic", 1.0))
    assert shading_of(viewer.document.entry(0)) == "PBR"
    assert inspector._material is folder and inspector._controls == controls and inspector._parts == parts
    session.apply(lambda document: document.changed(0, material={"type": "simple"}))
    assert inspector._material is folder and inspector._parts == parts
    assert "material.shininess" in inspector._controls or "material.metallic" not in inspector._controls
    viewer.close()


def test_commands_of_the_outliner_select_hide_and_lock_scene_entries() -> None:
    """A locked entry cannot be selected in the image or edited."""
    viewer = ls.view(ls.Scene(meshes=[ls.MeshInstance(ls.box(1.0), name="crate")]), height=90, device="cpu")
    viewer._loader.join()
    session, outliner, problems, client = viewer._session, viewer._outliner, [], cast(Any, None)
    session.error_listeners.append(problems.append)
    outliner._channel._take(("select 0 1", client))
    assert session.selected == 0 and "lumi-row selected" in outliner._tree.content
    outliner._channel._take(("hide 0 2", client))
    assert viewer.document.entry(0).hidden and not viewer.scene.meshes
    outliner._channel._take(("hide 0 3", client))
    outliner._channel._take(("lock 0 4", client))
    assert session.locked == {0} and viewer._gizmo._handle is None
    outliner.act("delete")
    assert viewer.document.entries and problems == ["crate is locked: unlock it in the list"]
    assert all(control.handle.disabled for control in outliner._inspector._controls.values())
    for nonsense in ("", "select", "select x 1", "explode 0 1", "select -1 2"):
        outliner._channel._take((nonsense, client))
    outliner._channel._take(("lock 0 5", client))
    assert not session.locked and session.selected == 0 and viewer._gizmo._handle is not None
    viewer.close()


def test_clock_of_the_inspector_moves_sun_and_sky() -> None:
    """Date and time of day change the time in its time zone; other fields stay."""
    document = ls.io.SceneDocument.of(ls.Scene(meshes=[ls.box(1.0)]))
    document, number = document.added("sun", {"latitude": 48.1, "longitude": 11.6, "time": "2026-06-21T18:30+02:00"})
    shown = {field.name: value for field, value in daylight_fields(present(document.entry(number).daylight))}
    assert (shown["date"], shown["time_of_day"], shown["latitude"]) == ("2026-06-21", 18.5, 48.1)
    moved = put_field(put_field(document, number, "time_of_day", 6.25), number, "date", "2026-12-21")
    expected = ls.lights.Daylight(48.1, 11.6, "2026-12-21T06:15+02:00")
    assert present(moved.entry(number).daylight).time == expected.time
    assert moved.scene().lights[0].intensity == 0.0 < document.scene().lights[0].intensity
    with pytest.raises(ls.ConfigError, match="date is 'tomorrow', expected a date such as 2026-06-21"):
        put_field(document, number, "date", "tomorrow")
