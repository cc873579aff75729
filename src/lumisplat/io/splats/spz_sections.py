"""The six packed sections that SPZ versions 1 to 4 share: positions, alphas, colours, scales, rotations and SH."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lumisplat.io.splats.columns import Floats, SplatColumns
from lumisplat.io.splats.smallest_three import pack_smallest_three, unpack_smallest_three
from lumisplat.io.splats.spz_header import SpzHeader

COLOR_SCALE = 0.15
"""A colour byte is 255 (0.5 + 0.15 DC): a range wider than 0..1, so that hardly a coefficient is clipped."""
DC_MAX = 0.5 / COLOR_SCALE
"""Largest DC, of either sign."""

LOG_SCALE_MIN = -10.0
"""Smallest logarithm of a scale that SPZ can store; a byte is 16 (log scale - this)."""
LOG_SCALE_MAX = LOG_SCALE_MIN + 255.0 / 16.0
"""Largest."""

SECTIONS = ("positions", "alphas", "colours", "scales", "rotations", "SH")

Bytes = npt.NDArray[np.uint8]


def decode_sections(header: SpzHeader, sections: Sequence[Bytes]) -> SplatColumns:
    """Gaussians in the axes of the file.

    Args:
        header: What the file says about them.
        sections: One array of bytes for each of `SECTIONS`, of the sizes that the header calls for.
    """
    positions, alphas, colors, scales, rotations, sh = sections
    n = header.count
    coefficients = np.empty((n, header.sh_coefficients, 3), dtype=np.float32)
    coefficients[:, 0] = (colors.reshape(n, 3) / np.float32(255.0) - np.float32(0.5)) / np.float32(COLOR_SCALE)
    coefficients[:, 1:] = (sh.reshape(n, -1, 3) - np.float32(128.0)) / np.float32(128.0)
    half = header.version == 1
    return SplatColumns(
        means=_half_positions(positions) if half else _fixed_positions(positions, header.fractional_bits),
        rotations_wxyz=_packed_rotations(rotations) if header.version >= 3 else _byte_rotations(rotations),
        log_scales=scales.reshape(n, 3) / np.float32(16.0) + np.float32(LOG_SCALE_MIN),
        opacities=alphas / np.float32(255.0),
        sh=coefficients,
        opacities_are_logits=False,
    )


def _half_positions(section: Bytes) -> Floats:
    return section.view("<f2").astype(np.float32).reshape(-1, 3)


def _fixed_positions(section: Bytes, fractional_bits: int) -> Floats:
    """24-bit two's complement, shape (N, 3)."""
    parts = section.reshape(-1, 3, 3).astype(np.int32)
    # Shifted to the high bytes of an int32 first, so that shifting back down extends the sign.
    fixed = (parts[..., 0] << 8 | parts[..., 1] << 16 | parts[..., 2] << 24) >> 8
    return fixed * np.float32(2.0**-fractional_bits)


def _byte_rotations(section: Bytes) -> Floats:
    """x, y and z as bytes; w is positive and follows from the unit length. Shape (N, 4), wxyz."""
    xyz = section.reshape(-1, 3) / np.float32(127.5) - np.float32(1.0)
    return unpack_smallest_three(np.zeros(len(xyz), dtype=np.int64), xyz)


def _packed_rotations(section: Bytes) -> Floats:
    """Smallest three of xyzw: a 2-bit index, then three times a sign and 9 bits of magnitude. Shape (N, 4), wxyz."""
    packed = section.view("<u4")
    fields = np.stack([packed >> np.uint32(shift) & np.uint32(0x3FF) for shift in (20, 10, 0)], axis=1)
    magnitude = (fields & np.uint32(0x1FF)) * np.float32(np.sqrt(0.5) / 511.0)
    smallest = np.where(fields >> np.uint32(9), -magnitude, magnitude).astype(np.float32)
    return np.roll(unpack_smallest_three(packed >> np.uint32(30), smallest), 1, axis=1)


def encode_sections(columns: SplatColumns, fractional_bits: int) -> list[bytes]:
    """The sections of versions 3 and 4, each value rounded to the nearest that can be stored.

    Args:
        columns: Gaussians in the axes of the file, with unit rotations, and opacities in 0..1.
        fractional_bits: Fractional bits of the positions, with which all of them fit into 24 bits.

    Returns:
        The bytes of each of `SECTIONS`; those of SH are none at degree 0.
    """
    # Clamped, as the largest coordinate that fits may round to the first that does not.
    fixed = np.clip(np.floor(columns.means * np.float64(2.0**fractional_bits) + 0.5), -(2**23), 2**23 - 1).astype("<i4")
    return [
        np.ascontiguousarray(fixed[..., None].view(np.uint8)[..., :3]).tobytes(),
        _rounded(255.0 * columns.opacities),
        _rounded(255.0 * (0.5 + COLOR_SCALE * columns.sh[:, 0].astype(np.float64))),
        _rounded(16.0 * (columns.log_scales.astype(np.float64) - LOG_SCALE_MIN)),
        _pack_rotations(columns.rotations_wxyz).tobytes(),
        _rounded(128.0 * columns.sh[:, 1:] + 128.0),
    ]


def _rounded(values: Floats) -> bytes:
    """Bytes, rounded and clamped."""
    return np.clip(np.floor(values + 0.5), 0, 255).astype(np.uint8).tobytes()


def _pack_rotations(wxyz: Floats) -> npt.NDArray[np.uint32]:
    """The inverse of `_packed_rotations`."""
    largest, smallest = pack_smallest_three(np.roll(wxyz, -1, axis=1))
    packed = largest.astype("<u4")
    for component in smallest.T:
        magnitude = np.minimum(np.floor(np.abs(component) * (511.0 * np.sqrt(2.0)) + 0.5), 511.0).astype("<u4")
        packed = packed << np.uint32(10) | (component < 0.0).astype("<u4") << np.uint32(9) | magnitude
    return packed
