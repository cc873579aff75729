"""Whole trainings on small rendered image sets improve, resume and refuse damaged checkpoints."""

from __future__ import annotations

import itertools
import json
import os
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.training import train
from lumisplat.training.parameters import SceneScale, neighbour_distances
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TargetPixels, TrainingView
from support.scenes.training_scenes import BACKGROUND, cameras, known_gaussians, views, write_training_folder

CONFIG = ls.TrainConfig(iterations=400, cap=150, initial=80, sh_degree=1, coarse=0, seed=3)


def trainer(config: ls.TrainConfig = CONFIG, threads: int | None = None, count: int = 8) -> Trainer:
    """Returns a trainer before its first iteration."""
    return Trainer(views(count), config, background=BACKGROUND, device="cpu", threads=threads)


def arrays(of: Trainer) -> dict[str, np.ndarray]:
    """Returns all arrays on which the next iteration depends."""
    state = of.checkpoint
    parts = {"values": state.parameters.values, "first": state.parameters.first, "second": state.parameters.second}
    return {f"{part}.{name}": values for part, held in parts.items() for name, values in held.items()}


def held_out_psnr(of: Trainer) -> float:
    """Returns the PSNR on views between the training views."""
    renderer = ls.create_renderer(ls.RenderConfig(background=BACKGROUND), "cpu")
    between = cameras(40)[33:]
    scores = [
        ls.metrics.psnr(
            np.clip(renderer.render(ls.Scene([of.gaussians()]), camera).color, 0.0, 1.0),
            np.clip(renderer.render(ls.Scene([known_gaussians()]), camera).color, 0.0, 1.0),
        )
        for camera in between
    ]
    return float(np.mean(scores))


@pytest.mark.parametrize("kind", list(ls.config.Densification))
def test_training_raises_the_psnr_of_held_out_views_by_4_db(kind: ls.config.Densification) -> None:
    """400 small iterations gain 4 dB."""
    one = trainer(replace(CONFIG, densification=kind))
    before = held_out_psnr(one)
    for _ in range(400):
        one.step()
    losses = [loss.total for _, loss in one.take_losses()]
    assert np.mean(losses[-40:]) < 0.6 * np.mean(losses[:20])
    assert held_out_psnr(one) > before + 4.0


@pytest.mark.deep
def test_training_recovers_images_of_known_gaussians_to_a_psnr_of_40_db() -> None:
    """32 rendered images give more than 40 dB on held-out views."""
    config = ls.TrainConfig(iterations=6000, cap=400, initial=400, sh_degree=1, coarse=0)
    one = Trainer(views(32, 64), config, background=BACKGROUND, device="cpu")
    for _ in range(config.iterations):
        one.step()
    assert held_out_psnr(one) > 40.0


@pytest.mark.parametrize("kind", list(ls.config.Densification))
def test_training_by_splats_has_the_same_bits_on_any_number_of_threads(kind: ls.config.Densification) -> None:
    """The compared iterations include densifications; another seed gives another result."""
    config = replace(CONFIG, densification=kind, iterations=700)
    made = [trainer(config, threads) for threads in (1, 2, 5)] + [trainer(replace(config, seed=4))]
    for one in made:
        for _ in range(220):
            one.step()
    first = arrays(made[0])
    for other in made[1:3]:
        for name, values in arrays(other).items():
            np.testing.assert_array_equal(values, first[name], err_msg=name)
    assert made[3].count != made[0].count or (arrays(made[3])["values.means"] != first["values.means"]).any()


def test_non_finite_loss_ends_the_training_with_an_error() -> None:
    """The iteration in which the loss becomes NaN raises the error."""
    broken = np.full((40, 40, 3), np.nan, np.float32)
    view = TrainingView("bad", cameras(1)[0], lambda: TargetPixels(broken))
    one = Trainer([view], CONFIG, device="cpu")
    with pytest.raises(ls.training.DivergedError, match=r"^training stopped at iteration 1: the loss is nan: check"):
        one.step()


@pytest.mark.parametrize("kind", list(ls.config.Densification))
def test_stopped_training_resumes_to_the_same_bits(
    kind: ls.config.Densification, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The iterations include densifications; the training folder has all documented files."""
    folder = write_training_folder(tmp_path / "set")
    config = replace(CONFIG, iterations=260 if kind is ls.config.Densification.MCMC else 420, densification=kind)
    color = "#1a334d"
    whole = ls.train(folder, config, output=tmp_path / "a.ply", background=color, device="cpu")
    monkeypatch.setattr(
        train, "time", SimpleNamespace(monotonic=itertools.count().__next__)
    )  # one second per iteration
    parts: list[ls.training.TrainResult] = []
    while not parts or not parts[-1].is_finished:
        output = tmp_path / "b.ply"
        parts.append(
            ls.train(folder, config, output=output, background=color, stop_after=93.0, preview=50, device="cpu")
        )
    assert whole.is_finished and len(parts) > 1 and parts[0].iterations < config.iterations
    assert whole.gaussians.count != CONFIG.initial
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert whole.score is not None and whole.score == parts[-1].score and len(whole.score.of_views) == 2
    left = {str(path.relative_to(tmp_path)) for path in (tmp_path / "b.training").rglob("*") if path.is_file()}
    names = {"checkpoint.npz", "curve.json", "curve.png", "metrics.json", "settings.toml"}
    previews = {f"previews/{step:07d}.png" for step in range(50, config.iterations, 50)}
    pictures = {"held out/00.png", "held out/08.png", *previews}
    assert left == {f"b.training/{name}" for name in names | pictures}
    assert ls.load_image(tmp_path / "b.training" / "held out" / "00.png").shape == (40, 80, 3)


def test_settings_file_of_a_training_reproduces_it_to_the_bit(tmp_path: Path) -> None:
    """The settings file alone gives the same bits."""
    folder, outputs = write_training_folder(tmp_path / "set"), (tmp_path / "a.ply", tmp_path / "b.ply")
    config = replace(CONFIG, iterations=6, seed=3, rates=ls.config.LearningRates(sh=0.004))
    first = ls.io.load_training_images(
        os.path.relpath(folder), scale=0.5, hold_out=4, background="#1a334d", allow_outside=True
    )
    ls.train(first, config, output=outputs[0], device="cpu")
    message = tomllib.loads((tmp_path / "a.training" / "settings.toml").read_text())
    assert list(message) == ["photographs", "train"] and message["photographs"]["folder"] == str(folder)
    again = ls.io.load_training_images(**message["photographs"])
    rates = ls.config.LearningRates(**message["train"].pop("rates"))
    ls.train(again, ls.TrainConfig(**message["train"], rates=rates), output=outputs[1], device="cpu")
    assert outputs[0].read_bytes() == outputs[1].read_bytes()
    assert again.read_from == first.read_from and len(again.held_out) == 3
    see_through = ls.io.load_training_images(folder)
    assert ls.io.load_training_images(folder, background="transparent").read_from == see_through.read_from
    ls.train(see_through, config, output=tmp_path / "c.ply", device="cpu")
    assert 'background = "transparent"' in (tmp_path / "c.training" / "settings.toml").read_text()
    ls.train(replace(first, read_from=None), config, output=tmp_path / "d.ply", device="cpu")
    assert list(tomllib.loads((tmp_path / "d.training" / "settings.toml").read_text())) == ["train"]


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    """Returns the data with one byte changed."""
    changed = bytearray(data)
    changed[rng.integers(len(data))] ^= int(rng.integers(1, 256))
    return bytes(changed)


def test_checkpoints_that_are_damaged_or_of_another_training_are_refused(tmp_path: Path) -> None:
    """Other settings, other images and damage are each reported in one line."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    config = replace(CONFIG, iterations=20)
    ls.train(folder, config, output=output, device="cpu")
    file = tmp_path / "a.training" / "checkpoint.npz"
    held, settings = file.read_bytes(), (tmp_path / "a.training" / "settings.toml").read_bytes()
    with pytest.raises(ls.FormatError, match=r"checkpoint\.npz.* was trained with cap 150, not 151"):
        ls.train(folder, replace(config, cap=151), output=output, device="cpu")
    other = write_training_folder(tmp_path / "other", 10)
    with pytest.raises(ls.FormatError, match="with other images"):
        ls.train(other, config, output=output, device="cpu")
    with pytest.raises(ls.FormatError, match="with other images"):
        ls.train(folder, config, output=output, background="white", device="cpu")
    assert file.read_bytes() == held and (tmp_path / "a.training" / "settings.toml").read_bytes() == settings
    rng = np.random.default_rng(0)
    for damaged in (
        *(held[: int(cut)] for cut in rng.integers(0, len(held), 9)),
        *(flipped(held, rng) for _ in range(40)),
    ):
        file.write_bytes(damaged)
        try:
            ls.train(folder, config, output=output, device="cpu")
        except ls.FormatError as error:
            message = f"{file}: is damaged, or not a training checkpoint: remove it, or start again (--overwrite, "
            assert str(error) == message + "overwrite=True)"
        else:
            assert len(damaged) == len(held), "only a changed byte without meaning, such as of a date, may pass"
            file.write_bytes(held)
    again = ls.train(folder, config, output=output, overwrite=True, device="cpu")
    assert again.iterations == 20 and file.read_bytes() == held


def test_checkpoints_with_inconsistent_arrays_are_refused_with_a_one_line_error(tmp_path: Path) -> None:
    """Archives with missing Gaussians, wrong shapes, negative iterations or a decompression bomb are refused."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    config = replace(CONFIG, iterations=20, exposures=True)
    ls.train(folder, config, output=output, device="cpu")
    file = tmp_path / "a.training" / "checkpoint.npz"
    with np.load(file) as held:
        good = dict(held)
    about = json.loads(str(good["about"]))
    half = len(good["values.means"]) // 2
    changes: dict[str, dict[str, Any]] = {
        "half": {"values.means": good["values.means"][:half]},
        "all of half": {name: good[name][:half] for name in good if "." in name and "photographs" not in name},
        "doubled": {"record.motion": np.tile(good["record.motion"], 2)},
        "rank": {"values.logits": good["values.logits"][:, None]},
        "moments": {"second.sh": good["second.sh"][:, :1]},
        "none": {name: good[name][:0] for name in good if "." in name and "photographs" not in name},
        "infinite": {"values.log_scales": np.full_like(good["values.log_scales"], np.inf)},
        "text": {"values.means": np.array(["a", "b"])},
        "steps": {"about": np.array(json.dumps(about | {"iteration": -3}))},
        "endless steps": {"about": np.array(json.dumps(about).replace('"iteration": 20', '"iteration": 1e999'))},
        "curve": {"about": np.array(json.dumps(about | {"curve": about["curve"] | {"steps": [0]}}))},
        "no settings": {"about": np.array(json.dumps(about | {"settings": 3}))},
        "nested": {"about": np.array("[" * 100_000)},
        "images": {"photographs.exposures": good["photographs.exposures"][:-1]},
    }
    del changes["all of half"]["values.sh"]
    for name, change in changes.items():
        np.savez(file, **(good | change))
        with pytest.raises(ls.FormatError, match=r"checkpoint\.npz: is damaged, or not a training checkpoint: "):
            ls.train(folder, config, output=output, device="cpu")
            pytest.fail(name)
    bomb: dict[str, Any] = good | {"values.means": np.zeros((20_000_000, 3), np.float32)}
    np.savez_compressed(file, **bomb)
    with pytest.raises(ls.FormatError, match="is damaged"):
        ls.train(folder, config, output=output, device="cpu")
    if hasattr(os, "mkfifo"):
        file.unlink()
        os.mkfifo(file)
        with pytest.raises(ls.FormatError, match="is a device, a pipe or a socket"):
            ls.train(folder, config, output=output, device="cpu")


def test_non_finite_parameters_end_training_before_any_file_is_written() -> None:
    """The loss stays finite, because Gaussians with non-finite parameters are not drawn."""
    one = trainer()
    one.step()
    means: Any = one._device_splats.values.means
    means.numpy()[3:5, 1] = np.nan  # on the CPU, a view of the memory
    with pytest.raises(
        ls.training.DivergedError,
        match=r"iteration 1: means of 2 of 80 Gaussians are not finite: lower TrainConfig.rates$",
    ):
        _ = one.checkpoint


def test_training_assumes_default_scene_scales_for_cameras_without_parallax() -> None:
    """The cameras are at one position, or have parallel axes."""
    spot = [ls.Camera.look_at((1.3, 0.7, -2.1), target) for target in np.random.default_rng(0).normal(size=(8, 3))]
    assert SceneScale.of(spot) == SceneScale(1.0, 1.0)
    rig = [ls.Camera.look_at((x, 0.0, 0.0), (x, 0.0, 1.0)) for x in (-0.1, 0.0, 0.1)]
    assert SceneScale.of(rig).distance == pytest.approx(3.0 * 1.1 * 0.1)
    assert SceneScale.of(cameras(9)).distance == pytest.approx(3.0, abs=0.2)


def test_initial_scale_of_a_gaussian_is_the_rms_distance_of_the_three_nearest_points() -> None:
    """The reference computes all distances; one, two and coincident points are accepted."""
    points = np.random.default_rng(5).uniform(size=(2000, 3)) * (1.0, 1.0, 0.0)
    nearest = np.sort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)[:, 1:4]
    np.testing.assert_allclose(neighbour_distances(points), np.sqrt(np.square(nearest).mean(axis=1)))
    assert neighbour_distances(np.zeros((1, 3)))[0] == 1.0
    np.testing.assert_allclose(neighbour_distances(np.eye(3)[:2]), np.sqrt(2.0))
    assert not neighbour_distances(np.zeros((5, 3))).any()
