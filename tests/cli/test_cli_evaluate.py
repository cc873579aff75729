"""Tests ``lumisplat evaluate``: a capture is compared with renders of itself whose errors are known."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.io.images.texture import write_png
from support.files.cli_files import Workspace
from support.files.training_image_files import change_frame, write_blender_images, write_nerfstudio_images
from support.scenes.raster_scenes import front_camera

CAMERAS = [front_camera(48, 36, 45.0, name=f"v{k}") for k in range(6)]


def shown(work: Workspace, background: str = "black") -> np.ndarray:
    """Returns the renders of all cameras."""
    config = ls.RenderConfig(background=background)  # pyright: ignore[reportArgumentType]
    return ls.render(ls.Scene(splats=[work.capture("capture.ply")]), CAMERAS[0], config, device="cpu").pixels_srgb()


@pytest.fixture
def work(tmp_path, capsys) -> Workspace:
    """Returns a folder with a capture and images of it; errors of the held-out v0, v2 and v4 increase."""
    workspace = Workspace(tmp_path, capsys)
    truth = shown(workspace)
    images = [np.clip(truth + 0.02 * k, 0.0, 1.0) for k in range(6)]
    write_nerfstudio_images(workspace.path("photos"), CAMERAS, images)
    return workspace


def evaluate(work: Workspace, *options: str, folder: str = "@photos") -> dict[str, list[str]]:
    """Returns the cells of the printed table by the first cell of each line."""
    done = work.run("evaluate", "@capture.ply", folder, "--device", "cpu", *options)
    assert done.status == 0, done.err
    return {line[:16].strip(): line[16:].split() for line in done.out.splitlines() if line[16:].split()}


def test_evaluate_table_has_means_and_the_worst_views_first(work):
    """Three views are held out, and values equal those of the library."""
    table = evaluate(work, "--hold-out", "2")
    assert list(table) == ["", "mean of 3 views", "v4", "v2", "v0"]
    assert table[""] == ["psnr", "ssim", "ms-ssim", "flip"]
    views = ls.io.load_training_images(work.path("photos"), hold_out=2).held_out
    truth = shown(work)
    psnrs = [ls.metrics.psnr(truth, view.pixels()) for view in views]
    assert psnrs[0] > 55.0 and 20.0 < psnrs[2] < 25.0
    assert [table[view.name][0] for view in views] == [f"{value:.2f}" for value in psnrs]
    assert float(table["mean of 3 views"][0]) == pytest.approx(np.mean(psnrs), abs=0.006)
    expected = [
        ls.metrics.ssim(truth, views[2].pixels()),
        ls.metrics.ms_ssim(truth, views[2].pixels(), scales=2),
    ]
    assert table["v4"][1:] == [f"{value:.4f}" for value in (*expected, ls.metrics.flip(truth, views[2].pixels()))]


def test_evaluate_logs_fewer_scales_of_ms_ssim_for_small_images(work, caplog):
    """36 rows are enough for two scales."""
    evaluate(work)
    assert "ms-ssim has 2 scales: images of 48 x 36 pixels are too small for 5" in caplog.messages


def test_evaluate_output_has_metrics_and_images_of_the_worst_views(work):
    """The report has all metrics, and image, render and difference side by side for the worst views."""
    done = work.run("evaluate", "@capture.ply", "@photos", "--device", "cpu", "--hold-out", "2", "-o", "@report")
    assert done.status == 0 and "metrics.json, and images of the worst 3 views" in done.out
    assert {file for file in work.files() if file.startswith("report")} == {
        "report/metrics.json", "report/v0.png", "report/v2.png", "report/v4.png",
    }  # fmt: skip
    report = json.loads(work.path("report/metrics.json").read_text())
    assert [view["name"] for view in report["views"]] == ["v0", "v2", "v4"]
    assert report["mean"]["psnr"] == pytest.approx(np.mean([view["psnr"] for view in report["views"]]))
    assert all(view["compared"] == 1.0 for view in report["views"])
    assert (report["ms_ssim_scales"], report["scale"]) == (2, 1.0)
    beside = np.asarray(Image.open(work.path("report/v4.png")))
    image, render, difference = np.split(beside.astype(int), 3, axis=1)
    np.testing.assert_array_equal(image, np.asarray(Image.open(work.path("photos/images/v4.png"))))
    np.testing.assert_allclose(render, 255.0 * shown(work), atol=0.501)
    np.testing.assert_allclose(difference, np.minimum(4 * np.abs(image - render), 255), atol=4)


def test_evaluate_does_not_compare_masked_pixels(work):
    """Damage outside the mask does not change the metrics."""
    before = evaluate(work, "--hold-out", "3")["v3"]
    image = np.array(Image.open(work.path("photos/images/v3.png")))
    mask = np.zeros((36, 48), np.uint8)
    mask[6:30, 8:40] = 255
    image[mask == 0] = 200
    write_png(work.path("photos/images/v3.png"), image)
    spoilt = evaluate(work, "--hold-out", "3")["v3"]
    assert float(spoilt[0]) < float(before[0]) - 3.0
    work.path("photos/masks").mkdir()
    Image.fromarray(mask).save(work.path("photos/masks/v3.png"))
    work.run("evaluate", "@capture.ply", "@photos", "--device", "cpu", "--hold-out", "3", "-o", "@masked")
    report = {view["name"]: view for view in json.loads(work.path("masked/metrics.json").read_text())["views"]}
    assert report["v3"]["compared"] == pytest.approx(24 * 32 / (36 * 48))
    view = ls.io.load_training_images(work.path("photos"), hold_out=3).held_out[1]
    assert report["v3"]["psnr"] == pytest.approx(ls.metrics.psnr(shown(work), view.pixels(), region=mask > 0), abs=1e-6)
    assert report["v3"]["psnr"] == pytest.approx(float(before[0]), abs=1.0)
    difference = np.asarray(Image.open(work.path("masked/v3.png")))[:, 96:]
    assert not difference[mask == 0].any() and difference[mask > 0].any()


def test_evaluate_composites_transparent_images_over_the_background(work):
    """RGBA renders equal the images if both are composited over black, and differ if one is composited over white."""
    frame = ls.render(
        ls.Scene(splats=[work.capture("capture.ply")]), CAMERAS[0], ls.RenderConfig(background=None), device="cpu"
    )
    write_blender_images(work.path("rgba"), {"train": CAMERAS[:2], "test": CAMERAS[2:4]})
    for part, names in (("train", ("v0", "v1")), ("test", ("v2", "v3"))):
        for name in names:
            write_png(work.path(f"rgba/{part}/{name}.png"), frame.pixels_srgb())
        for index in range(2):
            change_frame(work.path(f"rgba/transforms_{part}.json"), index, fl_x=45.0)
    for color in ("white", "black", "#4080c0"):
        assert float(evaluate(work, "--background", color, folder="@rgba")["mean of 2 views"][0]) > 45.0
    write_png(work.path("white.png"), shown(work, "white"))
    assert ls.metrics.psnr(ls.load_image(work.path("white.png")), shown(work)) < 20.0


def test_scale_option_of_evaluate_downscales_images_before_comparing_them(work):
    """The capture is rendered at the size of the images."""
    done = work.run("evaluate", "@capture.ply", "@photos", "--device", "cpu", "--scale", "0.5", "-o", "@half")
    assert done.status == 0
    assert ls.load_image(work.path("half/v0.png")).shape == (18, 3 * 24, 3)
    assert json.loads(work.path("half/metrics.json").read_text())["scale"] == 0.5


def test_evaluate_compares_fisheye_images_without_undistortion(work):
    """With rays or unscented projection, all pixels of fisheye images are compared with fisheye renders."""
    lens = [replace(camera, model=ls.CameraModel.FISHEYE, distortion=(0.1, 0, 0, 0, 0, 0)) for camera in CAMERAS]
    config = ls.RenderConfig(raster=ls.RasterConfig(projection=ls.config.Projection.UNSCENTED))
    truth = ls.render(ls.Scene([work.capture("capture.ply")]), lens[0], config, device="cpu").pixels_srgb()
    write_nerfstudio_images(work.path("fisheyes"), lens, [truth] * 6)
    table = evaluate(work, "--hold-out", "2", "--projection", "unscented", folder="@fisheyes")
    assert float(table["mean of 3 views"][0]) > 55.0
    traced = evaluate(work, "--hold-out", "2", "--pipeline", "trace", folder="@fisheyes")
    assert float(traced["mean of 3 views"][0]) > 40.0


def test_evaluate_shows_a_dash_for_metrics_of_missing_packages(work, monkeypatch):
    """The metric is null in the written report."""
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    table = evaluate(work)
    assert table["v0"][3] == "-" and table["v0"][0] != "-"
    done = work.run("evaluate", "@capture.ply", "@photos", "--device", "cpu", "-o", "@r")
    assert json.loads(work.path("r/metrics.json").read_text())["views"][0]["flip"] is None
    assert done.status == 0


@pytest.mark.parametrize(
    ("args", "problem"),
    [
        ((), "0 files given, expected a capture and a folder"),
        (("@capture.ply",), "1 file given, expected a capture and a folder"),
        (("@capture.ply", "@nowhere"), "nowhere: no such folder"),
        (("@capture.ply", "@capture.ply"), "capture.ply: is a file, expected the folder that holds transforms.json"),
        (("@lost.ply", "@photos"), "lost.ply: no such file"),
        (("@capture.ply", "@photos", "--hold-out", "0"), "--hold-out is 0: no image is left to compare"),
        (("@capture.ply", "@photos", "--hold-out", "1"), "--hold-out is 1, which leaves no image to train with"),
        (("@capture.ply", "@photos", "--scale", "2"), "--scale is 2.0, expected more than 0 and at most 1"),
        (("@capture.ply", "@photos", "--background", "transparent"), "--background is transparent, expected a colour"),
        (("@capture.ply", "@photos", "--background", "mauve"), "--background is 'mauve', expected three numbers"),
        (("@capture.ply", "@photos", "-o", "@capture.ply"), "capture.ply: is a file, expected a folder"),
        (("@capture.ply", "@photos", "-o", "@photos/images"), "photos/images has the images, which"),
        (("@capture.ply", "@photos", "-o", "@photos/images/v0.png"), "v0.png: is a file, expected a folder"),
    ],
)
def test_evaluate_command_reports_mistakes_of_the_user_in_one_line(work, args, problem, caplog):
    """Each mistake ends with status 2, writes nothing, and logs nothing about work that is not done."""
    before = work.files()
    done = work.run("evaluate", *args, "--device", "cpu") if args else work.run("evaluate")
    assert done.status == 2 and done.err.startswith("error: ") and done.err.count("\n") == 1
    assert problem in done.err and not caplog.messages
    assert work.files() == before
