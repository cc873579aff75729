"""Tests the camera of scenes without cameras, and the names of output files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli import main
from lumisplat.cli.output.images import file_stems, plan_shots
from lumisplat.frame.layers import layer_pictures
from support.scenes.raster_scenes import front_camera, joined, one_gaussian, quad, random_gaussians


def pixels(camera: ls.Camera, points: np.ndarray) -> np.ndarray:
    """Returns pixel x, pixel y and view depth of N world points, shape (N, 3)."""
    x, y, z = camera.camera_from_world[:3, :3] @ points.T + camera.camera_from_world[:3, 3:]
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z], axis=1)


@pytest.mark.parametrize("up", ["y-down", "y-up", "z-up"])
@pytest.mark.parametrize("size", [(1280, 720), (100, 400)])
def test_frame_camera_shows_the_whole_bounding_box(up, size):
    """All corners are visible, and the box fills the image in one direction."""
    scene = ls.Scene(splats=(ls.SplatInstance(random_gaussians(3, center=(5.0, -2.0, 9.0))),), up=up)
    low, high = scene.bulk_bounds()
    corners = np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T
    projected = pixels(ls.frame_camera(scene, width=size[0], height=size[1]), corners)
    assert (projected[:, 2] > 0.0).all()
    assert (projected[:, :2] >= 0.0).all() and (projected[:, :2] <= size).all()
    assert (np.ptp(projected[:, :2], axis=0) / size).max() > 0.75


@pytest.mark.parametrize(("up", "above"), [("y-down", (0, -1, 0)), ("y-up", (0, 1, 0)), ("z-up", (0, 0, 1))])
def test_frame_camera_shows_the_up_direction_upwards(up, above):
    """Points above the centre appear above it, and the camera looks down a little."""
    scene = ls.Scene(splats=(ls.SplatInstance(random_gaussians(3)),), up=up)
    camera = ls.frame_camera(scene)
    center = 0.5 * np.add(*scene.bulk_bounds())
    middle, higher = pixels(camera, np.stack([center, center + 0.1 * np.array(above)]))
    assert higher[1] < middle[1]
    assert higher[0] == pytest.approx(middle[0])
    assert (camera.eye - center) @ above > 0.0


def test_frame_camera_assumes_captures_are_y_down_and_scenes_of_meshes_are_y_up() -> None:
    """Without a stated direction, captures are y down, also beside meshes, and meshes alone are y up."""
    capture, mesh = random_gaussians(3), quad(1.0)
    for scene in (ls.Scene([capture]), ls.Scene([capture], [mesh])):
        np.testing.assert_array_equal(ls.frame_camera(scene).eye, ls.frame_camera(replace(scene, up="y-down")).eye)
    alone = ls.Scene([], [mesh])
    np.testing.assert_array_equal(ls.frame_camera(alone).eye, ls.frame_camera(replace(alone, up="y-up")).eye)


def test_frame_camera_ignores_stray_gaussians():
    """A faint Gaussian far away leaves the camera unchanged."""
    bulk = random_gaussians(3, count=500)
    stray = joined(bulk, one_gaussian(mean=(1e4, 0.0, 0.0), opacity=0.1))
    near, far = (ls.frame_camera(ls.Scene(splats=(ls.SplatInstance(g),))) for g in (bulk, stray))
    assert np.allclose(near.eye, far.eye, atol=0.1)


def test_frame_camera_refuses_an_empty_scene():
    """An empty scene has no bounds."""
    with pytest.raises(ls.SceneError, match="empty"):
        ls.frame_camera(ls.Scene())


@pytest.mark.parametrize("far", ["1e18", "1e38", "3.4e38"])
def test_render_refuses_scenes_too_large_for_a_camera(tmp_path, capsys, far):
    """The line names the file, not the camera's matrix."""
    (tmp_path / "huge.obj").write_text(f"v 0 0 0\nv {far} 0 0\nv 0 {far} 0\nf 1 2 3\n")
    assert main(["render", str(tmp_path / "huge.obj"), "-o", str(tmp_path / "out.png"), "--device", "cpu"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {tmp_path}/huge.obj: reaches {float(far):.3g} units away from the origin")
    assert error.count("\n") == 1
    assert not (tmp_path / "out.png").exists()


def test_output_file_stems_are_safe_and_unique():
    """No stem leaves its folder, is hidden, empty or too long, and no two are equal ignoring case."""
    names = ["a", "A", "a", "../../etc/passwd", "", "..", "über/öl 1", "x" * 400, "a_2", "."]
    names += ["\N{CJK UNIFIED IDEOGRAPH-68EE}" * 84 + end for end in ("", "b")]  # 252 bytes
    stems = file_stems(names)
    assert stems[0] == "a"
    assert len({stem.casefold() for stem in stems}) == len(names)
    for stem in stems:
        assert stem and not stem.startswith(".") and "/" not in stem and len(stem.encode()) < 200


def test_selected_cameras_are_rendered_in_the_order_of_the_file():
    """The order of the names on the command line does not matter."""
    cameras = [front_camera(name=name) for name in ("a", "b", "c")]
    shots = plan_shots(cameras, ("c", "a"), Path("out"), "auto")
    assert [shot.path for shot in shots] == [Path("out/a.png"), Path("out/c.png")]


def test_cameras_are_selected_by_name_or_by_file_stem():
    """A name that is no safe file name may be given in either form."""
    cameras = [front_camera(name="left eye"), front_camera(name="right eye")]
    for name in ("left eye", "left_eye"):
        assert [shot.path for shot in plan_shots(cameras, (name,), Path("out"), "auto")] == [Path("out/left_eye.png")]


def test_depth_layer_images_are_red_near_and_blue_far():
    """The guide documents red as near and blue as far."""
    frame = ls.render(ls.Scene([], [quad(2.0, 0.2), quad(4.0, 4.0)]), front_camera(33, 33), device="cpu")
    image = layer_pictures(frame, "depth")["depth"]
    near, far = image[16, 16], image[2, 2]
    assert near[0] > near[2] and far[2] > far[0]
