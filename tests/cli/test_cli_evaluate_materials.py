"""Tests ``lumisplat evaluate --materials``: table, files and mistakes."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from support.files.cli_files import Workspace
from support.files.relightable_files import painted_ball, panorama, write_layer, write_radiance, write_relightable_set

COMMAND = ("evaluate", "@ball.ply", "@set", "--materials", "--device", "cpu", "--samples", "4")


@pytest.fixture
def work(tmp_path, capsys) -> Workspace:
    """Returns a folder with a capture, and the set that it was made from with a known error in one view."""
    workspace = Workspace(tmp_path, capsys)
    ball = painted_ball()
    ls.save(workspace.path("ball.ply"), ball)
    write_relightable_set(workspace.path("set"), ball)
    write_layer(workspace.path("set"), "roughness", "r_003", np.full((32, 32, 1), 0.5))
    return workspace


def table(out: str) -> dict[str, str]:
    """Returns the values of the table by label."""
    rows = [line.split("  ") for line in out.splitlines() if "  " in line]
    return {row[0].strip(): next(cell for cell in row[1:] if cell.strip()).strip() for row in rows}


def test_evaluate_materials_table_equals_the_values_of_the_library(work):
    """Values are those of `evaluate_materials`, with units."""
    done = work.run(*COMMAND)
    assert done.status == 0, done.err
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=4)
    result = ls.inverse.evaluate_materials(work.capture("ball.ply"), work.path("set"), config=config, device="cpu")
    shown = table(done.out)
    assert shown["roughness, rmse"] == f"{result.roughness_rmse:.4f}" != "0.0000"
    assert shown["normals, mean"] == f"{result.normal_mean:.2f}"
    assert shown["albedo, scaled per channel"] == f"{result.albedo_psnr:.2f}"
    assert shown["relit in dusk, psnr"] == f"{result.relit['dusk'].psnr:.2f}"
    assert shown["environment, scaled per channel"] == "-"
    assert "dB" in done.out and "degrees" in done.out


def test_evaluate_materials_writes_metrics_and_comparison_images(work):
    """The report has metrics of all views, and for the worst views images of estimate, truth and difference."""
    done = work.run(*COMMAND, "-o", "@report")
    assert done.status == 0 and "images of the worst views: estimate, truth" in done.out
    assert {name for name in work.files() if name.startswith("report")} == {
        "report/metrics.json", "report/r_002.png", "report/r_003.png",
    }  # fmt: skip
    report = json.loads(work.path("report/metrics.json").read_text())
    assert report["all"]["albedo_scale"] == pytest.approx([1.0, 1.0, 1.0], abs=1e-4)
    assert [view["name"] for view in report["views"]] == ["r_002", "r_003"]
    assert set(report["views"][0]["relit"]["dusk"]) == {"psnr", "ssim", "flip"}
    beside = np.asarray(Image.open(work.path("report/r_003.png"))).astype(int)
    assert beside.shape == (4 * 32, 3 * 32, 3)
    found, truth, difference = np.split(beside[64:96], 3, axis=1)
    np.testing.assert_allclose(difference, np.minimum(4 * np.abs(found - truth), 255), atol=4)
    assert truth.max() == 128 and difference.any() and not beside[:32, 64:].any()


def test_evaluate_materials_compares_the_environment_of_the_capture(work):
    """The environment image is found beside the capture by its name, or given by an option."""
    write_radiance(work.path("ball.environment.exr"), 2.0 * panorama())
    beside = table(work.run(*COMMAND).out)["environment, scaled per channel"]
    assert float(beside) > 100.0
    write_radiance(work.path("other.exr"), panorama(-1.0))
    given = table(work.run(*COMMAND, "--environment", "@other.exr").out)["environment, scaled per channel"]
    assert float(given) < 40.0


def test_evaluate_materials_logs_missing_ground_truth(work, caplog):
    """The table has a dash for the metric."""
    for path in work.path("set/truth/normal").iterdir():
        path.unlink()
    work.path("set/truth/normal").rmdir()
    assert table(work.run(*COMMAND).out)["normals, mean"] == "-"
    assert any(
        line.startswith("no ground truth for normal:") and line.endswith("is missing") for line in caplog.messages
    )


@pytest.mark.parametrize(
    ("args", "problem"),
    [
        (
            (*COMMAND, "--scale", "0.5"),
            "--scale, --hold-out, --projection and --background cannot be used with --materials",
        ),
        (
            (*COMMAND, "--hold-out", "3"),
            "--scale, --hold-out, --projection and --background cannot be used with --materials",
        ),
        (("evaluate", "@ball.ply", "@ball.ply", "@set", "--materials"), "2 captures given, expected one with"),
        (("evaluate", "@ball.ply", "@set", "--samples", "4"), "--environment, --samples, --denoise and the pipelines"),
        (("evaluate", "@ball.ply", "@set", "--pipeline", "path"), "--denoise and the pipelines hybrid and path need"),
        (("evaluate", "@mesh.obj", "@set", "--materials"), "mesh.obj: is not a capture, expected Gaussians"),
        ((*COMMAND[:-1], "0"), "samples is 0, expected"),
        ((*COMMAND, "--environment", "@lost.exr"), "lost.exr: no such file"),
        (("evaluate", "@ball.ply", "@lost", "--materials"), "lost: no such folder"),
        ((*COMMAND, "-o", "@ball.ply"), "ball.ply: is a file, expected a folder"),
        ((*COMMAND, "-o", "@set/train"), "set/train has the images, which the report's images would replace"),
        ((*COMMAND, "-o", "@set/test"), "set/test has the images, which the report's images would replace"),
    ],
)
def test_evaluate_materials_command_reports_mistakes_of_the_user_in_one_line(work, args, problem):
    """Each mistake ends with status 2, and writes nothing."""
    before = work.files()
    done = work.run(*args)
    assert done.status == 2 and done.err.startswith("error: ") and done.err.count("\n") == 1
    assert problem in done.err
    assert work.files() == before
