"""Daylight at a place and time: the sun as a directional light, and the clear sky around it as an environment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, replace
from datetime import datetime, timedelta
from functools import lru_cache, partial
from typing import Annotated

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import Range
from lumisplat.config.setting import Share, frozen, given
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, FloatArray, unit_vector
from lumisplat.math.atmosphere import SUN_RADIUS, sky_luminance, sun_illuminance
from lumisplat.math.color import luminance
from lumisplat.math.directions import panorama_directions, panorama_solid_angles
from lumisplat.math.sun_position import sun_position
from lumisplat.math.transforms import quaternions_from_matrices
from lumisplat.scene.animation.keyframes import check_time
from lumisplat.scene.checks import take_scene_fields
from lumisplat.scene.lights import LightDirectional, LightEnvironment
from lumisplat.scene.placing import Vector, front_vector, up_vector

WHITE_LUX = 100_000.0
"""Illuminance that becomes an irradiance of pi, which shows white paper as display white: that of bright sunlight."""
SKY_ROWS = 64
"""Height of sky images; they are twice as wide. The sun's disc is not in them, so they have no small bright parts."""


def to_datetime(value: datetime | str, name: str = "time") -> datetime:
    """Converts ISO 8601 text, such as ``2026-06-21T18:30+02:00``, to a time with a time zone.

    Raises:
        SceneError: The text is no date and time, or the time zone is missing.
    """
    example = "expected a date and time with its offset from UTC, such as 2026-06-21T18:30+02:00"
    try:
        time = datetime.fromisoformat(value) if isinstance(value, str) else value
    except ValueError:
        raise SceneError(f"{name} is {value!r}, {example}") from None
    if not isinstance(time, datetime):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise SceneError(f"{name} is {value!r}, {example}")
    if time.tzinfo is None:
        raise SceneError(f"{name} is {time.isoformat()} without an offset from UTC, {example}")
    return time


def _north(value: npt.ArrayLike | str | None, name: str = "north") -> Vector | None:
    try:
        return None if value is None else up_vector(value)
    except SceneError:
        raise SceneError(f"{name} is {value!r}, expected the name of an axis, such as z-up, or three numbers") from None


@frozen
class Daylight:
    """Sun and clear sky at a place and time, in units that agree: 100,000 lux show white paper as display white.

    `lights` gives them as lights of a scene. At dusk they are as dim as outdoors; ``intensity`` or a camera's exposure
    brightens them. There are no clouds, no moon and no stars.

    Raises:
        SceneError: A number is out of range, the time has no time zone, or ``north`` is no direction.
    """

    latitude: Annotated[float, Range(-90.0, 90.0, "degrees")]
    """Degrees, positive north of the equator."""
    longitude: Annotated[float, Range(-180.0, 180.0, "degrees")]
    """Degrees, positive east of Greenwich."""
    time: datetime = given(converter=to_datetime)
    """Date and time with an offset from UTC: a datetime, or text such as ``2026-06-21T18:30+02:00``."""
    turbidity: Annotated[float, Range(1.0, 10.0)] = field(default=2.5, kw_only=True)
    """Haze: 1 is air without aerosols, 2 to 3 a clear day, 6 haze."""
    north: Vector | None = given(converter=_north, default=None, kw_only=True)
    """World direction of north, a vector that is made horizontal; None: ahead in the first view of a scene, which is -z
    where y is up, z where y is down, and y where z is up."""
    ground_albedo: Share = field(default=0.3, kw_only=True)
    """Fraction of the light that the ground outside of the scene reflects, which brightens the sky, too."""
    intensity: Annotated[float, Range(0.0)] = field(default=1.0, kw_only=True)
    """Factor on the light of sun and sky."""
    speed: Annotated[float, Range()] = field(default=0.0, kw_only=True)
    """Seconds by which the clock advances in a second of an animation: 3600 is an hour a second, 0 stands still."""

    __post_init__ = take_scene_fields

    def at(self, seconds: float) -> Daylight:
        """Returns the daylight at a time of an animation, in seconds: the clock has advanced by ``speed`` times that.

        Raises:
            SceneError: ``seconds`` is not finite, or the clock leaves the years 1 to 9999.
        """
        check_time(seconds)
        if self.speed == 0.0:
            return self
        try:
            return replace(self, time=self.time + timedelta(seconds=self.speed * seconds), speed=0.0)
        except OverflowError:
            raise SceneError(f"time is {self.time}, and with a speed of {self.speed:g} leaves the calendar") from None

    @property
    def position(self) -> tuple[float, float]:
        """Elevation of the sun above the horizon, and its azimuth, 0 in the north and 90 in the east, degrees."""
        return sun_position(self.latitude, self.longitude, self.time)

    def lights(self, up: npt.ArrayLike | str = "y-up") -> tuple[LightDirectional, LightEnvironment]:
        """Returns the sun and the sky as lights named ``sun`` and ``sky``; at night, the sun has an intensity of 0.

        Args:
            up: World direction that is up, an axis name or a vector: that of the scene.

        Raises:
            SceneError: ``up`` is no direction, or ``north`` is vertical.
        """
        elevation, azimuth = self.position
        upward = np.array(up_vector(up))
        away = self._horizontal(upward, azimuth)
        angle = np.radians(elevation)
        towards = np.cos(angle) * away + np.sin(angle) * upward
        scale = self.intensity * np.pi / WHITE_LUX
        lux = sun_illuminance(elevation, self.turbidity)
        bright = float(luminance(lux))
        color = lux / bright if bright > 0.0 else np.ones(3)
        # Axes of the image: y up, -z under the sun.
        axes = np.stack([np.cross(upward, -away), upward, -away], axis=1)
        return (
            LightDirectional(-towards, color, scale * bright, angle=float(SUN_RADIUS), name="sun"),
            LightEnvironment(
                _sky_image(elevation, self.turbidity, self.ground_albedo),
                intensity=scale,
                rotation_wxyz=quaternions_from_matrices(axes[None])[0],
                name="sky",
            ),
        )

    def moving(
        self, up: npt.ArrayLike | str = "y-up"
    ) -> tuple[Callable[[float], LightDirectional], Callable[[float], LightEnvironment]]:
        """Returns sun and sky as functions of an animation's time in seconds, for `Animation.lights`; see `at`."""
        return partial(_sun_at, self, up), partial(_sky_at, self, up)

    def _horizontal(self, upward: Doubles, azimuth: float) -> Doubles:
        """Returns the horizontal unit direction at an azimuth in degrees, shape (3,)."""
        start = -front_vector(upward) if self.north is None else np.array(self.north)
        north = start - (start @ upward) * upward
        if not np.linalg.norm(north) > 1e-6:
            raise SceneError(f"north is {self.north}, which is up or down: expected a horizontal direction")
        north = unit_vector(north)
        angle = np.radians(azimuth)
        return np.cos(angle) * north + np.sin(angle) * np.cross(north, upward)


def _sun_at(daylight: Daylight, up: npt.ArrayLike | str, seconds: float) -> LightDirectional:
    return daylight.at(seconds).lights(up)[0]


def _sky_at(daylight: Daylight, up: npt.ArrayLike | str, seconds: float) -> LightEnvironment:
    return daylight.at(seconds).lights(up)[1]


@lru_cache(maxsize=16)
def _sky_image(elevation: float, turbidity: float, albedo: float) -> FloatArray:
    """Returns the luminance of sky and ground, cd/m2, as a latitude-longitude image with the sun above its middle.

    Args:
        elevation: Elevation of the sun, degrees.
        turbidity: Haze.
        albedo: Fraction of the light that the ground reflects.
    """
    columns, half = 2 * SKY_ROWS, SKY_ROWS // 2
    directions = panorama_directions(SKY_ROWS, columns)[:half, SKY_ROWS:]
    right = sky_luminance(directions, elevation, turbidity, albedo)
    above = np.concatenate([right[:, ::-1], right], axis=1)
    weights = panorama_solid_angles(SKY_ROWS, columns)[:half] * directions[:, 0, 1]
    lux = (above.sum(axis=1) * weights[:, None]).sum(axis=0)
    lux += sun_illuminance(elevation, turbidity) * max(np.sin(np.radians(elevation)), 0.0)
    ground = np.broadcast_to(albedo * lux / np.pi, above.shape)
    image = np.concatenate([above, ground]).astype(np.float32)
    image.flags.writeable = False
    return image
