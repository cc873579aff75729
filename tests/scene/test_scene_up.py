"""Up and first view of a scene come from the scene, its captures or a guess, and the source is reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.splat_files import capture
from support.kinds import present

ROTATION = ls.SplatInstance(capture(1), rotation_degrees=(90.0, 0.0, 0.0)).transform


def test_up_direction_of_a_scene_is_its_own_or_else_of_its_capture_or_else_a_guess() -> None:
    """``up_source`` reports which of them was used."""
    plain, tilted = capture(5), replace(capture(5), up=(0.0, 1.0, 1.0))
    assert (ls.Scene([plain]).up_direction, ls.Scene([plain]).up_source) == ((0.0, -1.0, 0.0), "guess")
    assert ls.Scene().up_source == "guess"
    stated = ls.Scene([plain, tilted])
    assert stated.up_source == "capture"
    np.testing.assert_allclose(stated.up_direction, np.array((0.0, 1.0, 1.0)) / np.sqrt(2.0))
    given = ls.Scene([tilted], up="z-up")
    assert (given.up_direction, given.up_source) == ((0.0, 0.0, 1.0), "scene")


def test_up_direction_and_first_view_of_a_capture_rotate_with_its_instance() -> None:
    """A rotated instance rotates its capture's up and first view."""
    view = ls.Camera.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    instance = ls.SplatInstance(replace(capture(5), up="y-up", first_view=view), ROTATION)
    scene = ls.Scene([capture(2), instance])
    assert scene.up_direction == (0.0, 0.0, 1.0)
    np.testing.assert_allclose(present(scene.first_view).eye, (0.0, -4.0, 0.0), atol=1e-12)
    assert ls.Scene([capture(2)]).first_view is None


def test_captures_refuse_an_invalid_up_direction_or_first_camera_view() -> None:
    """An invalid up is refused by name, and a first view must be a camera."""
    with pytest.raises(ls.SceneError, match="up is 'sideways'"):
        replace(capture(1), up="sideways")
    with pytest.raises(ls.SceneError, match="first_view is 'front', expected a Camera"):
        replace(capture(1), first_view="front")


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.sog", "a.glb"])
def test_scene_file_without_an_up_key_has_the_up_direction_of_its_capture(tmp_path: Path, name: str) -> None:
    """The up follows the entry's rotation; the scene file's own up takes precedence; ``upright`` entries give no up."""
    ls.save(tmp_path / name, replace(capture(5), up="z-up"))
    file = tmp_path / "scene.toml"

    def up(top: str = "", entry: str = "") -> tuple[float, float, float]:
        file.write_text(
            f'{top}\n[[splats]]\npath = "{name}"\n{entry}\n[[cameras]]\neye = [9, 0, 0]\ntarget = [0, 0, 0]'
        )
        scene = ls.load(file)
        assert isinstance(scene, ls.Scene)
        (camera,) = ls.load_cameras(file)
        np.testing.assert_allclose(-camera.camera_from_world[1, :3], scene.up_direction, atol=1e-12)
        assert ls.io.SceneDocument.open(file).scene().up_direction == scene.up_direction
        return scene.up_direction

    assert up() == (0.0, 0.0, 1.0)
    assert up(entry="rotation_degrees = [180, 0, 0]") == pytest.approx((0.0, 0.0, -1.0))
    if not name.endswith("glb"):
        assert up(top='up = "y-up"') == (0.0, 1.0, 0.0)
    assert up(entry="upright = true") == (0.0, -1.0, 0.0)
