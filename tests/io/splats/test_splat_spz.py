"""SPZ: its versions, axes, flags and fixed-point range."""

from __future__ import annotations

import gzip
import itertools
import struct
from pathlib import Path

import gsply_cpp
import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError
from lumisplat.io.splats.axes import mirror_axes
from lumisplat.io.splats.columns import columns_from_gaussians
from lumisplat.io.splats.spz import position_bits
from support.files.splat_files import capture, legacy_spz, load_gaussians

COORDINATES = 0xADBE0003


def v4(path: Path, flags: int, extensions: bytes) -> Path:
    """A version 4 file with other flags, and extension records before the table of contents."""
    ls.save(path, capture(20, degree=2))
    data = bytearray(path.read_bytes())
    data[14] |= flags
    data[16:20] = struct.pack("<I", 32 + len(extensions))
    path.write_bytes(data[:32] + extensions + data[32:])
    return path


@pytest.mark.parametrize("degree", [0, 3])
def test_gzip_and_zstd_containers_agree(tmp_path: Path, degree: int) -> None:
    """The same content as version 3, which we decode, and as version 4, which gsply decodes, is the same capture."""
    c = columns_from_gaussians(capture(100, degree))
    rest = np.ascontiguousarray(c.sh[:, 1:]) if degree else None
    arrays = [np.ascontiguousarray(a) for a in (c.means, c.log_scales, c.rotations_wxyz, c.opacities, c.sh[:, 0])]
    for version in (3, 4):
        gsply_cpp.write_spz(str(tmp_path / f"{version}.spz"), *arrays, rest, version=version)
    ours, theirs = load_gaussians(tmp_path / "3.spz"), load_gaussians(tmp_path / "4.spz")
    np.testing.assert_array_equal(ours.means, theirs.means)
    np.testing.assert_allclose(ours.rotations_wxyz, theirs.rotations_wxyz, atol=1e-6)
    np.testing.assert_allclose(ours.scales, theirs.scales, rtol=1e-6)
    np.testing.assert_allclose(ours.opacities, theirs.opacities, atol=2e-6)
    np.testing.assert_allclose(ours.sh, theirs.sh, atol=1e-6)


def test_stored_axes_are_right_up_back(tmp_path: Path) -> None:
    """Positions that are down and forward for us are negative in y and z in the file."""
    one = capture(1)
    ls.save(tmp_path / "one.spz", one)
    stored = gsply_cpp.read_spz(str(tmp_path / "one.spz"))["means"]
    np.testing.assert_allclose(stored, one.means * (1, -1, -1), atol=2**-13)


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("flag", [0, 1])
def test_antialiased_flag_of_old_versions(tmp_path: Path, version: int, flag: int) -> None:
    """Flag bit 0 is read from every version."""
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
def test_axes_extension(tmp_path: Path, container: str, number: int, signs: tuple[int, int, int]) -> None:
    """LDB, RDB, LUB, RUB, LDF, RDF, LUF, RUF are 1 to 8, RUB is the default; unknown records are stepped over."""
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


def test_exchanged_axes_are_refused(tmp_path: Path) -> None:
    """Axes that cannot be converted are an error, not a wrong picture."""
    path = v4(tmp_path / "rfu.spz", flags=2, extensions=struct.pack("<III", COORDINATES, 4, 16))
    with pytest.raises(FormatError, match="SPZ_ADOBE_coordinate_system 16"):
        ls.load(path)


@pytest.mark.parametrize("largest", [1e-6, 0.01, 1.0, 31.9, 32.0, 100.0, 2047.9, 2048.0, 1e5, 4e6])
def test_positions_fit_their_bits(largest: float) -> None:
    """Coordinates stay within 24 bits, steps within 2^-17 of the largest one or 12 fractional bits, whatever fits."""
    bits = position_bits("a.spz", largest)
    assert 1 <= bits <= 24
    assert round(largest * 2**bits) <= 2**23
    assert bits >= 12 or largest * 2 ** (bits + 1) >= 2**23 - 1
    assert bits == 24 or 2.0**-bits <= max(largest * 2**-16, 2**-12 if largest < 2048 else np.inf)


@pytest.mark.parametrize("size", [0.01, 30.0, 5000.0, 1e6])
def test_small_and_large_scenes(tmp_path: Path, size: float) -> None:
    """Positions survive at any scale of the scene to 2^-16 of its size."""
    base = capture(50)
    means = base.means / np.abs(base.means).max() * size
    ls.save(tmp_path / "a.spz", ls.Gaussians(means, base.rotations_wxyz, base.scales, base.opacities, base.sh))
    np.testing.assert_allclose(load_gaussians(tmp_path / "a.spz").means, means, rtol=0, atol=size * 2**-16)


def test_what_is_clamped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Scales end at e^-10 and e^5.94, SH at -1 and 1; Gaussians that are widened are counted in a log line."""
    base = capture(4)
    scales, sh = base.scales.copy(), base.sh.copy()
    scales[0], scales[1, 2], scales[2] = 1e-7, 4.4e-5, 1e4
    sh[3, 1:] = 5.0
    ls.save(tmp_path / "a.spz", ls.Gaussians(base.means, base.rotations_wxyz, scales, base.opacities, sh))
    loaded = load_gaussians(tmp_path / "a.spz")
    np.testing.assert_allclose(np.log(loaded.scales)[[0, 2]], [[-10] * 3, [255 / 16 - 10] * 3], rtol=1e-6)
    np.testing.assert_allclose(loaded.sh[3, 1:], 1.0, atol=1 / 128)
    assert ["a.spz: 2 Gaussians are thinner than 4.5e-05" in r.message for r in caplog.records] == [True]


def test_positions_beyond_the_format(tmp_path: Path) -> None:
    """A scene too large for fixed point is refused instead of clamped."""
    base = capture(2)
    far = ls.Gaussians(base.means * 1e7, base.rotations_wxyz, base.scales, base.opacities, base.sh)
    with pytest.raises(FormatError, match="does not fit SPZ"):
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
def test_header_fields_are_checked(
    tmp_path: Path, container: str, field: tuple[int, str], value: int, message: str
) -> None:
    """Each header field out of its range is named, in both containers."""
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
def test_the_same_capture_as_spz_and_compressed_ply(data_dir: Path) -> None:
    """The biker lands on itself: positions to half a step of 12 bits (and the PLY's), rotations, colours, opacities."""
    spz, ply = (load_gaussians(data_dir / "splats" / name) for name in ("biker.spz", "biker.compressed.ply"))
    np.testing.assert_allclose(spz.means, ply.means, rtol=0, atol=2**-13 + 1e-6)
    np.testing.assert_allclose(spz.opacities, ply.opacities, rtol=0, atol=2e-6)
    np.testing.assert_allclose(spz.sh, ply.sh, rtol=0, atol=1 / (2 * 255 * 0.15) + 1e-5)
    inside = np.log(ply.scales) > -10.0  # SPZ ends there
    np.testing.assert_allclose(np.log(spz.scales)[inside], np.log(ply.scales)[inside], rtol=0, atol=1 / 32 + 1e-5)
    cosines = np.abs(np.einsum("ij,ij->i", spz.rotations_wxyz, ply.rotations_wxyz))
    assert cosines.min() > 1 - 6e-6  # the rounding of both formats, see test_round_trip


@pytest.mark.data
def test_only_the_right_mirroring_lands(data_dir: Path) -> None:
    """Of the eight ways to flip axes, the one chosen is the only one that makes the two files agree."""
    spz, ply = (load_gaussians(data_dir / "splats" / name) for name in ("biker.spz", "biker.compressed.ply"))
    agreeing = []
    for signs in itertools.product((1, -1), (1, -1), (1, -1)):
        other = mirror_axes(columns_from_gaussians(spz), signs)
        cosines = np.abs(np.einsum("ij,ij->i", other.rotations_wxyz, ply.rotations_wxyz))
        if np.abs(other.means - ply.means).max() < 1e-3 and cosines.min() > 0.999:
            agreeing.append(signs)
    assert agreeing == [(1, 1, 1)]
