"""SPZ: versions, axes, flags and fixed-point range."""

from __future__ import annotations

import gzip
import itertools
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import zstandard

import lumisplat as ls
from lumisplat.errors import FormatError
from lumisplat.io.splats.columns import columns_from_gaussians, mirror_axes
from lumisplat.io.splats.spz import position_bits
from support.files.splat_files import capture, legacy_spz, load_gaussians

COORDINATES = 0xADBE0003


def v4(path: Path, flags: int, extensions: bytes) -> Path:
    """Writes a version 4 file with other flags, and extension records before the table of contents."""
    ls.save(path, capture(20, degree=2))
    data = bytearray(path.read_bytes())
    data[14] |= flags
    data[16:20] = struct.pack("<I", 32 + len(extensions))
    path.write_bytes(data[:32] + extensions + data[32:])
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("states_sizes", [True, False])
def test_spz_gzip_and_zstd_containers_load_as_the_same_capture(tmp_path: Path, degree: int, states_sizes: bool) -> None:
    """The same sections are one gzip stream, or zstd streams with or without a stated size."""
    old = legacy_spz(capture(100, degree), 3)
    (tmp_path / "3.spz").write_bytes(old)
    (tmp_path / "4.spz").write_bytes(as_version_4(old, states_sizes))
    ours, theirs = load_gaussians(tmp_path / "3.spz"), load_gaussians(tmp_path / "4.spz")
    for field in ("means", "rotations_wxyz", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))


def as_version_4(old: bytes, states_sizes: bool = True) -> bytes:
    """Converts a version 3 file to version 4, with its sections as zstd streams."""
    content = gzip.decompress(old)
    magic, _, count, degree, bits, flags, _ = struct.unpack_from("<IIIBBBB", content)
    sizes = [size * count for size in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)) if size]
    ends = list(itertools.accumulate(sizes, initial=16))
    pack = zstandard.ZstdCompressor(write_content_size=states_sizes).compress
    streams = [pack(content[start:end]) for start, end in itertools.pairwise(ends)]
    toc = b"".join(struct.pack("<QQ", len(s), size) for s, size in zip(streams, sizes, strict=True))
    header = struct.pack("<IIIBBBBI12x", magic, 4, count, degree, bits, flags, len(sizes), 32)
    return header + toc + b"".join(streams)


TWO = ls.Gaussians(
    means=[[0.25, 1.5, -3.0001], [-7.125, 0.0, -1.75]],
    rotations_wxyz=[[0.5, -0.5, -0.5, -0.5001], [0.1, 0.2, 0.9, -0.37]],
    scales=[[0.01, 0.2, 1.5], [3e-5, 0.5, 40.0]],
    opacities=[0.3, 0.95],
    sh=[
        [[0.7, -1.2, 3.6], [-0.5, 0.25, -0.99], [1.2, -0.004, -0.1], [0.3, 0.3, -0.6]],
        [[-3.4, 0.01, 0.0], [0, 0, 0], [-1, 1, -0.5], [0.11, 0.12, 0.13]],
    ],
)

SECTIONS_OF_TWO = (
    "00100000a0ff02c0000038fe000000007000",
    "4df2",
    "9a52ff008080",
    "5686a60095db",
    "69a595b648321c69",
    "c060ff00818da6a633808080ff00c08e8f91",
)
"""Sections that gsply 0.4.6 wrote for `TWO`, mirrored to RUB by hand, with 14 fractional bits."""


def test_written_spz_sections_equal_those_of_gsply(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Header and sections of a file with two Gaussians are equal byte by byte."""
    monkeypatch.setattr("lumisplat.io.splats.spz.position_bits", lambda path, largest: 14)
    ls.save(tmp_path / "two.spz", TWO)
    data = (tmp_path / "two.spz").read_bytes()
    assert data[:32].hex() == "4e4753500400000002000000010e0006" + "20000000" + 12 * "00"
    start = 32 + 6 * 16
    for expected, (packed, size) in zip(SECTIONS_OF_TWO, struct.iter_unpack("<QQ", data[32:start]), strict=True):
        section = zstandard.ZstdDecompressor().decompress(data[start : start + packed])
        assert (section.hex(), size) == (expected, len(section))
        start += packed
    assert start == len(data)


def test_spz_stores_positions_in_right_up_back_axes(tmp_path: Path) -> None:
    """The reader of gsply 0.4.6 returns y and z of `TWO` negated: down and forward are negative in RUB."""
    (tmp_path / "two.spz").write_bytes(
        as_version_4(
            gzip.compress(
                struct.pack("<IIIBBBB", 0x5053474E, 3, 2, 1, 14, 0, 0) + bytes.fromhex("".join(SECTIONS_OF_TWO))
            )
        )
    )
    loaded = load_gaussians(tmp_path / "two.spz")
    np.testing.assert_array_equal(loaded.means, [[0.25, 1.5, -3.0001220703125], [-7.125, 0.0, -1.75]])
    quaternions = [
        [0.49954116, -0.49954116, -0.49954116, -0.501374],
        [-0.09963148, -0.20064673, -0.90126818, 0.37085053],
    ]
    np.testing.assert_allclose(loaded.rotations_wxyz, quaternions, atol=1e-7)
    np.testing.assert_allclose(np.log(loaded.scales), [[-4.625, -1.625, 0.375], [-10.0, -0.6875, 3.6875]], rtol=1e-6)
    np.testing.assert_allclose(loaded.opacities, [77 / 255, 242 / 255], rtol=1e-6)
    np.testing.assert_allclose(loaded.sh[0, 0], [0.692810595, -1.189542413, 3.333333254], rtol=1e-6)
    np.testing.assert_allclose(
        loaded.sh[0, 1:], [[-0.5, 0.25, -0.9921875], [1.0, -0.0078125, -0.1015625], [0.296875, 0.296875, -0.6015625]]
    )


def damaged_stream(path: Path, stream: int, replacement: bytes, states: int | None = None) -> Path:
    """Replaces one stream of a version 4 file; the table of contents still states the old size."""
    ls.save(path, capture(50, degree=1))
    data = path.read_bytes()
    toc = [list(entry) for entry in struct.iter_unpack("<QQ", data[32 : 32 + 6 * 16])]
    ends = list(itertools.accumulate((packed for packed, _ in toc), initial=32 + 6 * 16))
    streams = [data[start:end] for start, end in itertools.pairwise(ends)]
    streams[stream] = replacement
    toc[stream] = [len(replacement), toc[stream][1] if states is None else states]
    path.write_bytes(data[:32] + b"".join(struct.pack("<QQ", *entry) for entry in toc) + b"".join(streams))
    return path


@pytest.mark.parametrize("states_size", [True, False])
def test_spz_zstd_bombs_are_refused_before_they_fill_memory(tmp_path: Path, states_size: bool) -> None:
    """A stream that unpacks to a gigabyte is refused in one line."""
    packer = zstandard.ZstdCompressor(level=1, write_content_size=states_size)
    stream = packer.compressobj(size=2**28 if states_size else -1)
    bomb = b"".join([*(stream.compress(bytes(2**23)) for _ in range(32)), stream.flush()])
    path = damaged_stream(tmp_path / "bomb.spz", 2, bomb)
    tracemalloc.start()
    with pytest.raises(
        FormatError, match=r"its colours (unpack to 268,435,456 bytes, expected 150|cannot be unpacked)"
    ):
        ls.load(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(bomb) < 2**16
    assert peak < 2**22


@pytest.mark.parametrize(
    ("stream", "states", "message"),
    [
        (b"", None, "its alphas cannot be unpacked"),
        (b"no zstd", None, "its alphas cannot be unpacked"),
        (zstandard.compress(bytes(49)), None, "its alphas unpack to 49 bytes, expected 50"),
        (zstandard.ZstdCompressor(write_content_size=False).compress(bytes(49)), None, "unpack to 49 bytes"),
        (zstandard.compress(bytes(50))[:-1], None, "its alphas cannot be unpacked"),
        (zstandard.compress(bytes(51)), 51, "its streams do not hold 50 Gaussians"),
    ],
)
def test_damaged_spz_stream_is_named_by_the_error(
    tmp_path: Path, stream: bytes, states: int | None, message: str
) -> None:
    """A stream may be invalid, too short or too long."""
    with pytest.raises(FormatError, match=message):
        ls.load(damaged_stream(tmp_path / "a.spz", 1, stream, states))


def test_spz_checksums_detect_changed_bytes(tmp_path: Path) -> None:
    """Written streams have checksums, so no changed byte is decoded to Gaussians."""
    ls.save(tmp_path / "a.spz", capture(50, degree=1))
    data = (tmp_path / "a.spz").read_bytes()
    for position in range(32 + 6 * 16 + 20, len(data), 37):
        (tmp_path / "b.spz").write_bytes(data[:position] + bytes([data[position] ^ 0x10]) + data[position + 1 :])
        with pytest.raises(FormatError, match="damaged"):
            ls.load(tmp_path / "b.spz")


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("flag", [0, 1])
def test_spz_antialiased_flag_is_bit_0_in_all_versions(tmp_path: Path, version: int, flag: int) -> None:
    """Versions 1 to 3 have the same flags."""
    (tmp_path / "a.spz").write_bytes(legacy_spz(capture(5), version, flags=flag))
    assert load_gaussians(tmp_path / "a.spz").antialiased is bool(flag)


@pytest.mark.parametrize("container", ["v2", "v4"])
@pytest.mark.parametrize(
    ("number", "signs"),
    [
        (0, (1, -1, -1)),
        (1, (-1, 1, -1)),
        (2, (1, 1, -1)),
        (3, (-1, -1, -1)),
        (4, (1, -1, -1)),
        (5, (-1, 1, 1)),
        (6, (1, 1, 1)),
        (7, (-1, -1, 1)),
        (8, (1, -1, 1)),
    ],
)
def test_spz_axes_extension_mirrors_the_capture(
    tmp_path: Path, container: str, number: int, signs: tuple[int, int, int]
) -> None:
    """LDB, RDB, LUB, RUB, LDF, RDF, LUF, RUF are 1 to 8, and the default is RUB; unknown records are skipped."""
    record = struct.pack("<II3s", 0x12340001, 3, b"abc") + struct.pack("<III", COORDINATES, 4, number)
    path = tmp_path / "axes.spz"
    if container == "v4":
        v4(path, flags=2, extensions=b"")
        mirrored_means = load_gaussians(path).means
        v4(path, flags=2, extensions=record)
    else:
        path.write_bytes(legacy_spz(capture(20), 2))
        mirrored_means = load_gaussians(path).means
        path.write_bytes(legacy_spz(capture(20), 2, flags=2, extensions=record))
    np.testing.assert_array_equal(load_gaussians(path).means, mirrored_means * (1, -1, -1) * signs)


def test_spz_axes_with_exchanged_y_and_z_are_refused(tmp_path: Path) -> None:
    """Axes with exchanged y and z cannot be converted by mirroring."""
    path = v4(tmp_path / "rfu.spz", flags=2, extensions=struct.pack("<III", COORDINATES, 4, 16))
    with pytest.raises(FormatError, match="SPZ_ADOBE_coordinate_system 16"):
        ls.load(path)


@pytest.mark.parametrize("largest", [1e-6, 0.01, 1.0, 31.9, 32.0, 100.0, 2047.9, 2048.0, 1e5, 4e6])
def test_number_of_fractional_bits_of_spz_positions_suits_the_largest_coordinate(largest: float) -> None:
    """Coordinates fit 24 bits, with steps of at most 2^-17 of the largest one, or 12 fractional bits."""
    bits = position_bits("a.spz", largest)
    assert 1 <= bits <= 24
    assert round(largest * 2**bits) <= 2**23
    assert bits >= 12 or largest * 2 ** (bits + 1) >= 2**23 - 1
    assert bits == 24 or 2.0**-bits <= max(largest * 2**-16, 2**-12 if largest < 2048 else np.inf)


@pytest.mark.parametrize("size", [0.01, 30.0, 5000.0, 1e6])
def test_spz_positions_are_precise_in_small_and_large_scenes(tmp_path: Path, size: float) -> None:
    """At any scale, positions are preserved to 2^-16 of the scene's size."""
    base = capture(50)
    means = base.means / np.abs(base.means).max() * size
    ls.save(tmp_path / "a.spz", ls.Gaussians(means, base.rotations_wxyz, base.scales, base.opacities, base.sh))
    np.testing.assert_allclose(load_gaussians(tmp_path / "a.spz").means, means, rtol=0, atol=size * 2**-16)


def test_saving_spz_clamps_extreme_scales_and_sh_and_logs_their_number(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The limits are e^-10 and e^5.94 for scales, 3.33 for SH degree 0, -1 and 1 for other SH."""
    base = capture(4)
    scales, sh = base.scales.copy(), base.sh.copy()
    scales[0], scales[1, 2], scales[2] = 1e-7, 4.4e-5, 1e4
    sh[3, 1:] = 5.0
    sh[:2, 0] = [[4.0, 0.0, 0.0], [0.0, 0.0, -4.0]]
    ls.save(tmp_path / "a.spz", ls.Gaussians(base.means, base.rotations_wxyz, scales, base.opacities, sh))
    loaded = load_gaussians(tmp_path / "a.spz")
    np.testing.assert_allclose(np.log(loaded.scales)[[0, 2]], [[-10] * 3, [255 / 16 - 10] * 3], rtol=1e-6)
    np.testing.assert_allclose(loaded.sh[3, 1:], 1.0, atol=1 / 128)
    np.testing.assert_allclose([loaded.sh[0, 0, 0], loaded.sh[1, 0, 2]], [0.5 / 0.15, -0.5 / 0.15], rtol=1e-5)
    thin, wide, bright, sharp = (record.message for record in caplog.records)
    assert "a.spz: 2 of 4 Gaussians have scales below 4.5e-05" in thin
    assert "a.spz: 1 of 4 Gaussians have scales above 379" in wide
    assert "a.spz: 2 of 4 Gaussians have a colour too bright or too dark" in bright
    assert "a.spz: 1 of 4 Gaussians have SH coefficients outside -1..1" in sharp


def test_positions_beyond_the_range_of_spz_are_refused(tmp_path: Path) -> None:
    """Clamping such positions would destroy the capture."""
    base = capture(2)
    far = ls.Gaussians(base.means * 1e7, base.rotations_wxyz, base.scales, base.opacities, base.sh)
    with pytest.raises(FormatError, match="is beyond 4,194,304, the largest of SPZ"):
        ls.save(tmp_path / "far.spz", far)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ((0, "I"), 7, "no NGSP header"),
        ((4, "I"), 9, "version 9"),
        ((8, "I"), 0, "zero Gaussians"),
        ((8, "I"), 2**32 - 1, "would take"),
        ((12, "B"), 4, "SH degree 4"),
        ((13, "B"), 60, "60 fractional bits"),
    ],
)
@pytest.mark.parametrize("container", ["v3", "v4"])
def test_error_for_an_spz_header_field_out_of_range_names_the_field(
    tmp_path: Path, container: str, field: tuple[int, str], value: int, message: str
) -> None:
    """Both the gzip and the zstd container are checked."""
    path = tmp_path / "a.spz"
    if container == "v4":
        ls.save(path, capture(20))
        data = bytearray(path.read_bytes())
    else:
        data = bytearray(gzip.decompress(legacy_spz(capture(20), 3)))
    offset, kind = field
    struct.pack_into(f"<{kind}", data, offset, value)
    path.write_bytes(bytes(data) if container == "v4" else gzip.compress(bytes(data)))
    if container == "v4" and offset == 0:
        message = "neither gzip nor NGSP"
    with pytest.raises(FormatError, match=message):
        ls.load(path)


@pytest.mark.data
def test_downloaded_biker_capture_is_equal_as_spz_and_as_compressed_ply(data_dir: Path) -> None:
    """Positions agree to half a step of 12 bits and of the PLY, and so do rotations, colours and opacities."""
    spz, ply = (load_gaussians(data_dir / "splats" / name) for name in ("biker.spz", "biker.compressed.ply"))
    np.testing.assert_allclose(spz.means, ply.means, rtol=0, atol=2**-13 + 1e-6)
    np.testing.assert_allclose(spz.opacities, ply.opacities, rtol=0, atol=2e-6)
    np.testing.assert_allclose(spz.sh, ply.sh, rtol=0, atol=1 / (2 * 255 * 0.15) + 1e-5)
    inside = np.log(ply.scales) > -10.0  # the smallest scale of SPZ
    np.testing.assert_allclose(np.log(spz.scales)[inside], np.log(ply.scales)[inside], rtol=0, atol=1 / 32 + 1e-5)
    cosines = np.abs(np.einsum("ij,ij->i", spz.rotations_wxyz, ply.rotations_wxyz))
    assert cosines.min() > 1 - 6e-6  # the rounding of both formats, as in tests of round trips


@pytest.mark.data
def test_downloaded_biker_spz_and_ply_agree_only_if_no_axis_is_mirrored(data_dir: Path) -> None:
    """All eight combinations of mirrored axes are tried."""
    spz, ply = (load_gaussians(data_dir / "splats" / name) for name in ("biker.spz", "biker.compressed.ply"))
    agreeing = []
    for signs in itertools.product((1, -1), (1, -1), (1, -1)):
        other = mirror_axes(columns_from_gaussians(spz), signs)
        cosines = np.abs(np.einsum("ij,ij->i", other.rotations_wxyz, ply.rotations_wxyz))
        if np.abs(other.means - ply.means).max() < 1e-3 and cosines.min() > 0.999:
            agreeing.append(signs)
    assert agreeing == [(1, 1, 1)]
