"""The inspector: controls for the selected entry's transform, material, light parameters, sun angles and crop box."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from datetime import date, datetime, timedelta
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
"""Position of the temperature slider while a light's colour is not one that the slider has set, kelvins."""
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
"""Fields shown for a directional light in place of its direction: azimuth, elevation and hour."""
_CLOCK = (
    Setting("date", "text", "Date, as 2026-06-21."),
    Setting("time_of_day", "number", "Hours on the clock, in the time zone of the scene file.", range=Range(0.0, 24.0)),
)
"""Fields shown for daylight in place of its time."""
_ISO = Setting(
    "depth_iso_transmittance",
    "number",
    "Transmittance at the surface of the capture, which is lit; lower it past floaters and fuzz.",
    range=Range(0.0, 1.0),
    is_optional=True,
)
_CAPTURE_SHADING: dict[str, dict[str, Any]] = {
    "as captured": {"material": None, "shadow_catcher": None},
    "relit, PBR": {"material": {"type": "pbr"}, "shadow_catcher": None},
    "relit, simple": {"material": {"type": "simple"}, "shadow_catcher": None},
    "shadow catcher": {"material": None, "shadow_catcher": True},
}
"""Scene-file keys that give a capture each shading mode of the dropdown; None removes a key."""
_MESH_SHADING: dict[str, dict[str, Any]] = {
    "as in the file": {"material": None},
    "PBR": {"material": {"type": "pbr"}},
    "simple": {"material": {"type": "simple"}},
}
"""Scene-file keys that give a mesh each material type of the dropdown; None removes a key."""
_CAPTURE_HINT = (
    "as captured: unlit, with the captured colours. relit: lights illuminate a material. shadow catcher: as captured, "
    "but other objects cast shadows on it."
)
_MESH_HINT = "The parameters of the material are in the folder below."
_WITHOUT = ("name", "wrap_u", "wrap_v", "normal_scale", "occlusion_strength")
"""Material fields that get no control: they affect only textures, or have a control elsewhere."""


def light_fields(light: Any, up: tuple[float, float, float] = (0.0, 1.0, 0.0)) -> list[tuple[Setting, Any]]:
    """Returns a description and the value of each field of a light, as the inspector shows them; angles in degrees.

    A directional light has azimuth, elevation and hour in place of its direction.

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


def daylight_fields(daylight: ls.lights.Daylight) -> list[tuple[Setting, Any]]:
    """Returns a description and the value of each field of daylight, with date and time of day in place of its time."""
    time = daylight.time
    hours = time.hour + time.minute / 60.0 + time.second / 3600.0
    clock = zip(_CLOCK, (time.date().isoformat(), round(hours, 4)), strict=True)
    fields = control_settings(ls.lights.Daylight)
    return [*clock, *((one, getattr(daylight, one.name)) for one in fields if one.name not in ("time", "north"))]


def _clock_changed(time: datetime, name: str, value: Any) -> str:
    """Returns the time with another ``date`` or ``time_of_day``, as ISO 8601 text.

    Raises:
        ConfigError: The date is none.
    """
    if name == "date":
        try:
            return datetime.combine(date.fromisoformat(str(value)), time.timetz()).isoformat()
        except ValueError:
            raise ls.ConfigError(f"date is {value!r}, expected a date such as 2026-06-21") from None
    midnight = time.replace(hour=0, minute=0, second=0, microsecond=0)
    return (midnight + timedelta(seconds=min(round(3600.0 * float(value)), 86399))).isoformat()


def material_fields(material: Any, gaussians: ls.Gaussians | None) -> list[tuple[Setting, Any]]:
    """Returns a description and the value of each field of a material, as the inspector shows them.

    Fields that are None show the value that they stand for.

    Args:
        material: The material.
        gaussians: The capture with the material; None for a mesh.
    """
    kind = cast("type[Any]", type(material))
    is_pbr = isinstance(material, ls.MaterialPbr)
    in_force = material.values_on(gaussians)._asdict() if is_pbr else {}
    without = _WITHOUT if is_pbr or gaussians is None else (*_WITHOUT, "base_color")
    return [
        (
            replace(field, name=f"material.{field.name}", is_optional=field.is_optional and field.name not in in_force),
            in_force.get(field.name, getattr(material, field.name)),
        )
        for field in control_settings(kind)
        if field.name not in without
    ]


def shading_of(entry: ls.io.SceneEntry) -> str:
    """Returns the entry of the shading dropdown for a capture, such as ``relit, PBR``, or of the material dropdown."""
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
    """Controls of the selected scene entry; they are rebuilt when another entry is selected.

    Args:
        gui: Controls of the pages.
        session: Session to edit.
        folder: GUI folder of the controls.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, folder: viser.GuiFolderHandle) -> None:
        self._gui, self._session, self._folder = gui, session, folder
        self._shown: tuple[Any, ...] | None = None
        """Id, kind and field names (without material fields) of the entry for which controls exist; None without one.
        Other values make `show` rebuild the controls."""
        self._material_shown: tuple[Any, ...] = ()
        """Material fields for which controls exist; other fields make `show` rebuild them."""
        self._controls: dict[str, Control] = {}
        self._parts: list[Any] = []
        self._material: Any = None
        """GUI folder of the material controls; None without them. It is kept while its entry is selected, so that it
        stays open or closed."""
        self._material_parts: list[Any] = []
        self._crop: Crop | None = None
        self._followers: list[Callable[[ls.io.SceneEntry], None]] = []
        """Functions that update controls without a field of their own, such as the colour temperature, from the entry.
        """
        folder.visible = False
        session.on_change(self.show)

    def show(self) -> None:
        """Updates the controls to the selected entry, and rebuilds them if the selection or its fields have changed."""
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
        """Replaces the controls of the material fields, in the same GUI folder, after the material type has changed."""
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
        """Creates a control for each field, given with its value, and returns the viser handles."""
        handles: list[Any] = []
        for field, value in fields:
            control = Control(self._gui, field, value, self._putter(entry, field), self._session.report)
            self._controls[field.name] = control
            handles += control.handles
        return handles

    def _fields(self, entry: ls.io.SceneEntry) -> list[tuple[Setting, Any]]:
        """Returns a description and the value of each field of an entry that the inspector shows."""
        if entry.daylight is not None:
            return [(_flag("hidden"), entry.hidden), *daylight_fields(entry.daylight)]
        if entry.kind in ("lights", "environment"):
            return light_fields(entry.lights[0], self._session.scene.up_direction)
        fields: list[tuple[Setting, Any]] = [(_text("name"), entry.name), (_flag("hidden"), entry.hidden)]
        if entry.world_from_file is not None:
            fields += _transform_fields(np.asarray(entry.world_from_file))
        material: Any = None
        if entry.splats:
            if stored := entry.splats[0].gaussians.sh_degree:
                fields.append((_whole("sh_degree", 0, stored), min(entry.splats[0].sh_degree, stored)))
            fields.append((_ISO, entry.splats[0].depth_iso_transmittance))
            material = entry.splats[0].material
        elif entry.meshes:
            material = entry.meshes[0].mesh.material
        if material is not None:
            fields += material_fields(material, entry.splats[0].gaussians if entry.splats else None)
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
        """Rotation of the environment, (w, x, y, z), to which the slider adds its angle."""

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
    """Returns the document with one field of an entry changed.

    Args:
        document: The scene document.
        number: Entry id.
        name: Field name as in the inspector, such as ``scale``, ``azimuth_degrees`` or ``material.roughness``.
        value: New value.

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
    if entry.daylight is not None and name in [field.name for field in _CLOCK]:
        return document.changed(number, time=_clock_changed(entry.daylight.time, name, value))
    if name == "hidden":
        return document.changed(number, hidden=True if value else None)
    return document.changed(number, **_cleared_aliases(entry, name), **{name: _plain(value)})


def _cleared_aliases(entry: ls.io.SceneEntry, name: str) -> dict[str, Any]:
    """Returns changes that remove all keys for a light's aim before one is set, such as ``target`` for ``direction``.

    Fields that the removed keys also determined keep their present values.
    """
    light: Any = entry.lights[0] if entry.kind == "lights" else None
    if light is None or name not in light.aim_fields:
        return {}
    others = {key: _plain(tuple(getattr(light, key))) for key in light.aim_fields if key != name}
    return dict.fromkeys(light.aim_keys) | others


def rotated_about(wxyz: tuple[float, ...], axis: tuple[float, float, float], degrees: float) -> list[float]:
    """Returns the quaternion (w, x, y, z) of rotation ``wxyz``, then of a rotation about a world-space unit axis."""
    from viser import transforms

    rotation = transforms.SO3.exp(np.array(axis) * math.radians(degrees))
    turned = rotation @ transforms.SO3(np.array(wxyz))
    w, x, y, z = (float(turned.wxyz[index]) for index in range(4))
    return [w, x, y, z]


def _transform_fields(matrix: Any) -> list[tuple[Setting, Any]]:
    """Returns position, rotation (degrees about x, then y, then z) and scale of a similarity, as described fields."""
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
    """Returns a similarity with its position, rotation or scale, whichever ``name`` says, replaced by ``value``.

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
    """Returns the linear colour of a black body of a temperature, rounded to five digits for readable scene files."""
    return [round(channel, 5) for channel in color_of_temperature(kelvins)]


def _plain(value: Any) -> Any:
    """Converts a field's value, such as an enum or array, to a value that a scene file can hold."""
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
"""How far the crop sliders reach beyond the capture's bounding box (without stray Gaussians), as a fraction of its
side."""
_STEPS = 400

Ends = npt.NDArray[np.float64]
"""Row 0: lower ends of three ranges, along x, y and z; row 1: upper ends; shape (2, 3), file coordinates."""


class Crop:
    """Three sliders for a capture's crop box, one for each axis of its file, in viser's open GUI folder.

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
        """Moves the sliders to the capture's current crop box."""
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
        """Crops the capture after a slider has moved.

        Args:
            moved: Axis of the slider, 0 to 2, and its new lower and upper end; the other axes use their sliders'
                values.
        """
        ends = np.array([slider.value for slider in self._sliders], np.float64).T
        ends[:, moved[0]] = moved[1:3]
        number, reach, everything = self._number, self._slider_range, self._all_bounds
        self._session.apply(lambda document: cropped(document, number, ends, reach, everything), merge=f"{number} crop")


def crop_ranges(document: ls.io.SceneDocument, number: int, session: Session) -> tuple[Ends, Ends]:
    """Returns the bounds of all Gaussian means of a capture's file, and the range that the crop sliders cover.

    The sliders cover the bounding box without stray Gaussians, plus `_MARGIN` at each end.
    """
    entry = document.changed(number, crop_low=None, crop_high=None).entry(number)
    means = np.concatenate([np.asarray(instance.gaussians.means, np.float64) for instance in entry.splats])
    everything = np.array([means.min(axis=0), means.max(axis=0)])
    with session.changed:
        box = session.boxes.of(entry)
    assert box is not None
    margin = np.maximum(_MARGIN * (box[1] - box[0]), 1e-6)
    return everything, np.array([box[0] - margin, box[1] + margin])


def crop_ends(entry: ls.io.SceneEntry, reach: Ends) -> Ends:
    """Returns where the crop sliders stand for a capture: at its crop box, or at their limits ``reach`` without one."""
    low, high = entry.table.get("crop_low"), entry.table.get("crop_high")
    if low is None or high is None:
        return reach
    return np.clip([low, high], reach[0], reach[1])


def crop_table(ends: Ends) -> str:
    """Returns a Markdown table of the lower and upper crop ends along x, y and z."""
    rows = [f"| {'xyz'[axis]} | {ends[0, axis]:.4g} | {ends[1, axis]:.4g} |" for axis in range(3)]
    return "\n".join(["| | from | to |", "| --- | ---: | ---: |", *rows])


def cropped(
    document: ls.io.SceneDocument, number: int, ends: Ends, reach: Ends, everything: Ends
) -> ls.io.SceneDocument:
    """Returns the document with a capture cropped to the box that three sliders set.

    Args:
        document: The scene document.
        number: Entry id of the capture.
        ends: Slider ends.
        reach: Limits of the sliders; an end at its limit does not crop on that side.
        everything: Bounds of all Gaussian means of the file, to which an end at its limit is extended.

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
"""Latitude of the sun path that the field ``hour`` follows, radians north; at the equinox, the sun rises at 6 and sets
at 18 hours.
"""


def sun_angles(direction: npt.ArrayLike, up: tuple[float, float, float]) -> tuple[float, float, float]:
    """Returns a sun's azimuth and elevation in degrees, and the hour of the nearest point of the daily sun path.

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
    """Returns the unit direction in which sunlight travels, for a sun at an azimuth and elevation in degrees."""
    south, east, vertical = _axes(up)
    a, e = math.radians(azimuth), math.radians(elevation)
    return -(math.cos(e) * (math.cos(a) * south + math.sin(a) * east) + math.sin(e) * vertical)


def direction_of_hour(hour: float, up: tuple[float, float, float]) -> Vector:
    """Returns the unit direction in which sunlight travels at an hour of the sun path, 0 to 24, 12 is noon."""
    south, east, vertical = _axes(up)
    angle = math.radians(15.0 * (hour - 12.0))
    noon = math.cos(LATITUDE) * vertical + math.sin(LATITUDE) * south
    return -(math.cos(angle) * noon - math.sin(angle) * east)


@cache
def _axes(up: tuple[float, float, float]) -> tuple[Vector, Vector, Vector]:
    """Returns three unit vectors: toward the front of the scene, to the right as seen from the front, and up."""
    vertical = np.asarray(up, np.float64)
    camera = ls.frame_camera(ls.Scene(meshes=[ls.MeshInstance(ls.box(1.0))], up=up), azimuth=0.0, elevation=0.0)
    front = -np.asarray(camera.camera_from_world[2, :3], np.float64)
    return front, np.asarray(np.cross(vertical, front), np.float64), vertical
