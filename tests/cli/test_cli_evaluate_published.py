"""Tests ``lumisplat evaluate --protocol``: table, files, the training before it, and mistakes."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

import lumisplat as ls
from lumisplat.cli.commands import train
from support.files.cli_files import Workspace
from support.files.published_files import write_orb, write_synthetic4relight
from support.files.relightable_files import painted_ball

SYNTHETIC = ("@set", "--protocol", "synthetic4relight", "--lights", "@lights", "--pipeline", "hybrid", "--samples", "4")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder with a capture, and the set that it was made from."""
    folder, ball = tmp_path_factory.mktemp("published"), painted_ball()
    ls.save(folder / "ball.ply", ball)
    write_synthetic4relight(folder / "set", ball, folder / "lights")
    return folder


@pytest.fixture
def work(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Workspace:
    """Returns a workspace with copies of these files."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    return Workspace(tmp_path, capsys)


def test_table_and_report_have_the_figures_of_the_library(work: Workspace) -> None:
    """Labels say what was measured, under which light, and in which unit."""
    done = work.run("evaluate", "@ball.ply", *SYNTHETIC, "-o", "@report", "--device", "cpu")
    assert done.status == 0, done.err
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=4)
    benchmark = ls.inverse.Benchmark.SYNTHETIC4RELIGHT
    found = ls.inverse.evaluate_published(
        work.capture("ball.ply"), work.path("set"), benchmark, lights=work.path("lights"), config=config, device="cpu"
    )
    rows = dict(line.rsplit(maxsplit=1) for line in done.out.splitlines() if "  " in line)
    shown = {label.strip(): value for label, value in rows.items()}
    assert shown["relit in envmap12, PSNR, dB"] == f"{found.figures['relit_psnr/envmap12']:.2f}"
    assert shown["albedo, PSNR, dB"] == f"{found.figures['albedo_psnr']:.2f}"
    assert shown["roughness, mean squared error"] == f"{found.figures['roughness_mse']:.4f}"
    report = json.loads(work.path("report/metrics.json").read_text())
    assert report["protocol"] == "synthetic4relight"
    assert report["figures"]["novel_psnr"] == pytest.approx(found.figures["novel_psnr"])
    assert report["figures"]["seconds"] is None


def test_denoise_option_denoises_every_relit_image(work: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two views, each in two lights; without the option, none is denoised."""
    denoised: list[ls.Frame] = []
    monkeypatch.setattr(ls.Frame, "check_denoiser", lambda: None)
    monkeypatch.setattr(ls.Frame, "denoised", lambda frame: denoised.append(frame) or frame)
    done = work.run("evaluate", "@ball.ply", *SYNTHETIC, "--denoise", "--device", "cpu")
    assert done.status == 0 and len(denoised) == 4, done.err
    assert all(frame.albedo is not None for frame in denoised)
    work.run("evaluate", "@ball.ply", *SYNTHETIC, "--device", "cpu")
    assert len(denoised) == 4


def test_missing_denoiser_is_reported_before_anything_is_trained(
    work: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The line names the package extra to install."""
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    done = work.run("evaluate", *SYNTHETIC, "--denoise", "-o", "@trained")
    assert done.status == 2 and "pip install 'lumisplat[denoise]'" in done.err
    assert not work.path("trained").exists()


def test_without_a_capture_one_is_trained_on_the_images_of_the_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photographs of Stanford-ORB get their masks as alpha, and the trained capture is scored."""
    work, ball = Workspace(tmp_path, capsys), painted_ball()
    folder = write_orb(tmp_path, ball)
    asked: list[Any] = []

    def run(command: train.Train) -> None:
        images = ls.io.load_training_images(command.folder, hold_out=command.hold_out)
        asked.append((command.folder, command.relightable, images))
        ls.save(command.output, ball)

    monkeypatch.setattr(train.Train, "run", run)
    options = ("--protocol", "orb", "--pipeline", "hybrid", "--samples", "4", "-o", "@out")
    done = work.run("evaluate", str(folder), *options)
    assert done.status == 0, done.err
    [(images, relightable, loaded)] = asked
    assert images == tmp_path / "out" / "images" and relightable
    view = loaded.training[0]
    assert view.name == "0000" and 0.1 < view.alpha().mean() < 0.9
    assert (tmp_path / "out" / "ball_scene001.ply").is_file()
    assert "novel views, PSNR-L, dB" in done.out and "training, seconds" in done.out


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (("@set", "--protocol", "synthetic4relight"), "without a capture, one is trained: -o OUT says where"),
        (("@ball.ply", "@set", "--lights", "@lights"), "--lights needs --protocol"),
        (("@ball.ply", "@set", "--protocol", "tensoir"), "has no test_000/metadata.json"),
        (("@ball.ply", *SYNTHETIC, "--materials"), "--materials, --environment, --projection and --background exclude"),
        (("@ball.ply", *SYNTHETIC, "--scale", "0.5"), "--scale and --hold-out exclude --protocol"),
        (("@ball.ply", "@ball.ply", *SYNTHETIC), "3 files given, expected a capture and a folder"),
    ],
)
def test_mistakes_are_told_in_one_line(work: Workspace, arguments: tuple[str, ...], problem: str) -> None:
    """Nothing is rendered or written."""
    done = work.run("evaluate", *arguments)
    assert done.status != 0 and problem in done.err and done.err.count("\n") <= 2
