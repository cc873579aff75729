"""Tests ``lumisplat bake``: a scene file becomes a capture, and mistakes are one line."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Workspace
from support.scenes.path_scenes import ball, diffuse
from support.scenes.raster_scenes import one_gaussian

LIGHT = '[[lights]]\ntype = "directional"\ndirection = [0, -1, 0]\nintensity = 2.0\n'


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder with a ball with albedo, a capture without, a mesh, and scenes of these."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    ls.save(workspace.path("ball.ply"), ls.gaussians_from_mesh(ball(0.5, diffuse(0.6)), 150))
    ls.save(workspace.path("plain.ply"), one_gaussian())
    workspace.path("flag.obj").write_text("v 0 2 0\nv 1 2 0\nv 0 2 1\nf 1 2 3\n")
    placed = '[[splats]]\npath = "ball.ply"\nposition = [1, 2, 3]\nscale = 2.0\n[splats.material]\ntype = "pbr"\n'
    plain = '[[splats]]\npath = "plain.ply"\n'
    workspace.path("both.toml").write_text(placed + plain + '[[meshes]]\npath = "flag.obj"\n' + LIGHT)
    workspace.path("dark.toml").write_text(placed)
    workspace.path("plain.toml").write_text(plain + LIGHT)
    return workspace


@pytest.mark.parametrize("name", ["baked.ply", "baked.compressed.ply", "baked.spz"])
def test_bake_joins_all_captures_of_a_scene_into_one(work, name):
    """The capture with albedo is lit from above and joined with unlit captures.

    The output reports that meshes are missing.
    """
    done = work.run("bake", "@both.toml", "-o", f"@{name}", "--direct", "--samples", "2", "--device", "cpu")
    assert (done.status, done.err) == (0, "")
    assert "151 Gaussians" in done.out and "mesh" in done.out
    loaded = ls.load(work.path(name))
    assert isinstance(loaded, ls.Gaussians)
    assert loaded.albedo is None and loaded.sh_degree == 3
    middle = np.array([1.0, 2.0, 3.0])
    of_ball = np.linalg.norm(loaded.means - middle, axis=1) < 1.2
    assert of_ball.sum() == 150
    colors = loaded.sh[:, 0] * 0.28209479 + 0.5
    above, below = of_ball & (loaded.means[:, 1] > 2.5), of_ball & (loaded.means[:, 1] < 1.5)
    assert colors[above].mean() > colors[below].mean() + 0.3
    np.testing.assert_allclose(colors[~of_ball][0], (0.9, 0.5, 0.1), atol=0.02)


def test_bake_command_lights_a_capture_that_has_albedo_by_an_environment(work):
    """A single capture needs no scene file; its radiance is at least albedo times the environment's."""
    from lumisplat.io.images.exr import write_exr

    write_exr(work.path("sky.exr"), dict.fromkeys("RGB", np.full((2, 4), 0.5, np.float32)))
    options = ("--environment", "@sky.exr", "--degree", "0", "--samples", "2", "--exposure", "1", "--device", "cpu")
    assert work.run("bake", "@ball.ply", "-o", "@b.ply", *options).status == 0
    loaded = ls.load(work.path("b.ply"))
    assert isinstance(loaded, ls.Gaussians) and loaded.sh_degree == 0
    # 0.6 of a sky of 0.5, twice as bright.
    np.testing.assert_allclose(
        np.median(loaded.sh[:, 0] * 0.28209479 + 0.5), 1.055 * 0.6 ** (1 / 2.4) - 0.055, atol=0.02
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("@none.toml", "-o", "@b.ply"), "none.toml"),
        (("-o", "@b.ply"), "no scene given"),
        (("@both.toml", "-o", "@b.obj"), "b.obj: unknown extension '.obj', expected .ply"),
        (("@both.toml", "-o", "@ball.ply/b.ply"), "ball.ply"),
        (("@flag.obj", "-o", "@b.ply"), "takes a scene with splat sets"),
        (("@dark.toml", "-o", "@b.ply"), "no lights"),
        (("@plain.toml", "-o", "@b.ply"), "no splat set has a material"),
        (("@both.toml", "-o", "@b.ply", "--degree", "4"), "degree is 4"),
        (
            ("@both.toml", "-o", "@b.ply", "--direct", "--set=max_bounces=3"),
            "--direct has no bounces for --set max_bounces",
        ),
        (("@both.toml", "-o", "@b.ply", "--samples", "0"), "samples is 0"),
        (("@both.toml", "-o", "@b.ply", "--exposure", "nan"), "exposure is nan"),
    ],
)
def test_bake_command_reports_mistakes_of_the_user_in_one_line(work, arguments, message):
    """Each mistake ends with status 2, and writes nothing."""
    done = work.run("bake", *arguments, "--device", "cpu")
    assert done.status == 2
    assert message in done.err and done.err.count("\n") == 1 and "Traceback" not in done.err
    assert not work.path("b.ply").exists()
