"""MP4 videos: frames, colours, sizes and rates are read back; files are complete or absent."""

from __future__ import annotations

import sys
from fractions import Fraction

import av
import numpy as np
import pytest

import lumisplat as ls
from support.kinds import present


def decoded(path) -> tuple[list[np.ndarray], av.VideoStream]:
    """Decodes the frames as RGB bytes. Also returns the stream, which keeps its file open, as PyAV 19 needs."""
    container = av.open(str(path))
    stream = container.streams.video[0]
    return [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)], stream


def patches(width: int = 64, height: int = 48) -> np.ndarray:
    """Returns a frame of four flat colours."""
    frame = np.zeros((height, width, 3))
    colors = [[1, 0, 0], [0, 0.5, 0], [0.1, 0.2, 0.9], [0.75, 0.75, 0.75]]
    for index, color in enumerate(colors):
        frame[:, index * width // 4 : (index + 1) * width // 4] = color
    return frame


def test_mp4_video_preserves_colours(tmp_path):
    """Flat colours are within two steps of 255, so matrix and range match their tags."""
    ls.save_animation(tmp_path / "a.mp4", [patches()] * 3, fps=25)
    frames, stream = decoded(tmp_path / "a.mp4")
    for column in (8, 24, 40, 56):
        np.testing.assert_allclose(frames[1][24, column], 255 * patches()[24, column], atol=2.5)
    coding = stream.codec_context
    assert (coding.colorspace, coding.color_primaries, coding.color_trc, coding.color_range) == (1, 1, 1, 1)
    assert (coding.name, stream.pix_fmt) == ("h264", "yuv420p")


@pytest.mark.parametrize(("fps", "exact"), [(24, Fraction(24)), (12.5, Fraction(25, 2)), (29.97, Fraction(2997, 100))])
def test_frame_number_n_of_an_mp4_video_is_shown_at_exactly_n_over_fps_seconds(tmp_path, fps, exact):
    """All frames are present and in order."""
    ramp = [np.full((32, 32, 3), level) for level in np.linspace(0.1, 0.9, 9)]
    ls.save_animation(tmp_path / "a.mp4", iter(ramp), fps=fps)
    frames, stream = decoded(tmp_path / "a.mp4")
    assert stream.average_rate == exact
    assert present(stream.duration) * present(stream.time_base) == 9 / exact
    levels = [frame.mean() / 255 for frame in frames]
    assert levels == pytest.approx(np.linspace(0.1, 0.9, 9).tolist(), abs=0.01)


def test_mp4_frames_of_odd_size_are_padded_to_even_size(tmp_path):
    """The last row and column are repeated."""
    ls.save_animation(tmp_path / "a.mp4", [patches(63, 47)] * 2, fps=25)
    frames, _ = decoded(tmp_path / "a.mp4")
    assert frames[0].shape == (48, 64, 3)
    np.testing.assert_allclose(frames[0][-1, -1], 255 * 0.75, atol=3)


def test_failed_write_of_an_mp4_video_keeps_the_old_file(tmp_path):
    """If a frame fails, no new file is left behind."""
    (tmp_path / "old.mp4").write_bytes(b"as before")

    def failing():
        yield patches()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ls.save_animation(tmp_path / "old.mp4", failing())
    with pytest.raises(ls.SceneError, match="frames of one shape"):
        ls.save_animation(tmp_path / "new.mp4", [patches(), patches(32, 32)])
    assert [path.name for path in tmp_path.iterdir()] == ["old.mp4"]
    assert (tmp_path / "old.mp4").read_bytes() == b"as before"


def test_save_animation_refuses_invalid_mp4_arguments(tmp_path, monkeypatch):
    """Errors are no frames, transparent frames, rates out of range, an unwritable folder and a missing package."""
    with pytest.raises(ls.SceneError, match="got none"):
        ls.save_animation(tmp_path / "a.mp4", [])
    with pytest.raises(ls.SceneError, match=r"got \(4, 4, 4\)"):
        ls.save_animation(tmp_path / "a.mp4", [np.zeros((4, 4, 4))])
    with pytest.raises(ls.ConfigError, match="fps is 1000"):
        ls.save_animation(tmp_path / "a.mp4", [patches()], fps=1000)
    with pytest.raises(ls.FormatError, match="cannot be written"):
        ls.save_animation("/proc/a.mp4", [patches()])
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ls.errors.MissingExtraError, match=r"a video needs .* pip install 'lumisplat\[video\]'"):
        ls.save_animation(tmp_path / "a.mp4", [patches()])
    assert not list(tmp_path.iterdir())
