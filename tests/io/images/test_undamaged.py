"""Image files that are cut off or damaged are found without decoding those that are not."""

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
"""As a telephone appends a film, in whose bytes a picture may seem to begin."""


def picture(size: int = 48) -> Image.Image:
    """One that does not compress well."""
    return Image.fromarray(np.random.default_rng(1).integers(0, 256, (size, size, 3), np.uint8))


def encoded(kind: str, **more: Any) -> bytes:
    """The bytes of a file."""
    file = io.BytesIO()
    picture().save(file, **KINDS[kind], **more)
    return file.getvalue()


def with_thumbnail(data: bytes) -> bytes:
    """A JPEG that has another one in it, with an end of its own, before its pixels."""
    small = io.BytesIO()
    picture(8).save(small, format="JPEG")
    part = b"Exif\x00\x00" + small.getvalue()
    return data[:2] + b"\xff\xe1" + (len(part) + 2).to_bytes(2) + part + data[2:]


def is_whole(path: Path, data: bytes) -> bool:
    """Whether a file of these bytes is taken."""
    path.write_bytes(data)
    try:
        check_undamaged(path)
    except ls.FormatError as error:
        assert str(error).startswith(f"{path}: is ") and "\n" not in str(error)
        return False
    return True


@pytest.mark.parametrize("kind", KINDS)
def test_cut_anywhere_it_is_refused(kind: str, tmp_path: Path) -> None:
    """As decoding refuses it, whatever is missing at its end; whole, it is taken."""
    path, data = tmp_path / "a.img", encoded(kind)
    assert is_whole(path, data)
    for kept in [*range(1, len(data), 97), *range(len(data) - 5, len(data))]:
        try:
            with Image.open(io.BytesIO(data[:kept])) as image:
                image.load()
            decodes = True  # a PNG whose pixels are all there lacks its end only
        except Exception:
            decodes = False
        assert is_whole(path, data[:kept]) == decodes, kept


@pytest.mark.parametrize("kind", ["baseline", "progressive"])
def test_the_end_that_counts_is_that_of_the_picture(kind: str, tmp_path: Path) -> None:
    """Neither that of a thumbnail in the file, nor what is appended to it."""
    data = with_thumbnail(encoded(kind))
    assert is_whole(tmp_path / "a.jpg", data) and is_whole(tmp_path / "a.jpg", data + APPENDED)
    assert not is_whole(tmp_path / "a.jpg", data[: len(data) // 2])


def test_a_png_with_other_bytes_is_refused(tmp_path: Path) -> None:
    """One bit of its pixels."""
    data = bytearray(encoded("png"))
    data[len(data) // 2] ^= 4
    assert not is_whole(tmp_path / "a.png", bytes(data))


@pytest.mark.parametrize("kind", ["png", "baseline", "progressive"])
def test_what_is_whole_is_not_decoded(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That would take twenty times as long."""
    monkeypatch.setattr(texture, "decode_texture", lambda *_: pytest.fail("decoded"))
    assert is_whole(tmp_path / "a.img", encoded(kind))
    if kind != "png":
        assert is_whole(tmp_path / "a.img", with_thumbnail(encoded(kind)))
