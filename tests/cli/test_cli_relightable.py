"""Tests ``lumisplat train --relightable``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.cli import main
from lumisplat.math.color import decode_srgb
from support.scenes.training_scenes import write_training_folder

SHORT = ("--iterations", "30", "--cap", "120", "--sh-degree", "1", "--device", "cpu", "--material-steps", "3")


def test_train_relightable_writes_materials_and_an_environment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Materials are columns of the PLY; the environment is an image that lights other scenes."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "out" / "a.ply"
    command = ["train", str(folder), "-o", str(output), *SHORT, "--relightable"]
    assert main([*command, "--stop-after", "0.01s"]) == 0
    plain = ls.load(output)
    assert isinstance(plain, ls.Gaussians) and plain.albedo is None
    assert main(command) == 0
    assert "a.environment.exr: the environment;" in capsys.readouterr().out
    found = ls.load(output)
    assert isinstance(found, ls.Gaussians)
    assert found.albedo is not None and found.roughness is not None and found.normals is not None
    assert found.sh_degree == 1 and found.metallic is None
    environment = ls.LightEnvironment(ls.io.load_radiance(tmp_path / "out" / "a.environment.exr"))
    assert environment.image is not None and environment.image.shape == (16, 32, 3) and environment.image.min() > 0.0
    report = output.with_suffix(".training") / "materials"
    metrics = json.loads((report / "materials.json").read_text())
    assert metrics["gaussians"] == found.count and metrics["error"] > 0.0
    assert len(list(report.glob("*.png"))) == 3
    # The image is exposed to a mean of 0.3 of display white, however bright the environment is.
    assert decode_srgb(np.asarray(Image.open(report / "environment.png")) / 255.0).mean() == pytest.approx(
        0.3, abs=0.05
    )
    assert "flatness = 0.3" in (output.with_suffix(".training") / "settings.toml").read_text()


def test_train_relightable_estimates_materials_from_refined_poses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Materials are estimated with the refined cameras; missing values are null in the report."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    image_sets: list[ls.io.TrainingImages] = []
    find = ls.inverse.find_materials

    def spied(
        capture: ls.Gaussians, images: ls.io.TrainingImages, *rest: Any, **options: Any
    ) -> ls.inverse.FoundMaterials:
        image_sets.append(images)
        return find(capture, images, *rest, **options)

    monkeypatch.setattr(ls.inverse, "find_materials", spied)
    command = ["train", str(folder), "-o", str(output), *SHORT[:-1], "0", "--relightable", "--refine-poses"]
    assert main(command) == 0
    frames = json.loads((tmp_path / "a.training" / "poses.json").read_text())["frames"]
    poses = {Path(frame["file_path"]).stem: np.array(frame["transform_matrix"]) for frame in frames}
    before = {one.name: one.camera.eye for one in ls.io.load_training_images(folder).training}
    assert {one.name for one in image_sets[0].training} == set(before)
    for one in image_sets[0].training:
        np.testing.assert_allclose(one.camera.eye, poses[one.name][:3, 3], atol=1e-6)
        assert np.linalg.norm(one.camera.eye - before[one.name]) > 1e-5
    report = tmp_path / "a.training" / "materials" / "materials.json"
    assert json.loads(report.read_text())["error"] is None
    report.unlink()
    report.mkdir()
    capsys.readouterr()
    assert main(command) == 2
    assert "materials.json: cannot be written" in capsys.readouterr().err


def test_train_metal_writes_a_capture_of_metal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The option goes to the search, and is refused where nothing reads it."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    assert main(["train", str(folder), "-o", str(output), *SHORT, "--relightable", "--metal"]) == 0
    found = ls.load(output)
    assert isinstance(found, ls.Gaussians) and found.metallic is not None and (found.metallic == 1.0).all()
    assert main(["train", str(folder), "-o", str(output), "--metal"]) == 2
    assert "--metal needs --relightable" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("-o", "a.spz"), "a.spz, expected a .ply: others have no columns for --relightable"),
        (("-o", "a.compressed.ply"), "a.compressed.ply, expected a .ply: others have no columns for --relightable"),
        (("-o", "a.ply", "--pipeline", "trace"), "--relightable needs --pipeline raster and --projection ewa"),
        (("-o", "a.ply", "--exposures"), "of equal exposure: leave out --exposures"),
        (("-o", "a.ply", "--material-steps", "-1"), "--material-steps is -1, expected 0 or more"),
    ],
)
def test_train_refuses_the_option_relightable_together_with_options_that_exclude_it(
    options: tuple[str, ...], problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The error comes before any file is read."""
    assert main(["train", str(tmp_path), *options, "--relightable"]) == 2
    assert problem in capsys.readouterr().err


def test_train_relightable_with_flatness_0_keeps_surface_weights_at_0(tmp_path: Path) -> None:
    """All weights of surfaces are then 0, as without ``--relightable``."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    assert main(["train", str(folder), "-o", str(output), *SHORT, "--relightable", "--flatness", "0"]) == 0
    settings = (output.with_suffix(".training") / "settings.toml").read_text()
    assert "flatness = 0.0" in settings and "depth_spread = 0.0" in settings
