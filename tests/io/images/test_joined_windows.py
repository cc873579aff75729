"""Images joined from window files equal the whole image, pixel by pixel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.io.images.exr import read_exr, write_exr
from lumisplat.io.images.texture import write_png

SIZE = 71, 53
CAMERA = ls.Camera.look_at((0, 0, 0), (0, 0, 1), width=SIZE[0], height=SIZE[1])


def windows(columns: int = 3, rows: int = 2) -> list[tuple[int, int, int, int]]:
    """Returns windows that tile an image of `SIZE`."""
    return [camera.window for camera in CAMERA.windows(columns, rows) if camera.window is not None]


def part(image: np.ndarray, window: tuple[int, int, int, int]) -> np.ndarray:
    """Returns the pixels of a window."""
    left, top, width, height = window
    return image[top : top + height, left : left + width]


def noise(*channels: int) -> np.ndarray:
    """Returns bytes of smooth rows and noisy rows, so that every PNG filter is best for some row."""
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    image = np.stack([x * 3, y * 5, x + y, 255 - x], axis=2)[..., : channels[0]]
    image[20:30] = rng.integers(0, 256, (10, SIZE[0], channels[0]))
    return image.astype(np.uint8)


@pytest.mark.parametrize("channels", [3, 4])
def test_png_joined_from_window_files_equals_the_whole_image(tmp_path: Path, channels: int) -> None:
    """Pillow reads the joined RGB and RGBA files."""
    image = noise(channels)
    files = {window: tmp_path / f"{number}.png" for number, window in enumerate(windows())}
    for window, path in files.items():
        write_png(path, part(image, window))
    ls.io.join_windows(tmp_path / "joined.png", files)
    with Image.open(tmp_path / "joined.png") as joined:
        joined.verify()
    with Image.open(tmp_path / "joined.png") as joined:
        np.testing.assert_array_equal(np.asarray(joined), image)
    write_png(tmp_path / "whole.png", image)
    assert (tmp_path / "joined.png").stat().st_size < 1.1 * (tmp_path / "whole.png").stat().st_size


def test_exr_joined_from_window_files_equals_the_whole_image(tmp_path: Path) -> None:
    """OpenEXR reads floats, infinities and integers under long channel names, and the size of the whole image."""
    rng = np.random.default_rng(4)
    depth = rng.normal(size=SIZE[::-1]).astype(np.float32)
    depth[3] = np.inf
    smooth = np.zeros(SIZE[::-1], np.float32)
    index = rng.integers(-1, 9, SIZE[::-1])
    channels: dict[str, Any] = {
        "R": depth,
        "A": smooth,
        "index.gaussian": index,
        f"light.{'x' * 40}.direct.R": depth * 2,
    }
    files = {window: tmp_path / f"{number}.exr" for number, window in enumerate(windows())}
    for window, path in files.items():
        write_exr(path, {name: part(image, window) for name, image in channels.items()})
    ls.io.join_windows(tmp_path / "joined.exr", files)
    write_exr(tmp_path / "whole.exr", channels)
    joined, whole = read_exr(tmp_path / "joined.exr"), read_exr(tmp_path / "whole.exr")
    assert joined.keys() == whole.keys()
    for name, image in whole.items():
        assert joined[name].dtype == image.dtype
        np.testing.assert_array_equal(joined[name], image)
    headers = [OpenEXR.File(str(tmp_path / f"{name}.exr"), header_only=True).header() for name in ("joined", "whole")]
    for name in ("dataWindow", "displayWindow", "compression", "screenWindowWidth", "pixelAspectRatio"):
        np.testing.assert_array_equal(headers[0][name], headers[1][name], name)


def test_camera_windows_cover_each_pixel_exactly_once() -> None:
    """An image may be cut into as many windows as it has steps of 16 pixels; more windows are refused."""
    for columns, rows in ((1, 1), (5, 4), (2, 3), (5, 1)):
        count = np.zeros(SIZE[::-1], int)
        for window in windows(columns, rows):
            part(count, window)[...] += 1
        assert len(windows(columns, rows)) == columns * rows and (count == 1).all()
    with pytest.raises(ls.SceneError, match="columns is 6, expected 1 to 5"):
        CAMERA.windows(6, 1)
    with pytest.raises(ls.SceneError, match="cannot be cut again"):
        CAMERA.windows(2, 2)[0].windows(1, 1)


def test_join_windows_refuses_gaps_and_mismatched_files(tmp_path: Path) -> None:
    """The error is one line, and no file is written."""
    image = noise(3)
    files = {window: tmp_path / f"{number}.png" for number, window in enumerate(windows())}
    for window, path in files.items():
        write_png(path, part(image, window))
    out = tmp_path / "joined.png"
    lacking = dict(list(files.items())[:-1])
    with pytest.raises(ls.SceneError, match="end at column"):
        ls.io.join_windows(out, lacking)
    with pytest.raises(ls.SceneError, match="leaves a gap"):
        ls.io.join_windows(out, dict(list(files.items())[1:]))
    with pytest.raises(ls.SceneError, match="no window to join"):
        ls.io.join_windows(out, {})
    with pytest.raises(ls.FormatError, match=r"not to '\.jpg'"):
        ls.io.join_windows(tmp_path / "joined.jpg", files)
    last = list(files)[-1]
    write_png(files[last], image)
    with pytest.raises(ls.FormatError, match="expected"):
        ls.io.join_windows(out, files)
    write_png(files[last], part(noise(4), last))
    with pytest.raises(ls.FormatError, match="4 channels, but other windows have 3"):
        ls.io.join_windows(out, files)
    files[last].write_bytes(b"\x89PNG")
    with pytest.raises(ls.FormatError, match="cannot be read"):
        ls.io.join_windows(out, files)
    assert not list(tmp_path.glob("joined*")) and not list(tmp_path.glob(".*"))
