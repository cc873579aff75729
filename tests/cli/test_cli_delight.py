"""Tests ``lumisplat delight``: a capture gets materials, and mistakes are one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Workspace
from support.files.small_disks import small_disk
from support.scenes.path_scenes import ball, diffuse

DELIGHT = "delight @ball.ply -o @out.ply --cells 4 --device cpu --save-environment".split()
"""Command that lacks only the path of the environment image."""


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder with a ball as a capture, and a scene file."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    lit = ls.gaussians_from_mesh(ball(0.5, diffuse(0.6)), 700)
    ls.save(workspace.path("ball.ply"), replace(lit, albedo=None, roughness=None, normals=None))
    ls.save(
        workspace.path("few.ply"),
        ls.Gaussians(*(column[:9] for column in (lit.means, lit.rotations_wxyz, lit.scales, lit.opacities, lit.sh))),
    )
    rng = np.random.default_rng(0)
    means, opacities, scales = rng.uniform(-1.0, 1.0, (700, 3)), np.full(700, 0.2), np.full((700, 3), 0.04)
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (700, 1))
    ls.save(workspace.path("fog.ply"), ls.Gaussians(means, rotations, scales, opacities, np.zeros((700, 1, 3))))
    ls.save(workspace.path("point.ply"), ls.Gaussians(0.0 * means, rotations, scales, opacities, np.zeros((700, 1, 3))))
    workspace.path("scene.toml").write_text('[[splats]]\npath = "ball.ply"\n')
    return workspace


def test_delight_gives_a_capture_albedo_roughness_and_normals(work):
    """The Gaussians stay the same; remarks name guesses, and the environment is written as an image."""
    done = work.run(*DELIGHT, "@sky.exr", "--up", "y-up")
    assert (done.status, done.err) == (0, "")
    assert "700 Gaussians with albedo, roughness and normals" in done.out
    assert "environment, whose brightness is a guess" in done.out
    before, after = ls.load(work.path("ball.ply")), ls.load(work.path("out.ply"))
    assert isinstance(before, ls.Gaussians) and isinstance(after, ls.Gaussians)
    assert np.array_equal(before.means, after.means) and np.array_equal(before.sh, after.sh)
    assert after.albedo is not None and after.roughness is not None and after.normals is not None
    outward = after.means / np.linalg.norm(after.means, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", after.normals, outward).min() > 0.5
    assert np.ptp(after.albedo.mean(axis=1)) < 0.2
    environment = ls.io.load_radiance(work.path("sky.exr"))
    assert environment.shape[1] == 2 * environment.shape[0] and environment.min() > 0.0


def test_delight_writes_equal_materials_to_gltf_and_to_ply(work):
    """A .glb has the albedo, roughness and normals that a .ply has."""
    for name in ("found.glb", "found.ply"):
        done = work.run("delight", "@ball.ply", "-o", f"@{name}", "--cells", "4", "--device", "cpu")
        assert (done.status, done.err) == (0, "")
    scene, capture = ls.load(work.path("found.glb")), ls.load(work.path("found.ply"))
    assert isinstance(scene, ls.Gaussians) and isinstance(capture, ls.Gaussians)
    for name in ("albedo", "roughness", "normals"):
        np.testing.assert_array_equal(getattr(scene, name), getattr(capture, name))


def test_delight_writes_no_environment_image_for_a_room(work, monkeypatch):
    """A line reports that there is no environment, in place of a black image."""
    capture = ls.load(work.path("ball.ply"))
    assert isinstance(capture, ls.Gaussians)
    found = ls.inverse.estimate_materials(capture, ls.config.DelightConfig(cells=4, inside=True), device="cpu")
    monkeypatch.setattr(ls.inverse, "estimate_materials", lambda *_, **__: found)
    done = work.run("delight", "@ball.ply", "-o", "@out.ply", "--save-environment", "@sky.exr", "--device", "cpu")
    assert (done.status, done.err) == (0, "") and f"{work.path('sky.exr')}: not written: a room has" in done.out
    assert work.path("out.ply").exists() and not work.path("sky.exr").exists()


def test_delight_reports_a_full_disk_for_the_environment_in_one_line(work):
    """The line has the system's reason; no partial image is left, and the capture is written."""
    with small_disk(work.path("disk"), "4k") as disk:
        done = work.run(*DELIGHT, str(disk / "sky.exr"))
        assert done.status == 2 and done.out == ""
        assert done.err.splitlines() == [
            f"error: {disk / 'sky.exr'}: cannot be written: No space left on device ({work.path('out.ply')} is written)"
        ]
        assert not list(disk.iterdir())
    capture = ls.load(work.path("out.ply"))
    assert isinstance(capture, ls.Gaussians) and capture.albedo is not None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("@ball.ply", "-o", "@out.spz"),
            "expected .ply, .glb, .gltf, .usda, .usdc, .usdz or .usd: others cannot store materials",
        ),
        (("@ball.ply", "-o", "@out.compressed.ply"), "expected .ply"),
        (("@ball.ply", "-o", "@out.ply", "--save-environment", "@sky.png"), "expected .exr"),
        (("@ball.ply", "-o", "@out.ply", "--cells", "2"), "cells is 2"),
        (
            ("@ball.ply", "-o", "@out.ply", "--save-environment", "@sky.exr", "--inside", "yes"),
            "--inside yes exclude each other",
        ),
        (
            ("@ball.ply", "-o", "/proc/lumisplat.ply"),
            "/proc/lumisplat.ply: cannot be written, as /proc is not writable",
        ),
        (("@ball.ply", "-o", "@out.ply", "--up", "0,0,0"), "--up is '0,0,0', expected a direction"),
        (
            ("@point.ply", "-o", "@out.ply"),
            "point.ply: no surface to estimate materials of: all Gaussians are at one",
        ),
        (("@ball.ply", "-o", "@out.ply", "--lod", "2"), "--lod needs a streamed SOG"),
        (("@scene.toml", "-o", "@out.ply"), "is not a capture"),
        (("@none.ply", "-o", "@out.ply"), "none.ply"),
        (
            ("@fog.ply", "-o", "@out.ply"),
            "fog.ply: no surface to estimate materials of: Gaussians are isotropic",
        ),
        (("@few.ply", "-o", "@out.ply"), "few.ply: no surface to estimate materials of: 9 of 9 Gaussians"),
    ],
)
def test_delight_command_reports_mistakes_of_the_user_in_one_line(work, arguments, message):
    """Each line states what was expected, and nothing is written."""
    done = work.run("delight", *arguments, "--device", "cpu")
    assert done.status == 2
    assert message in done.err
    assert len(done.err.strip().splitlines()) == 1
    assert not work.path("out.ply").exists()
