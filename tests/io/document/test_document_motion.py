"""Scene documents with animations: the animation equals that of the opened file or of the program."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

import lumisplat as ls
from support.kinds import present
from support.scenes.raster_scenes import random_gaussians

MOVING = """
[[splats]]
path = "capture.ply"

[[actors]]
path = "capture.ply"
name = "walker"

[[actors.keyframes]]
time = 0.0
position = [0.0, 0.0, 0.0]

[[actors.keyframes]]
time = 2.0
position = [4.0, 0.0, 0.0]

[[cameras]]
name = "front"
eye = [0.0, -4.0, 1.0]
target = [0.0, 0.0, 0.0]

[[cameras]]
name = "flight"
target = [0.0, 0.0, 0.0]
near = 0.125
fov_y_degrees = 33.0

[[cameras.keyframes]]
time = 0.0
eye = [0.0, 1.0, 4.0]

[[cameras.keyframes]]
time = 1.5
eye = [3.0, 1.0, 3.0]
exposure = 2.0
aperture = 0.25
focus_distance = 7.0

[animation]
fps = 10.0

[animation.lighting]
direct = 0.25
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Writes a scene file with a moving capture and camera, beside the capture."""
    ls.save(tmp_path / "capture.ply", random_gaussians(1, count=20))
    (tmp_path / "scene.toml").write_text(MOVING)
    return tmp_path / "scene.toml"


def assert_same_camera(mine: ls.Camera, other: ls.Camera) -> None:
    """Checks that all fields of two cameras are equal up to rounding."""
    for field in fields(other):
        first, second = getattr(mine, field.name), getattr(other, field.name)
        if isinstance(second, float | np.ndarray | tuple):
            np.testing.assert_allclose(first, second, rtol=1e-9, atol=1e-12, err_msg=field.name)
        else:
            assert first == second, field.name


def assert_same_animation(mine: ls.Animation | None, other: ls.Animation) -> None:
    """Checks that two animations have equal actors, times, cameras and settings, and as many static objects."""
    mine = present(mine)
    assert (mine.fps, mine.frame_count, mine.lighting) == (other.fps, other.frame_count, other.lighting)
    assert (len(mine.scene.splats), len(mine.scene.meshes)) == (len(other.scene.splats), len(other.scene.meshes))
    for time in (0.0, 0.5, 1.0):
        for one, same in zip(mine.actors_at(time), other.actors_at(time), strict=True):
            np.testing.assert_allclose(one.transform, same.transform, atol=1e-12)
        assert_same_camera(present(mine.camera_path).at(time), present(other.camera_path).at(time))
    for camera, same in zip(mine.cameras, other.cameras, strict=True):
        assert_same_camera(camera, same)


def test_animation_of_a_document_equals_that_of_load_animation_for_its_file(file: Path) -> None:
    """The animation's scene has each static object once and no actor; hiding an entry removes its actor."""
    document = ls.io.SceneDocument.open(file)
    assert_same_animation(document.animation, ls.load_animation(file))
    assert len(document.scene().splats) == 2
    hidden = document.changed(1, hidden=True)
    assert not present(hidden.animation).actors and len(present(hidden.animation).scene.splats) == 1


def test_document_created_from_an_animation_has_its_lighting_settings_and_cameras(file: Path) -> None:
    """The moving camera is not listed among the fixed cameras."""
    animation = ls.load_animation(file)
    document = ls.io.SceneDocument.of(animation)
    assert not document.problems
    assert_same_animation(document.animation, animation)
    assert [camera.name for camera in document.cameras] == ["front", "flight"]


def test_documents_leave_out_and_name_cameras_that_scene_files_cannot_store() -> None:
    """Scene files store neither off-centre principal points nor camera paths without targets."""
    camera = ls.Camera.look_at((0, 0, 5), (0, 0, 0), name="good")
    off = ls.Camera(
        **{field.name: getattr(camera, field.name) for field in fields(camera)} | {"cx": 3.0, "name": "off"}
    )
    path = ls.CameraPath([camera, ls.Camera.look_at((0, 0, 6), (0, 0, 0))])
    document = ls.io.SceneDocument.of(ls.Animation(ls.Scene([random_gaussians(1, count=4)]), (), [off, camera], 5.0, 2))
    assert [camera.name for camera in document.cameras] == ["good"]
    assert len(document.problems) == 1 and document.problems[0].startswith("camera off is left out")
    moving = ls.io.SceneDocument.of(ls.Animation(ls.Scene(), camera_path=path))
    assert "the moving camera is left out" in moving.problems[0]


COORDINATE = st.floats(-100.0, 100.0)
CAMERAS = st.builds(
    dict,
    eye=st.tuples(COORDINATE, COORDINATE, st.floats(1.0, 100.0)),
    target=st.tuples(COORDINATE, COORDINATE, st.floats(-100.0, -1.0)),
    width=st.integers(1, 4000),
    height=st.integers(1, 4000),
    fov_y=st.floats(0.01, 3.0),
    near=st.floats(1e-3, 10.0),
    name=st.sampled_from(["", "left", "ä"]),
    model=st.sampled_from(ls.CameraModel),
    aperture=st.just(0.0) | st.floats(1e-3, 1.0),
    focus_distance=st.floats(0.1, 100.0),
)


@given(CAMERAS)
def test_every_camera_field_survives_a_round_trip_through_documents(values: dict[str, Any]) -> None:
    """Cameras of all models are restored; the focus distance is compared only if the camera has an aperture."""
    camera = ls.Camera.look_at(**values)
    animation = ls.Animation(ls.Scene(), (), [camera])
    (found,) = ls.io.SceneDocument.of(animation).cameras
    if not camera.aperture:
        assert math.isclose(found.focus_distance, camera.focus_distance, rel_tol=1e-9)
    assert_same_camera(found, camera if camera.name else replace(camera, name=found.name))


def test_documents_can_edit_fps_duration_and_avatar_lighting_of_an_animation(file: Path) -> None:
    """Removed keys are absent from the saved file, and errors name invalid values."""
    document = ls.io.SceneDocument.open(file)
    lighting = ls.config.AvatarLightingConfig(direct=0.25, shadows=False)
    edited = document.with_animation(fps=5.0, duration=3.0, frames=None, lighting=lighting)
    animation = edited.animation
    assert animation is not None and (animation.fps, animation.frame_count) == (5.0, 15)
    assert animation.lighting == lighting
    edited.save(file.with_name("edited.toml"))
    saved = ls.load_animation(file.with_name("edited.toml"))
    assert (saved.fps, saved.frame_count, saved.lighting) == (5.0, 15, lighting)
    without = edited.with_animation(fps=None, duration=None, lighting=ls.config.AvatarLightingConfig())
    assert "animation" not in without.top
    with pytest.raises(ls.FormatError, match="fps"):
        document.with_animation(fps=-1.0)
