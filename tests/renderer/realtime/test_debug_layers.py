"""Debug layers of real-time frames: history, probes and cells of the radiance cache."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.path_rooms import path_rooms, room_camera

DEBUG = ("history", "probes", "cache", "cache_cells")
LIGHT = ("direct_diffuse", "indirect_diffuse")
VIEW = room_camera(96, 72)
ROOM = path_rooms()["diffuse_area"].scene


def last_frame(frames: int, scene: ls.Scene = ROOM, **settings: object) -> ls.Frame:
    """Returns the last of ``frames`` frames, with debug layers."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, aovs=(*DEBUG, *LIGHT), **settings)  # pyright: ignore[reportArgumentType]
    renderer = ls.create_renderer(config, "cpu")
    frame = renderer.render(scene, VIEW)
    for _ in range(frames - 1):
        frame = renderer.render(scene, VIEW)
    return frame


@pytest.fixture(scope="module")
def frame() -> ls.Frame:
    """Returns a frame of the room after 24 frames."""
    return last_frame(24)


@pytest.mark.parametrize(("interval", "expected"), [(1, 3), (2, 2)])
def test_history_layer_of_realtime_frames_counts_frames_that_sampled_light(interval: int, expected: int) -> None:
    """After three frames, the history is 3; with samples in every second frame, it is 2."""
    settings = ls.RealtimeConfig(light_interval=interval, antialiasing=False)  # exact reprojection without jitter
    history = last_frame(3, max_bounces=0, realtime=settings).history
    assert history is not None
    np.testing.assert_allclose(history, expected, atol=1e-4)


def test_realtime_probes_layer_shows_a_probe_in_each_8_pixel_tile(frame: ls.Frame) -> None:
    """Every tile shows a surface, and all probes have been refreshed."""
    assert frame.probes is not None
    tiles = frame.probes.reshape(9, 8, 12, 8).max(axis=(1, 3))
    assert tiles.min() >= 1
    assert 9 * 12 <= (frame.probes >= 0).sum() <= 9 * 12 * 1.5
    assert frame.probes.max() <= 24


def test_radiance_cache_layer_has_the_mean_diffuse_light_of_the_realtime_frame(frame: ls.Frame) -> None:
    """The cache contains diffuse light of all bounces; the size of its cells follows the distance."""
    assert frame.cache is not None
    assert frame.cache_cells is not None
    assert frame.direct_diffuse is not None
    assert frame.indirect_diffuse is not None
    shown = frame.direct_diffuse + frame.indirect_diffuse
    assert frame.cache[frame.cache_cells >= 0].mean() == pytest.approx(shown[frame.cache_cells >= 0].mean(), rel=0.15)
    assert (frame.cache_cells >= 0).mean() > 0.9
    for number in np.unique(frame.cache_cells[frame.cache_cells >= 0])[::8]:
        inside = frame.cache_cells == number
        extent = np.ptp(frame.position[inside], axis=0)
        assert extent.max() <= frame.depth[inside].max() / 8.0 * 1.01


def test_realtime_debug_layers_can_be_viewed_and_saved(frame: ls.Frame, tmp_path) -> None:
    """Each debug layer has a separate image; light layers can be viewed, too."""
    pictures = {name: frame.view(name) for name in (*DEBUG, *LIGHT)}
    assert all(picture.shape == (72, 96, 3) and np.ptp(picture) > 0.2 for picture in pictures.values())
    assert frame.view_limits("history") == (0.0, 32.0)
    assert frame.probes is not None
    y, x = np.argwhere(frame.probes >= 0)[0]
    colours = frame.view("probes")[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
    assert np.ptp(colours[0, 0]) > 0.05  # drawn in colour
    cells = frame.cache_cells
    assert cells is not None
    first = cells == cells[36, 48]
    assert np.ptp(pictures["cache_cells"][first], axis=0).max() == 0.0
    frame.save(tmp_path / "a.exr", layers=DEBUG)
    for name in DEBUG:
        frame.save_view(tmp_path / f"{name}.png", name)


def test_realtime_probes_and_cache_layers_are_empty_without_bounces() -> None:
    """The layers are also empty for an empty scene."""
    for scene in (ROOM, ls.Scene(lights=ROOM.lights)):
        frame = last_frame(1, scene, max_bounces=0, lighting=True)
        assert frame.probes is not None
        assert frame.cache is not None
        assert frame.cache_cells is not None
        assert frame.probes.max() == frame.cache_cells.max() == -1
        assert frame.cache.max() == 0.0


@pytest.mark.parametrize("pipeline", ["raster", "trace", "hybrid", "path"])
def test_realtime_debug_layers_are_refused_in_other_pipelines(pipeline: str) -> None:
    """The error names the real-time pipeline."""
    config = ls.RenderConfig(pipeline=ls.Pipeline(pipeline), lighting=True, aovs=("history", "cache"))
    with pytest.raises(ls.ConfigError, match=r"has no cache, history among its aovs: Pipeline\.REALTIME does"):
        ls.render(ROOM, VIEW, config, device="cpu")
