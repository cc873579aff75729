"""The ``.splat`` of antimatter15's viewer: 32 bytes a Gaussian, without a header and without harmonics.

Three float32 of the position, three of the scales (standard deviations), four bytes of red, green, blue and opacity,
and four of the rotation, wxyz, as 128 q + 128. Axes are those of the PLY that it was made from.
Layout: https://github.com/antimatter15/splat.
"""

from __future__ import annotations

import numpy as np

from lumisplat.constants import SH_C0
from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike, read_bytes
from lumisplat.io.splats.columns import SplatColumns

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("wxyz", "u1", 4)])


def read_splat(path: PathLike) -> SplatColumns:
    """Reads a ``.splat``.

    Raises:
        FormatError: The file cannot be read, or is no whole number of rows.
    """
    data = read_bytes(path)
    if len(data) % _ROW.itemsize:
        raise FormatError(
            path, f"truncated, or no .splat: {len(data):,} bytes are no whole number of {_ROW.itemsize} a Gaussian"
        )
    rows = np.frombuffer(data, _ROW)
    rgba = rows["rgba"] / np.float32(255.0)
    return SplatColumns(
        means=rows["mean"],
        rotations_wxyz=(rows["wxyz"].astype(np.float32) - 128.0) / 128.0,
        log_scales=np.abs(rows["scale"]),
        opacities=rgba[:, 3],
        sh=((rgba[:, None, :3] - np.float32(0.5)) / np.float32(SH_C0)),
        scales_are_logarithms=False,
        opacities_are_logits=False,
    )
