"""The PSNR curve of a training is written as numbers and as a readable plot."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

import lumisplat as ls
from lumisplat.training.run_folder import MARGIN, SIZE, Curve, round_step
from support.scenes.training_scenes import write_training_folder

WIDTH, HEIGHT = SIZE


def dark(part: np.ndarray) -> int:
    """Returns the number of black pixels in a part of a plot."""
    return int((part.max(axis=-1) < 100).sum())


def colored(part: np.ndarray) -> int:
    """Returns the number of orange pixels in a part of a plot."""
    red, _, blue = np.moveaxis(part.astype(int), -1, 0)
    return int((red - blue > 120).sum())


def test_training_curve_plot_has_tick_labels_and_titles_on_both_axes() -> None:
    """Tick labels lie along the whole of both axes, and a single held-out evaluation is drawn."""
    curve = Curve(steps=[50, 700], squared=[0.1, 0.001], measured=[(700, 28.0)])
    pixels = np.asarray(curve.image())
    left, below = pixels[:, : MARGIN - 2], pixels[HEIGHT - MARGIN + 2 :]
    assert dark(left[: MARGIN - 15]) and dark(below[:, WIDTH // 2 - 30 : WIDTH // 2 + 30][-25:]), "titles"
    assert all(dark(part) for part in np.array_split(left[MARGIN:-MARGIN], 4)), "tick labels in dB"
    assert all(dark(part[:28]) for part in np.array_split(below[:, MARGIN:-MARGIN], 4, axis=1)), (
        "tick labels in iterations"
    )
    assert colored(pixels[MARGIN:, WIDTH - MARGIN - 10 :]) > 20


def test_ticks_of_the_training_curve_are_round_numbers() -> None:
    """Ticks are 1, 2 or 5 times a power of ten apart, and at most nine."""
    assert [round_step(least) for least in (0.1, 1.0, 1.5, 3.75, 6, 62.5, 875)] == [1, 1, 2, 5, 10, 100, 1000]
    for last in range(1, 20_000, 37):
        assert math.floor(last / round_step(last / 8)) <= 8


def test_training_curve_without_points_is_a_blank_image() -> None:
    """A curve whose only PSNR is infinite is blank as well."""
    for curve in (Curve(), Curve(steps=[50], squared=[0.0])):
        assert (np.asarray(curve.image()) == 255).all()


def test_training_evaluates_held_out_images_after_100_and_200_iterations_and_at_the_end(tmp_path: Path) -> None:
    """Evaluations are after 100 and 200 iterations, and at the end."""
    config = ls.TrainConfig(iterations=210, cap=80, initial=60, sh_degree=0)
    ls.train(write_training_folder(tmp_path / "set"), config, output=tmp_path / "a.ply", device="cpu")
    stored = json.loads((tmp_path / "a.training" / "curve.json").read_text())
    assert [step for step, _ in stored["measured"]] == [100, 200, 210]
