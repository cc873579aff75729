"""Layers and views as images: each value has its documented colour."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.config.render import PATH_AOVS, REALTIME_AOVS
from lumisplat.frame.layers import layer_pictures
from lumisplat.math.color import decode_srgb, encode_srgb
from support.files.image_files import read_image
from support.scenes.lit_frames import ball_frame

BLUE = (0.09, 0.13, 0.32)


OF_ALL_PIPELINES = ("normal", "depth", "index", "shadow", "hits", "transmittance")
"""Views that this file tests in all pipelines; tests of real-time frames cover the other views."""


@pytest.fixture(scope="module")
def frame() -> ls.Frame:
    """Returns a frame of the ball on the floor with all images."""
    return ball_frame()


def oklab(srgb: np.ndarray) -> np.ndarray:
    """Converts to Ottosson's perceptual colour space, (..., 3)."""
    cone = [[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566]]
    cone.append([0.0883024619, 0.2817188376, 0.6299787005])
    lab = [[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099]]
    lab.append([0.0259040371, 0.7827717662, -0.8086757660])
    return np.cbrt(decode_srgb(srgb) @ np.array(cone).T) @ np.array(lab).T


@pytest.mark.parametrize("view", OF_ALL_PIPELINES)
def test_each_view_of_a_frame_has_values_from_0_to_1_and_is_saved_unchanged(
    frame: ls.Frame, view: str, tmp_path: Path
) -> None:
    """Each view has the image's size, lies in 0..1, is not empty, and is saved unchanged."""
    picture = frame.view(view)
    assert picture.shape == (27, 48, 3) and picture.dtype == np.float32
    assert picture.min() >= 0.0 and picture.max() <= 1.0 and picture.std() > 0.05
    frame.save_view(tmp_path / "a.png", view)
    np.testing.assert_array_equal(
        read_image(tmp_path / "a.png")["srgb"], np.floor(picture * 255.0 + 0.5).astype(np.uint8)
    )


def test_heat_map_of_the_transmittance_view_is_perceptually_uniform(frame: ls.Frame) -> None:
    """Equal steps of transmittance are equal steps of perceived colour, with rising brightness."""
    alpha = np.linspace(1.0, 0.0, 33, dtype=np.float32)[None]
    colors = oklab(replace(frame, alpha=alpha).view("transmittance")[0].astype(np.float64))
    steps = np.linalg.norm(np.diff(colors, axis=0), axis=1)
    assert steps.max() < 1.3 * steps.min()
    assert (np.diff(colors[:, 0]) > 0.0).all()


def test_depth_view_runs_from_red_to_blue_over_the_depth_range(frame: ls.Frame) -> None:
    """The default range is that of the frame; with one range, equal depths have equal colours in all frames."""
    near, far = frame.view_limits("depth")
    surface = np.isfinite(frame.depth)
    assert frame.depth[surface].min() <= near < far <= frame.depth[surface].max()
    picture = frame.view("depth", (2.0, 14.0))
    depth = np.array([[2.0, 14.0, 8.0, 1.0, np.inf]], np.float32)
    other = replace(frame, depth=depth).view("depth", (2.0, 14.0))
    assert other[0, 0, 0] > 2.0 * other[0, 0, 2] and other[0, 1, 2] > other[0, 1, 0]
    np.testing.assert_array_equal(other[0, 3], other[0, 0])
    np.testing.assert_array_equal(other[0, 4], 0.0)
    same = np.unravel_index(np.argmin(np.abs(frame.depth - 8.0)), frame.depth.shape)
    np.testing.assert_allclose(picture[same], other[0, 2], atol=0.05)


def test_views_of_a_frame_without_surfaces_are_black_except_the_shadow_view(frame: ls.Frame) -> None:
    """Views of surfaces are black, and the view of shadows has the colour of pixels that no light reaches."""
    empty = replace(
        frame,
        depth=np.full_like(frame.depth, np.inf),
        normal=np.zeros_like(frame.normal),
        gaussian_index=np.full_like(frame.gaussian_index, -1),
        instance_index=np.full_like(frame.instance_index, -1),
        hits=np.zeros_like(frame.depth),
        light_direct=np.zeros((0, 27, 48, 3), np.float32),
        light_shadow=np.zeros((0, 27, 48, 3), np.float32),
        light_names=(),
    )
    for view in ("normal", "depth", "index", "hits"):
        np.testing.assert_array_equal(empty.view(view), 0.0)
    np.testing.assert_allclose(empty.view("shadow"), np.broadcast_to(BLUE, (27, 48, 3)), atol=1e-6)
    assert not layer_pictures(empty, "position")["position"].any()
    assert not layer_pictures(empty, "lights")


def test_shadow_view_averages_shadows_of_all_lights_weighted_by_brightness(frame: ls.Frame) -> None:
    """For lights of brightness 3 and 1, a half shadow of the brighter one leaves five eighths; no light is blue."""
    direct = np.zeros((2, 1, 4, 3), np.float32)
    shadow = np.ones_like(direct)
    direct[0, 0, :2], direct[1, 0, :2] = 3.0, 1.0
    direct[0, 0, 2] = (1.0, 0.0, 0.0)
    direct[1, 0, 2] = (0.0, 1.0, 0.0)
    shadow[0, 0, 1] = 0.5
    shadow[0, 0, 2] = 0.0
    picture = replace(frame, alpha=np.ones((1, 4), np.float32), light_direct=direct, light_shadow=shadow).view("shadow")
    expected = [[1.0] * 3, [0.625] * 3, [0.7152 / (0.7152 + 0.2126)] * 3, BLUE]
    np.testing.assert_allclose(picture[0], expected, atol=1e-6)


def test_view_of_hit_counts_has_a_fixed_logarithmic_colour_scale(frame: ls.Frame) -> None:
    """Each doubling of 1 + hits is an equal step on a fixed scale; zero hits are black."""
    hits = np.array([[0.0, 1.0, 3.0, 15.0, 255.0, 9000.0]], np.float32)
    picture = replace(frame, hits=hits).view("hits")[0]
    shares = np.array([[1.0, 2.0, 4.0, 8.0, 8.0]]) / 8.0
    heat = replace(frame, alpha=(1.0 - shares).astype(np.float32)).view("transmittance")[0]
    np.testing.assert_array_equal(picture[0], 0.0)
    np.testing.assert_allclose(picture[1:], heat, atol=1e-5)
    assert frame.view_limits("hits") == (0.0, 255.0)
    np.testing.assert_allclose(replace(frame, hits=hits).view("hits", (0.0, 15.0))[0, 3], heat[3], atol=1e-5)


def test_index_views_give_each_index_a_fixed_and_distinct_colour(frame: ls.Frame) -> None:
    """Neighbouring indices differ in colour, a Gaussian has one colour in every frame, and meshes differ as well."""
    gaussian = np.array([[0, 1, 0, -1, -1, -1]], np.int32)
    instance = np.array([[0, 0, 1, 2, 3, -1]], np.int32)
    picture = replace(frame, gaussian_index=gaussian, instance_index=instance).view("index")[0]
    assert len(np.unique(picture, axis=0)) == 6
    distance = np.abs(picture[:, None] - picture[None]).sum(axis=2) + 9.0 * np.eye(6)
    assert distance.min() > 0.15
    np.testing.assert_array_equal(picture[5], 0.0)


def test_exposure_applies_to_views_of_light_and_not_to_views_of_albedo(frame: ls.Frame) -> None:
    """Light is exposed and sRGB-encoded, albedo is not exposed, and shadows are linear."""
    bright = ball_frame(exposure=1.0)
    assert frame.reflection is not None and frame.albedo is not None and frame.light_shadow is not None
    expected = encode_srgb(np.minimum(2.0 * frame.reflection, 1.0))
    np.testing.assert_allclose(layer_pictures(bright, "reflection")["reflection"], expected, atol=1e-6)
    np.testing.assert_allclose(layer_pictures(bright, "albedo")["albedo"], encode_srgb(frame.albedo), atol=1e-6)
    lights = layer_pictures(bright, "lights")
    np.testing.assert_array_equal(lights["light.key.shadow"], frame.light_shadow[0])
    assert list(lights) == ["light.key.direct", "light.key.shadow", "light.1.direct", "light.1.shadow"]


def test_position_view_scales_coordinates_to_their_range(frame: ls.Frame) -> None:
    """Red follows x, green y and blue z, over the range of the frame."""
    picture = layer_pictures(frame, "position")["position"]
    surface = np.isfinite(frame.depth)
    for axis in range(3):
        values, colors = frame.position[surface][:, axis], picture[surface][:, axis]
        assert colors[values.argmin()] == 0.0 and colors[values.argmax()] == 1.0
        assert (np.diff(colors[values.argsort()]) >= 0.0).all()
    assert not picture[~surface].any()


def test_every_layer_of_a_frame_can_be_viewed(frame: ls.Frame) -> None:
    """Every layer of the frame can be shown; NaN is black."""
    layers = [
        layer for layer in ls.Frame.LAYERS if layer not in (*PATH_AOVS, *REALTIME_AOVS, "shadow_ratio", "shadow_matte")
    ]
    for layer in layers:
        for picture in layer_pictures(frame, layer).values():
            assert picture.shape == (27, 48, 3) and picture.dtype == np.float32
            assert picture.min() >= 0.0 and picture.max() <= 1.0 and picture.any()
    spoiled = replace(frame, emission=np.full_like(frame.normal, np.nan))
    assert not layer_pictures(spoiled, "emission")["emission"].any()


def test_saving_unknown_views_or_extensions_is_refused(frame: ls.Frame, tmp_path: Path) -> None:
    """The error for an unknown view lists the views, that for an extension the right one; no file is written."""
    with pytest.raises(ls.ConfigError, match="unknown view 'shadows', expected one of normal, depth"):
        frame.view("shadows")
    with pytest.raises(ls.ConfigError, match="unknown view 'x'"):
        frame.view("x", (0.0, 1.0))
    with pytest.raises(ls.ConfigError, match="unknown view"):
        frame.view_limits("alpha")
    with pytest.raises(ls.FormatError, match=r"expected \.png"):
        frame.save_view(tmp_path / "a.exr", "depth")
    assert not list(tmp_path.iterdir())
