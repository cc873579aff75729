"""Up direction and first view of a capture: every written format preserves them, and invalid ones are ignored."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.scene_toml import placement as up_module
from lumisplat.io.scene_toml.placement import stated_up
from lumisplat.io.splats.orientation import orientation_of
from support.files.splat_files import capture, load_gaussians
from support.kinds import present

UP = (0.1, 0.2, 0.97)
UNIT = np.array(UP) / np.linalg.norm(UP)
VIEW = ls.Camera.look_at((1.0, 2.0, 3.0), (0.1, 0.2, 0.3), UP, width=270, height=480, fov_y=1.2)
FORMATS = ["a.ply", "a.compressed.ply", "a.spz", "a.sog", "meta.json", "lod-meta.json", "a.glb", "a.gltf"]


def stated(count: int = 40) -> ls.Gaussians:
    """Returns a capture with an up direction and a first view."""
    return replace(capture(count), up=UP, first_view=VIEW)


def assert_states(found: ls.Gaussians) -> None:
    """Checks that up and first view equal those of `stated`."""
    np.testing.assert_allclose(present(found.up), UNIT, atol=1e-8)
    view = present(found.first_view)
    np.testing.assert_allclose(view.camera_from_world, VIEW.camera_from_world, atol=1e-8)
    np.testing.assert_allclose(
        [view.fov_y, view.focus_distance, view.width, view.height], [1.2, VIEW.focus_distance, 270, 480], rtol=1e-8
    )


@pytest.mark.parametrize("name", FORMATS)
def test_every_capture_format_preserves_up_direction_and_first_camera_view(tmp_path: Path, name: str) -> None:
    """Up and first view are in the coordinates of the saved capture."""
    ls.save(tmp_path / name, stated())
    assert_states(load_gaussians(tmp_path / name))
    np.testing.assert_allclose(present(stated_up(tmp_path / name)), UNIT, atol=1e-8)


def test_openusd_preserves_up_direction_and_first_camera_view_of_a_capture(tmp_path: Path) -> None:
    """Both are custom data of the particle field."""
    pytest.importorskip("pxr")
    ls.save(tmp_path / "a.usda", stated())
    assert_states(load_gaussians(tmp_path / "a.usda"))
    np.testing.assert_allclose(present(stated_up(tmp_path / "a.usda")), UNIT, atol=1e-8)


def test_blocks_preserve_up_direction_and_first_camera_view_of_a_capture(tmp_path: Path) -> None:
    """The index stores up and first view, and all functions that load blocks return both."""
    index = ls.io.write_blocks(tmp_path / "blocks", [stated()], 10.0)
    assert_states(load_gaussians(tmp_path / "blocks"))
    assert_states(ls.io.thin_blocks(index))
    assert stated_up(tmp_path / "blocks") is not None


@pytest.mark.parametrize("name", FORMATS[:-2])
def test_capture_without_a_known_up_direction_is_saved_without_one(tmp_path: Path, name: str) -> None:
    """Readers thus know that the up direction of the capture is a guess."""
    ls.save(tmp_path / name, capture(40))
    found = load_gaussians(tmp_path / name)
    assert found.up is None
    assert found.first_view is None


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_gltf_capture_of_another_program_is_y_up(tmp_path: Path, name: str) -> None:
    """In glTF y is up, so the capture is rotated to y down, and its up is stated."""
    ls.save(tmp_path / name, capture(40))
    assert load_gaussians(tmp_path / name).up == (0.0, -1.0, 0.0)


@pytest.mark.parametrize("name", ["a.glb", "a.usda"])
def test_tilted_capture_is_saved_y_up_in_gltf_and_openusd(tmp_path: Path, name: str) -> None:
    """A scene that loads the file shows the capture upright."""
    if name.endswith("usda"):
        pytest.importorskip("pxr")
    tall = replace(capture(40), means=np.linspace(0, 3, 40)[:, None] * np.array(UP), up=UP)
    ls.save(tmp_path / name, ls.Scene([tall, capture(3)], up=tall.up))
    scene = ls.load(tmp_path / name)
    assert isinstance(scene, ls.Scene)
    low, high = scene.splats[0].world_means[[0, -1]]
    np.testing.assert_allclose(high - low, 3.0 * np.linalg.norm(UP) * np.array([0.0, 1.0, 0.0]), atol=1e-5)
    np.testing.assert_allclose(scene.up_direction, (0.0, 1.0, 0.0))


@pytest.mark.parametrize(
    ("comment", "up"),
    [
        ("Vertical Axis: z", (0.0, 0.0, 1.0)),
        ("vertical axis: Y", (0.0, 1.0, 0.0)),
        ("Vertical Axis: -y", (0.0, -1.0, 0.0)),
        ("up_axis X", (1.0, 0.0, 0.0)),
        ("lumisplat up 0 -3 0", (0.0, -1.0, 0.0)),
        ("a vertical axis: z is nice", None),
        ("Vertical Axis: zenith", None),
    ],
)
def test_up_direction_is_read_from_ply_comments_of_nerfstudio_and_lumisplat(
    tmp_path: Path, comment: str, up: tuple[float, float, float] | None
) -> None:
    """Saving the loaded capture preserves a comment that is still right."""
    plain, named = tmp_path / "plain.ply", tmp_path / "named.ply"
    ls.save(plain, capture(5))
    named.write_bytes(plain.read_bytes().replace(b"element", f"comment {comment}\nelement".encode(), 1))
    found = load_gaussians(named)
    assert found.up == up
    ls.save(named, found)
    assert load_gaussians(named).up == up
    assert b"Vertical Axis: z\n" in named.read_bytes() or comment != "Vertical Axis: z"


def test_lumisplats_up_direction_comment_of_a_ply_overrides_that_of_nerfstudio(tmp_path: Path) -> None:
    """Saving a rotated capture writes its new up, and removes comments that are no longer right."""
    path = tmp_path / "a.ply"
    axis = replace(capture(5), comments=("Vertical Axis: z", "a comment"), up="z-up")
    ls.save(path, ls.transform(axis, rotation_degrees=(90.0, 0.0, 0.0)))
    found = load_gaussians(path)
    assert found.up == (0.0, -1.0, 0.0)
    assert found.comments == ("a comment",)


@pytest.mark.parametrize(
    "values",
    [
        {"up": [0, 0, 0]},
        {"up": "sideways"},
        {"up": [1, 2]},
        {"up": {"x": 1}},
        {"first_view": 3},
        {"first_view": {"eye": [0, 0, 0]}},
        {"first_view": {"eye": [0, 0, 0], "target": [0, 0, 0], "up": UP, "fov_y": 1, "width": 9, "height": 9}},
        {"first_view": {"eye": [0, 0, 1], "target": [0, 0, 0], "up": UP, "fov_y": 9, "width": 9, "height": 9}},
        {"first_view": {"eye": "abc", "target": [0, 0, 0], "up": UP, "fov_y": 1, "width": 10**400, "height": 9}},
        {"first_view": {"eye": [1e308, 0, 0], "target": [-1e308, 0, 0], "up": UP, "fov_y": 1, "width": 9, "height": 9}},
    ],
)
def test_invalid_up_direction_or_first_camera_view_is_ignored_with_a_log_line(
    values: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """The capture itself is loaded."""
    with caplog.at_level(logging.WARNING):
        assert orientation_of("x.ply", values) == (None, None)
    assert "x.ply" in caplog.text


@pytest.mark.parametrize("text", ["{", "[1]", "{" * 5000, '{"eye": NaN}', "0"])
def test_damaged_ply_comments_of_up_direction_and_first_camera_view_are_ignored(tmp_path: Path, text: str) -> None:
    """Whatever follows the keywords of a comment, the capture is loaded."""
    plain, path = tmp_path / "plain.ply", tmp_path / "a.ply"
    ls.save(plain, capture(5))
    line = f"comment lumisplat first_view {text}\ncomment lumisplat up {text}\nelement"
    path.write_bytes(plain.read_bytes().replace(b"element", line.encode(), 1))
    assert (load_gaussians(path).up, load_gaussians(path).first_view) == (None, None)


def test_edits_of_a_capture_preserve_its_up_direction_and_first_camera_view() -> None:
    """Cutting, decimating and sorting preserve up and first view.

    Merging takes both from the first capture that has them.
    """
    one = stated()
    box = ls.editing.crop(one, ((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0)))
    for edited in (box, ls.editing.decimate(one, 20), ls.editing.sort_morton(one), ls.editing.limit_sh_degree(one, 0)):
        assert_states(edited)
    assert_states(ls.merge([capture(10), one]))


def test_rotating_a_capture_rotates_its_up_direction_and_first_camera_view() -> None:
    """The camera of the first view projects every mean to the same pixel as before."""
    one = stated()
    moved = ls.transform(one, scale=3.0, rotation_degrees=(20.0, 130.0, 70.0), translation=(1.0, -2.0, 5.0))
    view = present(moved.first_view)

    def in_camera(camera: ls.Camera, means: np.ndarray) -> np.ndarray:
        return (np.c_[means, np.ones(len(means))] @ camera.camera_from_world.T)[:, :3]

    np.testing.assert_allclose(in_camera(view, moved.means), 3.0 * in_camera(VIEW, one.means), atol=1e-5)
    assert view.focus_distance == pytest.approx(3.0 * VIEW.focus_distance)
    rotated = ls.transform(one, rotation_degrees=(20.0, 130.0, 70.0))
    np.testing.assert_allclose(present(moved.up), present(rotated.up))
    assert np.dot(present(rotated.up), present(one.up)) < 0.9


def test_first_camera_view_is_stored_in_files_as_json_with_eye_target_and_up(tmp_path: Path) -> None:
    """Other programs can read eye, target and up without knowing the matrices of Lumisplat."""
    ls.save(tmp_path / "meta.json", stated())
    stored = json.loads((tmp_path / "meta.json").read_text())["lumisplat"]
    assert stored["first_view"] == {
        "eye": [1.0, 2.0, 3.0],
        "target": [0.1, 0.2, 0.3],
        "up": pytest.approx((-VIEW.camera_from_world[1, :3]).tolist()),
        "fov_y": 1.2,
        "width": 270,
        "height": 480,
    }


def test_up_direction_of_a_glb_named_several_times_in_a_scene_file_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Entries, actors and cameras need the up direction, and finding it reads the whole capture."""
    ls.save(tmp_path / "a.glb", stated())
    (tmp_path / "scene.toml").write_text(
        '[[splats]]\npath = "a.glb"\n[[cameras]]\neye = [0, 0, 3]\ntarget = [0, 0, 0]\n'
    )
    reads = list[object]()
    read = up_module.read_gltf

    def counted(*arguments: Any, **options: Any) -> object:
        reads.append(arguments)
        return read(*arguments, **options)

    monkeypatch.setattr(up_module, "read_gltf", counted)
    ls.load(tmp_path / "scene.toml")
    ls.load_cameras(tmp_path / "scene.toml")
    ls.io.SceneDocument.open(tmp_path / "scene.toml")
    assert len(reads) == 1
