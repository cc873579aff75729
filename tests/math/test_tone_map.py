"""Tone mapping: published curves, and captured colours that stay as captured."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.config import ToneMap
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.tone_map import apply_tone_map, captured_radiance, lit_picture, remove_tone_map

MAPS = list(ToneMap)


def random_colors(count: int, seed: int = 1) -> np.ndarray:
    """Returns N radiance values over twelve stops, shape (N, 3): saturated, grey, dark and far brighter than white."""
    rng = np.random.default_rng(seed)
    return (2.0 ** rng.uniform(-8.0, 4.0, (count, 1)) * rng.uniform(0.0, 1.0, (count, 3))).astype(np.float32)


def neutral_inverse(mapped: np.ndarray) -> np.ndarray:
    """Inverts the tone mapping function of Khronos PBR Neutral's specification, derived by hand, in float64."""
    f90, start, fade = 0.04, 0.76, 0.15
    peak_out = mapped.max(axis=-1, keepdims=True)
    bright = peak_out > start
    peak = np.where(bright, (1.0 - start) ** 2 / (1.0 - np.where(bright, peak_out, 0.0)) - 1.0 + 2.0 * start, peak_out)
    g = 1.0 / (fade * (peak - peak_out) + 1.0)
    color = np.where(bright, (mapped - peak_out * (1.0 - g)) / g * peak / peak_out, mapped)
    least = color.min(axis=-1, keepdims=True)
    toe = np.where(least < f90, np.sqrt(4.0 * f90 * np.maximum(least, 0.0)) - least, f90)
    return color + toe


def agx_with_polynomial(linear: np.ndarray) -> np.ndarray:
    """Computes AgX as Filament and three.js publish it, with a polynomial for the curve, in float64 sRGB."""
    to_rec2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0113], [0.0164, 0.0880, 0.8956]])
    to_rec709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
    inset = np.array(
        [
            [0.856627153315983, 0.0951212405381588, 0.0482516061458583],
            [0.137318972929847, 0.761241990602591, 0.101439036467562],
            [0.11189821299995, 0.0767994186031903, 0.811302368396859],
        ]
    )
    outset = np.array(
        [
            [1.1271005818144368, -0.11060664309660323, -0.016493938717834573],
            [-0.1413297634984383, 1.157823702216272, -0.016493938717834257],
            [-0.14132976349843826, -0.11060664309660294, 1.2519364065950405],
        ]
    )
    stops = np.log2(np.maximum(linear @ to_rec2020.T @ inset.T, 1e-10))
    x = np.clip((stops + 12.47393) / (4.026069 + 12.47393), 0.0, 1.0)
    curve = np.polynomial.Polynomial([-0.00232, 0.1191, 0.4298, -6.868, 31.96, -40.14, 15.5])
    display = np.maximum(curve(x) @ outset.T, 0.0) ** 2.2 @ to_rec709.T
    return encode_srgb(np.clip(display, 0.0, 1.0))


def test_neutral_tone_map_is_inverted_by_the_inverse_that_khronos_published() -> None:
    """The inverse of Khronos's function maps every result back to its input."""
    colors = random_colors(4000).astype(np.float64)
    back = neutral_inverse(decode_srgb(apply_tone_map(colors, ToneMap.NEUTRAL).astype(np.float64)))
    error = np.abs(back - colors) / colors.max(axis=1, keepdims=True)
    assert error.max() < 1e-3


@pytest.mark.parametrize(
    ("color", "expected"),
    [
        ((0.5, 0.5, 0.5), (0.46, 0.46, 0.46)),
        ((0.08, 0.4, 0.8), (0.04, 0.36, 0.76)),
        ((0.04, 0.3, 0.2), (0.01, 0.27, 0.17)),
        ((0.0, 0.3, 0.2), (0.0, 0.3, 0.2)),
        ((1.0, 1.0, 1.0), (0.8690909, 0.8690909, 0.8690909)),
        ((1.72, 0.04, 0.04), (0.9507692, 0.0999663, 0.0999663)),
    ],
)
def test_neutral_tone_map_matches_values_computed_by_hand(
    color: tuple[float, ...], expected: tuple[float, ...]
) -> None:
    """Between 0.08 and 0.8, 0.04 is subtracted; white and red match values computed by hand."""
    np.testing.assert_allclose(apply_tone_map(color, ToneMap.NEUTRAL), encode_srgb(np.array(expected)), atol=1e-5)


def test_agx_tone_map_is_within_0_006_of_the_published_polynomial() -> None:
    """The published polynomial deviates from the exact curve by up to 0.006, measured before the power of 2.2."""
    colors = random_colors(4000)
    error = np.abs(decode_srgb(apply_tone_map(colors, ToneMap.AGX)) - decode_srgb(agx_with_polynomial(colors)))
    assert error.max() < 0.018 and error.mean() < 0.003


def test_agx_tone_map_matches_values_computed_by_hand() -> None:
    """Middle grey maps to 0.5 before the display's power of 2.2; 6.5 stops above is white, 10 below is black."""
    grey = np.array([0.18 * 2.0**-10, 0.18, 0.18 * 2.0**6.5])[:, None] * np.ones(3)
    expected = encode_srgb(np.array([0.0, 0.5**2.2, 1.0]))
    np.testing.assert_allclose(apply_tone_map(grey, ToneMap.AGX), expected[:, None] * np.ones(3), atol=2e-3)


@pytest.mark.parametrize("tone_map", MAPS)
def test_tone_maps_are_monotonic_along_the_grey_axis(tone_map: ToneMap) -> None:
    """Along the greys no channel decreases by more than rounding, and greys stay grey."""
    greys = np.linspace(0.0, 20.0, 5001)[:, None] * np.ones(3)
    mapped = apply_tone_map(greys, tone_map)
    assert np.diff(mapped, axis=0).min() > -2e-6
    assert np.ptp(mapped, axis=1).max() < 2e-4
    assert mapped[0].max() < 1e-3 and mapped[-1].min() > 0.99


@pytest.mark.parametrize("tone_map", MAPS)
def test_tone_maps_give_a_finite_colour_for_any_light(tone_map: ToneMap) -> None:
    """Zero, negative, tiny, huge and infinite light give finite colours in 0..1; only NaN stays NaN."""
    values = np.array([0.0, -1.0, 1e-45, 1e-20, 1.0, 1e20, 3e38, np.inf], np.float32)
    colors = np.stack(np.meshgrid(values, values, values), axis=-1)
    with np.errstate(all="raise", under="ignore"):
        mapped = apply_tone_map(colors, tone_map)
    assert mapped.dtype == np.float32
    assert ((mapped >= 0.0) & (mapped <= 1.0)).all()
    assert np.isnan(apply_tone_map(np.full(3, np.nan), tone_map)).all()


def test_tone_map_none_encodes_colours_by_the_srgb_curve() -> None:
    """Colours up to white are sRGB-encoded; brighter ones are white."""
    colors = random_colors(1000)
    expected = encode_srgb(np.minimum(colors, 1.0))
    np.testing.assert_allclose(apply_tone_map(colors, ToneMap.NONE), expected, atol=1e-6)


def pixels(count: int, seed: int = 2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns premultiplied captured colours, their weights, and light of up to half of the captured radiance."""
    rng = np.random.default_rng(seed)
    weight = rng.uniform(0.0, 1.0, count)
    weight[: count // 2] = 1.0
    captured = (rng.uniform(0.0, 1.0, (count, 3)) * weight[:, None]).astype(np.float32)
    light = rng.uniform(-0.5, 0.5, (count, 3)) * captured_radiance(captured, weight)
    return captured, weight, light.astype(np.float32)


@pytest.mark.parametrize("tone_map", MAPS)
def test_tone_mapping_leaves_captures_without_light_unchanged_to_the_bit(tone_map: ToneMap) -> None:
    """Without light, the result is the captured colour, also above 1."""
    captured = random_colors(1000)
    weight = np.float32(1.0) - np.random.default_rng(1).uniform(0.0, 2e-6, 1000).astype(np.float32)
    np.testing.assert_array_equal(lit_picture(captured, weight, 0.0 * captured, 0.0, tone_map), captured)


@pytest.mark.parametrize("tone_map", MAPS)
def test_tone_mapped_image_is_continuous_as_light_on_a_capture_tends_to_zero(tone_map: ToneMap) -> None:
    """As light tends to zero, the image tends to the captured one, so that lit regions have no visible border."""
    captured, weight, light = pixels(2000)
    dark = captured_radiance(captured, weight)
    before = encode_srgb(dark)
    for share in (1e-2, 1e-3, 1e-4):
        shown = lit_picture(captured, weight, share * light, 0.0, tone_map)
        # The light is at most half of the captured radiance, and the slope of the sRGB curve at most 12.92.
        assert np.abs(shown - before).max() < 3.0 * share + 1e-5


@pytest.mark.parametrize("tone_map", MAPS)
def test_added_light_never_darkens_a_tone_mapped_capture(tone_map: ToneMap) -> None:
    """Channels that gain light are never darker than captured, channels that lose light never brighter.

    The law holds for white, too, which every tone mapper maps darker than a capture shows it.
    """
    captured, weight, light = pixels(4000)
    before = encode_srgb(captured_radiance(captured, weight))
    for scale in (0.1, 1.0, 10.0):
        shown = lit_picture(captured, weight, scale * light, 0.0, tone_map)
        assert (shown - before)[light > 0.0].min() > -1e-6
        assert (shown - before)[light < 0.0].max() < 1e-6


@pytest.mark.parametrize("tone_map", MAPS)
def test_capture_under_much_brighter_light_is_tone_mapped_like_any_other_surface(tone_map: ToneMap) -> None:
    """Without a capture, or where light is much brighter than the capture, the image is that of the tone mapper."""
    light = random_colors(1000)
    none = np.zeros_like(light)
    np.testing.assert_allclose(
        lit_picture(none, none[:, 0], light, 0.0, tone_map), apply_tone_map(light, tone_map), atol=1e-6
    )
    dim = np.full_like(light, 0.05)
    bright = 1.0 + light
    shown = lit_picture(dim, np.ones(1000), bright, 0.0, tone_map)
    np.testing.assert_allclose(shown, apply_tone_map(bright + decode_srgb(dim), tone_map), atol=2e-3)


@pytest.mark.parametrize("tone_map", MAPS)
def test_more_light_on_a_grey_capture_is_never_darker_after_tone_mapping(tone_map: ToneMap) -> None:
    """Over any captured grey, more grey light is never darker, from full shadow to far beyond white."""
    for grey in (0.02, 0.2, 0.5, 0.8, 1.0):
        radiance = decode_srgb(np.full(3, grey))
        light = np.linspace(-1.0, 8.0, 2001)[:, None] * radiance
        shown = lit_picture(np.full((2001, 3), grey), np.ones(2001), light, 0.0, tone_map)
        assert np.diff(shown[:, 0]).min() > -1e-6, grey


@pytest.mark.parametrize("tone_map", MAPS)
def test_exposure_of_one_stop_doubles_light_before_the_tone_map(tone_map: ToneMap) -> None:
    """One stop doubles light before the tone mapper; captures brighten along a curve of display values."""
    light = random_colors(500)
    none = np.zeros_like(light)
    shown = lit_picture(none, none[:, 0], light, 1.0, tone_map)
    np.testing.assert_allclose(shown, apply_tone_map(2.0 * light, tone_map), atol=1e-6)
    captured = np.full((1, 3), 0.25, np.float32)
    shown = lit_picture(captured, np.ones(1), np.zeros((1, 3)), 1.0, tone_map)
    np.testing.assert_allclose(shown, encode_srgb(2.0 * decode_srgb(captured)), atol=1e-6)
    for exposure in (-4000.0, 4000.0):
        assert np.isfinite(lit_picture(captured, np.ones(1), np.ones((1, 3)), exposure, tone_map)).all()


def test_captured_colour_of_a_partly_covered_pixel_is_divided_by_alpha_before_decoding() -> None:
    """Half a pixel of a captured colour has half of its radiance, not the radiance of half its code value."""
    captured = np.array([[0.4, 0.2, 0.1], [0.0, 0.0, 0.0]])
    radiance = captured_radiance(captured, np.array([0.5, 0.0]))
    np.testing.assert_allclose(radiance[0], 0.5 * decode_srgb(np.array([0.8, 0.4, 0.2])), atol=1e-7)
    np.testing.assert_array_equal(radiance[1], 0.0)


@pytest.mark.parametrize(
    ("tone_map", "brightest"), [(ls.ToneMap.NONE, 0.99), (ls.ToneMap.NEUTRAL, 6.0), (ls.ToneMap.AGX, 4.0)]
)
def test_remove_tone_map_inverts_apply_tone_map(tone_map, brightest):
    """The inverse holds for all hues from dark to bright that the display can show."""
    rng = np.random.default_rng(3)
    light = rng.random((2000, 3)) ** 2 * brightest + 0.01
    light *= rng.random((2000, 1)) * 0.9 + 0.1
    shown = apply_tone_map(light, tone_map).astype(np.float64)
    inside = ((shown > 0.02) & (shown < 0.99)).all(axis=1)
    assert inside.mean() > 0.5
    back = remove_tone_map(shown, tone_map)
    # Errors are relative to the brightest channel, because tone maps mix channels and flatten near black and white.
    brightest = light.max(axis=1, keepdims=True)
    np.testing.assert_allclose((back / brightest)[inside], (light / brightest)[inside], atol=1e-3)


@pytest.mark.parametrize("tone_map", ls.ToneMap)
def test_remove_tone_map_is_finite_for_black_white_and_saturated_colours(tone_map):
    """Black, white and saturated colours are inverted to finite, non-negative numbers."""
    ends = np.array([[0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 1, 1]], np.float64)
    back = remove_tone_map(ends, tone_map)
    assert np.isfinite(back).all() and (back >= 0.0).all()
