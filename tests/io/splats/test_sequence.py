"""Sequences of frames: order, times, caching, and folders without frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.transforms import multiply_quaternions
from lumisplat.scene.animation.actors import SEQUENCE_FRAMES_KEPT, GaussianSequence
from support.scenes.raster_scenes import random_gaussians


def write_frames(folder: Path, names: list[str], counts: list[int] | None = None) -> None:
    """Writes a frame for each name, with the given numbers of Gaussians or with 4, 5, 6, ..."""
    for k, name in enumerate(names):
        ls.save(folder / name, random_gaussians(k, count=counts[k] if counts else 4 + k))


def test_frames_of_a_sequence_are_sorted_by_number(tmp_path: Path) -> None:
    """Numbers in names compare as numbers of any width; hidden files and files of other formats are ignored."""
    write_frames(tmp_path, ["f_1.ply", "f_2.ply", "f_010.ply", "f_11.ply"])
    (tmp_path / "notes.txt").write_text("no frame")
    (tmp_path / "._f_3.ply").write_text("left by a file manager")
    sequence = ls.io.load_sequence(tmp_path, 2.0)
    assert sequence.frame_count == 4 and sequence.duration == 2.0
    assert [sequence.at(k / 2.0).count for k in range(4)] == [4, 5, 6, 7]


def test_frames_that_correspond_are_interpolated_and_others_are_not(tmp_path: Path, caplog) -> None:
    """Means are linear, scales geometric and rotations half-way; shuffled frames stay until the next, with a line."""
    first = random_gaussians(0, count=200, degree=1)
    turn = np.array([np.cos(0.2), 0.0, np.sin(0.2), 0.0])
    rotations = [multiply_quaternions(turn, row[None])[0] for row in first.rotations_wxyz]
    second = replace(
        first,
        means=first.means + np.array((0.01, 0.0, 0.02), np.float32),
        rotations_wxyz=-np.array(rotations),  # of the other sign: the same rotations
        scales=4.0 * first.scales,
    )
    shuffled = second.subset(np.random.default_rng(3).permutation(200))
    for name, frame in (("a1.ply", first), ("a2.ply", second), ("a3.ply", shuffled)):
        ls.save(tmp_path / name, frame)
    sequence = ls.io.load_sequence(tmp_path, 10.0)
    middle = sequence.at(0.05)
    np.testing.assert_allclose(middle.means, first.means + np.array((0.005, 0.0, 0.01)), atol=1e-6)
    np.testing.assert_allclose(middle.scales, 2.0 * first.scales, rtol=1e-5)
    half = np.array([np.cos(0.1), 0.0, np.sin(0.1), 0.0])
    expected = multiply_quaternions(half, first.rotations_wxyz)
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", middle.rotations_wxyz, expected)), 1.0, atol=1e-5)
    assert sequence.at(0.1) is sequence.at(0.15) and "different orders" in caplog.text


def test_sequence_of_different_counts_shows_each_frame_until_the_time_of_the_next(tmp_path: Path) -> None:
    """Frames may differ in count; they are then not interpolated."""
    write_frames(tmp_path, ["a1.spz", "a2.spz", "a3.spz"])
    sequence = ls.io.load_sequence(tmp_path, 10.0)
    for time, count in ((-1.0, 4), (0.0, 4), (0.099, 4), (0.1, 5), (0.15, 5), (0.2, 6), (50.0, 6)):
        assert sequence.at(time).count == count, time


@pytest.mark.parametrize("fps", [24.0, 25.0, 29.97, 30.0, 60.0, 1.0 / 3.0])
def test_rounding_of_times_makes_no_sequence_of_captures_skip_a_frame(fps: float, tmp_path: Path) -> None:
    """At time k / fps the frame is k, for all k."""
    shown: list[int] = []
    frame = random_gaussians(0, count=1)

    def load(path: Path) -> ls.Gaussians:
        shown.append(int(path.name))
        return frame

    sequence = GaussianSequence([tmp_path / str(k) for k in range(500)], fps, load)
    for time in ls.Animation(ls.Scene(), fps=fps, frame_count=500).times:
        sequence.at(float(time))
    assert shown == list(range(500))


def test_sequence_of_captures_keeps_the_two_last_used_frames_in_memory(tmp_path: Path) -> None:
    """A frame is loaded on first use, and again only after it has left the cache."""
    loaded: list[str] = []

    def load(path: Path) -> ls.Gaussians:
        loaded.append(path.name)
        return random_gaussians(0, count=1)

    sequence = GaussianSequence([tmp_path / str(k) for k in range(5)], 1.0, load)
    assert loaded == []
    for time in (0.0, 0.0, 1.0, 0.0, 1.0, 2.0, 1.0, 0.0):
        sequence.at(time)
    assert SEQUENCE_FRAMES_KEPT == 2
    assert loaded == ["0", "1", "2", "0"]


def test_sequence_refuses_frames_with_invalid_gaussians_unless_told_to_drop_them(tmp_path: Path) -> None:
    """A frame with NaN is refused when its time is shown, or with drop_invalid loses the invalid Gaussians."""
    write_frames(tmp_path, ["a1.ply", "a2.ply"], [10, 10])
    data = bytearray((tmp_path / "a2.ply").read_bytes())
    at = data.index(b"end_header\n") + len(b"end_header\n")
    data[at : at + 4] = np.float32(np.nan).tobytes()
    (tmp_path / "a2.ply").write_bytes(bytes(data))
    sequence = ls.io.load_sequence(tmp_path, 1.0)
    assert sequence.at(0.0).count == 10
    with pytest.raises(ls.FormatError, match=r"a2\.ply: "):
        sequence.at(1.0)
    assert ls.io.load_sequence(tmp_path, 1.0, drop_invalid=True).at(1.0).count == 9


def test_load_sequence_refuses_folders_without_captures_or_with_several_formats(tmp_path: Path) -> None:
    """The one-line error states what was expected."""
    with pytest.raises(ls.FormatError, match=r"holds no frames: expected files that end in .*\.spz"):
        ls.io.load_sequence(tmp_path, 25.0)
    with pytest.raises(ls.FormatError, match="no such folder"):
        ls.io.load_sequence(tmp_path / "none", 25.0)
    write_frames(tmp_path, ["a1.ply", "a1.spz"])
    with pytest.raises(ls.FormatError, match=r"is a file, expected a folder"):
        ls.io.load_sequence(tmp_path / "a1.ply", 25.0)
    with pytest.raises(ls.FormatError, match=r"holds frames in \.ply and \.spz, expected one format"):
        ls.io.load_sequence(tmp_path, 25.0)


def test_load_sequence_refuses_meshes_as_frames(tmp_path: Path) -> None:
    """A PLY with faces is not a frame."""
    import trimesh

    trimesh.creation.box().export(tmp_path / "a1.ply")
    with pytest.raises(ls.FormatError, match=r"a1\.ply: is a mesh, expected a frame of Gaussians"):
        ls.io.load_sequence(tmp_path, 25.0)


def test_sequences_refuse_nonpositive_rates_and_nonfinite_times(tmp_path: Path) -> None:
    """The rate is 0, negative, NaN or text; the time is NaN."""
    write_frames(tmp_path, ["a1.ply"])
    for fps in (0.0, -1.0, float("nan"), cast(Any, "25")):
        with pytest.raises(ls.SceneError, match="fps is"):
            ls.io.load_sequence(tmp_path, fps)
    with pytest.raises(ls.SceneError, match="time is nan"):
        ls.io.load_sequence(tmp_path, 1.0).at(float("nan"))
