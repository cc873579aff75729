"""The sun's position against published values of other programs and almanacs."""

from __future__ import annotations

import math
from datetime import datetime, timedelta

import numpy as np
import pytest

from lumisplat.math.sun_position import equatorial, sun_position


def test_sun_position_equals_that_of_nrels_algorithm() -> None:
    """Example of Reda and Andreas (2004), good to 0.0003 degrees: zenith angle with refraction, and azimuth.

    Their air is at 820 hPa and bends light less, by 0.004 degrees.
    """
    elevation, azimuth = sun_position(39.742476, -105.1786, datetime.fromisoformat("2003-10-17T12:30:30-07:00"))
    assert 90.0 - elevation == pytest.approx(50.11162, abs=0.005)
    assert azimuth == pytest.approx(194.34024, abs=0.001)


def test_declination_and_right_ascension_of_the_sun_are_those_of_meeus_example() -> None:
    """Example 25.a, which has five digits; and equinoxes and a solstice of almanacs, to the minute."""
    declination, ascension = map(math.degrees, equatorial(datetime.fromisoformat("1992-10-13T00:00+00:00")))
    assert declination == pytest.approx(-7.78507, abs=1e-4) and ascension % 360.0 == pytest.approx(198.38083, abs=1e-4)
    for time, degrees in (
        ("2026-03-20T14:46+00:00", 0.0),
        ("2026-06-21T08:25+00:00", 23.438),
        ("2026-09-23T00:05+00:00", 0.0),
    ):
        assert math.degrees(equatorial(datetime.fromisoformat(time))[0]) == pytest.approx(degrees, abs=0.005)


@pytest.mark.parametrize(
    ("latitude", "time", "azimuth", "elevation"),
    [
        (48.0, "2026-06-21T12:02+00:00", 180.0, 65.45),  # noon at Greenwich is 2 minutes late then
        (-34.0, "2026-12-21T11:58+00:00", 0.0, 79.44),  # the sun is in the north at noon
        (90.0, "2026-06-21T08:25+00:00", None, 23.48),  # day at the pole, lifted by refraction
    ],
)
def test_sun_at_noon_is_in_the_south_or_north_at_its_declination(
    latitude: float, time: str, azimuth: float | None, elevation: float
) -> None:
    """Elevations are 90 degrees minus the latitude's distance from the declination of the day."""
    found = sun_position(latitude, 0.0, datetime.fromisoformat(time))
    assert found[0] == pytest.approx(elevation, abs=0.03)
    assert azimuth is None or abs((found[1] - azimuth + 180.0) % 360.0 - 180.0) < 1.0


def test_elevation_of_the_setting_sun_has_no_jump() -> None:
    """Refraction fades below the horizon: the sun sinks by less than 0.005 degrees a second until it is at -4."""
    start = datetime.fromisoformat("2026-06-21T19:00+00:00")
    found = np.array([sun_position(48.1, 11.6, start + timedelta(seconds=one))[0] for one in range(3600)])
    assert found[0] > 1.0 and found[-1] < -3.0
    steps = -np.diff(found)
    assert 0.0 < steps.min() and steps.max() < 0.005
