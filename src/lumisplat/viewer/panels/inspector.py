"""Edits the selected object: transform, material, light parameters, sun angles, and the crop box of a capture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.config.setting import Range, Setting
from lumisplat.viewer.panels.controls import (
    KELVIN_RANGE,
    Control,
    color_of_temperature,
    control_settings,
    set_if_changed,
)
from lumisplat.viewer.scene_extent import scale_of
from lumisplat.viewer.server.event_queue import value_callback
from lumisplat.viewer.session import Session

if TYPE_CHECKING:
    import viser


_DEFAULT_K = 6500.0
"""Temperature shown for a light whose colour was not set by temperature, kelvins."""
_SUN = (
    Setting(
        "azimuth_degrees",
        "number",
        "Angle about the vertical, counter-clockwise seen from above; 0 is the front of the scene.",
        range=Range(0.0, 360.0),
    ),
    Setting("elevation_degrees", "number", "Angle above the horizon.", range=Range(-90.0, 90.0)),
    Setting(
        "hour",
        "number",
        "Sets the sun by solar time at the equinox, at latitude 45° north; south is the front of the scene.",
        range=Range(0.0, 24.0),
    ),
)
"""Fields of the inspector that replace the direction of a sun."""
_CAPTURE_SHADING: dict[str, dict[str, Any]] = {
    "as captured": {"material": None, "shadow_catcher": None},
    "relit, PBR": {"material": {"type": "pbr"}, "shadow_catcher": None},
    "relit, simple": {"material": {"type": "simple"}, "shadow_catcher": None},
    "shadow catcher": {"material": None, "shadow_catcher": True},
}
"""Shading modes of a capture, each with the keys of the scene entry that select it."""
_MESH_SHADING: dict[str, dict[str, Any]] = {
    "as in the file": {"material": None},
    "PBR": {"material": {"type": "pbr"}},
    "simple": {"material": {"type": "simple"}},
}
"""Material types of a mesh, each with the keys of the scene entry that select it."""
_CAPTURE_HINT = (
    "as captured: unlit, with the captured colours. relit: lights illuminate a material. shadow catcher: as captured, "
    "but other objects cast shadows on it."
)
_MESH_HINT = "The parameters of the material are in the folder below."
_WITHOUT = ("name", "wrap_u", "wrap_v", "normal_scale", "occlusion_strength")
"""Material fields without a control: fields that only textures use, or that are shown elsewhere."""


def light_fields(light: Any, up: tuple[float, float, float] = (0.0, 1.0, 0.0)) -> list[tuple[Setting, Any]]:
    """Returns the fields of a light by scene-file key, with their values; angles are in degrees.

    A sun has azimuth, elevation and hour in place of its direction.

    Args:
        light: The light.
        up: Up direction of the scene.
    """
    found: list[tuple[Setting, Any]] = []
    kind = cast("type[Any]", type(light))
    for field in control_settings(kind):
        value = getattr(light, field.name)
        if field.name.endswith("angle"):
            degrees = replace(field, name=f"{field.name}_degrees", range=Range(0.0, 90.0))
            found.append((degrees, math.degrees(value)))
        elif field.name == "direction" and isinstance(light, ls.LightDirectional):
            found += zip(_SUN, (round(angle, 2) for angle in sun_angles(value, up)), strict=True)
        else:
            found.append((field, value))
    return found


def shading_of(entry: ls.io.SceneEntry) -> str:
    """Returns the shading mode of a capture or the material type of a mesh."""
    if not entry.splats:
        given = entry.table.get("material")
        if given is None:
            return "as in the file"
        return "simple" if isinstance(entry.meshes[0].mesh.material, ls.MaterialSimple) else "PBR"
    splat = entry.splats[0]
    if splat.shadow_catcher:
        return "shadow catcher"
    if splat.material is None:
        return "as captured"
    return "relit, PBR" if isinstance(splat.material, ls.MaterialPbr) else "relit, simple"


class Inspector:
    """Controls of the selected entry, rebuilt for each selection.

    Args:
        gui: Controls of the pages.
        session: Session to edit.
        folder: GUI folder of the controls.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, folder: viser.GuiFolderHandle) -> None:
        self._gui, self._session, self._folder = gui, session, folder
        self._shown: tuple[Any, ...] | None = None
        """Entry and field names for which the current controls were built, without material fields."""
        self._material_shown: tuple[Any, ...] = ()
        """Fields for which the current material controls were built."""
        self._controls: dict[str, Control] = {}
        self._parts: list[Any] = []
        self._material: Any = None
        """GUI folder of the material. The folder stays while its entry is selected, so that it stays open or closed."""
        self._material_parts: list[Any] = []
        self._crop: Crop | None = None
        self._followers: list[Callable[[ls.io.SceneEntry], None]] = []
        """Functions that update derived controls, such as the colour temperature, from the entry."""
        folder.visible = False
        session.on_change(self.show)

    def show(self) -> None:
        """Shows the selected entry."""
        entry = self._session.selected_entry
        fields = [] if entry is None else self._fields(entry)
        of_material = [field for field in fields if _is_of_material(field[0])]
        others = [field for field in fields if not _is_of_material(field[0])]
        names = None if entry is None else (entry.id, entry.kind, [field.name for field, _ in others])
        if names != self._shown:
            self._rebuild(entry, others)
            self._shown, self._material_shown = names, ()
        if entry is None:
            return
        of = tuple(field for field, _ in of_material)
        if of != self._material_shown:
            self._rebuild_material(entry, of_material)
            self._material_shown = of
        is_locked = entry.id in self._session.locked
        for field, value in fields:
            self._controls[field.name].show(value)
            self._controls[field.name].set_unused("Locked: unlock the object in the list." if is_locked else None)
        if self._crop is not None:
            self._crop.show()
        for follow in self._followers:
            follow(entry)

    def _rebuild(self, entry: ls.io.SceneEntry | None, fields: list[tuple[Setting, Any]]) -> None:
        for part in reversed(self._parts):
            part.remove()
        self._parts, self._controls, self._crop, self._followers = [], {}, None, []
        self._material, self._material_parts = None, []
        self._folder.visible = entry is not None
        if entry is None:
            return
        with self._folder:
            self._parts += self._add_fields(entry, fields)
            if entry.kind == "lights":
                self._add_temperature(entry)
            elif entry.kind == "environment":
                self._add_rotation(entry)
            elif entry.splats or entry.meshes:
                self._add_shading(entry)
            if entry.splats:
                self._crop = Crop(self._gui, self._session, entry.id)
                self._parts.append(self._crop.folder)
            if entry.splats or entry.meshes:
                self._material = self._gui.add_folder("material", expand_by_default=False)
                self._parts.append(self._material)

    def _rebuild_material(self, entry: ls.io.SceneEntry, fields: list[tuple[Setting, Any]]) -> None:
        """Rebuilds the controls for another material type, in the same folder."""
        for part in reversed(self._material_parts):
            part.remove()
        self._controls = {name: each for name, each in self._controls.items() if not _is_of_material(each.field)}
        self._material_parts = []
        if self._material is None:
            return
        self._material.visible = bool(fields)
        with self._material:
            self._material_parts = self._add_fields(entry, fields)

    def _add_fields(self, entry: ls.io.SceneEntry, fields: list[tuple[Setting, Any]]) -> list[Any]:
        """Adds controls of fields and returns their GUI handles."""
        handles: list[Any] = []
        for field, value in fields:
            control = Control(self._gui, field, value, self._putter(entry, field), self._session.report)
            self._controls[field.name] = control
            handles += control.handles
        return handles

    def _fields(self, entry: ls.io.SceneEntry) -> list[tuple[Setting, Any]]:
        """Returns the fields of an entry, with their values."""
        if entry.kind in ("lights", "environment"):
            return light_fields(entry.lights[0], self._session.scene.up_direction)
        fields: list[tuple[Setting, Any]] = [(_text("name"), entry.name), (_flag("hidden"), entry.hidden)]
        if entry.world_from_file is not None:
            fields += _transform_fields(np.asarray(entry.world_from_file))
        material: Any = None
        if entry.splats:
            if stored := entry.splats[0].gaussians.sh_degree:
                fields.append((_whole("sh_degree", 0, stored), min(entry.splats[0].sh_degree, stored)))
            material = entry.splats[0].material
        elif entry.meshes:
            material = entry.meshes[0].mesh.material
        if material is not None:
            kind = cast("type[Any]", type(material))
            own = [field for field in control_settings(kind) if field.name not in _WITHOUT]
            fields += [(replace(field, name=f"material.{field.name}"), getattr(material, field.name)) for field in own]
        return fields

    def _putter(self, entry: ls.io.SceneEntry, field: Setting) -> Callable[[Any], None]:
        number, name = entry.id, field.name
        merge = f"{number} {name}" if field.kind in ("whole", "number", "color", "vector") else None

        def put(value: Any) -> None:
            self._session.apply(lambda document: put_field(document, number, name, value), merge=merge)

        return put

    def _add_shading(self, entry: ls.io.SceneEntry) -> None:
        number = entry.id
        looks, hint = (_CAPTURE_SHADING, _CAPTURE_HINT) if entry.splats else (_MESH_SHADING, _MESH_HINT)
        label = "shading" if entry.splats else "material type"
        dropdown = self._gui.add_dropdown(label, list(looks), initial_value=shading_of(entry), hint=hint)

        def change(look: str) -> None:
            if look in looks:
                self._session.apply(lambda document: document.changed(number, **looks[look]))

        def follow(now: ls.io.SceneEntry) -> None:
            set_if_changed(dropdown, "value", shading_of(now))

        dropdown.on_update(value_callback(str, change))
        self._followers.append(follow)
        self._parts.append(dropdown)

    def _add_temperature(self, entry: ls.io.SceneEntry) -> None:
        number, (low, high) = entry.id, KELVIN_RANGE
        hint = "Sets the colour to that of a black body."
        slider = self._gui.add_slider("temperature (K)", low, high, 50.0, _DEFAULT_K, hint=hint)

        def change(kelvins: float) -> None:
            color = _rounded_color(kelvins)
            self._session.apply(lambda document: document.changed(number, color=color), merge=f"{number} kelvin")

        def follow(now: ls.io.SceneEntry) -> None:
            color: Any = getattr(now.lights[0], "color", ())
            if list(color) != _rounded_color(float(slider.value)):
                slider.value = _DEFAULT_K

        slider.on_update(value_callback(float, change))
        self._followers.append(follow)
        self._parts.append(slider)

    def _add_rotation(self, entry: ls.io.SceneEntry) -> None:
        number = entry.id
        hint = "Rotates the environment about the vertical."
        slider = self._gui.add_slider("rotation (°)", -180.0, 180.0, 1.0, 0.0, hint=hint)
        start = _environment_rotation(entry)
        """Environment rotation at the centre of the slider."""

        def change(degrees: float) -> None:
            keys = {"rotation_wxyz": rotated_about(start, self._session.scene.up_direction, degrees)}
            self._session.apply(lambda document: document.changed(number, **keys), merge=f"{number} turn")

        def follow(now: ls.io.SceneEntry) -> None:
            nonlocal start
            turned = rotated_about(start, self._session.scene.up_direction, float(slider.value))
            if not np.allclose(turned, _environment_rotation(now), atol=1e-9):
                start = _environment_rotation(now)
                slider.value = 0.0

        slider.on_update(value_callback(float, change))
        self._followers.append(follow)
        self._parts.append(slider)


def put_field(document: ls.io.SceneDocument, number: int, name: str, value: Any) -> ls.io.SceneDocument:
    """Returns the document with a new value of an entry's field, named as in the inspector.

    Raises:
        LumisplatError: The value is invalid.
    """
    entry = document.entry(number)
    if name.startswith("material."):
        material = dict(document.material(number)) | {name.removeprefix("material."): _plain(value)}
        shown = entry.splats[0].material if entry.splats else entry.meshes[0].mesh.material
        material.setdefault("type", "pbr" if isinstance(shown, ls.MaterialPbr) else "simple")
        return document.changed(number, material=material)
    if name in ("position", "rotation_degrees", "scale") and entry.kind not in ("lights", "environment"):
        return document.placed(number, _moved(np.asarray(entry.world_from_file), name, value))
    if name in (field.name for field in _SUN):
        sun: Any = entry.lights[0]
        up = document.scene().up_direction
        azimuth, elevation, _ = sun_angles(sun.direction, up)
        if name == "hour":
            direction = direction_of_hour(value, up)
        elif name == "azimuth_degrees":
            direction = direction_of_angles(value, elevation, up)
        else:
            direction = direction_of_angles(azimuth, value, up)
        at = [round(float(x), 6) for x in direction]
        return document.changed(number, direction=at, position=None, target=None)
    if name == "hidden":
        return document.changed(number, hidden=True if value else None)
    return document.changed(number, **_cleared_aliases(entry, name), **{name: _plain(value)})


def _cleared_aliases(entry: ls.io.SceneEntry, name: str) -> dict[str, Any]:
    """Returns the keys that must be cleared when a field is set, because they specify the same property.

    An example is ``target`` when ``direction`` is set.
    """
    light: Any = entry.lights[0] if entry.kind == "lights" else None
    if light is None or name not in light.aim_fields:
        return {}
    others = {key: _plain(tuple(getattr(light, key))) for key in light.aim_fields if key != name}
    return dict.fromkeys(light.aim_keys) | others


def rotated_about(wxyz: tuple[float, ...], axis: tuple[float, float, float], degrees: float) -> list[float]:
    """Returns a quaternion rotated by an angle about a world-space axis."""
    from viser import transforms

    rotation = transforms.SO3.exp(np.array(axis) * math.radians(degrees))
    turned = rotation @ transforms.SO3(np.array(wxyz))
    w, x, y, z = (float(turned.wxyz[index]) for index in range(4))
    return [w, x, y, z]


def _transform_fields(matrix: Any) -> list[tuple[Setting, Any]]:
    """Returns position, rotation about x, y and z, and scale of a similarity, as fields with values."""
    from viser import transforms

    scale = scale_of(matrix)
    angles = transforms.SO3.from_matrix(matrix[:3, :3] / scale).as_rpy_radians()
    degrees = tuple(math.degrees(float(angle)) for angle in (angles.roll, angles.pitch, angles.yaw))
    return [
        (Setting("position", "vector", "World position of the object's origin, scene units."), tuple(matrix[:3, 3])),
        (Setting("rotation_degrees", "vector", "Rotation about the world's x, then y, then z axis."), degrees),
        (Setting("scale", "number", "Uniform scale factor.", range=Range(1e-6)), scale),
    ]


def _moved(matrix: Any, name: str, value: Any) -> Any:
    """Returns a similarity with another position, rotation or scale.

    Raises:
        ConfigError: The scale is not > 0.
    """
    from viser import transforms

    moved = np.array(matrix)
    scale = scale_of(moved)
    if name == "position":
        moved[:3, 3] = value
    elif name == "scale":
        if not 0.0 < value < math.inf:
            raise ls.ConfigError(f"scale is {value:g}, expected a number > 0")
        moved[:3, :3] *= value / scale
    else:
        moved[:3, :3] = scale * transforms.SO3.from_rpy_radians(*np.radians(value)).as_matrix()
    return moved


def _environment_rotation(entry: ls.io.SceneEntry) -> tuple[float, ...]:
    environment: Any = entry.lights[0]
    return tuple(float(x) for x in environment.rotation_wxyz)


def _rounded_color(kelvins: float) -> list[float]:
    """Returns the colour of a black body, rounded to five digits for readable scene files."""
    return [round(channel, 5) for channel in color_of_temperature(kelvins)]


def _plain(value: Any) -> Any:
    """Converts a value to its form in a scene-file table."""
    if isinstance(value, tuple):
        return [float(x) for x in cast("tuple[float, ...]", value)]
    return value.value if hasattr(value, "value") else value


def _is_of_material(field: Setting) -> bool:
    return field.name.startswith("material.")


def _text(name: str) -> Setting:
    return Setting(name, "text", "")


def _flag(name: str) -> Setting:
    return Setting(name, "flag", "")


def _whole(name: str, low: int, high: int) -> Setting:
    return Setting(name, "whole", "", range=Range(low, high))


_MARGIN = 0.25
"""Margin of the crop sliders beyond the bulk of a capture, as a fraction of the bulk's size along the axis."""
_STEPS = 400

Ends = npt.NDArray[np.float64]
"""Lower and upper ends of a range along x, y and z, shape (2, 3)."""


class Crop:
    """Controls of a capture's crop box, in the current GUI folder.

    Args:
        gui: Controls of the pages.
        session: Session to edit.
        number: Entry id of the capture.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, number: int) -> None:
        self._session, self._number = session, number
        self._all_bounds, self._slider_range = crop_ranges(session.state.document, number, session)
        self.folder = gui.add_folder("crop", expand_by_default=False)
        with self.folder:
            self._sliders = [self._slider(gui, axis) for axis in range(3)]
            self._numbers = gui.add_markdown("")
        self.show()

    def show(self) -> None:
        """Shows the current crop box of the capture."""
        ends = crop_ends(self._session.state.document.entry(self._number), self._slider_range)
        for axis, slider in enumerate(self._sliders):
            slider.value = (float(ends[0, axis]), float(ends[1, axis]))
        self._numbers.content = crop_table(ends)

    def _slider(self, gui: viser.GuiApi, axis: int) -> Any:
        low, high = (float(end) for end in self._slider_range[:, axis])
        hint = "Keeps this range of the file's coordinates; at its limits, a slider does not crop."
        step = (high - low) / _STEPS
        slider = gui.add_multi_slider(f"crop {'xyz'[axis]}", low, high, step, (low, high), hint=hint)
        slider.on_update(value_callback(lambda value: (axis, *value), self._change))
        return slider

    def _change(self, moved: tuple[Any, ...]) -> None:
        """Crops to the ends of all sliders; the moved slider's ends come from its event."""
        ends = np.array([slider.value for slider in self._sliders], np.float64).T
        ends[:, moved[0]] = moved[1:3]
        number, reach, everything = self._number, self._slider_range, self._all_bounds
        self._session.apply(lambda document: cropped(document, number, ends, reach, everything), merge=f"{number} crop")


def crop_ranges(document: ls.io.SceneDocument, number: int, session: Session) -> tuple[Ends, Ends]:
    """Returns the bounds of all Gaussians of a capture's file, and the range of the crop sliders around its bulk."""
    entry = document.changed(number, crop_low=None, crop_high=None).entry(number)
    means = np.concatenate([np.asarray(instance.gaussians.means, np.float64) for instance in entry.splats])
    everything = np.array([means.min(axis=0), means.max(axis=0)])
    with session.changed:
        box = session.boxes.of(entry)
    assert box is not None
    margin = np.maximum(_MARGIN * (box[1] - box[0]), 1e-6)
    return everything, np.array([box[0] - margin, box[1] + margin])


def crop_ends(entry: ls.io.SceneEntry, reach: Ends) -> Ends:
    """Returns the slider ends for a capture's crop box."""
    low, high = entry.table.get("crop_low"), entry.table.get("crop_high")
    if low is None or high is None:
        return reach
    return np.clip([low, high], reach[0], reach[1])


def crop_table(ends: Ends) -> str:
    """Returns the slider ends as a Markdown table."""
    rows = [f"| {'xyz'[axis]} | {ends[0, axis]:.4g} | {ends[1, axis]:.4g} |" for axis in range(3)]
    return "\n".join(["| | from | to |", "| --- | ---: | ---: |", *rows])


def cropped(
    document: ls.io.SceneDocument, number: int, ends: Ends, reach: Ends, everything: Ends
) -> ls.io.SceneDocument:
    """Returns the document with a capture cropped to the slider ends.

    Args:
        document: The scene document.
        number: Entry id of the capture.
        ends: Slider ends.
        reach: Range of the sliders; an end at its limit does not crop that side.
        everything: Bounds of all Gaussians.

    Raises:
        FormatError: No Gaussian would be left.
    """
    tolerance = (reach[1] - reach[0]) / _STEPS
    is_open = np.abs(ends - reach) < tolerance
    if is_open.all():
        return document.changed(number, crop_low=None, crop_high=None)
    outside = np.array(
        [np.minimum(everything[0], reach[0]) - tolerance, np.maximum(everything[1], reach[1]) + tolerance]
    )
    low, high = np.where(is_open, outside, ends)
    return document.changed(number, crop_low=low, crop_high=high)


Vector = npt.NDArray[np.float64]

LATITUDE = math.radians(45.0)
"""Latitude, radians north, of the sun path that the hour selects. The date is the equinox: sunrise at 6, sunset at 18.
"""


def sun_angles(direction: npt.ArrayLike, up: tuple[float, float, float]) -> tuple[float, float, float]:
    """Returns azimuth and elevation of a sun in degrees, and the hour of the nearest position on the sun's daily path.

    Azimuth is counter-clockwise seen from above, 0 to 360. Azimuth 0 is the front of the scene, where the sun is at
    noon.

    Args:
        direction: Direction in which the light travels, world space, shape (3,).
        up: Up direction of the scene, a unit vector.
    """
    towards = -np.asarray(direction, np.float64)
    south, east, height = (float(axis @ towards) for axis in _axes(up))
    azimuth = math.degrees(math.atan2(east, south)) % 360.0
    elevation = math.degrees(math.atan2(height, math.hypot(south, east)))
    hour_angle = math.atan2(-east, height * math.cos(LATITUDE) + south * math.sin(LATITUDE))
    return azimuth, elevation, 12.0 + math.degrees(hour_angle) / 15.0


def direction_of_angles(azimuth: float, elevation: float, up: tuple[float, float, float]) -> Vector:
    """Returns the unit direction in which a sun's light travels, given azimuth and elevation in degrees."""
    south, east, vertical = _axes(up)
    a, e = math.radians(azimuth), math.radians(elevation)
    return -(math.cos(e) * (math.cos(a) * south + math.sin(a) * east) + math.sin(e) * vertical)


def direction_of_hour(hour: float, up: tuple[float, float, float]) -> Vector:
    """Returns the unit direction in which a sun's light travels at an hour of the day, 0 to 24."""
    south, east, vertical = _axes(up)
    angle = math.radians(15.0 * (hour - 12.0))
    noon = math.cos(LATITUDE) * vertical + math.sin(LATITUDE) * south
    return -(math.cos(angle) * noon - math.sin(angle) * east)


@cache
def _axes(up: tuple[float, float, float]) -> tuple[Vector, Vector, Vector]:
    """Returns unit vectors of a scene with an up direction: toward the front, to its right seen from there, and up."""
    vertical = np.asarray(up, np.float64)
    camera = ls.frame_camera(ls.Scene(meshes=[ls.MeshInstance(ls.box(1.0))], up=up), azimuth=0.0, elevation=0.0)
    front = -np.asarray(camera.camera_from_world[2, :3], np.float64)
    return front, np.asarray(np.cross(vertical, front), np.float64), vertical
