"""A sheet of a frame's layers: small pictures in a grid, each with its name."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import lumisplat as ls

if TYPE_CHECKING:
    from PIL import Image

_COLUMNS = 4
_LAYERS = ("albedo", "normal", "depth", "position", "gaussian_index", "instance_index", "emission", "reflection")
"""The first rows; two of the lights follow, which end with Gaussians a ray and the picture itself."""

SHEET_AOVS = ("albedo", "emission", "reflection", "lights", "hits")
"""What a frame needs for it."""


def write_sheet(frame: ls.Frame, path: Path) -> None:
    """Writes the sheet of a frame that has every layer and three lights, twice as wide as the frame."""
    from PIL import Image

    tiles = _tiles(frame)
    width, height = max(1, frame.camera.width // 2), max(1, frame.camera.height // 2)
    sheet = Image.new("RGB", (_COLUMNS * width, -(-len(tiles) // _COLUMNS) * height))
    for place, (name, picture) in enumerate(tiles.items()):
        # Colours of indices must not mix.
        how = Image.Resampling.NEAREST if "index" in name else Image.Resampling.BOX
        tile = picture.resize((width, height), how)
        _label(tile, name)
        sheet.paste(tile, (place % _COLUMNS * width, place // _COLUMNS * height))
    sheet.save(path)


def _tiles(frame: ls.Frame) -> dict[str, Image.Image]:
    """The pictures by name, in order."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        frame.save(Path(folder) / "picture.png", layers=(*_LAYERS, "lights", "hits"))
        pictures = {
            file.name.removeprefix("picture.").removesuffix("png").strip("."): Image.open(file).convert("RGB")
            for file in Path(folder).iterdir()
        }
    # Lights stay in their order, whatever their names.
    parts = {part: [f"light.{name}.{part}" for name in frame.light_names] for part in ("direct", "shadow")}
    order = [*_LAYERS, *parts["direct"], "hits", *parts["shadow"], ""]
    return {name or "picture": pictures[name] for name in order}


def _label(tile: Image.Image, name: str) -> None:
    from PIL import ImageDraw, ImageFont

    font = ImageFont.load_default(max(8, tile.height // 14))
    ImageDraw.Draw(tile).text(
        (6, tile.height - 5), name, fill="white", font=font, anchor="ld", stroke_width=2, stroke_fill="black"
    )
