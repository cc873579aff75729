"""Key views of the viewer's camera path are keyframes of the scene file, and saving preserves the path."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_viewer import lit_scene

import lumisplat as ls
from lumisplat.viewer.panels.video import (
    Key,
    camera_of,
    keys_html,
    keys_of,
    video_cameras,
    with_key,
    with_key_moved,
    without_camera_path,
    without_key,
)

TARGET = (0.0, 0.0, 0.0)


def key(x: float, exposure: float = 0.0) -> Key:
    """Returns a key view of the origin from the front, shifted to the right."""
    eye, up = (x, -0.5, -3.0), (0.0, -1.0, 0.0)
    camera = ls.Camera.look_at(eye, TARGET, up, width=320, height=180, fov_y=0.7)
    return Key(replace(camera, exposure=exposure), TARGET)


def camera_path_document() -> ls.io.SceneDocument:
    """Returns a document with three key views, two seconds and then one second apart."""
    document = with_key(ls.io.SceneDocument.of(lit_scene()), key(-1.0), 2.0)
    return with_key(with_key(document, key(0.0), 2.0), key(1.0, exposure=1.0), 1.0)


def test_camera_path_of_the_viewer_passes_through_its_key_views() -> None:
    """The path has the key views' poses, fields of view and exposures at their times, and the animation's duration."""
    document = camera_path_document()
    assert [entry["time"] for entry in keys_of(document)] == [0.0, 2.0, 3.0]
    animation = document.animation
    assert animation is not None and animation.camera_path is not None and animation.duration == 3.0
    for time, wanted in ((0.0, key(-1.0)), (2.0, key(0.0)), (3.0, key(1.0, exposure=1.0))):
        camera = animation.camera_path.at(time)
        np.testing.assert_allclose(camera.camera_from_world, wanted.camera.camera_from_world, atol=1e-5)
        assert camera.fov_y == pytest.approx(0.7, rel=1e-5) and camera.exposure == wanted.camera.exposure


def test_deleting_a_key_view_of_a_camera_path_moves_later_ones_to_close_the_gap() -> None:
    """Later key views move forward to close the gap; other cameras of the file are unchanged."""
    starts = [[key["eye"][0] for key in keys_of(without_key(camera_path_document(), number))] for number in range(3)]
    times = [[key["time"] for key in keys_of(without_key(camera_path_document(), number))] for number in range(3)]
    assert starts == [[0.0, 1.0], [-1.0, 1.0], [-1.0, 0.0]] and times == [[0.0, 1.0], [0.0, 2.0], [0.0, 2.0]]
    with pytest.raises(ls.SceneError, match="no key view 4"):
        without_key(camera_path_document(), 3)
    still = {"name": "front", "eye": [0.0, 0.0, -4.0], "target": [0.0, 0.0, 0.0]}
    document = with_key(ls.io.SceneDocument.of(lit_scene()).with_cameras([still]), key(0.0), 1.0)
    assert [camera.name for camera in document.cameras] == ["front", "flight"]
    twice = with_key(document, key(1.0), 1.0)
    assert len(keys_of(twice)) == 2 and without_key(twice, 1).cameras[1].name == "flight"
    assert [camera.name for camera in without_key(without_key(twice, 1), 0).cameras] == ["front"]
    assert without_camera_path(twice).animation is None


def test_swapped_key_views_of_a_camera_path_exchange_their_times() -> None:
    """A key view swaps with its neighbour; moving the first one earlier or the last one later changes nothing."""
    moved = with_key_moved(camera_path_document(), 2, -1)
    assert [key["eye"][0] for key in keys_of(moved)] == [-1.0, 1.0, 0.0]
    assert [key["time"] for key in keys_of(moved)] == [0.0, 2.0, 3.0]
    assert keys_of(with_key_moved(moved, 1, 1)) == keys_of(camera_path_document())
    assert keys_of(with_key_moved(camera_path_document(), 0, -1)) == keys_of(camera_path_document())


def test_viewer_lists_the_key_views_of_its_camera_path_with_thumbnails() -> None:
    """Each key view has its time, its buttons and a thumbnail rendered by its own camera."""
    keys = keys_of(camera_path_document())
    text = keys_html(keys, ["data:a", "", "data:c"], "channel")
    assert text.count("<img") == 2 and 'data-to="channel"' in text and ">3 s<" in text
    assert all(
        f'data-command="{command} {number}"' in text for command in ("sooner", "later", "delete") for number in range(3)
    )
    camera, wanted = camera_of(keys[2], (0.0, -1.0, 0.0), (128, 72)), key(1.0).camera
    np.testing.assert_allclose(camera.camera_from_world, wanted.camera_from_world, atol=1e-5)
    assert camera.image_size == (128, 72) and camera.fov_y == pytest.approx(0.7, rel=1e-5)


def test_key_view_later_than_the_end_of_the_animation_extends_it() -> None:
    """A longer animation keeps its duration."""
    document = with_key(ls.io.SceneDocument.of(lit_scene()), key(0.0), 1.0)
    longer = with_key(document.with_animation(duration=9.0, fps=10.0), key(1.0), 4.0).animation
    assert longer is not None and longer.duration == 9.0 and longer.frame_count == 90
    shorter = with_key(document.with_animation(frames=5), key(1.0), 4.0).animation
    assert shorter is not None and shorter.duration == 4.0


def test_saved_camera_path_loads_with_the_same_cameras(tmp_path: Path) -> None:
    """`load_animation` gives the same camera for each frame."""
    document = camera_path_document()
    document.save(tmp_path / "scene.toml")
    animation, saved = document.animation, ls.load_animation(tmp_path / "scene.toml")
    assert animation is not None and saved.camera_path is not None
    view = key(0.0).camera
    cameras = video_cameras(animation, view.scaled(height=90))
    assert len(cameras) == saved.frame_count == 75 and {camera.height for camera in cameras} == {90}
    for camera, time in zip(cameras, saved.times.tolist(), strict=True):
        expected = saved.camera_path.at(time)
        np.testing.assert_allclose(camera.camera_from_world, expected.camera_from_world, atol=1e-12)
        assert math.isclose(camera.fov_y, expected.fov_y, rel_tol=1e-12)


def test_video_of_the_viewer_without_a_camera_path_uses_the_pages_camera() -> None:
    """The video has one frame for each time of the animation."""
    animation = ls.Animation(lit_scene(), frame_count=4)
    view = key(0.5).camera
    assert video_cameras(animation, view) == [view] * 4
