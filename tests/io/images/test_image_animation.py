"""Image animations: timing, palettes without flicker, complete files or none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lumisplat.errors import ConfigError, FormatError, SceneError
from lumisplat.io import save_animation


def moving_light(count: int = 12, height: int = 48, width: int = 64) -> list[np.ndarray]:
    """Renders a bright spot that moves over the right half of a coloured gradient; the left half is static."""
    y, x = np.mgrid[:height, :width] / (height - 1.0)
    still = np.stack([0.2 + 0.6 * x / x.max(), 0.5 * y + 0.2, 0.7 - 0.4 * y], axis=2)
    frames = []
    for index in range(count):
        spot = np.exp(-40.0 * ((x - 1.0) ** 2 + (y - index / count) ** 2))[..., None]
        spot[:, : width // 2] = 0.0
        frames.append(np.clip(still + spot * (1.0, 0.9, 0.6), 0.0, 1.0))
    return frames


def read(path: Path) -> tuple[list[np.ndarray], list[float]]:
    """Reads frames as bytes, and their durations in milliseconds."""
    frames, durations = [], []
    with Image.open(path) as animation:
        for index in range(getattr(animation, "n_frames", 1)):
            animation.seek(index)
            animation.load()
            durations.append(animation.info["duration"])
            frames.append(np.asarray(animation.convert("RGB")).astype(int))
        assert animation.info["loop"] == 0
    return frames, durations


@pytest.mark.parametrize(("suffix", "error"), [("gif", 5.0), ("webp", 3.0), ("png", 0.51), ("apng", 0.51)])
def test_saved_image_animations_keep_all_frames_in_order(tmp_path: Path, suffix: str, error: float) -> None:
    """Frames have a small mean error, and durations are exact."""
    given = moving_light()
    save_animation(tmp_path / f"a.{suffix}", given, 10.0)
    frames, durations = read(tmp_path / f"a.{suffix}")
    assert len(frames) == len(given)
    assert durations == [100] * 12
    for found, expected in zip(frames, given, strict=True):
        assert np.abs(found - 255.0 * expected).mean() < error


def test_static_pixels_of_a_saved_gif_do_not_flicker(tmp_path: Path) -> None:
    """Static pixels have equal bytes in all frames, dithered or not."""
    save_animation(tmp_path / "a.gif", moving_light())
    frames, _ = read(tmp_path / "a.gif")
    for frame in frames[1:]:
        np.testing.assert_array_equal(frame[:, :32], frames[0][:, :32])
    assert np.abs(frames[6] - frames[0])[:, 32:].max() > 50


def test_gif_dithering_preserves_the_mean_colour(tmp_path: Path) -> None:
    """Neighbouring pixels average to colours that the palette lacks, without banding."""
    rows = np.linspace(0.2, 0.4, 240)[:, None, None]
    other = np.random.default_rng(1).uniform(0.0, 1.0, (240, 240, 3))
    frame = np.concatenate([np.broadcast_to(rows * (1.0, 0.8, 0.9), (240, 120, 3)), other], axis=1)
    save_animation(tmp_path / "a.gif", [frame, frame[:, ::-1]])
    (found, _), _ = read(tmp_path / "a.gif")
    error = (found - 255.0 * frame)[:, :120]
    blocks = error.reshape(20, 12, 10, 12, 3).mean(axis=(1, 3))
    assert np.abs(blocks).mean() < 0.5 * np.abs(error).mean()


@pytest.mark.parametrize("suffix", ["gif", "webp", "png"])
@pytest.mark.parametrize("fps", [7.0, 24.0, 30.0, 50.0])
def test_rounding_frame_durations_of_saved_image_animations_causes_no_drift(
    tmp_path: Path, suffix: str, fps: float
) -> None:
    """Durations are rounded to the format's unit so that their sum stays right."""
    save_animation(tmp_path / f"a.{suffix}", moving_light(24, 8, 12), fps)
    _, durations = read(tmp_path / f"a.{suffix}")
    unit = 10.0 if suffix == "gif" else 1.0
    assert len(durations) == 24
    assert sum(durations) == pytest.approx(24_000.0 / fps, abs=0.51 * unit)
    assert max(durations) - min(durations) <= unit


def test_all_frames_of_a_saved_gif_share_one_palette(tmp_path: Path) -> None:
    """The palette is stored once, after the header of the file."""
    save_animation(tmp_path / "a.gif", moving_light())
    data = (tmp_path / "a.gif").read_bytes()
    palette = data[13:781]  # behind the header, 3 bytes for each of 256 colours
    assert data.count(palette) == 1


def test_save_animation_refuses_invalid_frames_and_extensions(tmp_path: Path) -> None:
    """The error is one line, and no file appears."""
    good = moving_light(2, 8, 12)
    with pytest.raises(SceneError, match="got none"):
        save_animation(tmp_path / "a.gif", [])
    with pytest.raises(SceneError, match=r"one shape \(H, W, 3\)"):
        save_animation(tmp_path / "a.gif", [good[0], good[1][:4]])
    with pytest.raises(SceneError, match=r"one shape \(H, W, 3\)"):
        save_animation(tmp_path / "a.webp", [np.zeros((4, 4, 4))])
    with pytest.raises(FormatError, match=r"unknown extension '.avi'"):
        save_animation(tmp_path / "a.avi", good)
    for fps in (0.0, -1.0, 60.0, float("nan")):
        with pytest.raises(ConfigError, match="fps is"):
            save_animation(tmp_path / "a.gif", good, fps)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(FormatError, match="cannot be written"):
        save_animation(tmp_path / "file" / "a.gif", good)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
