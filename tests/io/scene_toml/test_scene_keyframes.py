"""Keyframes of lights, environments and materials in scene files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.files.hdr_files import write_hdr

SCENE = """
[[lights]]
type = "spot"
name = "key"
position = [0, 4, 0]
target = [0, 0, 0]
intensity = 10

[[lights.keyframes]]
time = 0.5

[[lights.keyframes]]
time = 1.5
position = [2, 4, 0]
intensity = 30
outer_angle_degrees = 20

[[lights]]
type = "point"
position = [1, 1, 1]

[environment]
path = "sky.hdr"

[[environment.keyframes]]
time = 0.0
intensity = 0.5

[[environment.keyframes]]
time = 2.0
intensity = 1.5

[materials.wax]
roughness = 0.2

[[materials.wax.keyframes]]
time = 1.0
emissive = 0

[[materials.wax.keyframes]]
time = 3.0
emissive = [4, 2, 0]

[[meshes]]
shape = "box"
material = "wax"
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Returns a scene file with a moving spot, an environment that fades in, and a material that starts to glow."""
    write_hdr(tmp_path / "sky.hdr", np.ones((2, 4, 3), np.float32))
    (tmp_path / "scene.toml").write_text(SCENE)
    return tmp_path / "scene.toml"


def test_lights_environment_and_materials_of_a_scene_file_follow_their_keyframes(file: Path) -> None:
    """Missing keys are inherited; the animation lasts until the last key; a still is that of time 0."""
    animation = ls.load_animation(file)
    assert animation.frame_count == 75 and len(animation.scene.lights) == 1
    at: Any = animation.scene_at(1.0)
    point, spot, sky = at.lights
    assert point.kind == "point" and spot.position == (1.0, 4.0, 0.0) and spot.intensity == 20.0 and spot.name == "key"
    np.testing.assert_allclose(spot.direction, np.array([-1.0, -4.0, 0.0]) / np.sqrt(17.0), atol=1e-12)
    assert np.degrees(spot.outer_angle) == pytest.approx(32.5) and sky.intensity == 1.0
    later: Any = animation.scene_at(2.0).meshes[0].mesh.material
    assert later.emissive == (2.0, 1.0, 0.0) and later.roughness == 0.2
    still: Any = ls.load(file)
    assert [light.intensity for light in still.lights] == [1.0, 10.0, 0.5]


def test_editable_scene_follows_and_saves_the_keyframes_of_its_lights(file: Path, tmp_path: Path) -> None:
    """A document of the file, one of the loaded animation, and its saved file have the same lights at a time."""
    animation = ls.load_animation(file)
    opened, made = ls.io.SceneDocument.open(file), ls.io.SceneDocument.of(animation)
    made.save(tmp_path / "saved.toml")
    saved = ls.load_animation(tmp_path / "saved.toml")

    def values(scene: ls.Scene) -> list[tuple[str, object]]:
        lights: list[Any] = sorted(scene.lights, key=lambda light: light.kind)
        glow: Any = scene.meshes[0].mesh.material
        return [
            (light.kind, np.round([light.intensity, *getattr(light, "direction", ())], 9).tolist()) for light in lights
        ] + [("glow", glow.emissive)]

    for time in (0.0, 1.2, 5.0):
        wanted = values(animation.scene_at(time))
        for found in (opened.scene(time), made.scene(time), saved.scene_at(time)):
            assert values(found) == wanted
    spot = next(entry for entry in opened.entries if entry.name == "key")
    with pytest.raises(ls.SceneError, match="intensity of key changes with time"):
        opened.changed(spot.id, intensity=3.0)


def test_light_given_by_a_function_shows_in_a_document_and_cannot_be_saved(tmp_path: Path) -> None:
    """Scene files hold keyframes, no functions."""
    function = lambda time: ls.LightPoint((time, 0.0, 0.0), name="orbit")  # noqa: E731
    document = ls.io.SceneDocument.of(ls.Animation(ls.Scene(meshes=[ls.box(1.0)]), lights=[function]))
    light: Any = document.scene(2.0).lights[0]
    assert light.position == (2.0, 0.0, 0.0) and document.animation is not None
    with pytest.raises(ls.FormatError, match="orbit was made by a program and cannot be stored"):
        document.save(tmp_path / "scene.toml")


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("time = 1.5", "time = 0.5", "line 13, lights[0].keyframes[1]: time is 0.5, expected seconds after 0.5"),
        ("outer_angle_degrees = 20", "name = 'b'", "line 16, lights[0].keyframes[1]: unknown 'name'"),
        ("intensity = 30", "intensity = -1", "line 15, lights[0].keyframes[1]: intensity is -1"),
        ("emissive = 0", "", "lacks emissive, a number or three, here or in the material above"),
        ("emissive = 0", "emissive = -1", "materials.wax.keyframes[0]: emissive is -1"),
        ('material = "wax"', "material = { keyframes = [] }", "keyframes change named materials"),
    ],
)
def test_error_for_an_invalid_keyframe_names_line_and_key(file: Path, old: str, new: str, problem: str) -> None:
    """Lines are those of the keyframe."""
    file.write_text(SCENE.replace(old, new))
    with pytest.raises(ls.FormatError) as error:
        ls.load_animation(file)
    assert problem in str(error.value)
