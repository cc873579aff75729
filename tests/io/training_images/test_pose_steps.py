"""Steps around COLMAP: stored results, progress and model selection. A stub replaces COLMAP itself."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.images.texture import write_png
from lumisplat.io.training_images.poses import LENS_MODEL
from support.files.colmap_stub import ColmapStub


@pytest.fixture
def colmap(monkeypatch: pytest.MonkeyPatch) -> ColmapStub:
    """Replaces pycolmap by a stub."""
    stub = ColmapStub()
    monkeypatch.setitem(sys.modules, "pycolmap", stub)
    return stub


def write_images(folder: Path, count: int, sizes: tuple[int, ...] = (8,)) -> Path:
    """Writes images whose names have spaces."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for k in range(count):
        write_png(folder / "images" / f"of day {k}.png", np.full((6, sizes[k % len(sizes)], 3), 0.5))
    return folder


def test_find_poses_estimates_one_lens_for_all_images_if_their_sizes_are_equal(
    colmap: ColmapStub, tmp_path: Path
) -> None:
    """Features are extracted in several calls; if images have two sizes, each image gets a lens of its own."""
    colmap.models = [range(9)]
    ls.io.find_poses(write_images(tmp_path / "one", 9))
    assert colmap.lenses == [(LENS_MODEL, "single", k > 0) for k in range(3)]
    colmap.lenses.clear()
    ls.io.find_poses(write_images(tmp_path / "two", 9, (8, 9)))
    assert colmap.lenses == [(LENS_MODEL, "per image", False)] * 3


def test_find_poses_continues_after_an_interruption_at_any_step(
    colmap: ColmapStub, tmp_path: Path, caplog: Any
) -> None:
    """The next call continues, logs this, and removes the work folder at the end."""
    write_images(tmp_path, 9)
    colmap.models = [range(9)]
    for step, summary in (
        ("extract", "features of 4 of 9 images, 0 matched pairs"),
        ("match", "features of 9 of 9 images, 32 matched pairs"),
        ("estimate_poses", "features of 9 of 9 images, 36 matched pairs"),
    ):
        colmap.interrupt_in = step
        with pytest.raises(KeyboardInterrupt, match=f"poses.unfinished holds {summary}; the same command continues"):
            ls.io.find_poses(tmp_path)
        assert {path.name for path in tmp_path.iterdir()} == {"images", "poses.unfinished"}
    assert caplog.text.count("continues from") == 2
    colmap.interrupt_in = ""
    model = ls.io.find_poses(tmp_path)
    assert "continues from features of 9 of 9 images, 36 matched pairs" in caplog.text
    assert (model / "names.txt").read_text().splitlines() == [f"of day {k}.png" for k in range(9)]
    assert {path.name for path in tmp_path.iterdir()} == {"images", "sparse"}


def test_find_poses_restarts_if_images_changed(colmap: ColmapStub, tmp_path: Path, caplog: Any) -> None:
    """A changed, removed or added image invalidates the stored results."""
    colmap.interrupt_in = "match"
    paths = [tmp_path / "images" / f"of day {k}.png" for k in (1, 2, 9)]
    for change in (
        lambda: write_png(paths[0], np.full((6, 8, 3), 0.25)),
        paths[1].unlink,
        lambda: write_png(paths[2], np.full((6, 8, 3), 0.25)),
    ):
        write_images(tmp_path, 4)
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                ls.io.find_poses(tmp_path)
        assert "continues from features of" in caplog.text
        change()
        caplog.clear()
        with pytest.raises(KeyboardInterrupt):
            ls.io.find_poses(tmp_path)
        assert "continues from" not in caplog.text


def test_find_poses_uses_the_largest_of_several_colmap_models_and_logs_their_sizes(
    colmap: ColmapStub, tmp_path: Path, caplog: Any
) -> None:
    """The log counts images without a pose by their original names."""
    colmap.models = [(0, 1, 2), (3, 4, 5, 6, 7)]
    reported: list[tuple[str, float]] = []
    model = ls.io.find_poses(
        write_images(tmp_path, 9), progress=lambda step, fraction: reported.append((step, fraction))
    )
    assert (model / "names.txt").read_text().splitlines() == [f"of day {k}.png" for k in range(3, 8)]
    assert "2 separate models, of 5 and 3 images: the largest is used" in caplog.text
    assert "no pose was found for 4 of 9 images (of day 0.png, of day 1.png, of day 2.png, ...)" in caplog.text
    placing = [entry for entry in reported if entry[0].startswith("finding poses")]
    assert ("finding poses, 8 of 9 images", 8 / 9) in placing, "images of all models count"
    assert [fraction for _, fraction in placing] == sorted(fraction for _, fraction in placing)


def test_find_poses_does_not_log_colmap_models_that_add_no_images(
    colmap: ColmapStub, tmp_path: Path, caplog: Any
) -> None:
    """COLMAP also returns models of two images, and models whose images are all in the largest model."""
    colmap.models = [(0, 1), (1, 2, 3), (0, 1, 2, 3, 4, 5, 6, 7, 8)]
    ls.io.find_poses(write_images(tmp_path, 9))
    assert caplog.text == ""


def test_find_poses_reports_progress_of_the_bundle_adjustment(colmap: ColmapStub, tmp_path: Path) -> None:
    """The last adjustment of many images takes long, and the progress bar explains why it stays at 99 %."""
    colmap.models = [range(5)]
    reported: list[tuple[str, float]] = []
    ls.io.find_poses(write_images(tmp_path, 5), progress=lambda step, fraction: reported.append((step, fraction)))
    assert reported[-2:] == [("finding poses, bundle adjustment", 0.99), ("finding poses", 1.0)]


@pytest.mark.parametrize(
    ("features", "verified", "reason"),
    [
        (12, 0, "they have too little texture, 12 features each"),
        (500, 3, "only 3 image pairs match: neighbouring images must be sharp"),
        (500, 30, "there is no parallax"),
    ],
)
def test_find_poses_error_explains_why_no_poses_were_found(
    features: int, verified: int, reason: str, colmap: ColmapStub, tmp_path: Path
) -> None:
    """The error is one line, and the work folder is removed."""
    colmap.models, colmap.features, colmap.verified = (), features, verified
    with pytest.raises(ls.FormatError, match=f"no poses were found for its 9 images: {reason}"):
        ls.io.find_poses(write_images(tmp_path, 9))
    assert {path.name for path in tmp_path.iterdir()} == {"images"}
