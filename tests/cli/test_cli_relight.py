"""Tests ``lumisplat relight``: an avatar and a scene give a relit capture."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.demo import shapes
from support.files.cli_files import Workspace
from support.scenes.raster_scenes import flat_sh, one_gaussian


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder with a white ball without normals, and a room with red light from +x only."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    ball = ls.gaussians_from_mesh(shapes.sphere(0.5), 400)
    white = flat_sh(np.ones((400, 3)))
    ls.save(
        workspace.path("ball.ply"), ls.Gaussians(ball.means, ball.rotations_wxyz, ball.scales, ball.opacities, white)
    )
    ls.save(workspace.path("room.ply"), one_gaussian((4.0, 0.0, 0.0), 1.5, 1.0, (1.0, 0.2, 0.2)))
    workspace.path("two.toml").write_text('[[splats]]\npath = "ball.ply"\n[[splats]]\npath = "room.ply"\n')
    # A half turn about y maps +x of the room to -x of the ball.
    workspace.path("turned.toml").write_text(
        '[[splats]]\npath = "ball.ply"\nrotation_wxyz = [0, 0, 1, 0]\nposition = [0, 0, 0]\nscale = 0.5\n'
    )
    workspace.path("white.toml").write_text('[render]\nbackground = [1, 1, 1]\n[[splats]]\npath = "dust.ply"\n')
    ls.save(workspace.path("dust.ply"), one_gaussian((0.0, 0.0, 50.0), 1e-3, 1e-3, (1.0, 1.0, 1.0)))
    return workspace


def lit_sides(work: Workspace, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns mean colours of the ball's half towards +x, and of the other half."""
    loaded = ls.load(work.path(name))
    assert isinstance(loaded, ls.Gaussians)
    colors = loaded.sh[:, 0] * 0.28209479 + 0.5
    front = loaded.means[:, 0] > 0.0
    return colors[front].mean(axis=0), colors[~front].mean(axis=0)


@pytest.mark.parametrize("name", ["relit.ply", "relit.compressed.ply", "relit.spz"])
def test_relit_avatar_is_brighter_on_the_side_of_the_light(work, name):
    """Each format works; the output has the position and brightness of the light."""
    done = work.run("relight", "@ball.ply", "@room.ply", "-o", f"@{name}", "--gamma", "4", "--device", "cpu")
    assert (done.status, done.err) == (0, "")
    assert "400 Gaussians" in done.out and "mean light there" in done.out
    front, back = lit_sides(work, name)
    assert front[0] > back[0] + 0.3 and front[0] > front[1] + 0.2


def test_relit_avatar_rotated_by_a_scene_file_is_lit_from_the_other_side(work):
    """The file of the avatar is unchanged."""
    assert (
        work.run("relight", "@turned.toml", "@room.ply", "-o", "@a.ply", "--gamma", "4", "--device", "cpu").status == 0
    )
    front, back = lit_sides(work, "a.ply")
    assert back[0] > front[0] + 0.3
    loaded, ball = ls.load(work.path("a.ply")), ls.load(work.path("ball.ply"))
    assert isinstance(loaded, ls.Gaussians) and isinstance(ball, ls.Gaussians)
    np.testing.assert_array_equal(loaded.means, ball.means)


def test_relight_in_a_constant_white_environment_changes_no_colours(work):
    """Settings of a scene.toml apply, and ``--background`` overrides them."""
    assert work.run("relight", "@ball.ply", "@white.toml", "-o", "@same.ply", "--device", "cpu").status == 0
    assert work.path("same.ply").read_bytes() == work.path("ball.ply").read_bytes()
    dark = work.run("relight", "@ball.ply", "@white.toml", "--background", "black", "-o", "@b.ply", "--device", "cpu")
    assert dark.status == 0
    np.testing.assert_allclose(lit_sides(work, "b.ply"), 0.0, atol=1e-5)


def test_relight_command_gives_the_capture_of_the_library_with_equal_arguments(work):
    """The library gives the same capture and the same image."""
    options = ("--at", "1", "-0.5", "0.25", "--degree", "2", "--exponent", "3", "--scale-max", "0.5", "--gamma", "2")
    done = work.run(
        "relight", "@ball.ply", "@room.ply", "-o", "@a.ply", *options, "--near", "0.1", "--normals", "pca",
        "--probe", "@p.exr", "--up", "z-up", "--device", "cpu",
    )  # fmt: skip
    assert done.status == 0 and "p.exr: the light as an image" in done.out
    room, ball = (ls.load(work.path(name)) for name in ("room.ply", "ball.ply"))
    assert isinstance(room, ls.Gaussians) and isinstance(ball, ls.Gaussians)
    probe = ls.avatars.EnvironmentProbe.capture(ls.Scene([room]), (1, -0.5, 0.25), 2, near=0.1, device="cpu")
    config = ls.config.RelightConfig(exponent=3.0, scale_max=0.5, gamma=2.0, normals=ls.config.NormalEstimate.PCA)
    loaded = ls.load(work.path("a.ply"))
    assert isinstance(loaded, ls.Gaussians)
    np.testing.assert_array_equal(loaded.sh, ls.relight(ball, probe, config).sh)
    half = np.sqrt(0.5)
    np.testing.assert_array_equal(
        ls.io.load_radiance(work.path("p.exr")), probe.image(rotation_wxyz=(half, half, 0, 0))
    )


def test_relight_at_a_dim_position_prints_a_suitable_gamma(work):
    """The gamma preserves the avatar's brightness."""
    printed = work.run("relight", "@ball.ply", "@room.ply", "-o", "@a.ply", "--device", "cpu").out
    assert "to keep the avatar about as bright as it was: --gamma" in printed


def test_relight_at_a_position_without_light_prints_advice_that_suggests_no_gamma(work):
    """No gamma would help."""
    printed = work.run("relight", "@ball.ply", "@dust.ply", "-o", "@a.ply", "--device", "cpu").out
    assert "there is almost no light" in printed and "--gamma" not in printed


@pytest.mark.parametrize(
    ("args", "named"),
    [
        (("@missing.ply", "@room.ply"), "missing.ply"),
        (("@ball.ply", "@missing.ply"), "missing.ply"),
        (("@ball.ply",), "no scene given"),
        (("@mesh.obj", "@room.ply"), "mesh.obj: is not a capture"),
        (("@mesh.obj", "@room.ply"), "ls.gaussians_from_mesh"),
        (("@two.toml", "@room.ply"), "two.toml: is not a capture"),
        (("@ball.ply", "@room.ply", "-o", "@relit.png"), "relit.png: unknown extension '.png', expected .ply"),
        (("@ball.ply", "@sky.exr", "-o", "@relit.ply"), "sky.exr: is an image, not a scene: --environment"),
        (("@ball.ply", "@room.ply", "--probe", "@probe.hdr"), "probe.hdr: unknown extension"),
        (("@ball.ply", "@room.ply", "--gamma", "-1"), "gamma is -1.0, expected 0.0 to 1000.0"),
        (("@ball.ply", "@room.ply", "--exponent", "0"), "exponent is 0.0"),
        (("@ball.ply", "@room.ply", "--degree", "9"), "degree is 9, expected a whole number from 0 to 8"),
        (("@ball.ply", "@room.ply", "--near", "0"), "near is 0.0"),
        (("@ball.ply", "@room.ply", "--at", "nan", "0", "0"), "--at is 'nan,0,0', expected finite numbers"),
        (("@ball.ply", "@room.ply", "--background", "mauve"), "mauve"),
        (("@ball.ply", "@room.ply", "--device", "cuda:7"), "cuda:7"),
    ],
)
def test_relight_command_reports_mistakes_of_the_user_in_one_line(work, monkeypatch, args, named):
    """Each mistake ends with status 2 and one line on standard error that names it, and writes no file."""
    monkeypatch.chdir(work.folder)
    work.path("sky.exr").write_text("an image")
    before = work.files()
    done = work.run("relight", *args)
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("error: ") and done.err.count("\n") == 1
    assert named in done.err
    assert work.files() == before
