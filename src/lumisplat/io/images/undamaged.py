"""Whether an image file is whole, found without decoding it where its format allows that."""

from __future__ import annotations

import io

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike, read_bytes
from lumisplat.io.images.texture import decode_texture

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_SCAN, _END = 0xDA, b"\xff\xd9"
"""Markers of a JPEG: its pixels begin, and they have ended (ITU-T T.81, table B.1)."""


def check_undamaged(path: PathLike) -> None:
    """Refuses an image file that is cut off, and a PNG that is damaged anywhere.

    What a PNG's checksums or the end of a JPEG's picture do not show to be whole is decoded.

    Raises:
        FormatError: It cannot be decoded to its end.
    """
    data = read_bytes(path)
    if _is_whole_png(data) or _is_ended_jpeg(data):
        return
    try:
        decode_texture(data, path)
    except FormatError:
        if not data.startswith((_PNG, _JPEG)):
            raise
        raise FormatError(
            path, "is cut off or damaged: copy it anew, or remove it, and the photograph is left out"
        ) from None


def _is_whole_png(data: bytes) -> bool:
    """Whether all of its parts are there, with the checksums that they should have."""
    from PIL import Image

    if not data.startswith(_PNG):
        return False
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            image.verify()
    except Exception:  # Pillow's decoders raise many kinds of errors
        return False
    return True


def _is_ended_jpeg(data: bytes) -> bool:
    """Whether its picture has an end: not that of a thumbnail before it, nor of what some cameras append."""
    if not data.startswith(_JPEG):
        return False
    at = len(_JPEG)
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == _SCAN:
            return data.find(_END, at) >= 0
        at += 2 + int.from_bytes(data[at + 2 : at + 4])
    return False
