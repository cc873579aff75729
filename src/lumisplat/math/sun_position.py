"""Where the sun stands in the sky at a place and time (Meeus 1998, chapters 12, 16, 22 and 25, low accuracy)."""

from __future__ import annotations

import math
from datetime import UTC, datetime

_EPOCH = datetime(2000, 1, 1, 12, tzinfo=UTC)
"""Epoch J2000. The difference between terrestrial and universal time, a minute, turns the sun by less than 0.001
degrees."""


def sun_position(latitude: float, longitude: float, time: datetime) -> tuple[float, float]:
    """Returns elevation and azimuth of the sun's centre as seen at sea level, degrees; the azimuth is 90 in the east.

    The error is at most 0.02 degrees from 1900 to 2100, more within 1 degree of the horizon, where the refraction of
    the air varies.

    Args:
        latitude: Degrees, positive north of the equator.
        longitude: Degrees, positive east of Greenwich.
        time: Time with a time zone.
    """
    declination, ascension = equatorial(time)
    days = (time - _EPOCH).total_seconds() / 86400.0
    sidereal = 280.46061837 + 360.98564736629 * days + longitude
    hour = math.radians(sidereal) - ascension
    south = math.radians(latitude)
    sine = math.sin(south) * math.sin(declination) + math.cos(south) * math.cos(declination) * math.cos(hour)
    elevation = math.degrees(math.asin(max(-1.0, min(sine, 1.0))))
    west = math.atan2(math.sin(hour), math.cos(hour) * math.sin(south) - math.tan(declination) * math.cos(south))
    return elevation + _refraction(elevation), (math.degrees(west) + 180.0) % 360.0


def equatorial(time: datetime) -> tuple[float, float]:
    """Returns apparent declination and right ascension of the sun, radians."""
    centuries = (time - _EPOCH).total_seconds() / (86400.0 * 36525.0)
    mean = math.radians(357.52911 + 35999.05029 * centuries - 0.0001537 * centuries**2)
    center = (
        (1.914602 - 0.004817 * centuries) * math.sin(mean)
        + (0.019993 - 0.000101 * centuries) * math.sin(2.0 * mean)
        + 0.000289 * math.sin(3.0 * mean)
    )
    node = math.radians(125.04 - 1934.136 * centuries)
    along = 280.46646 + 36000.76983 * centuries + 0.0003032 * centuries**2 + center
    longitude = math.radians(along - 0.00569 - 0.00478 * math.sin(node))
    obliquity = math.radians(23.4392911 - 0.0130042 * centuries + 0.00256 * math.cos(node))
    declination = math.asin(math.sin(obliquity) * math.sin(longitude))
    return declination, math.atan2(math.cos(obliquity) * math.sin(longitude), math.cos(longitude))


def _refraction(elevation: float) -> float:
    """Returns how far the air lifts the sun, degrees (Saemundsson 1986; below -0.575 degrees NOAA's solar calculator).

    It fades out below the horizon, so that the sky does not jump when the sun sets.
    """
    if elevation < -0.575:
        return -0.005771 / math.tan(math.radians(elevation))
    return 0.0170 / math.tan(math.radians(elevation + 10.3 / (elevation + 5.11)))
