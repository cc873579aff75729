"""Points and splits of nerfstudio's ``transforms.json``."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.files.training_image_files import ring_cameras, write_nerfstudio_images

POINTS = np.random.default_rng(3).normal(size=(7, 3)).astype(np.float32)
BYTES = np.random.default_rng(4).integers(0, 256, (7, 3), np.uint8)


def folder_with(folder: Path, **values: Any) -> Path:
    """Writes ten images whose transforms.json has these further keys."""
    return write_nerfstudio_images(folder, ring_cameras(10, 8, 6), **values)


def write_points(path: Path, positions: np.ndarray, colors: np.ndarray | None = None) -> None:
    """Writes a PLY of points as nerfstudio does."""
    columns = [("float", name, positions[:, k]) for k, name in enumerate("xyz")]
    if colors is not None:
        kind = "uchar" if colors.dtype == np.uint8 else "float"
        columns += [(kind, name, colors[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    lines = [f"property {kind} {name}" for kind, name, _ in columns]
    head = "\n".join(["ply", "format ascii 1.0", f"element vertex {len(positions)}", *lines, "end_header", ""])
    rows = "".join(" ".join(repr(column[i].item()) for _, _, column in columns) + "\n" for i in range(len(positions)))
    path.write_text(head + rows)


def names(found: tuple[Any, ...]) -> list[int]:
    """Returns the numbers in the names of the views."""
    return [int(view.name.removeprefix("view_")) for view in found]


def test_points_of_nerfstudio_transforms_json_are_loaded(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Colours may be bytes, floats or missing; a missing file is logged."""
    folder = folder_with(tmp_path / "set", ply_file_path="./sparse_pc.ply")
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert ls.io.load_training_images(folder).points is None
    assert "sparse_pc.ply does not exist" in caplog.text.replace("'", "").replace('"', "").replace("./", "")
    for colors, expected in (
        (BYTES, BYTES / 255.0),
        (BYTES / np.float32(255.0), BYTES / 255.0),
        (None, 0.5 + 0.0 * POINTS),
    ):
        write_points(folder / "sparse_pc.ply", POINTS, colors)
        found = ls.io.load_training_images(folder)
        assert found.points is not None and found.point_colors is not None
        np.testing.assert_allclose(found.points, POINTS, rtol=1e-6)
        np.testing.assert_allclose(found.point_colors, expected, atol=1e-6)
    write_points(folder / "sparse_pc.ply", np.where(POINTS > 1.0, np.nan, POINTS))
    with pytest.raises(ls.FormatError, match="not finite"):
        ls.io.load_training_images(folder)
    folder_with(folder, ply_file_path="../other.ply")
    with pytest.raises(ls.FormatError, match="not in its folder"):
        ls.io.load_training_images(folder)


@pytest.mark.parametrize(
    ("given", "training", "held_out"),
    [
        ({"train": [0, 1, 2, 3], "test": [5, 6], "val": [7]}, [0, 1, 2, 3], [5, 6]),
        ({"train": [0, 1, 2, 3], "val": [7]}, [0, 1, 2, 3], [7]),
        ({"train": [0, 1, 2, 3, 4, 5]}, [0, 1, 2, 3, 4, 5], [6, 7, 8, 9]),
        ({"test": [0, 9]}, [1, 2, 3, 4, 5, 6, 7, 8], [0, 9]),
        ({}, [1, 2, 3, 4, 5, 6, 7, 9], [0, 8]),
    ],
)
def test_splits_of_nerfstudio_transforms_json_define_held_out_images(
    given: dict[str, list[int]], training: list[int], held_out: list[int], tmp_path: Path
) -> None:
    """Frames match by path in any spelling; without splits every eighth image is held out."""
    splits = {f"{part}_filenames": [f"./images/view_{k}.png" for k in numbers] for part, numbers in given.items()}
    folder = folder_with(tmp_path / "set", **splits)
    found = ls.io.load_training_images(folder)
    assert names(found.training) == training and names(found.held_out) == held_out
    if "train" in given:
        all_of_it = ls.io.load_training_images(folder, hold_out=0)
        assert names(all_of_it.training) == training and not all_of_it.held_out


def test_invalid_splits_of_nerfstudio_transforms_json_are_refused(tmp_path: Path) -> None:
    """A split is not a list, or names no frame."""
    for value, problem in (("all", "expected a list of the file_path of frames"), (["a.png"], "none of the frames")):
        folder = folder_with(tmp_path / str(len(value)), train_filenames=value)
        with pytest.raises(ls.FormatError, match=problem):
            ls.io.load_training_images(folder)
        assert json.loads((folder / "transforms.json").read_text())["train_filenames"] == value
