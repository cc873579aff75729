"""Extraction of training images from videos: the sharpest frames, upright, all or none."""

from __future__ import annotations

import logging
import sys
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image, ImageFilter

import lumisplat as ls
from lumisplat.io.training_images.video_frames import sharpness

SIZE = 96, 64
"""Width and height of the videos."""


def scene(seed: int, blur: float = 0.0) -> Image.Image:
    """Returns a detailed image, red at the left, blurred by ``blur``."""
    noise = np.random.default_rng(seed).uniform(60, 200, (SIZE[1] // 4, SIZE[0] // 4, 3)).astype(np.uint8)
    image = Image.fromarray(noise).resize(SIZE, Image.Resampling.NEAREST)
    image.paste((230, 20, 20), (0, 0, SIZE[0] // 4, SIZE[1]))
    return image.filter(ImageFilter.GaussianBlur(blur))


def write_video(path: Path, images: list[Image.Image], fps: int = 10, **coding: int) -> Path:
    """Writes images as a video."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps), options={"crf": "8"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for name, value in coding.items():
            setattr(stream.codec_context, name, value)
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_image(image)))
        container.mux(stream.encode())
    return path


def pixels(path: Path) -> np.ndarray:
    """Reads the pixels of an image."""
    with Image.open(path) as image:
        return np.asarray(image, np.float64)


def test_sharpest_frame_of_each_video_interval_is_extracted(tmp_path: Path) -> None:
    """Of ten frames per second, one in five is not blurred."""
    sharp = [3, 5, 14]
    images = [scene(number, 0.0 if number in sharp else 3.0) for number in range(15)]
    reported: list[float] = []
    files = ls.io.extract_frames(
        write_video(tmp_path / "a.mp4", images),
        tmp_path / "walk",
        progress=lambda _, fraction: reported.append(fraction),
    )
    assert [file.relative_to(tmp_path).as_posix() for file in files] == [f"walk/images/{n:04}.jpg" for n in (1, 2, 3)]
    for file, number in zip(files, sharp, strict=True):
        assert np.abs(pixels(file) - np.asarray(images[number], np.float64)).mean() < 8.0
    assert reported == sorted(reported) and reported[-1] > 0.9


def test_interval_length_sets_the_number_of_extracted_frames(tmp_path: Path) -> None:
    """An interval as long as the video gives one image, a very short one gives every frame."""
    video = write_video(tmp_path / "a.mp4", [scene(number) for number in range(7)])
    assert len(ls.io.extract_frames(video, tmp_path / "one", every=10.0)) == 1
    assert len(ls.io.extract_frames(video, tmp_path / "all", every=0.01)) == 7


def test_image_sharpness_decreases_with_blur() -> None:
    """Images are compared at a reduced size, so noise of single pixels does not count as sharpness."""
    values = [sharpness(scene(0, blur)) for blur in (0.0, 0.7, 1.5, 3.0)]
    assert values == sorted(values, reverse=True) and values[0] > 10.0 * values[-1]
    plain = Image.new("RGB", (1920, 1920), (120, 120, 120))
    noise = np.random.default_rng(0).normal(120.0, 12.0, (1920, 1920, 3)).clip(0, 255).astype(np.uint8)
    assert sharpness(plain) == 0.0 and sharpness(Image.fromarray(noise)) < 0.15 * 20.0 * 12.0**2
    assert sharpness(Image.new("RGB", (2, 2))) == 0.0


def test_frames_of_rotated_videos_are_extracted_upright(tmp_path: Path) -> None:
    """Phones store portrait videos rotated: red at the left comes from the bottom or top of the stored frame."""
    video = write_video(tmp_path / "a.mp4", [scene(0)] * 3)
    for angle, where in ((90, np.s_[-20:]), (-90, np.s_[:20]), (180, np.s_[:, -20:])):
        rotated = rotated_video(video, tmp_path / f"{angle}.mp4", angle)
        (file,) = ls.io.extract_frames(rotated, tmp_path / f"turned {angle}")
        red = pixels(file)[where].reshape(-1, 3).mean(axis=0)
        assert red[0] > 200.0 and red[1] < 60.0, angle
        assert pixels(file).shape[:2] == (SIZE[::-1] if angle == 180 else SIZE)


def rotated_video(video: Path, path: Path, angle: int) -> Path:
    """Copies a video with a rotation to the left in the matrix of its track header."""
    cos, sin = round(np.cos(np.deg2rad(angle))), round(np.sin(np.deg2rad(angle)))
    data = bytearray(video.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    one, deep = 1 << 16, 1 << 30
    matrix = [cos * one, -sin * one, 0, sin * one, cos * one, 0, 0, 0, deep]
    data[at : at + 36] = b"".join(value.to_bytes(4, "big", signed=True) for value in matrix)
    path.write_bytes(data)
    return path


def test_extracted_video_frames_are_downscaled_but_never_upscaled(tmp_path: Path) -> None:
    """The longer side is at most the given number of pixels."""
    video = write_video(tmp_path / "a.mp4", [scene(0)] * 2)
    for size, expected in ((48, (48, 32)), (1600, SIZE)):
        (file,) = ls.io.extract_frames(video, tmp_path / str(size), size=size)
        assert pixels(file).shape[1::-1] == expected


def test_extracting_frames_of_an_hdr_video_logs_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The video is HLG, the default of phones."""
    video = write_video(tmp_path / "a.mp4", [scene(0)] * 2, color_trc=18)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        ls.io.extract_frames(video, tmp_path / "walk")
    assert "is HDR (HLG)" in caplog.text and caplog.text.count("HDR (") == 1


def test_black_and_still_videos_are_refused_as_training_images(tmp_path: Path) -> None:
    """Black videos may have sensor noise; nothing is left behind."""
    rng = np.random.default_rng(0)

    def noisy(image: Image.Image, level: float) -> Image.Image:
        values = np.asarray(image, np.float64) + rng.normal(0.0, level, (*SIZE[::-1], 3))
        return Image.fromarray(values.clip(0, 255).astype(np.uint8))

    black, still = Image.new("RGB", SIZE), scene(0)
    for name, images, message in (
        ("black", [noisy(black, 4.0) for _ in range(12)], "black.mp4: is black throughout"),
        ("one", [black], "one.mp4: is black throughout"),
        ("still", [noisy(still, 2.0) for _ in range(12)], "still.mp4: shows no motion"),
    ):
        with pytest.raises(ls.FormatError, match=message):
            ls.io.extract_frames(write_video(tmp_path / f"{name}.mp4", images), tmp_path / "walk")
        assert not list(tmp_path.glob("walk/*"))
    wide = scene(1).resize((2 * SIZE[0], SIZE[1]))
    slow = [wide.crop((k // 4, 0, k // 4 + SIZE[0], SIZE[1])) for k in range(12)]
    assert len(ls.io.extract_frames(write_video(tmp_path / "slow.mp4", slow), tmp_path / "slow")) == 3, (
        "two pixels in all"
    )


def test_unreadable_videos_are_refused_without_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each error is one line."""
    video = write_video(tmp_path / "a.mp4", [scene(0)] * 4)
    (tmp_path / "text.mp4").write_text("no film")
    (tmp_path / "cut.mp4").write_bytes(video.read_bytes()[:200])
    (tmp_path / "there" / "images").mkdir(parents=True)
    (tmp_path / "file").write_text("")
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        sound = container.add_stream("aac", rate=48000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 48000
        container.mux(sound.encode(frame))
        container.mux(sound.encode())
    for name, to, error, message in (
        ("none.mp4", "walk", ls.errors.MissingFileError, "none.mp4"),
        ("text.mp4", "walk", ls.FormatError, "text.mp4: is not a readable video"),
        ("cut.mp4", "walk", ls.FormatError, "cut.mp4: is not a readable video"),
        ("sound.mp4", "walk", ls.FormatError, "has no video stream"),
        ("a.mp4", "there", ls.FormatError, "already exists"),
        ("a.mp4", "file/walk", ls.FormatError, "cannot be written"),
    ):
        with pytest.raises(error, match=message):
            ls.io.extract_frames(tmp_path / name, tmp_path / to)
        assert not list(tmp_path.glob("walk/*"))
    for every, size in ((0.0, 100), (1.0, 3)):
        with pytest.raises(ls.ConfigError):
            ls.io.extract_frames(video, tmp_path / "walk", every=every, size=size)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ls.errors.MissingExtraError, match=r"lumisplat\[video\]"):
        ls.io.extract_frames(video, tmp_path / "walk")
