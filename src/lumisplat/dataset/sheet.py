"""A sheet of the first views and their layers, to look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.math.arrays import FloatArray

if TYPE_CHECKING:
    from PIL import Image

_TILES = 48
"""Pictures of a sheet, at most."""
_ACROSS = 8
"""Pictures in a row, about."""
_WIDTH = 200
"""Of a picture, pixels."""
_FAR, _NEAR = 0.1, 1.0
"""Grey of the farthest and the nearest surface of a view."""
_NOT_SHOWN = ("exr",)


def write_sheet(path: Path, folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Writes a sheet: each view with its layers side by side. Depth is grey, near is white; ids have colours.

    Args:
        path: The PNG.
        folder: The data set's.
        records: What is known of the views, in order.

    Raises:
        FormatError: A file cannot be read or written.
    """
    from PIL import Image

    layers = [layer for layer in records[0]["files"] if layer not in _NOT_SHOWN]
    shown = records[: max(1, _TILES // len(layers))]
    size = records[0]["camera"]["width"], records[0]["camera"]["height"]
    width, height = _WIDTH, max(1, round(_WIDTH * size[1] / size[0]))
    together = max(1, _ACROSS // len(layers))
    rows = -(-len(shown) // together)
    sheet = Image.new("RGB", (min(together, len(shown)) * len(layers) * width, rows * height))
    for number, record in enumerate(shown):
        left, top = number % together * len(layers) * width, number // together * height
        for column, layer in enumerate(layers):
            tile = _tile(folder / record["files"][layer], layer)
            how = Image.Resampling.NEAREST if layer in ("instance", "category") else Image.Resampling.BOX
            sheet.paste(tile.resize((width, height), how), (left + column * width, top))
    with atomic_write(path) as temporary:
        sheet.save(temporary, format="PNG")


def _tile(path: Path, layer: str) -> Image.Image:
    """A layer as a picture."""
    from PIL import Image

    try:
        if layer == "depth":
            return Image.fromarray(_gray(np.load(path, allow_pickle=False)))
        with Image.open(path, formats=("PNG",)) as image:
            if layer in ("instance", "category"):
                return Image.fromarray(_colors(np.asarray(image)))
            if image.mode == "RGBA":
                return Image.alpha_composite(Image.new("RGBA", image.size, (90, 90, 90, 255)), image).convert("RGB")
            return image.convert("RGB")
    except (OSError, ValueError) as error:
        raise FormatError(path, f"cannot be read: {error}") from None


def _gray(depth: FloatArray) -> np.ndarray:
    """Depth as bytes, near is white; black: there is no surface."""
    surface = depth > 0.0
    near, far = (depth[surface].min(), depth[surface].max()) if surface.any() else (0.0, 1.0)
    share = (far - depth) / max(float(far - near), 1e-9)
    gray = np.where(surface, _FAR + (_NEAR - _FAR) * share, 0.0)
    return np.repeat((255.0 * np.clip(gray, 0.0, 1.0)).astype(np.uint8)[..., None], 3, axis=2)


def _colors(ids: np.ndarray) -> np.ndarray:
    """A colour for each id, shape (H, W, 3); black: 0."""
    hashed = ids.astype(np.uint32) * np.uint32(2654435761)
    colors = np.stack([(hashed >> shift) & 0xFF for shift in (8, 16, 24)], axis=-1) / 255.0
    return (255.0 * np.where(ids[..., None] > 0, 0.25 + 0.75 * colors, 0.0)).astype(np.uint8)
