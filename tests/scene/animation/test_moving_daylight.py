"""Sun and sky at a place and time as lights of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.lights import Daylight
from lumisplat.math.color import luminance
from lumisplat.math.directions import panorama_directions, panorama_solid_angles
from lumisplat.math.transforms import rotation_matrix
from support.files.scene_files import load_scene, refuses

EVENING = Daylight(48.1, 11.6, "2026-06-21T18:30+02:00")
SUN = """
[sun]
latitude = 48.1
longitude = 11.6
time = 2026-06-21T18:30:00+02:00
"""
BOX = """
[[meshes]]
shape = "box"
"""


@pytest.mark.parametrize(
    ("up", "north", "east"),
    [
        ("y-up", (0, 0, -1), (1, 0, 0)),
        ("y-down", (0, 0, 1), (1, 0, 0)),
        ("z-up", (0, 1, 0), (1, 0, 0)),
        ("y-up", (1, 0, 0), (0, 0, 1)),
    ],
)
def test_sun_stands_where_up_and_north_put_it_and_its_sky_is_brightest_there(up: str, north: Any, east: Any) -> None:
    """In the west on a summer's evening; the brightest pixel of the sky is at the sun or below it, at the horizon."""
    sun, sky = Daylight(48.1, 11.6, EVENING.time, north=north if north == (1, 0, 0) else None).lights(up)
    towards, upward = -np.array(sun.direction), np.array(ls.Scene(up=up).up_direction)
    elevation, azimuth = EVENING.position
    assert np.degrees(np.arcsin(towards @ upward)) == pytest.approx(elevation, abs=1e-9) and 15.0 < elevation < 35.0
    assert np.degrees(np.arctan2(towards @ east, towards @ north)) % 360.0 == pytest.approx(azimuth, abs=1e-9)
    assert 255.0 < azimuth < 300.0 and sky.image is not None
    height, width = sky.image.shape[:2]
    brightest = panorama_directions(height, width)[np.unravel_index(luminance(sky.image).argmax(), (height, width))]
    found = rotation_matrix(sky.rotation_wxyz) @ brightest
    assert 0.0 < np.degrees(np.arcsin(found @ upward)) < elevation + 180.0 / height
    assert np.degrees(np.arctan2(found @ east, found @ north)) % 360.0 == pytest.approx(azimuth, abs=360.0 / width)


def test_sun_and_sky_have_the_units_of_one_scale() -> None:
    """The ground's irradiance is pi for 100,000 lux, and the ground of the image reflects its albedo of that."""
    sun, sky = Daylight(0.0, 0.0, "2026-03-20T10:00+00:00", ground_albedo=0.4).lights()
    assert sky.image is not None
    height, width = sky.image.shape[:2]
    directions, angles = panorama_directions(height, width), panorama_solid_angles(height, width)[:, None]
    above = (luminance(sky.image) * np.maximum(directions[..., 1], 0.0) * angles).sum() * sky.intensity
    direct = sun.intensity * float(luminance(sun.color)) * -sun.direction[1]
    assert 0.8 * np.pi < above + direct < 1.1 * np.pi and 3.0 < direct / above < 6.0  # a sun at 60 degrees
    assert luminance(sky.image[-1, 0]) * sky.intensity == pytest.approx(0.4 / np.pi * (above + direct), rel=1e-5)
    assert np.degrees(sun.angle) == pytest.approx(0.2665)


def test_clock_runs_with_an_animation_and_the_sun_sets(tmp_path: Path) -> None:
    """Three hours in six seconds; the list of lights stays the same, and a set sun has no light."""
    animation_text = SUN + BOX + "[animation]\nduration = 12.0\n"
    file = tmp_path / "scene.toml"
    file.write_text(animation_text.replace("[sun]\n", "[sun]\nspeed = 1800\n"))
    animation = ls.load_animation(file)
    found_lights: list[Any] = [animation.scene_at(time).lights for time in (0.0, 6.0, 12.0)]
    start, later, night = found_lights
    for found, seconds in ((start, 0.0), (later, 10800.0)):
        time = f"2026-06-21T{18 + int(seconds // 3600)}:30+02:00"
        expected = Daylight(48.1, 11.6, time).lights()
        assert found[0].direction == pytest.approx(expected[0].direction)
    assert [light.name for light in night] == ["sun", "sky"] and night[0].intensity == 0.0 < start[0].intensity
    document = ls.io.SceneDocument.open(file)
    shown: Any = document.scene(6.0).lights[0]
    assert shown.direction == pytest.approx(later[0].direction)


def test_scene_file_with_a_sun_has_its_lights_and_saves_it_as_written(tmp_path: Path) -> None:
    """A hidden sun has none; editing the clock moves the sun."""
    scene: Any = load_scene(tmp_path, SUN + BOX)
    expected = EVENING.lights(scene.up_direction)
    assert [light.name for light in scene.lights] == ["sun", "sky"]
    assert scene.lights[0].direction == expected[0].direction
    document = ls.io.SceneDocument.open(tmp_path / "scene.toml")
    (number,) = [entry.id for entry in document.entries if entry.kind == "sun"]
    noon = document.changed(number, time="2026-06-21T13:15+02:00")
    noon.save(tmp_path / "noon.toml")
    saved: Any = ls.load(tmp_path / "noon.toml")
    edited: Any = noon.scene().lights[0]
    assert saved.lights[0].direction == edited.direction != expected[0].direction
    assert not document.changed(number, hidden=True).scene().lights
    with pytest.raises(ls.ConfigError, match="there is a sun with its sky already"):
        document.added("environment", {"color": 1.0})


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (SUN.replace("+02:00", ""), "line 5, sun: time is 2026-06-21T18:30:00 without an offset from UTC, expected"),
        (
            SUN.replace("2026-06-21T18:30:00+02:00", '"noon"'),
            "time is 'noon', expected a date and time",
        ),
        (SUN.replace("48.1", "91"), "latitude is 91, expected"),
        (SUN.replace("latitude = 48.1\n", ""), "sun: lacks latitude, a number"),
        (SUN + "north = 'y-up'\nturbidity = 3", "which is up or down: expected a horizontal direction"),
        (SUN + "[environment]\ncolor = 1.0", "has [sun], which brings its sky, and [environment]: remove one of them"),
        (SUN + "haze = 2", "unknown 'haze'"),
    ],
)
def test_error_for_an_invalid_sun_of_a_scene_file_names_line_and_key(tmp_path: Path, text: str, problem: str) -> None:
    """The error is one line."""
    with pytest.raises(ls.FormatError) as caught:
        load_scene(tmp_path, text + BOX)
    refuses(caught, tmp_path, problem)


def test_clock_that_runs_needs_a_length_of_the_animation(tmp_path: Path) -> None:
    """The error says where to give it."""
    (tmp_path / "scene.toml").write_text(SUN + "speed = 60" + BOX)
    with pytest.raises(ls.FormatError, match="give duration or frames in"):
        ls.load_animation(tmp_path / "scene.toml")
