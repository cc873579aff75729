"""Layers of a frame as pictures that can be looked at."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from lumisplat.render.frame import Frame

_RAMP = np.array(
    [
        [0.19, 0.07, 0.23],
        [0.27, 0.45, 0.95],
        [0.12, 0.86, 0.73],
        [0.72, 0.95, 0.23],
        [0.98, 0.55, 0.14],
        [0.55, 0.05, 0.03],
    ]
)
"""Dark blue over green to red: equal steps of depth stay apart, which a grey ramp does not show."""


def layer_picture(frame: Frame, layer: str) -> npt.NDArray[np.float32]:
    """Display-referred colours for one layer of ``frame``, shape (H, W, 3), 0..1.

    Depth runs from red (near) to blue (far) over its own range, normals are mapped from -1..1, indices get a colour of
    their own each. Where there is no surface the picture is black.

    Args:
        frame: What was rendered.
        layer: ``depth``, ``normal``, ``gaussian_index`` or ``instance_index``.
    """
    values = getattr(frame, layer)
    if layer == "normal":
        picture = np.where(values.any(axis=2, keepdims=True), 0.5 + 0.5 * values, 0.0)
    elif layer == "depth":
        picture = _depth_picture(values)
    else:
        picture = _index_picture(values)
    return np.clip(picture, 0.0, 1.0).astype(np.float32)


def _depth_picture(depth: npt.NDArray) -> npt.NDArray:
    hit = np.isfinite(depth)
    if not hit.any():
        return np.zeros((*depth.shape, 3))
    near, far = np.percentile(depth[hit], (1, 99))
    closeness = (far - np.where(hit, depth, far)) / max(far - near, 1e-9)
    stops = np.linspace(0.0, 1.0, len(_RAMP))
    colors = np.stack([np.interp(closeness, stops, _RAMP[:, channel]) for channel in range(3)], axis=-1)
    return np.where(hit[..., None], colors, 0.0)


def _index_picture(indices: npt.NDArray) -> npt.NDArray:
    # Knuth's multiplicative hash: neighbours in index get colours far apart, the same ones in every frame.
    hashed = indices.astype(np.uint32) * np.uint32(2654435761)
    colors = np.stack([(hashed >> shift) & 0xFF for shift in (8, 16, 24)], axis=-1) / 255.0
    return np.where((indices >= 0)[..., None], 0.2 + 0.8 * colors, 0.0)
