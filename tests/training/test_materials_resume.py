"""An interrupted material search resumes, and its output is written completely or not at all."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.training import color_fit, find_materials
from support.scenes.lit_sphere import ball, matte, write_training_images

GREY = np.array([0.5, 0.4, 0.3])
CONFIG = ls.config.MaterialsConfig(directions=32, environment_steps=20, iterations=9)


class Killed(Exception):
    """Simulates a signal that cannot be handled: nothing is cleaned up or written."""


def bright_above(ray_directions: np.ndarray) -> np.ndarray:
    """Returns bluish radiance for N ray directions, brighter towards smaller y, shape (N, 3)."""
    return (1.0 - 0.8 * ray_directions[:, 1:2]) * (0.6, 0.7, 0.9)


@pytest.fixture(scope="module")
def capture() -> ls.Gaussians:
    """Returns a small captured ball."""
    return matte(ball(150), GREY, bright_above)


@pytest.fixture(scope="module")
def folder(capture: ls.Gaussians, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder with four images of the ball."""
    return write_training_images(tmp_path_factory.mktemp("set"), capture, count=4, size=24)


@pytest.fixture(autouse=True)
def always(monkeypatch: pytest.MonkeyPatch) -> None:
    """Writes the state after each iteration."""
    monkeypatch.setattr(find_materials, "CHECKPOINT_EVERY_S", 0.0)


def found(
    capture: ls.Gaussians, folder: Path, output: Path | None, dies_at: int | None = None
) -> ls.inverse.FoundMaterials:
    """Runs the material search; ``dies_at`` raises `Killed` before the iteration of that number."""
    steps = iter(range(100))

    def progress(label: str, fraction: float) -> None:
        if label == "finding materials" and next(steps) == dies_at:
            raise Killed

    return ls.inverse.find_materials(capture, folder, CONFIG, output=output, device="cpu", progress=progress)


def files_of(output: Path) -> dict[str, bytes]:
    """Returns the files of a capture and of its training folder."""
    return {
        str(path.relative_to(output.parent)): path.read_bytes() for path in output.parent.rglob("*.*") if path.is_file()
    }


@pytest.fixture(scope="module")
def whole(capture: ls.Gaussians, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> ls.inverse.FoundMaterials:
    """Returns the result of an uninterrupted search."""
    return found(capture, folder, tmp_path_factory.mktemp("whole") / "a.ply")


def assert_same(first: ls.inverse.FoundMaterials, second: ls.inverse.FoundMaterials) -> None:
    """Compares two results to the bit."""
    for name in ("albedo", "roughness", "metallic", "normals", "albedo_error", "roughness_error"):
        np.testing.assert_array_equal(getattr(first.gaussians, name), getattr(second.gaussians, name), name)
    np.testing.assert_array_equal(first.environment.image, second.environment.image)  # pyright: ignore[reportArgumentType]
    assert (first.error, first.too_light) == (second.error, second.too_light)


def never(*arguments: Any, **options: Any) -> Any:
    """Fails if a finished stage is run again."""
    raise AssertionError("a finished stage is run again")


def test_interrupted_material_search_resumes_to_the_same_bits(
    capture: ls.Gaussians,
    folder: Path,
    whole: ls.inverse.FoundMaterials,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A resumed search traces no ray again, and the file of incident radiance is removed at the end."""
    output = tmp_path / "a.ply"
    with pytest.raises(Killed):
        found(capture, folder, output, dies_at=0)
    assert set(files_of(output)) == {"a.training/materials.npz", "a.training/light.npz"}
    monkeypatch.setattr(find_materials, "traced_incident", never)
    monkeypatch.setattr(find_materials, "rendered_normals", never)
    for steps in (2, 5):
        with pytest.raises(Killed):
            found(capture, folder, output, dies_at=steps)
    assert_same(found(capture, folder, output), whole)
    assert set(files_of(output)) == {"a.ply", "a.environment.exr", "a.training/materials.npz"}
    monkeypatch.setattr(find_materials.MaterialFit, "step", never)
    assert_same(found(capture, folder, output), whole)  # without a further iteration


def test_interrupted_search_of_metals_resumes_to_the_same_bits(
    capture: ls.Gaussians, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Colours are not fitted again."""
    metal = replace(CONFIG, metal=True)
    monkeypatch.setattr(f"{__name__}.CONFIG", metal)
    monkeypatch.setattr(color_fit, "STEPS", 5)
    whole = found(capture, folder, None)
    with pytest.raises(Killed):
        found(capture, folder, tmp_path / "a.ply", dies_at=2)
    monkeypatch.setattr(find_materials, "fit_colors", never)
    assert_same(found(capture, folder, tmp_path / "a.ply"), whole)


def test_material_search_resumed_without_its_incident_radiance_file_traces_it_again(
    capture: ls.Gaussians, folder: Path, whole: ls.inverse.FoundMaterials, tmp_path: Path
) -> None:
    """The result has the same bits as that of an uninterrupted search."""
    output = tmp_path / "a.ply"
    with pytest.raises(Killed):
        found(capture, folder, output, dies_at=4)
    (tmp_path / "a.training" / "light.npz").unlink()
    assert_same(found(capture, folder, output), whole)


def test_material_search_discards_saved_state_of_another_capture_or_other_settings(
    capture: ls.Gaussians,
    folder: Path,
    whole: ls.inverse.FoundMaterials,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A state of other colours or settings, or a damaged one, is reported in a log line, and the search starts anew."""
    output, path = tmp_path / "a.ply", tmp_path / "a.training" / "materials.npz"
    with pytest.raises(Killed):
        found(matte(ball(150), 0.5 * GREY, bright_above), folder, output, dies_at=4)
    states = {"another capture": path.read_bytes()}
    ls.inverse.find_materials(
        capture, folder, ls.config.MaterialsConfig(directions=32, iterations=2), output=output, device="cpu"
    )
    states |= {"other settings": path.read_bytes(), "half of it": path.read_bytes()[:300], "nothing": b""}
    with np.load(path) as held:
        good = dict(held)
    for case, change in {
        "half": {"start.albedo": good["start.albedo"][:75]},
        "no moments": {"fit.albedo.first": np.zeros(3)},
        "not finite": {"start.sky": np.full_like(good["start.sky"], np.nan)},
    }.items():
        np.savez(tmp_path / "changed.npz", **(good | change))
        states[case] = (tmp_path / "changed.npz").read_bytes()
    for case, data in states.items():
        path.write_bytes(data)
        caplog.clear()
        with caplog.at_level(logging.WARNING, logger="lumisplat"):
            assert_same(found(capture, folder, output), whole)
        assert "materials.npz: is damaged, or of another capture, other images or settings" in caplog.text, case


def test_material_search_refuses_an_unwritable_output_before_it_reads_any_input(
    capture: ls.Gaussians, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error comes before any input is read."""
    monkeypatch.setattr(find_materials, "load_training_images", never)
    (tmp_path / "file").write_text("")
    (tmp_path / "b.environment.exr").mkdir()
    for output, problem in (
        (tmp_path / "file" / "a.ply", "a.ply: cannot be written"),
        (tmp_path / "b.ply", "is a folder"),
    ):
        with pytest.raises(ls.FormatError, match=problem):
            ls.inverse.find_materials(capture, folder, CONFIG, output=output, device="cpu")
    assert {path.name for path in tmp_path.iterdir()} == {"file", "b.environment.exr"}


@pytest.mark.parametrize("fails", ["save", "write_radiance"])
def test_material_search_writes_environment_and_capture_together_or_not_at_all(
    capture: ls.Gaussians, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    """If the disk is full, earlier files stay, and the message names the requested output."""
    output = tmp_path / "a.ply"
    found(capture, folder, output)
    for path in (output, tmp_path / "a.environment.exr"):
        path.write_bytes(b"of before")

    def full(path: Path, *arguments: Any) -> None:
        raise ls.FormatError(path, "cannot be written: no space left")

    monkeypatch.setattr(find_materials, fails, full)
    with pytest.raises(ls.FormatError, match=r"^\S+/a(\.environment\.exr|\.ply): cannot be written: no space left"):
        found(capture, folder, output)
    assert {data for name, data in files_of(output).items() if "training" not in name} == {b"of before"}
    assert len(files_of(output)) == 3  # the state of the search stays for the next call


def test_overwriting_a_training_removes_its_material_files(capture: ls.Gaussians, folder: Path, tmp_path: Path) -> None:
    """The training folder only has files of an interrupted material search."""
    output = tmp_path / "a.ply"
    with pytest.raises(Killed):
        found(capture, folder, output, dies_at=1)
    config = ls.TrainConfig(iterations=2, cap=150, initial=80, sh_degree=0)
    ls.train(folder, config, output=output, overwrite=True, device="cpu")
    assert not list((tmp_path / "a.training").glob("*light*")) and not list((tmp_path / "a.training").glob("mat*"))
