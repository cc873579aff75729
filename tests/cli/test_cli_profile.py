"""``lumisplat profile``: the Gaussians on the ray of a pixel."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.files.cli_files import Workspace
from support.files.image_files import read_image

ARGS = ("profile", "@capture.ply", "--cameras", "@cameras.json", "--device", "cpu")


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def test_profile_writes_the_gaussians_on_the_ray_of_a_pixel(work):
    """The table is that of the library, in CSV, on standard output and printed; the plot is that of its profile."""
    capture = ls.load(work.path("capture.ply"))
    assert isinstance(capture, ls.Gaussians)
    scene = ls.Scene([capture])
    camera = ls.load_cameras(work.path("cameras.json"))[0]
    along = camera.ray_directions()[20, 30] @ camera.camera_from_world[:3, :3]
    hits = ls.trace_rays(scene, camera.eye, [along], profile=True, device="cpu")
    profile = hits.profile
    assert profile is not None and len(profile.t) > 1
    assert work.run(*ARGS, "--pixel", "30,20", "-o", "@ray.csv").status == 0
    header, *rows = csv.reader(work.path("ray.csv").read_text().splitlines())
    assert header == ["hit", "t", "alpha", "transmittance", "gaussian", "capture"]
    np.testing.assert_allclose(np.array(rows, float)[:, 1:4].T, [profile.t, profile.alpha, profile.transmittance], 1e-2)
    assert [int(row[4]) for row in rows] == profile.gaussian_index.tolist()
    piped = work.run(*ARGS, "--pixel", "30,20", "-o", "-").out
    assert list(csv.reader(piped.splitlines()))[1:] == rows
    printed = work.run(*ARGS, "--pixel", "30,20").out
    assert [line.split() for line in printed.splitlines()] == [header, *rows]
    assert work.run(*ARGS, "--pixel", "30,20", "-o", "@ray.png").status == 0
    np.testing.assert_array_equal(read_image(work.path("ray.png"))["srgb"], hits.plot())


def test_plot_of_a_ray_shows_its_transmittance_and_its_surface() -> None:
    """The blue line is at the height of the transmittance, and the green one at the depth, if there is one."""
    t, behind = np.array([1.0, 2.0, 4.0]), np.array([0.8, 0.4, 0.04])
    alpha = np.array([0.2, 0.5, 0.9])
    profile = ls.rays.RayProfile(np.array([0, 3, 3]), t, alpha, behind, np.zeros(3, int), np.zeros(3, int))
    depths, zeros, ones = np.array([2.0, np.inf], np.float32), np.zeros((2, 3), np.float32), np.ones(2, np.float32)
    none = np.full(2, -1, np.int32)
    two = ls.rays.RayHits(zeros, ones, depths, zeros, none, none, profile=profile)
    shown = two.plot(0, size=(400, 200)).astype(int)
    is_blue = (shown[..., 2] - shown[..., 0] > 120) & (shown[..., 2] > 200)
    is_green = (shown[..., 1] - shown[..., 2] > 60) & (shown[..., 1] - shown[..., 0] > 60)
    left, above, bottom, right = 44, 12, 200 - 28, 400 - 12
    for distance, value in ((1.5, 0.8), (3.0, 0.4)):
        x = round(left + (distance - 0.85) / 3.3 * (right - left))
        assert np.flatnonzero(is_blue[:, x]).mean() == pytest.approx(bottom - value * (bottom - above), abs=1.5)
    x = np.flatnonzero(is_green[bottom - 20 : bottom - 5].all(axis=0))
    assert x.mean() == pytest.approx(left + (2.0 - 0.85) / 3.3 * (right - left), abs=1.5)
    assert two.plot(1, size=(400, 200)).shape == (200, 400, 3)
    with pytest.raises(ls.SceneError, match=r"no profile to plot: trace_rays\(\.\.\., profile=True\) makes one"):
        replace(two, profile=None).plot()
    with pytest.raises(ls.ConfigError, match="the plot has size 100 x 200, expected 160 to 8192"):
        two.plot(0, size=(100, 200))


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (("--pixel", "64,20"), "--pixel is 64,20, expected X,Y from 0,0 to 63,47"),
        (("--pixel", "middle"), "--pixel is middle, expected X,Y"),
        (("-o", "@ray.exr"), "ray.exr: expected .png for a plot or .csv for a table"),
        (("--camera", "up"), "no camera is named 'up': there are left, right"),
    ],
)
def test_profile_refuses_wrong_pixels_outputs_and_cameras(work, options, error):
    """One line gives the reason, and the status is 2."""
    outcome = work.run(*ARGS, *options)
    assert outcome.status == 2 and error in outcome.err and outcome.err.count("\n") == 1
