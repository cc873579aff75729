"""Lit frames: derived images and files, of a frame whose images are given by formulas."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.frame.frame_data import FrameStats
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.tone_map import apply_tone_map
from support.files.image_files import read_image
from support.scenes.lit_frames import ball_frame, unlit

MAPS = list(ls.ToneMap)


def untouched(frame: ls.Frame) -> np.ndarray:
    """Returns the mask of pixels to which the formulas give a capture or the background, and no light."""
    assert frame.light is not None
    return ~frame.light.any(axis=2) & (frame.instance_index != 1)


@pytest.mark.parametrize("tone_map", MAPS)
@pytest.mark.parametrize("background", [(0.25, 0.5, 0.75), None], ids=["over grey", "transparent"])
def test_pixels_of_a_lit_frame_to_which_light_adds_nothing_equal_the_unlit_frame(
    tone_map: ls.ToneMap, background: tuple | None, tmp_path: Path
) -> None:
    """Exactly the pixels without added light have the values and PNG bytes of the unlit frame."""
    frame = ball_frame(background=background, tone_map=tone_map)
    same = untouched(frame)
    assert 0.3 < same.mean() < 0.9
    np.testing.assert_array_equal(frame.pixels_srgb()[same], unlit(frame).pixels_srgb()[same])
    frame.save(tmp_path / "lit.png")
    unlit(frame).save(tmp_path / "unlit.png")
    lit, plain = (read_image(tmp_path / name)["srgb"] for name in ("lit.png", "unlit.png"))
    np.testing.assert_array_equal(lit[same], plain[same])
    assert (lit != plain).any(axis=2)[~same].mean() > 0.5


@pytest.mark.parametrize("tone_map", MAPS)
def test_png_of_a_lit_frame_is_exposed_and_tone_mapped(tone_map: ls.ToneMap, tmp_path: Path) -> None:
    """Pixels without a capture are the tone-mapped, exposed light."""
    frame = ball_frame(tone_map=tone_map, exposure=1.5)
    assert frame.light is not None and frame.captured_weight is not None
    frame.save(tmp_path / "a.png")
    without_capture = frame.captured_weight == 0.0
    expected = np.floor(apply_tone_map(2.0**1.5 * frame.light[without_capture], tone_map) * 255.0 + 0.5)
    saved = read_image(tmp_path / "a.png")["srgb"][without_capture]
    assert without_capture.any() and np.abs(saved - expected).max() <= 1.0


def test_transparent_png_of_a_lit_frame_divides_colours_by_alpha(tmp_path: Path) -> None:
    """A half-covered pixel has the full colour and alpha one half."""
    frame = ball_frame(background=None, tone_map=ls.ToneMap.NEUTRAL)
    assert frame.light is not None and frame.captured is not None and frame.captured_weight is not None
    thin = replace(
        frame,
        alpha=0.5 * frame.alpha,
        light=0.5 * frame.light,
        captured=0.5 * frame.captured,
        captured_weight=0.5 * frame.captured_weight,
    )
    np.testing.assert_allclose(thin.pixels_srgb()[..., :3], frame.pixels_srgb()[..., :3], atol=1e-6)
    thin.save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")["srgb"][..., 3], np.where(frame.alpha > 0.0, 128, 0))


def test_premultiplied_colours_of_a_lit_frame_are_linear_without_background() -> None:
    """``premultiplied`` equals the radiance of the same frame rendered without a background."""
    over, transparent = ball_frame(), ball_frame(background=None)
    np.testing.assert_allclose(over.premultiplied(), transparent.color, atol=2e-6)
    np.testing.assert_allclose(over.straight() * over.alpha[..., None], over.premultiplied(), atol=1e-6)
    assert over.premultiplied()[over.alpha == 0.0].max() == 0.0


def test_premultiplied_colour_of_a_lit_transparent_capture_is_its_colour_times_alpha() -> None:
    """A capture of alpha 0.6 over a background keeps its colour, and 0.6 of its radiance."""
    frame = ball_frame(1, 1)
    captured = np.array([[[0.9, 0.2, 0.4]]], np.float32)
    thin = replace(
        frame,
        alpha=np.full((1, 1), 0.6, np.float32),
        captured=0.6 * captured + 0.4 * np.array([0.25, 0.5, 0.75], np.float32),
        captured_weight=np.ones((1, 1), np.float32),
        light=np.zeros((1, 1, 3), np.float32),
    )
    np.testing.assert_allclose(thin.premultiplied(), 0.6 * decode_srgb(captured), atol=1e-6)
    np.testing.assert_allclose(thin.straight(), decode_srgb(captured), atol=1e-6)
    np.testing.assert_allclose(unlit(thin).straight(), captured, atol=1e-6)
    np.testing.assert_allclose(thin.layers(())["R"], unlit(thin).layers(())["R"], atol=1e-6)


def test_exr_of_a_lit_frame_ignores_exposure_and_tone_map(tmp_path: Path) -> None:
    """RGBA is premultiplied and linear, independent of exposure and tone map; every layer has its channels."""
    frame = ball_frame(tone_map=ls.ToneMap.AGX, exposure=2.0)
    frame.save(tmp_path / "a.exr")
    channels = read_image(tmp_path / "a.exr")
    color = np.stack([channels[name] for name in "RGB"], axis=2)
    np.testing.assert_allclose(color, ball_frame(background=None).color, atol=2e-6)
    np.testing.assert_array_equal(channels["A"], frame.alpha)
    expected = {"R", "G", "B", "A", "depth.Z", "hits.Y", "sample_count.Y", "index.gaussian", "index.instance"}
    expected |= {f"{name}.{axis}" for name in ("normal", "position") for axis in "XYZ"}
    per_light = [f"light.{name}.{part}" for name in ("key", "1") for part in ("direct", "shadow")]
    expected |= {f"{name}.{c}" for name in ("albedo", "emission", "reflection", "variance", *per_light) for c in "RGB"}
    assert channels.keys() == expected
    assert frame.light_shadow is not None and frame.light_direct is not None and frame.hits is not None
    np.testing.assert_array_equal(channels["light.key.shadow.G"], frame.light_shadow[0, ..., 1])
    np.testing.assert_array_equal(channels["light.1.direct.B"], frame.light_direct[1, ..., 2])
    np.testing.assert_array_equal(channels["hits.Y"], frame.hits)
    np.testing.assert_array_equal(channels["position.Z"], frame.position[..., 2])


def test_exr_pixels_of_a_lit_frame_to_which_light_adds_nothing_equal_the_unlit_frame(tmp_path: Path) -> None:
    """Pixels without added light have the same linear channels, lit or unlit."""
    frame = ball_frame()
    lit, plain = frame.layers(()), unlit(frame).layers(())
    for name in "RGBA":
        np.testing.assert_allclose(lit[name][untouched(frame)], plain[name][untouched(frame)], atol=1e-6)


def test_layers_of_a_lit_frame_are_saved_as_images_beside_the_png(tmp_path: Path) -> None:
    """Each layer becomes an image of its name; each light becomes two."""
    ball_frame().save(tmp_path / "a.png", ["albedo", "lights", "position"])
    names = ["albedo", "light.key.direct", "light.key.shadow", "light.1.direct", "light.1.shadow", "position"]
    assert {path.name for path in tmp_path.iterdir()} == {"a.png", *(f"a.{name}.png" for name in names)}


def test_npz_file_of_a_lit_frame_stores_its_rendered_layers_and_no_others(tmp_path: Path) -> None:
    """Every image and the lights' names survive a round trip; layers that were not requested are absent."""
    frame = replace(ball_frame(), reflection=None)
    frame.save(tmp_path / "a.npz")
    arrays = read_image(tmp_path / "a.npz")
    for name in ("color", "captured", "captured_weight", "light", "albedo", "light_direct", "light_shadow", "hits"):
        np.testing.assert_array_equal(arrays[name], getattr(frame, name))
    assert arrays["light_names"].tolist() == ["key", ""]
    assert "reflection" not in arrays and "depth_z" in arrays and "position" in arrays


def test_saving_or_viewing_layers_that_were_not_rendered_is_refused(tmp_path: Path) -> None:
    """A layer or view that was not rendered is refused with the setting that adds it, and no file is written."""
    frame = replace(ball_frame(), albedo=None, light_direct=None, light_shadow=None, hits=None)
    for layer in ("albedo", "lights", "hits"):
        for name in ("a.png", "a.exr"):
            with pytest.raises(ls.ConfigError, match=rf"no '{layer}'.*RenderConfig\.aovs"):
                frame.save(tmp_path / name, [layer])
    for view, needed in (("shadow", "lights"), ("hits", "hits")):
        assert ls.Frame.NEEDS[view] == needed
        with pytest.raises(ls.ConfigError, match=f"no '{needed}'"):
            frame.save_view(tmp_path / "a.png", view)
    assert "albedo.R" not in frame.layers()
    assert not list(tmp_path.iterdir())


def test_labels_of_lights_are_unique_and_valid_in_file_and_channel_names() -> None:
    """Names of lights become unique labels that are valid in channel and file names."""
    frame = ball_frame()
    direct, shadow = np.zeros((6, 27, 48, 3), np.float32), np.ones((6, 27, 48, 3), np.float32)
    names = ("sun", "Sun", "", "a.b/../c", "\u592a\u967d", "x" * 300)
    frame = replace(frame, light_direct=direct, light_shadow=shadow, light_names=names)
    labels = {name.split(".")[1] for name in frame.layers(["lights"]) if name.startswith("light.")}
    assert labels == {"sun", "Sun_2", "2", "a_b_c", "4", "x" * 60}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["light", "captured", "captured_weight", "alpha", "color"])
def test_saving_non_finite_radiance_writes_black_and_logs_a_warning(
    value: float, field: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The warning counts non-finite pixels; PNG and EXR contain 0 for these pixels, and all others are unchanged."""
    good = ball_frame(tone_map=ls.ToneMap.AGX)
    image = np.array(getattr(good, field))
    image[20, 10:13] = value
    frame = replace(good, **{field: image})
    for name in ("a.png", "a.exr"):
        caplog.clear()
        with caplog.at_level(logging.WARNING, "lumisplat"):
            frame.save(tmp_path / name, ())
        assert [record.getMessage() for record in caplog.records] == [
            f"{tmp_path / name}: 3 pixels are not finite and are black in the file"
        ]
    good.save(tmp_path / "b.png")
    saved, expected = (np.array(read_image(tmp_path / name)["srgb"]) for name in ("a.png", "b.png"))
    expected[20, 10:13] = 0
    np.testing.assert_array_equal(saved, expected)
    channels = read_image(tmp_path / "a.exr")
    for name in "RGBA":
        assert np.isfinite(channels[name]).all() and not channels[name][20, 10:13].any()


def test_saving_non_finite_layers_logs_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A non-finite pixel in a radiance layer does not blacken the image, but is counted in the warning."""
    frame = ball_frame()
    assert frame.light_direct is not None
    direct = np.array(frame.light_direct)
    direct[1, 20, 4, 2] = np.nan
    frame = replace(frame, light_direct=direct)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        frame.save(tmp_path / "a.exr")
    assert "1 pixels are not finite" in caplog.text
    channels = read_image(tmp_path / "a.exr")
    assert channels["light.1.direct.B"][20, 4] == 0.0 and channels["B"][20, 4] > 0.0


def test_saving_a_frame_logs_discarded_samples_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Samples that the renderer left out as non-finite are reported once, when the frame is saved."""
    good = FrameStats({}, 1, 1, 0, 1, 1, 1)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        replace(ball_frame(), stats=good).save(tmp_path / "a.png")
        assert not caplog.records
        replace(ball_frame(), stats=replace(good, nonfinite_count=7)).save(tmp_path / "a.png", ["depth"])
    assert [record.getMessage() for record in caplog.records] == [
        f"{tmp_path / 'a.png'}: 7 Gaussians or samples were left out, because a value was NaN or too large for float32"
    ]


def test_colour_of_a_lit_frame_is_captured_colour_plus_light() -> None:
    """The frame from formulas obeys the renderers' rule: color = decoded captured part + light."""
    frame = ball_frame()
    plain = untouched(frame)
    np.testing.assert_allclose(encode_srgb(frame.color[plain]), unlit(frame).color[plain], atol=1e-6)
    without_capture = frame.captured_weight == 0.0
    assert frame.light is not None
    np.testing.assert_array_equal(frame.color[without_capture], frame.light[without_capture])
    np.testing.assert_allclose(frame.color[0, 0], decode_srgb(np.array([0.25, 0.5, 0.75])), atol=1e-6)
