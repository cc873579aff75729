"""Finding materials goes on where it was interrupted, and its output is there as a whole or not at all."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.training import find_materials
from support.scenes.lit_sphere import ball, matte, photographed

GREY = np.array([0.5, 0.4, 0.3])
CONFIG = ls.config.MaterialsConfig(directions=32, sky_steps=20, iterations=9)


class Killed(Exception):
    """As a signal that no program hears: nothing is tidied, nothing is written."""


def bright_above(ways: np.ndarray) -> np.ndarray:
    """Bluish, and brighter where y is less."""
    return (1.0 - 0.8 * ways[:, 1:2]) * (0.6, 0.7, 0.9)


@pytest.fixture(scope="module")
def capture() -> ls.Gaussians:
    """A small ball."""
    return matte(ball(150), GREY, bright_above)


@pytest.fixture(scope="module")
def folder(capture: ls.Gaussians, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four photographs of it."""
    return photographed(tmp_path_factory.mktemp("set"), capture, count=4, size=24)


@pytest.fixture(autouse=True)
def always(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is found is kept after each step."""
    monkeypatch.setattr(find_materials, "CHECKPOINT_EVERY_S", 0.0)


def found(
    capture: ls.Gaussians, folder: Path, output: Path | None, dies_at: int | None = None
) -> ls.inverse.FoundMaterials:
    """What is found, unless it dies before a step."""
    steps = iter(range(100))

    def progress(label: str, fraction: float) -> None:
        if label == "finding materials" and next(steps) == dies_at:
            raise Killed

    return ls.inverse.find_materials(capture, folder, CONFIG, output=output, device="cpu", progress=progress)


def files_of(output: Path) -> dict[str, bytes]:
    """What is left beside a capture, and itself."""
    return {
        str(path.relative_to(output.parent)): path.read_bytes() for path in output.parent.rglob("*.*") if path.is_file()
    }


@pytest.fixture(scope="module")
def whole(capture: ls.Gaussians, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> ls.inverse.FoundMaterials:
    """Found in one go."""
    return found(capture, folder, tmp_path_factory.mktemp("whole") / "a.ply")


def assert_same(first: ls.inverse.FoundMaterials, second: ls.inverse.FoundMaterials) -> None:
    """To the bit."""
    for name in ("albedo", "roughness", "normals"):
        np.testing.assert_array_equal(getattr(first.gaussians, name), getattr(second.gaussians, name), name)
    np.testing.assert_array_equal(first.environment.image, second.environment.image)  # pyright: ignore[reportArgumentType]
    assert (first.error, first.too_light) == (second.error, second.too_light)


def never(*arguments: Any, **options: Any) -> Any:
    """What was done already."""
    raise AssertionError("done again")


def test_it_goes_on_to_the_same_bits(
    capture: ls.Gaussians,
    folder: Path,
    whole: ls.inverse.FoundMaterials,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After several deaths; nothing is traced again, and light is there no longer than it is needed."""
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
    assert_same(found(capture, folder, output), whole)  # at once


def test_light_that_is_lost_is_traced_again(
    capture: ls.Gaussians, folder: Path, whole: ls.inverse.FoundMaterials, tmp_path: Path
) -> None:
    """To the same bits."""
    output = tmp_path / "a.ply"
    with pytest.raises(Killed):
        found(capture, folder, output, dies_at=4)
    (tmp_path / "a.training" / "light.npz").unlink()
    assert_same(found(capture, folder, output), whole)


def test_what_is_of_something_else_begins_anew(
    capture: ls.Gaussians,
    folder: Path,
    whole: ls.inverse.FoundMaterials,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Other colours, other settings, damage: a log line says so, and the result is that of a first call."""
    output, path = tmp_path / "a.ply", tmp_path / "a.training" / "materials.npz"
    with pytest.raises(Killed):
        found(matte(ball(150), 0.5 * GREY, bright_above), folder, output, dies_at=4)
    whose = {"another capture": path.read_bytes()}
    ls.inverse.find_materials(
        capture, folder, ls.config.MaterialsConfig(directions=32, iterations=2), output=output, device="cpu"
    )
    whose |= {"other settings": path.read_bytes(), "half of it": path.read_bytes()[:300], "nothing": b""}
    with np.load(path) as held:
        good = dict(held)
    for why, change in {
        "half": {"start.albedo": good["start.albedo"][:75]},
        "no moments": {"fit.albedo.first": np.zeros(3)},
        "not finite": {"start.sky": np.full_like(good["start.sky"], np.nan)},
    }.items():
        np.savez(tmp_path / "changed.npz", **(good | change))
        whose[why] = (tmp_path / "changed.npz").read_bytes()
    for why, data in whose.items():
        path.write_bytes(data)
        caplog.clear()
        with caplog.at_level(logging.WARNING, logger="lumisplat"):
            assert_same(found(capture, folder, output), whole)
        assert "materials.npz: is damaged, or of another capture, other images or settings" in caplog.text, why


def test_an_output_that_cannot_be_written_is_told_at_once(
    capture: ls.Gaussians, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything is read or found."""
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
def test_sky_and_capture_are_written_both_or_not_at_all(
    capture: ls.Gaussians, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    """Those of before stay if the disk is full, and the message names what was asked for."""
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
    assert len(files_of(output)) == 3  # what was found waits for the next call


def test_a_training_that_begins_anew_forgets_it(capture: ls.Gaussians, folder: Path, tmp_path: Path) -> None:
    """Overwriting removes what materials have left, too, also where nothing else is there."""
    output = tmp_path / "a.ply"
    with pytest.raises(Killed):
        found(capture, folder, output, dies_at=1)
    config = ls.TrainConfig(iterations=2, cap=150, initial=80, sh_degree=0)
    ls.train(folder, config, output=output, overwrite=True, device="cpu")
    assert not list((tmp_path / "a.training").glob("*light*")) and not list((tmp_path / "a.training").glob("mat*"))
