"""Tests options that place a camera: ``--eye``, ``--target``, ``--azimuth`` and so on."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Workspace
from support.files.image_files import read_image


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def shown(work: Workspace, *options: str, scene: str = "@capture.ply") -> np.ndarray:
    """Returns the image that ``render`` writes with these options."""
    outcome = work.run("render", scene, "-o", "@a.png", "--width", "48", "--height", "32", "--device", "cpu", *options)
    assert outcome.status == 0, outcome.err
    return read_image(work.path("a.png"))["srgb"]


def expected(work: Workspace, camera: ls.Camera) -> np.ndarray:
    """Returns the image that the library renders with a camera."""
    frame = ls.render(ls.Scene([work.capture("capture.ply")]), camera, device="cpu")
    return (np.clip(frame.color, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


SIZE: Any = {"width": 48, "height": 32}


def test_azimuth_and_elevation_options_give_the_camera_of_frame_camera(work) -> None:
    """Angles are in degrees on the command line, in radians in Python."""
    scene = ls.Scene([work.capture("capture.ply")])
    camera = ls.frame_camera(scene, azimuth=math.radians(30), elevation=math.radians(-10), distance=6.0, **SIZE)
    image = shown(work, "--azimuth", "30", "--elevation", "-10", "--distance", "6")
    np.testing.assert_array_equal(image, expected(work, camera))
    lens = ls.frame_camera(scene, fov_y=math.radians(20), target=(0.2, 0.1, 4.0), **SIZE)
    np.testing.assert_array_equal(shown(work, "--fov", "20", "--target", "0.2 0.1 4"), expected(work, lens))


def test_eye_and_target_options_of_render_give_the_camera_of_look_at(work) -> None:
    """Up is that of the capture, y down; a number may be negative and come first."""
    camera = ls.Camera.look_at((-1, -0.5, 0), (0, 0, 4), (0, -1, 0), fov_y=math.radians(50), **SIZE)
    near = min(camera.near, 1e-3 * math.dist((-1, -0.5, 0), (0, 0, 4)))
    assert near == pytest.approx(math.sqrt(17.25) / 1000)
    options = ("--eye=-1,-0.5,0", "--target", "0,0,4", "--fov", "50")
    np.testing.assert_array_equal(shown(work, *options), expected(work, camera))


@pytest.mark.parametrize("up", ["y-up", "z-up", "0.3,-1,0"])
def test_up_option_of_render_sets_which_direction_is_up_in_the_image(work, up) -> None:
    """``--up`` is an axis or any direction, as ``up`` of a scene."""
    direction = up if up[0] in "yz" else (0.3, -1, 0)
    scene = ls.Scene([work.capture("capture.ply")], up=direction)
    np.testing.assert_array_equal(shown(work, "--up", up), expected(work, ls.frame_camera(scene, **SIZE)))


def test_view_straight_from_above_has_a_defined_orientation(work) -> None:
    """The direction in which the default camera looks is up in the image."""
    camera = ls.Camera.look_at((0, -5, 4), (0, 0, 4), (0, 0, 1), **SIZE)
    np.testing.assert_array_equal(shown(work, "--eye", "0,-5,4", "--target", "0,0,4"), expected(work, camera))


def test_viewpoint_options_replace_the_cameras_of_a_scene_file(work) -> None:
    """The up direction of the scene file stays."""
    work.path("scene.toml").write_text(
        'up = "y-up"\n[[splats]]\npath = "capture.ply"\n[[cameras]]\neye = [0, 0, 0]\ntarget = [0, 0, 4]\n'
    )
    scene = ls.Scene([work.capture("capture.ply")], up="y-up")
    camera = ls.frame_camera(scene, azimuth=math.radians(90), **SIZE)
    np.testing.assert_array_equal(shown(work, "--azimuth", "90", scene="@scene.toml"), expected(work, camera))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--eye", "1,2"), "--eye is '1,2', expected three numbers"),
        (("--target", "1,2,nan"), "--target is '1,2,nan', expected finite numbers"),
        (("--eye", "0,0,1", "--azimuth", "3"), "--eye and --azimuth are both given"),
        (("--cameras", "@cameras.json", "--fov", "30"), "--cameras and --fov are both given"),
        (("--elevation", "100"), "--elevation is 100, expected degrees from -90 to 90"),
        (("--fov", "180"), "--fov is 180, expected degrees between 0 and 180"),
        (("--distance", "0"), "--distance is 0, expected a positive number"),
        (("--up", "sideways"), "--up is 'sideways', expected auto, y-down"),
        (("--up", "0,0,0"), "--up is '0,0,0', expected a direction"),
        (("--eye", "0,0,1", "--target", "0,0,1"), "--eye is 0,0,1, which equals the target"),
    ],
)
def test_contradicting_viewpoint_options_are_refused(work, options, message) -> None:
    """The one-line message names the options."""
    outcome = work.run("render", "@capture.ply", "-o", "@a.png", "--device", "cpu", *options)
    assert outcome.status == 2
    assert message in outcome.err and len(outcome.err.splitlines()) == 1


def test_bench_accepts_viewpoint_options(work) -> None:
    """Every command that renders has these options."""
    outcome = work.run("bench", "@capture.ply", "--azimuth", "45", "--width", "32", "--repeats", "1", "--device", "cpu")
    assert outcome.status == 0 and "32 x 18" in outcome.out


def test_single_gltf_or_usd_file_is_rendered_by_its_own_cameras(work) -> None:
    """Each camera of the file gives an image with its name.

    A viewpoint option replaces the cameras, and they are not used if a capture is given, too.
    """
    mesh = ls.MeshInstance(ls.box(1.0), name="box")
    cameras = [ls.Camera.look_at(eye, (0, 0, 0), **SIZE, name=name) for name, eye in SIDES.items()]
    ls.save(work.folder / "box.glb", ls.Scene(meshes=[mesh], up="y-up"), cameras=cameras)
    options = ("--width", "48", "--height", "32", "--device", "cpu")
    assert work.run("render", "@box.glb", "-o", "@out", *options).status == 0
    assert sorted(path.name for path in work.path("out").iterdir()) == ["left.png", "top.png"]
    for camera in ls.load_cameras(work.path("box.glb"), **SIZE):
        frame = ls.render(ls.io.load(work.path("box.glb")), camera, device="cpu")  # pyright: ignore[reportArgumentType]
        image = read_image(work.path("out") / f"{camera.name}.png")["srgb"]
        np.testing.assert_array_equal(image, (np.clip(frame.pixels_srgb(), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))
    assert work.run("render", "@box.glb", "--azimuth", "40", "-o", "@own", *options).status == 0
    assert [path.name for path in work.path("own").iterdir()] == ["front.png"]
    work.capture("capture.ply")
    assert work.run("render", "@capture.ply", "@box.glb", "-o", "@both", *options).status == 0
    assert len([*work.path("both").iterdir()]) == 1


SIDES = {"left": (-4.0, 0.5, 0.1), "top": (0.2, 4.0, 1.0)}
