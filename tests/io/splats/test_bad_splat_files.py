"""Every damaged file gives one clear `FormatError` that names it, no other error, and no huge allocation."""

from __future__ import annotations

import gzip
import io
import json
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.errors import FormatError, SceneError
from lumisplat.scene.gaussians import Gaussians
from support.files.splat_files import (
    FORMATS,
    FUZZED,
    capture,
    load_gaussians,
    ply_header,
    sog_files,
    unpacked,
    write_format,
)

INRIA = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
INRIA += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def refused(path: Path) -> str:
    """Returns the error message of loading a file; it names the path and fits one line."""
    with pytest.raises(FormatError) as error:
        ls.load(path)
    message = str(error.value)
    assert str(path) in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize("name", FUZZED)
def test_empty_capture_files_are_refused(tmp_path: Path, name: str) -> None:
    """The error says that the file is empty."""
    (tmp_path / name).write_bytes(b"")
    assert "is empty" in refused(tmp_path / name)


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.6, 0.98])
def test_truncated_capture_files_are_refused(tmp_path: Path, name: str, fraction: float) -> None:
    """The file may end anywhere."""
    path = write_format(tmp_path, name)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * fraction)])
    refused(path)


@pytest.mark.parametrize("name", ["capture.ply", "big_endian.ply", "capture.compressed.ply", "capture.spz", "v3.spz"])
def test_capture_files_without_their_last_byte_are_refused(tmp_path: Path, name: str) -> None:
    """In a gzip stream, only the checksum and length may be missing."""
    path = write_format(tmp_path, name)
    data = path.read_bytes()
    path.write_bytes(gzip.compress(gzip.decompress(data)[:-1]) if data[:2] == b"\x1f\x8b" else data[:-1])
    assert "truncated" in refused(path)


@pytest.mark.parametrize("name", FUZZED)
def test_random_bytes_are_refused_by_every_capture_reader(tmp_path: Path, name: str) -> None:
    """Five thousand random bytes are an error in every format."""
    (tmp_path / name).write_bytes(np.random.default_rng(0).bytes(5000))
    refused(tmp_path / name)


@pytest.mark.parametrize("name", FUZZED)
def test_capture_files_truncated_anywhere_either_load_or_are_refused(tmp_path: Path, name: str) -> None:
    """A refusal is a one-line error."""
    path = write_format(tmp_path, name)
    data = path.read_bytes()
    for length in np.random.default_rng(1).integers(1, len(data), 40):
        path.write_bytes(data[:length])
        load_or_refuse(path)


@pytest.mark.parametrize("name", FUZZED)
def test_capture_files_with_random_byte_changes_either_load_or_are_refused(tmp_path: Path, name: str) -> None:
    """Half of the changes hit the first 400 bytes, which hold the header."""
    path = write_format(tmp_path, name)
    original = path.read_bytes()
    rng = np.random.default_rng(2)
    for _ in range(80):
        data = bytearray(original)
        reach = len(data) if rng.random() < 0.5 else min(len(data), 400)
        for position in rng.integers(0, reach, rng.integers(1, 5)):
            data[position] = rng.integers(256)
        path.write_bytes(data)
        load_or_refuse(path)


@pytest.mark.deep
@pytest.mark.parametrize("name", FUZZED)
def test_randomly_mutated_capture_files_either_load_or_are_refused(tmp_path: Path, name: str) -> None:
    """Bytes are changed, a piece is cut out, doubled or zeroed, or the end is lost; errors are one line."""
    path = write_format(tmp_path, name)
    original = path.read_bytes()
    rng = np.random.default_rng(4)
    for _ in range(2000):
        path.write_bytes(mutated(original, rng))
        load_or_refuse(path)


def mutated(original: bytes, rng: np.random.Generator) -> bytes:
    """Returns data with one kind of damage, most often near the beginning."""
    reach = len(original) if rng.random() < 0.5 else min(len(original), 400)
    start, size = int(rng.integers(0, reach)), int(rng.integers(1, 64))
    head, piece, tail = original[:start], original[start : start + size], original[start + size :]
    kind = rng.integers(6)
    if kind == 0:
        return head
    if kind == 1:
        return head + tail
    if kind == 2:
        return head + piece + piece + tail
    if kind == 3:
        return head + bytes([rng.choice([0, 255])]) * len(piece) + tail
    data = bytearray(original)
    for position in rng.integers(0, reach, rng.integers(1, 6)):
        data[position] = rng.integers(256) if kind == 4 else data[position] ^ (1 << rng.integers(8))
    return bytes(data)


def test_sog_with_random_byte_changes_in_meta_json_either_loads_or_is_refused(tmp_path: Path) -> None:
    """Three random bytes of the JSON text are replaced."""
    folder = unpacked(tmp_path / "sog", sog_files(capture(40), linear=False))
    original = (folder / "meta.json").read_bytes()
    rng = np.random.default_rng(3)
    for _ in range(80):
        data = bytearray(original)
        for position in rng.integers(0, len(data), 3):
            data[position] = rng.integers(32, 127)
        (folder / "meta.json").write_bytes(data)
        load_or_refuse(folder)


def load_or_refuse(path: Path) -> None:
    """Loads a file twice; the only allowed exception is a SceneError of one line."""
    for drop_invalid in (False, True):
        try:
            assert isinstance(ls.load(path, drop_invalid=drop_invalid), Gaussians)
        except SceneError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("name", ["capture.ply", "ascii.ply", "big_endian.ply"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nonfinite_ply_values_are_counted_and_can_be_dropped(tmp_path: Path, name: str, value: float) -> None:
    """The error names the properties with NaN and infinity."""
    path = tmp_path / name
    rows = np.tile([1.0, 2, 3, 0.1, 0.2, 0.3, 0, -1, -2, -3, 1, 0, 0, 0], (5, 1))
    rows[1, 3] = rows[4, 3] = rows[4, 0] = value
    if name.startswith("ascii"):
        text = "\n".join(" ".join(map(str, row)) for row in rows)
        path.write_bytes(ply_header(5, INRIA, "ascii") + text.encode())
    else:
        order, kind, encoding = ("<f4", "float", "little") if name == "capture.ply" else (">f8", "double", "big")
        path.write_bytes(ply_header(5, INRIA, f"binary_{encoding}_endian", kind) + rows.astype(order).tobytes())
    message = refused(path)
    assert "2 NaN or infinite values in f_dc_0" in message
    assert "1 NaN or infinite values in x" in message
    assert "--drop-invalid" in message
    assert load_gaussians(path, drop_invalid=True).count == 3


def test_ply_doubles_beyond_the_range_of_float32_count_as_infinite(tmp_path: Path) -> None:
    """The error counts these values in the property x."""
    row = np.array([1e300, 2, 3, 0.1, 0.2, 0.3, 0, -1, -2, -3, 1, 0, 0, 0])
    (tmp_path / "a.ply").write_bytes(ply_header(1, INRIA, kind="double") + row.astype("<f8").tobytes())
    assert "1 NaN or infinite values in x" in refused(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_without_any_gaussian_is_refused(tmp_path: Path, encoding: str) -> None:
    """A vertex count of zero is an error in every encoding."""
    (tmp_path / "a.ply").write_bytes(ply_header(0, INRIA, encoding))
    assert "zero Gaussians" in refused(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("count", [6, 10**9, 10**18, 10**40])
def test_ply_count_beyond_the_file_size_is_refused_without_allocation(
    tmp_path: Path, encoding: str, count: int
) -> None:
    """The count may be arbitrarily large."""
    body = b"0 " * 14 * 5 if encoding == "ascii" else bytes(14 * 4 * 5)
    (tmp_path / "a.ply").write_bytes(ply_header(count, INRIA, encoding) + body)
    tracemalloc.start()
    message = refused(tmp_path / "a.ply")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "truncated: the header promises" in message
    assert peak < 2**22


def test_compressed_ply_counts_beyond_the_file_size_are_refused(tmp_path: Path) -> None:
    """The counts of Gaussians and of chunks are checked."""
    path = write_format(tmp_path, "capture.compressed.ply")
    data = path.read_bytes()
    path.write_bytes(data.replace(b"element vertex 40", b"element vertex 4000000000"))
    assert "truncated" in refused(path)
    path.write_bytes(data.replace(b"element chunk 1", b"element chunk 1000000000000"))
    assert "truncated" in refused(path)


def test_spz_gzip_stream_is_inflated_up_to_the_announced_size_and_no_further(tmp_path: Path) -> None:
    """Further zeros in the stream take no memory."""
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 0, 12, 0, 0)
    good = header + bytes([0] * 9 + [128] + [128] * 3 + [100] * 3 + [0] * 4)
    stream = io.BytesIO()
    with gzip.GzipFile(fileobj=stream, mode="wb", compresslevel=1) as bomb:
        bomb.write(good)
        for _ in range(16):
            bomb.write(bytes(2**23))
    (tmp_path / "bomb.spz").write_bytes(stream.getvalue())
    tracemalloc.start()
    assert load_gaussians(tmp_path / "bomb.spz").count == 1
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**24


def test_spz_gzip_bomb_with_a_matching_header_is_refused(tmp_path: Path) -> None:
    """A header that claims a billion Gaussians in a small file is refused without inflating them."""
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, 10**9, 0, 12, 0, 0)
    (tmp_path / "bomb.spz").write_bytes(gzip.compress(header + bytes(2**20)))
    assert "made to exhaust memory" in refused(tmp_path / "bomb.spz")


def test_sog_zip_bomb_is_refused_before_it_is_inflated(tmp_path: Path) -> None:
    """A bundle member that inflates to hundreds of megabytes is not read."""
    files = sog_files(capture(10), linear=False)
    with zipfile.ZipFile(tmp_path / "bomb.sog", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as bundle:
        bundle.writestr("meta.json", files["meta.json"])
        with bundle.open("means_l.webp", "w") as member:
            for _ in range(33):
                member.write(bytes(2**23))
    tracemalloc.start()
    message = refused(tmp_path / "bomb.sog")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "means_l.webp would take 276,824,064 bytes" in message
    assert peak < 2**24


def test_sog_image_that_claims_90_million_pixels_is_refused(tmp_path: Path) -> None:
    """The image is refused before it is decoded."""
    files = sog_files(capture(10), linear=False)
    buffer = io.BytesIO()
    Image.new("L", (9500, 9500)).save(buffer, "PNG")
    folder = unpacked(tmp_path / "bomb", files | {"quats.webp": buffer.getvalue()})
    assert "quats.webp" in refused(folder)


def test_total_pixel_count_of_sog_images_is_limited(tmp_path: Path) -> None:
    """Each image is within the limit, but their sum is not."""
    files = sog_files(capture(10), linear=False)
    buffer = io.BytesIO()
    Image.new("L", (7000, 7000)).save(buffer, "PNG")
    meta = json.loads(files["meta.json"])
    names = [f"more_{k}.webp" for k in range(6)]
    meta["means"]["files"] += names
    files |= dict.fromkeys(names, buffer.getvalue()) | {"meta.json": json.dumps(meta).encode()}
    tracemalloc.start()
    assert "all its images would take" in refused(unpacked(tmp_path / "bomb", files))
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


def test_load_with_an_unknown_extension_lists_the_supported_ones(tmp_path: Path) -> None:
    """The error of ``load`` names .ply, .compressed.ply, .spz and all others."""
    (tmp_path / "a.xyz").write_bytes(b"data")
    assert "unknown extension '.xyz', expected .ply, .compressed.ply, .spz" in refused(tmp_path / "a.xyz")


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.sog", "meta.json", "a.obj", "nothing"])
def test_missing_capture_file_has_the_same_error_for_every_extension(tmp_path: Path, name: str) -> None:
    """The message is "no such file"."""
    assert "no such file" in refused(tmp_path / name)


@pytest.mark.parametrize("name", ["folder", "folder.ply", "folder.spz"])
def test_folder_without_meta_json_is_refused_as_a_capture(tmp_path: Path, name: str) -> None:
    """A folder of training images is refused with advice to train a capture; the folder may end in .ply."""
    (tmp_path / name).mkdir()
    assert "is a folder without a meta.json" in refused(tmp_path / name)
    (tmp_path / name / "transforms.json").write_text("{}")
    assert "is a folder of images, not a capture: train one from them" in refused(tmp_path / name)


def test_ply_of_points_without_opacity_and_scale_is_refused_as_a_capture(tmp_path: Path) -> None:
    """The error lists the missing properties."""
    (tmp_path / "points.ply").write_bytes(ply_header(2, ["x", "y", "z"]) + bytes(24))
    assert "a point cloud, not a Gaussian capture: it has no opacity, scale or rotation" in refused(
        tmp_path / "points.ply"
    )


@pytest.mark.parametrize(
    "header",
    [
        b"ply\n",
        b"ply\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex -3\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nproperty float x\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty quad x\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float x\nend_header\n",
        b"ply\nformat middle_endian 1.0\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex " + b"9" * 5000 + b"\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uchar int opacity\nend_header\n\x00",
    ],
)
def test_damaged_ply_headers_of_captures_are_refused_with_a_one_line_error(tmp_path: Path, header: bytes) -> None:
    """Counts are missing or negative, and types are unknown."""
    (tmp_path / "a.ply").write_bytes(header)
    refused(tmp_path / "a.ply")
