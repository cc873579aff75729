"""Tests ``--view`` and ``--aov`` of ``lumisplat render``."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import OpenEXR
import pytest
import warp as wp
from PIL import Image

import lumisplat as ls
from lumisplat.cli.output.images import FrameWriter, Layers, Views
from support.files.cli_files import Workspace
from support.files.image_files import read_image
from support.scenes.raster_scenes import front_camera

ARGS = ("render", "@mesh.obj", "--cameras", "@cameras.json", "--device", "cpu")


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def mesh_scene(work: Workspace) -> ls.Scene:
    """Returns the scene that the commands render."""
    mesh = ls.load(work.path("mesh.obj"))
    assert isinstance(mesh, ls.Mesh)
    return ls.Scene(meshes=[mesh])


@pytest.mark.parametrize("view", ["normal", "depth", "index", "transmittance"])
def test_view_option_of_render_writes_that_view_in_place_of_the_image(work, view):
    """``--view`` writes the library's view of the same frame under the image's name, and no other file."""
    assert work.run(*ARGS, "--frames", "left", "--view", view, "-o", "@out").status == 0
    scene, camera = mesh_scene(work), ls.load_cameras(work.path("cameras.json"))[0]
    expected = ls.render(scene, camera, device="cpu").view(view)
    assert [path.name for path in work.path("out").iterdir()] == ["left.png"]
    np.testing.assert_array_equal(
        read_image(work.path("out/left.png"))["srgb"], np.floor(expected * 255.0 + 0.5).astype(np.uint8)
    )


def test_views_of_one_render_share_their_colour_scale(work):
    """The depth range of the first frame is used for all and printed, so that a colour is the same distance."""
    back = np.eye(4)
    back[2, 3] = 2.0
    ls.save_cameras(
        work.path("two.json"), [front_camera(name="left"), front_camera(name="right", camera_from_world=back)]
    )
    outcome = work.run("render", "@mesh.obj", "--cameras", "@two.json", "--view", "depth", "-o", "@out")
    scene, cameras = mesh_scene(work), ls.load_cameras(work.path("two.json"))
    left, right = (ls.render(scene, camera, device="cpu") for camera in cameras)
    near, far = left.view_limits("depth")
    assert right.view_limits("depth") != (near, far)
    found = re.search(r"from ([\d.]+) \(red\) to ([\d.]+) \(blue\)", outcome.out)
    assert found and [float(number) for number in found.groups()] == pytest.approx([near, far], rel=1e-3)
    expected = np.floor(right.view("depth", (near, far)) * 255.0 + 0.5).astype(np.uint8)
    np.testing.assert_array_equal(read_image(work.path("out/right.png"))["srgb"], expected)


def test_shadow_view_of_render_is_white_on_lit_surfaces_and_blue_where_no_light_reaches(work):
    """The lit side of the triangle is white, and pixels that no light reaches are blue."""
    work.path("scene.toml").write_text(
        '[[meshes]]\npath = "mesh.obj"\n'
        '[[lights]]\nname = "lamp"\ntype = "point"\nposition = [0, 0, 1]\nintensity = 9\n'
    )
    args = ("render", "@scene.toml", "--cameras", "@cameras.json", "--frames", "left", "--device", "cpu")
    assert work.run(*args, "--view", "shadow", "-o", "@a.png").status == 0
    image = read_image(work.path("a.png"))["srgb"]
    assert tuple(image[24, 32]) == (255, 255, 255)
    assert tuple(image[0, 0]) == (23, 33, 82)
    assert work.run(*args, "--aov", "albedo,lights", "-o", "@b.exr").status == 0
    channels = read_image(work.path("b.exr"))
    assert {"albedo.R", "light.lamp.direct.G", "light.lamp.shadow.B"} < set(channels)
    assert channels["light.lamp.direct.G"][24, 32] == pytest.approx(channels["G"][24, 32], rel=1e-5)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (("--view", "shadow", "--lighting", "off"), "no 'lights'"),
        (("--aov", "albedo", "--lighting", "off"), "no 'albedo'"),
        (("--view", "depth", "--aov", "depth"), "--view and --aov exclude each other"),
        (("--view", "depth", "--format", "exr"), "--view writes an image in colours, expected .png"),
        (
            ("--aov", "cryptomatte"),
            "--aov cryptomatte needs an EXR",
        ),
        (("--view", "shadows"), "--view has 'shadows', did you mean shadow? expected one of normal, depth"),
        (("--view", "depth,normal"), "insets are drawn on the image: --view color,depth,normal"),
        (("--view", "color,depth", "--format", "exr"), "--view writes an image in colours, expected .png"),
        (("--view", "color,depth", "--tiles", "2x2"), "--view and --tiles exclude each other"),
        (("--insets", "depth,normal"), "--insets is now --view color,depth,normal"),
        (("--aov", "depth,shadow"), "--aov has 'shadow', did you mean shadow_ratio? expected some of depth, normal"),
    ],
)
def test_render_refuses_views_and_layers_that_it_cannot_write(work, options, error):
    """One line gives the reason, nothing is written, and the status is 2."""
    outcome = work.run(*ARGS, "--frames", "left", *options, "-o", "@out")
    assert outcome.status == 2 and error in outcome.err
    assert outcome.err.count("\n") == 1
    assert not list(work.path("out").glob("*"))


def test_view_and_layer_options_of_render_request_the_layers_that_they_need():
    """Each layer is requested once."""
    assert FrameWriter(Layers.of("depth, albedo,lights").names).aovs == ("albedo", "lights")
    assert FrameWriter((), Views.of("shadow")).aovs == ("lights",)
    assert FrameWriter((), Views.of("color,hits,shadow")).aovs == ("hits", "lights")
    assert FrameWriter((), Views.of("depth")).aovs == () and FrameWriter(()).aovs == ()


def test_insets_of_render_are_drawn_into_the_lower_right_corner_of_the_image(work):
    """Elsewhere the image is unchanged; the Python call writes the same file, and refuses other formats."""
    assert work.run(*ARGS, "--frames", "left", "--view", "color,depth,normal", "-o", "@a.png").status == 0
    frame = ls.render(mesh_scene(work), ls.load_cameras(work.path("cameras.json"))[0], device="cpu")
    frame.save(work.path("b.png"), insets=("depth", "normal"))
    frame.save(work.path("plain.png"))
    shown, same, plain = (read_image(work.path(f"{name}.png"))["srgb"] for name in ("a", "b", "plain"))
    np.testing.assert_array_equal(shown, same)
    changed = (shown != plain).any(axis=2)
    height, width = changed.shape
    assert changed.any() and not changed[: height // 2].any() and not changed[:, : width // 4].any()
    with pytest.raises(ls.ConfigError, match="insets can only be drawn on PNG files"):
        frame.save(work.path("c.exr"), insets="depth")


def test_sixteen_bit_depth_image_stores_the_depth_range_that_it_encodes(work):
    """``--aov depth`` also writes 16-bit grey; the range in its text, which is also printed, restores the depths."""
    outcome = work.run(*ARGS, "--frames", "left", "--aov", "depth", "-o", "@a.png")
    assert outcome.status == 0 and work.path("a.depth.png").exists()
    frame = ls.render(mesh_scene(work), ls.load_cameras(work.path("cameras.json"))[0], device="cpu")
    assert frame.depth_range is not None
    near, far = frame.depth_range
    with Image.open(work.path("a.depth16.png")) as image:
        texts, values = dict(image.info), np.asarray(image, np.int64)
        assert image.mode == "I;16"
    assert (float(texts["depth_near"]), float(texts["depth_far"])) == (near, far)
    assert f"from {near:.6g} (1) to {far:.6g} (65535)" in outcome.out
    hit = np.isfinite(frame.depth)
    np.testing.assert_array_equal(values > 0, hit)
    depth = near + (values - 1) / 65534 * (far - near)
    np.testing.assert_allclose(depth[hit], frame.depth[hit], atol=0.51 / 65534 * (far - near) + 1e-6)


def test_sixteen_bit_depth_images_are_valid_without_a_surface_and_at_constant_depth(work):
    """Without a surface all pixels are 0; a range of zero length divides nothing by zero."""
    frame = ls.render(ls.Scene(), front_camera(8, 6), device="cpu")
    assert frame.depth_range is None
    frame.save(work.path("none.png"), layers="depth")
    assert not np.asarray(Image.open(work.path("none.depth16.png"))).any()
    flat = replace(frame, depth=np.full_like(frame.depth, 2.0))
    flat.save(work.path("flat.png"), layers="depth")
    assert (np.asarray(Image.open(work.path("flat.depth16.png"))) == 1).all()


def test_crease_angle_set_on_the_command_line_makes_mesh_normals_smooth_or_flat(work) -> None:
    """An OBJ without normals is smooth with a wide angle and flat with 0; the angle is in degrees."""
    sheet = "v -1 -1 5\nv 0 -1 4\nv 0 1 4\nv -1 1 5\nv 1 -1 5\nv 1 1 5\nf 1 2 3 4\nf 2 5 6 3\n"
    work.path("sheet.obj").write_text(sheet)
    shades = {}
    for angle in ("0", "60", "120"):
        options = (f"--set=meshes.crease_angle_degrees={angle}", "--width", "32", "--view", "normal")
        outcome = work.run("render", "@sheet.obj", *options, "-o", f"@{angle}.png")
        assert outcome.status == 0, outcome.err
        pixels = ls.load_image(work.path(f"{angle}.png"))
        shades[angle] = len(np.unique(pixels.reshape(-1, 3), axis=0))
    assert shades["0"] == shades["60"] < shades["120"]
    outcome = work.run("render", "@sheet.obj", "--set=meshes.crease_angle_degrees=200", "-o", "@no.png")
    assert outcome.status == 2 and "--set meshes.crease_angle_degrees=200: expected 0 to 180 degrees" in outcome.err


def test_cryptomattes_are_written_into_the_exr(work: Workspace) -> None:
    """Cryptomattes are additional parts with the names of files; the image stays the first part."""
    outcome = work.run("render", "@capture.ply", "@mesh.obj", "--width", "24", "--aov", "cryptomatte", "-o", "@out.exr")
    assert outcome.status == 0
    file: Any
    with OpenEXR.File(str(work.path("out.exr"))) as file:
        assert [part.name() for part in file.parts] == ["rgba", "CryptoObject", "CryptoMaterial"]
        manifest = next(str(value) for key, value in file.header(1).items() if key.endswith("/manifest"))
    assert "capture" in manifest and "mesh" in manifest


def test_deep_samples_are_written_beside_the_image(work: Workspace) -> None:
    """The file is NAME.deep.exr; on standard output, which takes one file, ``--aov deep`` is refused."""
    args = ("render", "@capture.ply", "@mesh.obj", "--width", "24", "--aov", "deep")
    assert work.run(*args, "-o", "@out.png").status == 0
    file: Any
    with OpenEXR.File(str(work.path("out.deep.exr")), separate_channels=True) as file:
        assert file.channels().keys() == {"R", "G", "B", "A", "Z", "ZBack"}
    assert "--aov deep writes another beside it" in work.run(*args, "-o", "-").err
