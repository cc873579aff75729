"""Names of cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from lumisplat.scene.camera import Camera

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr", ".heic")


def name_from_image(image: object) -> str:
    """The name of an image file without its folder and extension: `images/0001.png` gives `0001`; other dots stay."""
    name = str(image).replace("\\", "/").rstrip("/").rpartition("/")[2]
    return name[: -len(Path(name).suffix)] if Path(name).suffix.lower() in _IMAGE_SUFFIXES else name


def unique_names(cameras: list[Camera]) -> list[Camera]:
    """The cameras with distinct names: an empty name becomes `frame_00000`, a repeated one gets a number."""
    used: set[str] = set()
    copies: dict[str, int] = {}  # the last number that each name was given, so that many equal ones take no longer
    named: list[Camera] = []
    for index, camera in enumerate(cameras):
        base = camera.name or f"frame_{index:05d}"
        name = base
        while name in used:
            copies[base] = copies.get(base, 1) + 1
            name = f"{base}_{copies[base]}"
        used.add(name)
        named.append(camera if name == camera.name else replace(camera, name=name))
    return named
