"""Radiance images: the encodings of Radiance HDR, OpenEXR, and one-line errors for other files."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from PIL import Image

import lumisplat as ls
from lumisplat.io.images.radiance import decode_hdr
from support.files.hdr_files import HEADER, hdr_bytes, radiance, write_exr
from support.files.mesh_files import TEXELS, png_bytes


def pixels(seed: int, height: int = 5, width: int = 40, levels: int = 256) -> np.ndarray:
    """Returns RGBE bytes with runs, none equal to a marker of the encodings, shape (H, W, 4)."""
    rng = np.random.default_rng(seed)
    rgbe = np.repeat(rng.integers(2, levels, (height, width, 4)), 4, axis=1)[:, rng.integers(0, 4) :][:, :width]
    rgbe[..., 0] |= 4
    rgbe[0, 0, 3] = 0
    return rgbe.astype(np.uint8)


def load(tmp_path: Path, data: bytes) -> np.ndarray:
    """Writes the bytes to an .hdr file, and loads it."""
    (tmp_path / "a.hdr").write_bytes(data)
    return ls.io.load_radiance(tmp_path / "a.hdr")


@pytest.mark.parametrize("encoding", ["flat", "old", "new"])
def test_all_three_hdr_encodings_decode_to_equal_pixels(tmp_path: Path, encoding: str) -> None:
    """Pixels are mantissa times 2^(exponent - 136), and 0 where the exponent is 0."""
    rgbe = pixels(1)
    image = load(tmp_path, hdr_bytes(rgbe, encoding))
    np.testing.assert_array_equal(image, radiance(rgbe))
    assert image.dtype == np.float32 and not image.flags.writeable
    assert not image[0, 0].any() and image[1:].any()


@given(
    width=st.one_of(st.integers(1, 300), st.just(1000)),
    height=st.integers(1, 4),
    seed=st.integers(0, 1000),
    encoding=st.sampled_from(["flat", "old", "new"]),
)
def test_run_length_encoded_hdr_pixels_are_decoded_exactly(width: int, height: int, seed: int, encoding: str) -> None:
    """Runs have every length, across the limits of 127, 128 and 255."""
    if encoding == "new" and width < 8:
        encoding = "flat"
    rgbe = pixels(seed, height, width, levels=8)
    if seed % 3 == 0:
        rgbe[:] = rgbe[0, 0] | 2
    np.testing.assert_array_equal(decode_hdr("a.hdr", hdr_bytes(rgbe, encoding)), radiance(rgbe))


def test_rows_of_one_hdr_may_have_different_encodings(tmp_path: Path) -> None:
    """One row has runs, one is uncompressed, one has old-style repeats."""
    rgbe = pixels(2, height=3)
    parts = [hdr_bytes(rgbe[k : k + 1], name, b"", b"-") for k, name in enumerate(("new", "flat", "old"))]
    data = HEADER + b"\n-Y 3 +X 40\n" + b"".join(part[len(b"\n-\n") :] for part in parts)
    np.testing.assert_array_equal(load(tmp_path, data), radiance(rgbe))


def test_hdr_pixels_are_divided_by_exposure_and_color_correction(tmp_path: Path) -> None:
    """Every EXPOSURE and COLORCORR line of the header counts."""
    rgbe = pixels(3)
    header = HEADER + b"EXPOSURE=4\nSOFTWARE=x\nEXPOSURE= 0.5\nCOLORCORR=1 2 4\n"
    np.testing.assert_allclose(load(tmp_path, hdr_bytes(rgbe, "new", header)), radiance(rgbe) / (2.0, 4.0, 8.0))


@pytest.mark.parametrize("encoding", ["flat", "old", "new"])
def test_hdr_truncated_at_any_byte_is_refused(tmp_path: Path, encoding: str) -> None:
    """The error names the first missing row."""
    data = hdr_bytes(pixels(4, height=2, width=12), encoding)
    for size in range(1, len(data)):
        with pytest.raises(ls.FormatError) as caught:
            decode_hdr("a.hdr", data[:size])
        assert "truncated" in str(caught.value) or "resolution" in str(caught.value)
    with pytest.raises(ls.FormatError, match="truncated: the pixels end in row 1 of 2"):
        load(tmp_path, data[:-1])


GOOD = pixels(5)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (png_bytes(TEXELS), "is a PNG image with 8 bits per channel, expected .hdr or .exr"),
        (b"\xff\xd8\xff\xe0 jpeg", "is a JPEG image with 8 bits per channel, expected .hdr or .exr"),
        (b"ply\nformat ascii 1.0\n", "is neither Radiance HDR nor OpenEXR, expected .hdr or .exr"),
        (b"", "is empty"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n", "truncated: the HDR header"),
        (hdr_bytes(GOOD, header=b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n"), "has FORMAT '32-bit_rle_xyze', expected"),
        (hdr_bytes(GOOD, header=HEADER + b"EXPOSURE=0\n"), "has EXPOSURE '0', expected a positive number"),
        (hdr_bytes(GOOD, header=HEADER + b"EXPOSURE=bright\n"), "has EXPOSURE 'bright', expected"),
        (hdr_bytes(GOOD, header=HEADER + b"EXPOSURE=nan\n"), "has EXPOSURE 'nan', expected"),
        (hdr_bytes(GOOD, resolution=b"+Y 5 +X 40"), r"is stored as '\+Y 5 \+X 40', expected '-Y height \+X width'"),
        (hdr_bytes(GOOD, resolution=b"+X 40 -Y 5"), r"is stored as '\+X 40 -Y 5'"),
        (hdr_bytes(GOOD, resolution=b"-Y 5 -X 40"), r"is stored as '-Y 5 -X 40'"),
        (hdr_bytes(GOOD, resolution=b"5 by 40"), "has the resolution '5 by 40'"),
        (hdr_bytes(GOOD, resolution=b"-Y 0 +X 40"), "has no pixels: 40 x 0"),
        (hdr_bytes(GOOD, resolution=b"-Y 900000 +X 900000"), "900000 x 900000 pixels would take .* bytes of memory"),
        (HEADER + b"\n-Y 1 +X 8\n\2\2\0\10" + b"\x90\1" * 4, "damaged: a run crosses the end of row 0"),
        (HEADER + b"\n-Y 1 +X 2\n\1\1\1\1\5\5\5\5", "damaged: a run crosses the end of row 0"),
        (HEADER + b"\n-Y 1 +X 2\n\5\5\5\5\1\1\1\7", "damaged: a run crosses the end of row 0"),
        (b"\x76\x2f\x31\x01\x02\0\0\0garbage", "damaged, or not an EXR file"),
    ],
)
def test_files_without_radiance_are_refused_as_environment_maps(tmp_path: Path, data: bytes, message: str) -> None:
    """The one-line error names the file, whatever its extension."""
    with pytest.raises(ls.FormatError, match=message) as caught:
        load(tmp_path, data)
    assert str(caught.value).startswith(f"{tmp_path / 'a.hdr'}: ")
    assert "\n" not in str(caught.value)


def test_load_radiance_has_different_errors_for_missing_files_and_for_folders(tmp_path: Path) -> None:
    """The two messages are "no such file" and "is a folder"."""
    with pytest.raises(ls.FormatError, match="no such file"):
        ls.io.load_radiance(tmp_path / "lost.exr")
    with pytest.raises(ls.FormatError, match="is a folder"):
        ls.io.load_radiance(tmp_path)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_exr_colours_may_be_half_or_float(tmp_path: Path, dtype: type) -> None:
    """Channels other than R, G and B are ignored."""
    image = np.random.default_rng(6).uniform(0.0, 9.0, (3, 5, 3)).astype(dtype)
    planes = {name: image[..., k] for k, name in enumerate("RGB")}
    write_exr(tmp_path / "a.exr", **planes, A=np.ones((3, 5), dtype))
    loaded = ls.io.load_radiance(tmp_path / "a.exr")
    np.testing.assert_array_equal(loaded, image.astype(np.float32))
    assert loaded.dtype == np.float32 and loaded.flags.c_contiguous and not loaded.flags.writeable


PLANE = np.ones((3, 5), np.float32)


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({"Y": PLANE}, "has no channel R nor G nor B, only Y: expected R, G and B"),
        ({"R": PLANE, "G": PLANE, "depth.Z": PLANE}, "has no channel B, only "),
        ({name: PLANE.astype(np.uint32) for name in "RGB"}, r"has R, G and B as uint32 \(3, 5\), .* expected half"),
    ],
)
def test_exr_without_float_rgb_channels_is_refused(
    tmp_path: Path, channels: dict[str, np.ndarray], message: str
) -> None:
    """The error names the channels of the file."""
    write_exr(tmp_path / "a.exr", **channels)
    with pytest.raises(ls.FormatError, match=message):
        ls.io.load_radiance(tmp_path / "a.exr")


def test_truncated_exr_is_refused(tmp_path: Path) -> None:
    """The file ends within its pixels."""
    noise = np.random.default_rng(7).uniform(size=(40, 50)).astype(np.float32)
    data = write_exr(tmp_path / "a.exr", R=noise, G=noise, B=noise).read_bytes()
    (tmp_path / "a.exr").write_bytes(data[: len(data) // 2])
    with pytest.raises(ls.FormatError, match="damaged, or not an EXR file"):
        ls.io.load_radiance(tmp_path / "a.exr")


def test_negative_and_nonfinite_radiance_becomes_0_and_is_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One log line counts nonfinite and negative values; valid files log nothing."""
    plane = np.ones((2, 4), np.float32)
    bad = plane.copy()
    bad[0] = (np.nan, np.inf, -np.inf, -0.5)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        ls.io.load_radiance(write_exr(tmp_path / "good.exr", R=plane, G=plane, B=plane))
        assert not caplog.records
        image = ls.io.load_radiance(write_exr(tmp_path / "bad.exr", R=bad, G=plane, B=-plane))
    (record,) = caplog.records
    assert record.getMessage().endswith("bad.exr: values set to 0: 3 not finite, 9 negative")
    np.testing.assert_array_equal(image[0], [(0, 1, 0)] * 4)
    np.testing.assert_array_equal(image[1], [(1, 1, 0)] * 4)


def test_slightly_negative_radiance_becomes_0_without_a_log_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Filters leave small negative values beside bright lights; noticeable ones are counted as always."""
    plane = np.ones((8, 16), np.float32)
    plane[3, 4:6] = 500.0, -0.2
    with caplog.at_level(logging.WARNING, "lumisplat"):
        image = ls.io.load_radiance(write_exr(tmp_path / "a.exr", R=plane, G=plane, B=plane))
        assert (image[3, 5] == 0.0).all() and not caplog.records
        plane[3, 5] = -2.0
        ls.io.load_radiance(write_exr(tmp_path / "a.exr", R=plane, G=plane, B=plane))
    assert caplog.messages[0].endswith("a.exr: values set to 0: 3 negative")


def test_environment_light_does_not_copy_its_loaded_image(tmp_path: Path) -> None:
    """The image of the light is the loaded array."""
    image = load(tmp_path, hdr_bytes(GOOD))
    assert ls.LightEnvironment(image=image).image is image


@pytest.mark.data
def test_downloaded_environment_maps_are_read(data_dir: Path) -> None:
    """An HDR with runs and an EXR are twice as wide as high, and exceed display white somewhere."""
    for name in ("composition.hdr", "envmap3.exr"):
        image = ls.io.load_radiance(data_dir / "env" / name)
        assert image.shape[1] == 2 * image.shape[0]
        assert image.max() > 3.0 and (image >= 0.0).all()


def test_8_bit_images_are_refused_as_radiance_even_with_an_exr_extension(tmp_path: Path) -> None:
    """The content decides, so a PNG named .exr is refused."""
    Image.fromarray(TEXELS).save(tmp_path / "b.png")
    (tmp_path / "b.png").rename(tmp_path / "b.exr")
    with pytest.raises(ls.FormatError, match="is a PNG image with 8 bits per channel"):
        ls.io.load_radiance(tmp_path / "b.exr")
