"""Radiance HDR and OpenEXR files written by hand, for the tests of their readers."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

HEADER = b"#?RADIANCE\n# made by hand\nFORMAT=32-bit_rle_rgbe\n"


def hdr_bytes(rgbe: np.ndarray, encoding: str = "flat", header: bytes = HEADER, resolution: bytes = b"") -> bytes:
    """A Radiance picture of RGBE bytes, shape (H, W, 4), in one of the encodings ``flat``, ``old`` and ``new``."""
    height, width, _ = rgbe.shape
    encode = {"flat": lambda row: row.tobytes(), "old": _old_row, "new": _new_row}[encoding]
    resolution = resolution or b"-Y %d +X %d" % (height, width)
    return header + b"\n" + resolution + b"\n" + b"".join(encode(row) for row in rgbe)


def radiance(rgbe: np.ndarray) -> np.ndarray:
    """What RGBE bytes mean, shape (H, W, 3): 0 where the exponent is."""
    scale = np.where(rgbe[..., 3:] > 0, 2.0 ** (rgbe[..., 3:].astype(np.float64) - 136.0), 0.0)
    return (rgbe[..., :3] * scale).astype(np.float32)


def write_hdr(path: Path, linear: np.ndarray) -> Path:
    """Writes an image of radiance, shape (H, W, 3), at the eight bits that RGBE has; returns the path."""
    exponent = np.ceil(np.log2(np.maximum(linear.max(axis=2), 1e-30)) + 1e-9)
    mantissa = np.clip(np.round(linear * 2.0 ** (8.0 - exponent[..., None])), 0, 255)
    rgbe = np.concatenate([mantissa, exponent[..., None] + 128.0], axis=2).astype(np.uint8)
    path.write_bytes(hdr_bytes(rgbe, "new" if 8 <= linear.shape[1] < 2**15 else "flat"))
    return path


def write_exr(path: Path, **channels: np.ndarray) -> Path:
    """Writes named channels, each (H, W), half or float as they are; returns the path."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    with OpenEXR.File(header, planes) as file:
        file.write(str(path))
    return path


def _new_row(row: np.ndarray) -> bytes:
    """Channel by channel; runs of at least three become a run, the rest stretches of at most 128 bytes."""
    data = bytes([2, 2, len(row) >> 8, len(row) & 255])
    for channel in row.T:
        stretch = b""
        for value, group in itertools.groupby(channel.tolist()):
            count = len(list(group))
            if count < 3:
                stretch += bytes([value]) * count
                continue
            data += _stretches(stretch)
            stretch = b""
            while count:
                data += bytes([128 + min(count, 127), value])
                count -= min(count, 127)
        data += _stretches(stretch)
    return data


def _stretches(values: bytes) -> bytes:
    chunks = [values[k : k + 128] for k in range(0, len(values), 128)]
    return b"".join(bytes([len(chunk)]) + chunk for chunk in chunks)


def _old_row(row: np.ndarray) -> bytes:
    """Pixels that repeat become (1, 1, 1, n), n in as many bytes as it takes, the low ones first."""
    data = b""
    for pixel, group in itertools.groupby(map(bytes, row)):
        data += pixel
        count = len(list(group)) - 1
        while count:
            data += bytes([1, 1, 1, count & 255])
            count >>= 8
    return data
