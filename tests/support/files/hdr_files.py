"""Writes Radiance HDR and OpenEXR files independently of the package, for tests of its readers."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

HEADER = b"#?RADIANCE\n# made by hand\nFORMAT=32-bit_rle_rgbe\n"


def hdr_bytes(rgbe: np.ndarray, encoding: str = "flat", header: bytes = HEADER, resolution: bytes = b"") -> bytes:
    """Encodes RGBE bytes, shape (H, W, 4), as a Radiance HDR in the encoding ``flat``, ``old`` or ``new``."""
    height, width, _ = rgbe.shape
    encode = {"flat": lambda row: row.tobytes(), "old": _old_row, "new": _new_row}[encoding]
    resolution = resolution or b"-Y %d +X %d" % (height, width)
    return header + b"\n" + resolution + b"\n" + b"".join(encode(row) for row in rgbe)


def radiance(rgbe: np.ndarray) -> np.ndarray:
    """Converts RGBE bytes to radiance, shape (H, W, 3); it is 0 where the exponent is 0."""
    scale = np.where(rgbe[..., 3:] > 0, 2.0 ** (rgbe[..., 3:].astype(np.float64) - 136.0), 0.0)
    return (rgbe[..., :3] * scale).astype(np.float32)


def write_hdr(path: Path, linear: np.ndarray) -> Path:
    """Writes radiance, shape (H, W, 3), with the 8-bit mantissas of RGBE. Returns the path."""
    exponent = np.ceil(np.log2(np.maximum(linear.max(axis=2), 1e-30)) + 1e-9)
    mantissa = np.clip(np.round(linear * 2.0 ** (8.0 - exponent[..., None])), 0, 255)
    rgbe = np.concatenate([mantissa, exponent[..., None] + 128.0], axis=2).astype(np.uint8)
    path.write_bytes(hdr_bytes(rgbe, "new" if 8 <= linear.shape[1] < 2**15 else "flat"))
    return path


def write_exr(path: Path, **channels: np.ndarray) -> Path:
    """Writes named channels, each half or float of shape (H, W). Returns the path."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    planes = {name: np.ascontiguousarray(plane) for name, plane in channels.items()}
    with OpenEXR.File(header, planes) as file:
        file.write(str(path))
    return path


def _new_row(row: np.ndarray) -> bytes:
    """Encodes a row channel by channel: three or more equal bytes as a run, others as literals of at most 128 bytes."""
    data = bytes([2, 2, len(row) >> 8, len(row) & 255])
    for channel in row.T:
        literal = b""
        for value, group in itertools.groupby(channel.tolist()):
            count = len(list(group))
            if count < 3:
                literal += bytes([value]) * count
                continue
            data += _literals(literal)
            literal = b""
            while count:
                data += bytes([128 + min(count, 127), value])
                count -= min(count, 127)
        data += _literals(literal)
    return data


def _literals(values: bytes) -> bytes:
    chunks = [values[k : k + 128] for k in range(0, len(values), 128)]
    return b"".join(bytes([len(chunk)]) + chunk for chunk in chunks)


def _old_row(row: np.ndarray) -> bytes:
    """Encodes a row; n repetitions of a pixel become pixels (1, 1, 1, byte), one for each byte of n, low byte first."""
    data = b""
    for pixel, group in itertools.groupby(map(bytes, row)):
        data += pixel
        count = len(list(group)) - 1
        while count:
            data += bytes([1, 1, 1, count & 255])
            count >>= 8
    return data
