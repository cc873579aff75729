"""Lazy frames, whose images are downloaded when first read as on a GPU, simulated on the CPU."""

from __future__ import annotations

import copy
import gc
import pickle
import threading
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.frame.frame_data import unpremultiplied
from lumisplat.io.images.texture import to_bytes
from lumisplat.math.tone_map import lit_picture
from lumisplat.renderer.film.picture import encoded_lit_pixels, encoded_pixels, picture_data, picture_of
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.downloads import DeviceCopies, Downloads
from lumisplat.runtime.launcher import Launcher
from support.compare.graph_launcher import GraphLauncher
from support.scenes.lit_scene import ENVIRONMENT, LIGHTS, camera, config, scene

ALL_AOVS = ("albedo", "emission", "reflection", "lights", "hits")
SETTINGS = {
    "unlit": config(ls.Pipeline.RASTER, lighting=False),
    "unlit rays": config(lighting=False, aovs=("hits",)),
    "lit": config(ls.Pipeline.HYBRID, samples=1, aovs=ALL_AOVS),
    "transparent": config(ls.Pipeline.RASTER, lighting=False, background=None),
}


def lazy_renderer(settings: ls.RenderConfig, launcher: Launcher | None = None) -> ls.Renderer:
    """Returns a renderer that downloads lazily, as on a GPU."""
    renderer = ls.Renderer(settings, launcher or GraphLauncher())
    renderer._buffers.downloads = Downloads(is_lazy=True)
    return renderer


def eager_frame(settings: ls.RenderConfig, view: ls.Camera) -> ls.Frame:
    """Returns the frame as a CPU downloads it."""
    return ls.Renderer(settings, Launcher("cpu", parallel=True)).render(scene(*LIGHTS, ENVIRONMENT), view)


def other_camera() -> ls.Camera:
    """Returns another camera of the same size."""
    return ls.Camera.look_at((0.9, 1.1, -2.0), (0.0, 0.25, 0.7), width=48, height=32, fov_y=0.8)


def unread(frame: ls.Frame) -> set[str]:
    """Returns the names of images that have not been downloaded."""
    return set(frame._fetches()) - {"picture"}


def assert_same(frame: Any, expected: ls.Frame) -> None:
    """Checks that all images are equal."""
    for field in fields(expected):
        value = getattr(expected, field.name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(frame, field.name), value, field.name)
            assert getattr(frame, field.name).dtype == value.dtype
    for name, words in (expected.accumulated or {}).items():
        np.testing.assert_array_equal(frame.accumulated[name].view(np.uint32), words.view(np.uint32), name)
    assert frame.light_names == expected.light_names
    assert frame.color_space == expected.color_space


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS.keys())
def test_frame_whose_images_are_not_yet_downloaded_is_not_changed_by_later_frames(settings: ls.RenderConfig) -> None:
    """The images of the frame waited on the device or were downloaded when later frames needed the memory."""
    renderer, shown = lazy_renderer(settings), scene(*LIGHTS, ENVIRONMENT)
    views = [camera(), other_camera()] * 3
    frames = [renderer.render(shown, view) for view in views]
    assert unread(frames[0]) and not unread(frames[-1])
    for frame, view in reversed(list(zip(frames, views, strict=True))):
        assert_same(frame, eager_frame(settings, view))
        assert not unread(frame)


def test_images_of_a_frame_stay_on_the_device_until_they_are_read() -> None:
    """The repr and the list of layers of the frame do not download images, either."""
    frame = lazy_renderer(SETTINGS["lit"]).render(scene(*LIGHTS, ENVIRONMENT), camera())
    everything = unread(frame)
    assert {"color", "depth", "albedo", "light_shadow", "captured", "hits"} <= everything
    assert "lit" in repr(frame) and frame.has("light")
    assert unread(frame) == everything
    assert frame.depth is frame.depth
    assert everything - unread(frame) == {"depth"}
    frame.layers(["normal"])
    assert {"albedo", "light_shadow", "hits", "gaussian_index"} <= unread(frame)


def test_copied_and_pickled_lazy_frames_have_all_images() -> None:
    """Frames are pickled, copied and deep-copied before their images are read."""
    expected = eager_frame(SETTINGS["lit"], camera())
    for duplicate in (lambda frame: pickle.loads(pickle.dumps(frame)), copy.copy, copy.deepcopy):
        frame = lazy_renderer(SETTINGS["lit"]).render(scene(*LIGHTS, ENVIRONMENT), camera())
        assert_same(duplicate(frame), expected)


def test_unknown_attributes_of_lazy_frames_raise_attribute_errors() -> None:
    """Lazy and eager frames raise the error of any Python object."""
    for frame in (lazy_renderer(SETTINGS["unlit"]).render(scene(), camera()), eager_frame(SETTINGS["unlit"], camera())):
        with pytest.raises(AttributeError, match=r"'Frame' object has no attribute 'colour'"):
            frame.colour  # pyright: ignore[reportAttributeAccessIssue, reportUnknownMemberType]  # noqa: B018


def test_device_memory_of_a_lazy_frame_is_reused_once_it_is_read_or_dropped() -> None:
    """Memory is returned when a frame is dropped, or when all of its images have been read."""
    renderer = lazy_renderer(SETTINGS["lit"])
    downloads = renderer._buffers.downloads
    frame = renderer.render(scene(*LIGHTS), camera())
    assert downloads.lent == {"host": 0, "device": 1}
    for name in unread(frame):
        getattr(frame, name)
    assert downloads.lent == {"host": 1, "device": 0}
    del frame
    gc.collect()
    assert downloads.lent == {"host": 0, "device": 0}
    memory = [renderer.render(scene(*LIGHTS), camera()).stats for _ in range(3)]
    assert len({stats.memory_bytes for stats in memory if stats}) == 1


def test_lazy_frames_with_unread_images_can_be_resumed() -> None:
    """The images are uploaded again."""
    settings = config(ls.Pipeline.HYBRID, samples=2)
    renderer, shown = lazy_renderer(settings), scene(*LIGHTS, ENVIRONMENT)
    resumed = renderer.render(shown, camera(), resume=renderer.render(shown, camera()))
    eager = ls.Renderer(settings, Launcher("cpu", parallel=True))
    assert_same(resumed, eager.render(shown, camera(), resume=eager.render(shown, camera())))


def test_several_threads_can_read_a_lazy_frame_concurrently() -> None:
    """Six threads read all images."""
    frame, expected = (
        lazy_renderer(SETTINGS["lit"]).render(scene(*LIGHTS, ENVIRONMENT), camera()),
        eager_frame(SETTINGS["lit"], camera()),
    )
    problems: list[BaseException] = []

    def read() -> None:
        try:
            assert_same(frame, expected)
        except BaseException as problem:
            problems.append(problem)

    threads = [threading.Thread(target=read) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not problems


# --- Encoded bytes ---


def pictures(color: np.ndarray, alpha: np.ndarray, *, transparent: bool) -> tuple[np.ndarray | None, np.ndarray]:
    """Encodes an unlit frame to bytes, on the device and on the host."""
    launcher, buffers = Launcher("cpu", parallel=True), Buffers("cpu")
    pixels = PixelBuffers.of(buffers, (color.shape[1], color.shape[0]))
    shape = alpha.shape
    index = np.zeros(shape, np.int32)
    images = {"color": color, "alpha": alpha, "depth": alpha, "normal": color, "gaussian": index, "instance": index}
    pixels.upload(images)
    encoded = encoded_pixels(launcher, buffers, pixels, transparent=transparent)
    copies = Downloads().copies({"picture": encoded})
    picture = picture_of(copies, "picture", pixels.size, transparent=transparent)()
    view = ls.Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), width=shape[1], height=shape[0])
    background = None if transparent else (0.0, 0.0, 0.0)
    frame = ls.Frame(color, alpha, alpha, color, index, index, camera=view, background=background)
    return picture, np.asarray(frame, dtype=np.uint8)


@pytest.mark.parametrize("transparent", [False, True])
def test_device_and_host_encode_a_frame_to_the_same_8_bit_image(transparent: bool) -> None:
    """The bytes are equal next to rounding edges, beyond 0..1, and for alpha of 0 or nearly 0."""
    rng = np.random.default_rng(4)
    edges = ((np.arange(256) + 0.5) / 255.0).astype(np.float32)
    for _ in range(3):
        edges = np.concatenate([edges, np.nextafter(edges, np.float32(2.0)), np.nextafter(edges, np.float32(-1.0))])
    values = np.concatenate([edges, rng.uniform(-0.5, 1.5, 60_000).astype(np.float32), [1e30, -1e30, 0.0, -0.0, 1e-40]])
    color = np.resize(rng.permutation(values), (150, 200, 3)).astype(np.float32)
    alpha = rng.uniform(-0.1, 1.1, (150, 200)).astype(np.float32)
    alpha[:20] = rng.choice(np.array([0.0, 1e-6, 1.0, 1.0 - 2**-24], np.float32), (20, 200))
    picture, expected = pictures(color, alpha, transparent=transparent)
    assert picture is not None and picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, expected)


def test_frames_with_non_finite_values_are_encoded_to_8_bits_by_the_host() -> None:
    """One non-finite colour or alpha suffices; the host draws the pixel black and counts it when saving."""
    for channel, value in ((0, np.nan), (1, np.inf), (2, -np.inf)):
        color = np.full((4, 5, 3), 0.5, np.float32)
        color[2, 3, channel] = value
        assert pictures(color, np.ones((4, 5), np.float32), transparent=False)[0] is None
    assert pictures(np.ones((4, 5, 3), np.float32), np.full((4, 5), np.nan, np.float32), transparent=False)[0] is None


def lit_bytes(images: dict[str, np.ndarray], exposure: float, tone_map: ls.ToneMap, *, transparent: bool) -> Any:
    """Encodes a lit frame on the device; returns None if a pixel is not finite."""
    launcher, buffers = Launcher("cpu", parallel=True), Buffers("cpu")
    alpha = images["alpha"]
    size, index = (alpha.shape[1], alpha.shape[0]), np.zeros(alpha.shape, np.int32)
    pixels, lit = PixelBuffers.of(buffers, size), PixelBuffers.of_light(buffers, size)
    filled = {"depth": alpha, "normal": images["light"], "gaussian": index, "instance": index}
    pixels.upload({"color": images["captured"], "alpha": alpha, **filled})
    lit.upload({"captured_weight": images["captured_weight"], "light": images["light"], "color": images["light"]})
    display = picture_data(exposure, tone_map, transparent=transparent)
    copies = Downloads().copies({"picture": encoded_lit_pixels(launcher, buffers, pixels, lit, display)})
    return picture_of(copies, "picture", size, transparent=transparent)()


def random_lit_images(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Returns captured, mixed and lit pixels, dark and bright, shadowed, transparent, unlit or without capture."""
    shape = (120, 160)
    alpha = rng.choice([0.0, 1e-4, 0.3, 1.0], shape)
    weight = alpha * rng.choice([0.0, 0.2, 1.0 - 1e-6, 1.0], shape)
    captured = weight[..., None] * rng.uniform(0.0, 1.1, (*shape, 3))
    light = rng.normal(size=(*shape, 3)) * 10.0 ** rng.uniform(-4.0, 2.0, (*shape, 1))
    light[rng.random(shape) < 0.3] = 0.0
    light[0, :4] = ((1e30, 0.0, 0.0), (1e30, 1e30, 1e30), (-1e30, 0.5, 0.5), (1e-30, 1e-30, 1e-30))
    images = {"alpha": alpha, "captured_weight": weight, "captured": captured, "light": light}
    return {name: image.astype(np.float32) for name, image in images.items()}


@pytest.mark.parametrize("transparent", [False, True])
@pytest.mark.parametrize("exposure", [-2.5, 0.0, 1.0, 100.0])
@pytest.mark.parametrize("tone_map", ls.ToneMap)
def test_device_and_host_encode_lit_frames_to_8_bit_within_one_step(
    tone_map: ls.ToneMap, exposure: float, transparent: bool
) -> None:
    """Bytes differ by at most 1 next to rounding edges; purely captured pixels are equal to the bit."""
    images = random_lit_images(np.random.default_rng(int(exposure) + 9))
    captured, weight, light = (images[name] for name in ("captured", "captured_weight", "light"))
    if transparent:
        captured, weight, light = (unpremultiplied(part, images["alpha"]) for part in (captured, weight, light))
    colors = lit_picture(captured, weight, light, exposure, tone_map)
    picture = lit_bytes(images, exposure, tone_map, transparent=transparent)
    expected = to_bytes(np.concatenate([colors, images["alpha"][..., None]], axis=2), "a frame")
    assert picture is not None and picture.shape[2] == 3 + transparent
    difference = np.abs(picture.astype(int) - expected[..., : picture.shape[2]])
    assert difference.max() <= 1
    assert (difference > 0).mean() < 1e-3
    if exposure == 0.0:
        captured_only = (weight >= 1.0 - 1e-5) & (light == 0.0).all(axis=2)
        assert captured_only.sum() > 500
        np.testing.assert_array_equal(picture[captured_only], expected[captured_only][..., : picture.shape[2]])


@pytest.mark.parametrize("name", ["captured", "captured_weight", "light", "alpha"])
def test_lit_frames_with_non_finite_values_are_encoded_to_8_bits_by_the_host(name: str) -> None:
    """One non-finite value in any image of the frame suffices."""
    images = random_lit_images(np.random.default_rng(3))
    assert lit_bytes(images, 0.0, ls.ToneMap.NEUTRAL, transparent=False) is not None
    images[name][5, 7] = np.nan
    assert lit_bytes(images, 0.0, ls.ToneMap.NEUTRAL, transparent=False) is None


@pytest.mark.parametrize("name", SETTINGS.keys())
def test_lazy_frame_that_is_saved_or_shown_downloads_only_its_8_bit_image(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Saving, displaying and converting a frame to bytes downloads 4 bytes a pixel."""
    renderer, view = lazy_renderer(SETTINGS[name]), camera()
    copied: list[int] = []
    words = DeviceCopies.words

    def counting(copies: DeviceCopies, name: str, first: int = 0, count: int | None = None) -> np.ndarray:
        part = words(copies, name, first, count)
        copied.append(part.size)
        return part

    monkeypatch.setattr(DeviceCopies, "words", counting)
    frame = renderer.render(scene(*LIGHTS, ENVIRONMENT), view)
    everything = unread(frame)
    frame.save(tmp_path / "a.png")
    np.asarray(frame, dtype=np.uint8)
    frame._repr_png_()
    assert unread(frame) == everything
    assert copied == [view.width * view.height + 1]  # once
    assert_same_picture(np.asarray(frame, np.uint8), np.asarray(eager_frame(SETTINGS[name], view), np.uint8), name)


def assert_same_picture(picture: np.ndarray, expected: np.ndarray, name: str) -> None:
    """Checks that bytes are equal if unlit, and else differ by at most 1."""
    if SETTINGS[name].lighting is False:
        np.testing.assert_array_equal(picture, expected)
    assert np.abs(picture.astype(int) - expected).max() <= 1


def test_writing_to_the_colours_of_a_lazy_frame_changes_its_8_bit_image() -> None:
    """The bytes that the device encoded earlier are discarded."""
    frame = lazy_renderer(SETTINGS["unlit"]).render(scene(*LIGHTS, ENVIRONMENT), camera())
    before = np.asarray(frame, dtype=np.uint8)
    frame.color[...] = 0.25
    frame.alpha[...] = 1.0
    after = np.asarray(frame, dtype=np.uint8)
    np.testing.assert_array_equal(after[..., :3], 64)
    assert (before[..., :3] != 64).any()


@pytest.mark.parametrize("kind", ["png", "exr", "npz"])
@pytest.mark.parametrize("name", SETTINGS.keys())
def test_lazy_and_eager_frames_save_equal_files(name: str, kind: str, tmp_path: Path) -> None:
    """Files are equal byte by byte; 8-bit images of lit frames differ by at most 1."""
    frame = lazy_renderer(SETTINGS[name]).render(scene(*LIGHTS, ENVIRONMENT), camera())
    lazy, eager = tmp_path / f"lazy.{kind}", tmp_path / f"eager.{kind}"
    frame.save(lazy)
    eager_frame(SETTINGS[name], camera()).save(eager)
    if name == "lit" and kind == "png":
        assert_same_picture(np.asarray(Image.open(lazy)), np.asarray(Image.open(eager)), name)
    else:
        assert lazy.read_bytes() == eager.read_bytes()


def test_writing_to_the_light_of_a_lazy_frame_changes_its_8_bit_image() -> None:
    """The bytes that the device encoded earlier are discarded."""
    frame = lazy_renderer(SETTINGS["lit"]).render(scene(*LIGHTS, ENVIRONMENT), camera())
    before = np.asarray(frame, dtype=np.uint8)
    assert frame.light is not None
    frame.light[...] = 100.0
    assert (np.asarray(frame, dtype=np.uint8) > before).mean() > 0.5


@pytest.mark.parametrize("name", ["unlit", "unlit rays", "lit", "transparent"])
def test_cpu_renderer_with_the_option_encode_returns_frames_with_their_8_bit_image(name: str) -> None:
    """With ``encode``, the frame contains its bytes, which equal those encoded later."""
    renderer = ls.Renderer(SETTINGS[name], Launcher("cpu", threads=3))
    plain = renderer.render(scene(*LIGHTS, ENVIRONMENT), camera())
    encoded = renderer.render(scene(*LIGHTS, ENVIRONMENT), camera(), encode=True)
    assert "picture" not in plain._fetches() and "picture" in encoded._fetches()
    assert encoded._picture().dtype == np.uint8
    difference = np.abs(np.asarray(encoded, np.uint8).astype(int) - np.asarray(plain, np.uint8))
    assert difference.max() <= (name == "lit")
    np.testing.assert_array_equal(encoded.color, plain.color)
