"""Truncated and damaged image files are detected without decoding complete ones."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.io.images import texture
from lumisplat.io.images.texture import check_undamaged

KINDS: dict[str, dict[str, Any]] = {
    "png": {"format": "PNG"},
    "baseline": {"format": "JPEG", "quality": 90},
    "progressive": {"format": "JPEG", "quality": 90, "progressive": True},
    "webp": {"format": "WEBP"},
}
APPENDED = b"\x00\xff\xda\x00\x07" * 9
"""Data of a video as phones append it, in which a JPEG seems to begin."""


def image(size: int = 48) -> Image.Image:
    """Returns an image that compresses badly."""
    return Image.fromarray(np.random.default_rng(1).integers(0, 256, (size, size, 3), np.uint8))


def encoded(kind: str, **more: Any) -> bytes:
    """Encodes an image to the bytes of a file."""
    file = io.BytesIO()
    image().save(file, **KINDS[kind], **more)
    return file.getvalue()


def with_thumbnail(data: bytes) -> bytes:
    """Returns a JPEG with a thumbnail, which has an end marker of its own, before its pixels."""
    small = io.BytesIO()
    image(8).save(small, format="JPEG")
    part = b"Exif\x00\x00" + small.getvalue()
    return data[:2] + b"\xff\xe1" + (len(part) + 2).to_bytes(2) + part + data[2:]


def is_whole(path: Path, data: bytes) -> bool:
    """Returns whether `check_undamaged` accepts a file of these bytes."""
    path.write_bytes(data)
    try:
        check_undamaged(path)
    except ls.FormatError as error:
        assert str(error).startswith(f"{path}: is ") and "\n" not in str(error)
        return False
    return True


@pytest.mark.parametrize("kind", KINDS)
def test_images_truncated_at_any_byte_are_detected(kind: str, tmp_path: Path) -> None:
    """`check_undamaged` decides as a full decoder does, and accepts the complete file."""
    path, data = tmp_path / "a.img", encoded(kind)
    assert is_whole(path, data)
    for size in [*range(1, len(data), 97), *range(len(data) - 5, len(data))]:
        try:
            with Image.open(io.BytesIO(data[:size])) as image:
                image.load()
            decodes = True  # a PNG with all pixels lacks only its end chunk
        except Exception:
            decodes = False
        assert is_whole(path, data[:size]) == decodes, size


@pytest.mark.parametrize("kind", ["baseline", "progressive"])
def test_thumbnail_and_appended_data_do_not_hide_a_truncated_jpeg(kind: str, tmp_path: Path) -> None:
    """Only the end marker of the main image counts."""
    data = with_thumbnail(encoded(kind))
    assert is_whole(tmp_path / "a.jpg", data) and is_whole(tmp_path / "a.jpg", data + APPENDED)
    assert not is_whole(tmp_path / "a.jpg", data[: len(data) // 2])


def test_png_with_one_changed_bit_is_detected_as_damaged(tmp_path: Path) -> None:
    """The bit is in the middle of the pixel data."""
    data = bytearray(encoded("png"))
    data[len(data) // 2] ^= 4
    assert not is_whole(tmp_path / "a.png", bytes(data))


@pytest.mark.parametrize("kind", ["png", "baseline", "progressive"])
def test_undamaged_images_are_recognised_without_decoding_them(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Decoding would take twenty times as long."""
    monkeypatch.setattr(texture, "decode_texture", lambda *_: pytest.fail("decoded"))
    assert is_whole(tmp_path / "a.img", encoded(kind))
    if kind != "png":
        assert is_whole(tmp_path / "a.img", with_thumbnail(encoded(kind)))
