"""Textures of glTF materials: which of them one set of texture coordinates can place, and their texels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.images.image import decode_texture

if TYPE_CHECKING:
    import pygltflib

_NAMES = {
    "base_color_texture": "baseColorTexture",
    "metallic_roughness_texture": "metallicRoughnessTexture",
    "normal_texture": "normalTexture",
    "occlusion_texture": "occlusionTexture",
    "emissive_texture": "emissiveTexture",
}
"""Our names of the textures of a material, and glTF's, the one first that the coordinates of a mesh are taken of."""


class Placement(NamedTuple):
    """How texture coordinates place a texture: textures of equal placement can share theirs."""

    uv_set: int = 0
    """Number of the primitive's TEXCOORD attribute."""
    offset: tuple[float, ...] = (0.0, 0.0)
    rotation: float = 0.0
    scale: tuple[float, ...] = (1.0, 1.0)

    def applied(self, uvs: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Scales, rotates, then offsets (KHR_texture_transform), shape (V, 2).

        Positive angles turn counter-clockwise as one looks at the image, v down: as Khronos' viewer does, not as the
        GLSL of the extension's text does (github.com/KhronosGroup/glTF issue 1563).
        """
        if self == Placement(self.uv_set):
            return uvs
        cos, sin = math.cos(self.rotation), math.sin(self.rotation)
        linear = np.array([[cos, sin], [-sin, cos]]) @ np.diag(self.scale)
        return (uvs @ linear.T + self.offset).astype(np.float32)


class Textures(NamedTuple):
    """The textures of one material."""

    placement: Placement
    """Of all that are kept: the first one's."""
    indices: dict[str, int]
    """Index in the file's textures by our name."""
    left_out: list[str]
    """glTF's names of those that are placed otherwise."""


def material_textures(material: pygltflib.Material, *, only_color: bool = False) -> Textures:
    """What textures a material has.

    Args:
        material: Of the file.
        only_color: The base colour's alone counts.
    """
    pbr = material.pbrMetallicRoughness
    infos = {}
    for ours, theirs in _NAMES.items():
        info = getattr(pbr if hasattr(pbr, theirs) else material, theirs, None)
        if info is not None and (ours == "base_color_texture" or not only_color):
            infos[ours] = info
    placements = {name: _placement(info) for name, info in infos.items()}
    leading = next(iter(placements.values()), Placement())
    indices = {name: infos[name].index for name, placement in placements.items() if placement == leading}
    return Textures(leading, indices, [_NAMES[name] for name in infos if name not in indices])


def _placement(info: Any) -> Placement:
    transform = (info.extensions or {}).get("KHR_texture_transform", {})
    return Placement(
        uv_set=transform.get("texCoord", info.texCoord or 0),
        offset=tuple(map(float, transform.get("offset", (0.0, 0.0)))),
        rotation=float(transform.get("rotation", 0.0)),
        scale=tuple(map(float, transform.get("scale", (1.0, 1.0)))),
    )


class GltfTexels:
    """Texels of a file's textures by index; each image is decoded once."""

    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._images: dict[int, npt.NDArray[np.uint8]] = {}

    def get(self, index: int, referrer: str) -> npt.NDArray[np.uint8]:
        """Texels as stored, without alpha, shape (H, W, 3).

        Raises:
            FormatError: A bad index, or a missing or corrupt image.
        """
        file = self._file
        texture = file.item("textures", index, referrer)
        webp = (texture.extensions or {}).get("EXT_texture_webp", {})
        source = webp.get("source", texture.source)
        image = file.item("images", source, f"textures[{index}]")
        if source not in self._images:
            label = f"images[{source}]" + (f" {image.name!r}" if image.name else "")
            if image.bufferView is not None:
                data = bytes(file.view_bytes(image.bufferView, label)[0])
            else:
                data = file.resource(image.uri, label)
                label = image.uri if not image.uri.startswith("data:") else label
            self._images[source] = decode_texture(data, file.path, label)[:, :, :3]
        return self._images[source]
