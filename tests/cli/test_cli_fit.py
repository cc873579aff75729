"""Tests ``lumisplat fit``: lights of a scene are found from images of it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from PIL import Image

import lumisplat as ls
from support.files.cli_files import Workspace
from support.kinds import present

ROOM = """
[render]
background = "#203040"

[[cameras]]
name = "door"
eye = [0.0, 1.6, 4.0]
target = [0.0, 0.8, 0.0]
width = 64
height = 48

[[cameras]]
name = "window.png"
eye = [3.0, 1.8, 2.5]
target = [0.0, 0.5, 0.0]
width = 64
height = 48

# A floor, a wall and a box.
[[meshes]]
path = "floor.obj"
material = {{ base_color = [0.7, 0.6, 0.5], roughness = 1.0, specular = 0.0 }}

[[meshes]]
path = "box.obj"
name = "box"
material = {{ base_color = {box}, roughness = 1.0, specular = 0.0 }}

[[lights]]
type = "point"
name = "left"
position = [-1.5, 2.0, 1.0]
color = {left}
intensity = {strength}

[[lights]]
type = "point"
name = "right"
position = [1.6, 1.7, 1.2]
intensity = {strength}

[[lights]]
type = "point"
name = "switched off"
position = [0.0, 1.0, 0.0]
enabled = false
"""


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder with a scene file of a room whose lights are wrong, and images with the true lights."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    workspace.path("floor.obj").write_text(
        "v -4 0 -3\nv 4 0 -3\nv 4 0 5\nv -4 0 5\nv -4 4 -3\nv 4 4 -3\nf 4 3 2 1\nf 1 2 6 5\n"
    )
    corners = [(x, y, z) for x in (-0.5, 0.5) for y in (0.0, 1.0) for z in (-0.5, 0.5)]
    sides = ((1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4))
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f " + " ".join(map(str, side)) for side in sides]
    workspace.path("box.obj").write_text("\n".join(lines) + "\n")
    workspace.path("truth.toml").write_text(ROOM.format(box=[0.2, 0.4, 0.7], left=[1.0, 0.5, 0.25], strength=4.0))
    workspace.path("room.toml").write_text(ROOM.format(box=[0.2, 0.4, 0.7], left=[1.0, 1.0, 1.0], strength=1.0))
    workspace.path("grey.toml").write_text(ROOM.format(box=[0.4, 0.4, 0.4], left=[1.0, 0.5, 0.25], strength=4.0))
    for camera in ls.load_cameras(workspace.path("truth.toml")):
        name = camera.name.removesuffix(".png")
        scene = ls.load(workspace.path("truth.toml"))
        assert isinstance(scene, ls.Scene)
        ls.render(scene, camera, device="cpu").save(workspace.path(f"{name}.png"))
    return workspace


FIT = ("--pipeline", "raster", "--samples", "1", "--environment-degree", "none", "--device", "cpu")


def lights_of(work: Workspace, name: str) -> dict[str, np.ndarray]:
    """Returns the powers of a scene file's lights by name."""
    scene = ls.load(work.path(name))
    assert isinstance(scene, ls.Scene)
    return {light.name: np.array(light.color) * light.intensity for light in scene.lights}


def test_fit_writes_fitted_lights_to_a_new_scene_file(work):
    """All other entries stay the same, and the old file is unchanged."""
    before = work.path("room.toml").read_text()
    done = work.run("fit", "@room.toml", "@door.png", "-o", "@fitted.toml", *FIT)
    assert (done.status, done.err) == (0, "")
    assert "left" in done.out and "right" in done.out and "residual" in done.out
    assert work.path("room.toml").read_text() == before
    found = lights_of(work, "fitted.toml")
    np.testing.assert_allclose(found["left"], (4.0, 2.0, 1.0), rtol=0.02)
    np.testing.assert_allclose(found["right"], (4.0, 4.0, 4.0), rtol=0.02)
    scene = ls.load(work.path("fitted.toml"))
    assert isinstance(scene, ls.Scene) and len(scene.meshes) == 2 and len(scene.lights) == 3
    assert [camera.name for camera in ls.load_cameras(work.path("fitted.toml"))] == ["door", "window.png"]
    # The fitted scene renders the image that was given.
    camera = ls.load_cameras(work.path("fitted.toml"))[0]
    image = ls.render(scene, camera, device="cpu").pixels_srgb()
    assert ls.metrics.psnr(image, ls.load_image(work.path("door.png"))) > 40.0


def test_fit_writes_a_fitted_environment_beside_the_scene_file(work):
    """SH become an image that the file names by a relative path and that can be read again."""
    sunlit = work.path("truth.toml").read_text() + "[environment]\ncolor = [0.5, 0.6, 0.8]\nvisible = false\n"
    work.path("sunlit.toml").write_text(sunlit)
    scene = ls.load(work.path("sunlit.toml"))
    assert isinstance(scene, ls.Scene)
    ls.render(scene, ls.load_cameras(work.path("sunlit.toml"))[0], device="cpu").save(work.path("door.png"))
    done = work.run(
        "fit",
        "@room.toml",
        "@door.png",
        "--environment-degree",
        "1",
        "--size",
        "16",
        "--pipeline",
        "raster",
        "--samples",
        "2",
        "--device",
        "cpu",
        "-o",
        "@f.toml",
    )
    assert done.status == 0, done.err
    assert work.path("f.assets/environment.exr").exists()
    assert 'path = "f.assets/environment.exr"' in work.path("f.toml").read_text()
    assert "environment" in lights_of(work, "f.toml")


def test_fit_of_images_without_environment_light_writes_no_environment(work, caplog):
    """Only point lights shone: one line reports it, and the scene has no black environment."""
    options = ("--environment-degree", "1", "--size", "32", "--pipeline", "raster", "--samples", "2", "--device", "cpu")
    done = work.run("fit", "@room.toml", "@door.png", *options, "-o", "@f.toml")
    assert done.status == 0, done.err
    assert "environment: none of its light was found in the images, so the scene has none" in caplog.messages
    assert "environment" not in work.path("f.toml").read_text() and "environment" not in done.out
    assert not work.path("f.assets").exists()


def test_fit_of_several_images_writes_a_report(work):
    """Cameras are found by name or by image name; the report has images side by side and metrics."""
    done = work.run("fit", "@room.toml", "@door.png", "@window.png", "-o", "@a.toml", "--report", "@report", *FIT)
    assert done.status == 0, done.err
    with Image.open(work.path("report/door.png")) as image:
        assert image.size == (3 * 64, 48)
    report = json.loads(work.path("report/report.json").read_text())
    assert [view["residual"] < 0.02 for view in report["views"]] == [True, True]
    assert [light["light"] for light in report["lights"]] == ["left", "right"]
    for fitted in report["lights"]:
        power = lights_of(work, "a.toml")[fitted["light"]]
        assert [fitted["red"], fitted["green"], fitted["blue"]] == pytest.approx(list(power), rel=1e-5)
    swapped = work.run("fit", "@room.toml", "@window.png", "--camera", "window.png", "-o", "@b.toml", *FIT)
    assert swapped.status == 0
    np.testing.assert_allclose(lights_of(work, "b.toml")["right"], (4.0, 4.0, 4.0), rtol=0.03)


def test_fit_with_base_colors_writes_colours_of_a_mesh_to_the_scene_file(work):
    """The box's base colour is estimated while the lights stay as given."""
    done = work.run("fit", "@grey.toml", "@door.png", "-o", "@a.toml", "--base-colors", "box", "--no-intensities", *FIT)
    assert done.status == 0, done.err
    scene = ls.load(work.path("a.toml"))
    assert isinstance(scene, ls.Scene)
    np.testing.assert_allclose(present(scene.meshes[1].mesh.material.base_color), (0.2, 0.4, 0.7), atol=0.01)


def test_fit_overwrites_a_scene_file_only_with_overwrite(work):
    """The output file is here the scene itself."""
    refused = work.run("fit", "@room.toml", "@door.png", "-o", "@room.toml", *FIT)
    assert refused.status == 2 and "already exists" in refused.err and "--overwrite" in refused.err
    allowed = work.run("fit", "@room.toml", "@door.png", "-o", "@room.toml", "--overwrite", *FIT)
    assert allowed.status == 0, allowed.err
    np.testing.assert_allclose(lights_of(work, "room.toml")["left"], (4.0, 2.0, 1.0), rtol=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("@room.toml", "-o", "@a.toml"), "no image given"),
        (("@door.png", "-o", "@a.toml"), "no scene given"),
        (("@room.toml", "@door.png", "-o", "@a.ply"), "is no .toml"),
        (
            ("@room.toml", "@door.png", "-o", "@a.toml", "--camera", "roof"),
            "has no camera 'roof', only door, window.png",
        ),
        (
            ("@room.toml", "@door.png", "-o", "@a.toml", "--camera", "door", "--camera", "door"),
            "names 2 and there are 1",
        ),
        (("@room.toml", "@other.png", "-o", "@a.toml"), "has no camera 'other'"),
        (("@box.obj", "@door.png", "-o", "@a.toml"), "no cameras given"),
        (("@room.toml", "@door.png", "-o", "@a.toml", "--exposure", "bright"), "--exposure is 'bright'"),
        (
            ("@room.toml", "@door.png", "-o", "@a.toml", "--base-colors", " ,"),
            "--base-colors is ' ,', expected all, or",
        ),
        (("@room.toml", "@door.png", "-o", "@a.toml", "--report", "@."), "has the images, which the report's images"),
        (
            ("@room.toml", "@door.png", "-o", "@folder.toml", "--overwrite"),
            "folder.toml: is a folder, expected the name",
        ),
        (("@room.toml", "@door.png", "-o", "@b.toml"), "b.assets: is a file, expected a folder"),
        (("@room.toml", "@door.png", "-o", "@a.toml", "--keep-hues", "--no-intensities"), "leave out one of them"),
        (("@room.toml", "@door.png", "-o", "@a.toml", "--no-intensities"), "nothing to fit"),
        (
            ("@room.toml", "@door.png", "-o", "@a.toml", "--report", "@door.png"),
            "door.png: is a file, expected a folder",
        ),
        (("@room.toml", "@wide.png", "-o", "@a.toml", "--camera", "door"), "another aspect ratio"),
    ],
)
def test_fit_command_reports_mistakes_of_the_user_in_one_line(work, arguments, message):
    """Each mistake ends with status 2, and writes no file."""
    Image.new("RGB", (80, 40), (90, 90, 90)).save(work.path("wide.png"))
    work.path("folder.toml").mkdir()
    work.path("b.assets").write_text("in the way")
    before = work.path("door.png").read_bytes()
    done = work.run("fit", *arguments, *FIT)
    assert done.status == 2 and done.out == ""
    assert message in done.err and done.err.count("\n") == 1
    assert not work.path("a.toml").exists() and work.path("door.png").read_bytes() == before


def test_help_of_the_fit_command_states_how_long_a_fit_takes(work):
    """The help also states the time with ``--positions``."""
    text = " ".join(work.run("fit", "--help").out.replace("│", " ").split())
    assert "half a minute on one CPU core, and four minutes with --positions" in text
    assert "directions of spots and suns; takes minutes" in text


def test_fit_writes_fitted_colours_of_a_capture_to_a_new_file(work):
    """The capture is darker than in the image; the written scene names a corrected file."""
    mesh = ls.load(work.path("box.obj"))
    assert isinstance(mesh, ls.Mesh)
    gaussians = ls.gaussians_from_mesh(mesh, 150)
    assert gaussians.albedo is not None
    entry = (
        '[[splats]]\npath = "{}.ply"\nname = "chest"\nposition = [1.5, 0.0, 0.5]\nmaterial = {{ roughness = 1.0 }}\n'
    )
    for name, red in (("light", 0.6), ("dark", 0.3)):
        albedo = np.full_like(gaussians.albedo, 0.4)
        albedo[:, 0] = red
        ls.save(work.path(f"{name}.ply"), replace(gaussians, albedo=albedo))
        work.path(f"{name}.toml").write_text(work.path("truth.toml").read_text() + entry.format(name))
    scene, camera = ls.load(work.path("light.toml")), ls.load_cameras(work.path("light.toml"))[0]
    assert isinstance(scene, ls.Scene)
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=1)
    ls.render(scene, camera, config, device="cpu").save(work.path("door.png"))
    options = ("--base-colors", "chest", "--no-intensities", "--pipeline", "hybrid", *FIT[2:])
    done = work.run("fit", "@dark.toml", "@door.png", "--camera", "door", "-o", "@fitted.toml", *options)
    assert done.status == 0, done.err
    fitted = ls.load(work.path("fitted.toml"))
    assert isinstance(fitted, ls.Scene) and work.path("fitted.assets/dark.ply").exists()
    assert fitted.splats[0].gaussians.albedo is not None and fitted.splats[0].name == "chest"
    np.testing.assert_allclose(fitted.splats[0].gaussians.albedo.mean(axis=0), (0.6, 0.4, 0.4), atol=0.01)
    before = ls.load(work.path("dark.ply"))
    assert isinstance(before, ls.Gaussians) and before.albedo is not None and before.albedo[0, 0] == np.float32(0.3)
