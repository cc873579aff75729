"""Image files: rounding, clamping, channel names, complete files or none."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.arrays import write_npz
from lumisplat.io.images.exr import Channel, read_exr, write_deep_exr, write_exr
from lumisplat.io.images.texture import decode_texture, read_texture, write_png
from support.files.image_files import read_image
from support.files.mesh_files import TEXELS, png_bytes
from support.files.small_disks import small_disk


@pytest.mark.parametrize("channels", [3, 4])
def test_image_value_n_over_255_is_written_to_png_as_byte_n(tmp_path: Path, channels: int) -> None:
    """Every byte n of an RGB or RGBA image is written and read back."""
    expected = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(channels, axis=2)
    if channels == 4:
        expected[0, 0, 3] = 7
    write_png(tmp_path / "a.png", expected / np.float32(255))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")["srgb"], expected)


def test_written_png_rounds_half_up_and_clamps_to_0_and_1(tmp_path: Path) -> None:
    """Infinite values become 0 or 1."""
    values = np.array([[0.5, 1.5, 2.5], [-3.0, np.inf, -np.inf]]) / 255.0
    values[1, 0] = -3.0
    write_png(tmp_path / "a.png", values[:, None])
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")["srgb"][:, 0], [(1, 2, 3), (0, 255, 0)])


def test_nan_pixels_are_written_to_png_as_0_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One log line counts the NaN values."""
    pixels = np.ones((2, 2, 3))
    pixels[0, 1, :2] = np.nan
    with caplog.at_level(logging.WARNING, "lumisplat"):
        write_png(tmp_path / "a.png", pixels)
    assert "2 NaN" in caplog.text
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")["srgb"][0, 1], (0, 0, 255))


def test_exr_round_trip_keeps_channel_names_and_bits(tmp_path: Path) -> None:
    """Names that Nuke groups into layers, 32-bit values, infinite depth, and -1 as the largest id are preserved."""
    rng = np.random.default_rng(1)
    names = ["R", "G", "B", "A", "depth.Z", "normal.X", "normal.Y", "normal.Z"]
    channels: dict[str, Channel] = {name: rng.normal(size=(5, 7)).astype(np.float32) for name in names}
    channels["depth.Z"][0, 0] = np.inf
    channels["index.gaussian"] = np.arange(-1, 34, dtype=np.int32).reshape(5, 7)
    write_exr(tmp_path / "a.exr", channels, {"lumisplat/camera": "front"})
    loaded = read_image(tmp_path / "a.exr")
    assert sorted(loaded) == sorted(channels)
    for name in names:
        np.testing.assert_array_equal(loaded[name], channels[name])
    assert loaded["index.gaussian"].dtype == np.uint32
    np.testing.assert_array_equal(loaded["index.gaussian"].astype(np.int32), channels["index.gaussian"])


def test_written_exr_is_one_zip_compressed_part_with_metadata(tmp_path: Path) -> None:
    """The metadata are attributes of the OpenEXR header."""
    import OpenEXR

    write_exr(tmp_path / "a.exr", {"R": np.zeros((2, 2), np.float32)}, {"camera": "front"})
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        assert len(file.parts) == 1
        assert file.header()["camera"] == "front"
        assert file.header()["compression"] == OpenEXR.ZIP_COMPRESSION


def test_npz_round_trip_keeps_names_types_and_values_of_arrays(tmp_path: Path) -> None:
    """A float32 colour and an int32 index are written."""
    arrays = {"color": np.ones((2, 3, 3), np.float32), "gaussian_index": np.full((2, 3), -1, np.int32)}
    write_npz(tmp_path / "a.npz", arrays)
    loaded = read_image(tmp_path / "a.npz")
    for name, array in arrays.items():
        np.testing.assert_array_equal(loaded[name], array)
        assert loaded[name].dtype == array.dtype


@pytest.mark.parametrize("pixels", [np.zeros((4, 4)), np.zeros((0, 4, 3)), np.zeros((2, 2, 2))])
def test_image_writers_refuse_invalid_shapes_before_creating_a_file(tmp_path: Path, pixels: np.ndarray) -> None:
    """Greyscale, empty and two-channel arrays are refused, and so are channels of different shapes."""
    with pytest.raises(SceneError, match="must have shape"):
        write_png(tmp_path / "a.png", pixels)
    with pytest.raises(SceneError, match="one shape"):
        write_exr(tmp_path / "a.exr", {"R": np.zeros((2, 2)), "G": np.zeros((2, 3))})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("extension", ["png", "exr", "npz"])
def test_image_writers_report_an_unwritable_folder_and_leave_no_file(tmp_path: Path, extension: str) -> None:
    """The folder's path belongs to a file; the error names the output."""
    (tmp_path / "out").write_text("in the way")
    path = tmp_path / "out" / f"a.{extension}"
    image = np.zeros((2, 2, 3), np.float32)
    write = {
        "png": lambda: write_png(path, image),
        "exr": lambda: write_exr(path, {"R": image[..., 0]}),
        "npz": lambda: write_npz(path, {"color": image}),
    }
    with pytest.raises(FormatError, match="cannot be written"):
        write[extension]()
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize("is_deep", [False, True])
def test_exr_write_on_a_full_disk_keeps_the_old_file(tmp_path: Path, is_deep: bool) -> None:
    """The error has the system's reason, and the partial file is removed."""
    noise = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    with small_disk(tmp_path / "disk", "8k") as disk:
        path = disk / "a.exr"
        write_exr(path, {"R": np.zeros((4, 4), np.float32)})
        with pytest.raises(FormatError, match=r"a\.exr: cannot be written: No space left on device$"):
            if is_deep:
                write_deep_exr(path, (64, 64), np.arange(64 * 64 + 1), {"A": noise.ravel()})
            else:
                write_exr(path, {"R": noise})
        assert os.listdir(disk) == ["a.exr"] and read_exr(path)["R"].shape == (4, 4)


def test_failed_png_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No temporary file stays."""
    from PIL import Image

    write_png(tmp_path / "a.png", np.ones((2, 2, 3)))
    before = (tmp_path / "a.png").read_bytes()

    def fail(self: Image.Image, where: Path, **_: object) -> None:
        Path(where).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(FormatError, match="No space left"):
        write_png(tmp_path / "a.png", np.zeros((2, 2, 3)))
    assert (tmp_path / "a.png").read_bytes() == before
    assert os.listdir(tmp_path) == ["a.png"]


@pytest.mark.parametrize(("name", "read"), [("a.png", read_texture), ("a.exr", read_exr)])
def test_error_for_an_image_file_that_cannot_be_decoded_names_the_file(
    tmp_path: Path, name: str, read: Callable[[Path], object]
) -> None:
    """PNG and EXR readers raise one FormatError."""
    (tmp_path / name).write_bytes(b"\x93not an image at all" * 9)
    with pytest.raises(FormatError, match=name):
        read(tmp_path / name)


@pytest.mark.parametrize(
    ("mode", "expected"),
    [("RGB", (255, 0, 0)), ("L", (76, 76, 76)), ("P", (255, 0, 0)), ("I;16", (76, 76, 76)), ("RGBA", (255, 0, 0, 255))],
)
def test_grey_palette_and_16_bit_textures_become_8_bit_rgb(mode: str, expected: tuple) -> None:
    """Transparent images become RGBA; 16-bit values are scaled, not clamped."""
    import io

    from PIL import Image

    image = Image.fromarray(TEXELS[:1, :1])
    if mode == "I;16":
        image = Image.fromarray(np.array([[76 * 257]], np.uint16))
    stream = io.BytesIO()
    (image if mode == "I;16" else image.convert(mode)).save(stream, "PNG")
    np.testing.assert_array_equal(decode_texture(stream.getvalue(), "a.glb", "images[0]")[0, 0], expected)


def test_small_image_that_claims_huge_dimensions_is_refused() -> None:
    """The refusal comes before memory is allocated."""
    claimed = bytearray(png_bytes())
    claimed[16:24] = (60_000).to_bytes(4, "big") * 2
    import zlib

    claimed[29:33] = zlib.crc32(bytes(claimed[12:29])).to_bytes(4, "big")
    with pytest.raises(FormatError, match="too large"):
        decode_texture(bytes(claimed), "a.glb", "images[0]")


def test_texture_loading_never_starts_other_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """For an EPS named as a PNG, Pillow would run Ghostscript on an untrusted program."""
    from PIL import EpsImagePlugin

    def never(*arguments: object, **options: object) -> None:
        raise AssertionError("Ghostscript was started")

    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", never)
    eps = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n{ } loop\nshowpage\n%%EOF\n"
    with pytest.raises(FormatError, match=r"t\.png: is corrupt, or not an image"):
        decode_texture(eps, "t.png")
