"""Reads the textures of glTF materials. The textures read for one material share one set of texture coordinates."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.source import TextureBytes
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.images.texture import decode_texture
from lumisplat.scene.materials import TextureWrap, WrapPair

if TYPE_CHECKING:
    import pygltflib

_NAMES = {
    "base_color_texture": "baseColorTexture",
    "metallic_roughness_texture": "metallicRoughnessTexture",
    "normal_texture": "normalTexture",
    "occlusion_texture": "occlusionTexture",
    "emissive_texture": "emissiveTexture",
    "transmission_texture": "transmissionTexture",
    "clearcoat_texture": "clearcoatTexture",
    "clearcoat_roughness_texture": "clearcoatRoughnessTexture",
    "sheen_color_texture": "sheenColorTexture",
    "sheen_roughness_texture": "sheenRoughnessTexture",
}
"""Texture names of Lumisplat, each with its glTF name, in order of priority: a mesh gets the texture coordinates of
the first texture that its material has."""


_GLOSSINESS_NAMES = {"baseColorTexture": "diffuseTexture", "metallicRoughnessTexture": "specularGlossinessTexture"}
"""glTF names of the two metallic-roughness textures, each with the specular-glossiness texture that replaces it."""

_WRAPS = {10497: TextureWrap.REPEAT, 33071: TextureWrap.CLAMP, 33648: TextureWrap.MIRROR}
"""Wrap modes by the numbers that glTF takes from OpenGL."""
WRAP_NUMBERS = {wrap: number for number, wrap in _WRAPS.items()}


class UvTransform(NamedTuple):
    """Texture coordinates that a texture uses: a TEXCOORD attribute, scaled, then rotated, then offset.

    Textures with equal `UvTransform` can share texture coordinates.
    """

    uv_set: int = 0
    """Number of the TEXCOORD attribute."""
    offset: tuple[float, ...] = (0.0, 0.0)
    rotation: float = 0.0
    scale: tuple[float, ...] = (1.0, 1.0)

    def apply(self, uvs: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Scales, rotates, then offsets texture coordinates of V vertices (KHR_texture_transform), shape (V, 2).

        Positive angles rotate the image counter-clockwise with v down, as in Khronos' sample viewer. The GLSL code in
        the extension's text does the opposite (github.com/KhronosGroup/glTF issue 1563).
        """
        if self == UvTransform(self.uv_set):
            return uvs
        cos, sin = math.cos(self.rotation), math.sin(self.rotation)
        linear = np.array([[cos, sin], [-sin, cos]]) @ np.diag(self.scale)
        return (uvs @ linear.T + self.offset).astype(np.float32)


class Textures(NamedTuple):
    """Textures of one material, all with the texture coordinates of its first texture."""

    uv_transform: UvTransform
    """Texture coordinates of the material's first texture. All textures in ``indices`` use these coordinates."""
    indices: dict[str, int]
    """Indices into the file's list ``textures``, by the name of the material field, such as ``normal_texture``.
    """
    left_out: list[str]
    """glTF names of textures that are not read, because they have other texture coordinates than the first texture."""

    def wraps(self, file: GltfFile, referrer: str) -> dict[str, WrapPair]:
        """Returns the wrap modes along u and v of each texture, by Lumisplat's names.

        Raises:
            FormatError: An index is invalid, or a sampler has an unknown wrap mode.
        """
        return {name: _wrap(file, index, referrer) for name, index in self.indices.items()}


def material_textures(material: pygltflib.Material, *, only_color: bool = False) -> Textures:
    """Returns the textures of a material that can share texture coordinates.

    Args:
        material: The material.
        only_color: Whether to consider only the base colour texture.
    """
    infos: dict[str, _Info] = {}
    for name, gltf_name in _NAMES.items():
        info = _info(material, gltf_name)
        if info is not None and (name == "base_color_texture" or not only_color):
            infos[name] = info
    uv_transforms = {name: _uv_transform(info) for name, info in infos.items()}
    leading = next(iter(uv_transforms.values()), UvTransform())
    indices = {name: infos[name].index for name, uv_transform in uv_transforms.items() if uv_transform == leading}
    return Textures(leading, indices, [_NAMES[name] for name in infos if name not in indices])


class _Info(NamedTuple):
    """A glTF textureInfo of a material: texture index, number of the TEXCOORD attribute, and extensions."""

    index: Any
    uv_set: Any
    extensions: dict[str, Any]


def _info(material: pygltflib.Material, name: str) -> _Info | None:
    """Returns the textureInfo with a glTF name from a material or one of its extensions; None if both lack it."""
    if name in _GLOSSINESS_NAMES and (replaced := specular_glossiness(material)) is not None:
        found = replaced.get(_GLOSSINESS_NAMES[name])
        return None if found is None else _Info(found.get("index"), found.get("texCoord"), found.get("extensions", {}))
    pbr = material.pbrMetallicRoughness
    info = getattr(pbr if hasattr(pbr, name) else material, name, None)
    if info is not None:
        return _Info(info.index, info.texCoord, info.extensions or {})
    extensions: dict[str, Any] = material.extensions or {}
    for extension in ("transmission", "clearcoat", "sheen"):
        found = extensions.get(f"KHR_materials_{extension}", {}).get(name)
        if found is not None:
            return _Info(found.get("index"), found.get("texCoord"), found.get("extensions", {}))
    return None


def specular_glossiness(material: pygltflib.Material) -> dict[str, Any] | None:
    """Returns a material's KHR_materials_pbrSpecularGlossiness object, unless metallic-roughness takes precedence.

    None is returned for a material without the extension, and for one with metallic-roughness values. Writers that give
    both kinds of values intend metallic-roughness for programs that cannot read the extension.
    """
    found: dict[str, Any] | None = (material.extensions or {}).get("KHR_materials_pbrSpecularGlossiness")
    pbr = material.pbrMetallicRoughness
    textured = any(getattr(pbr, name, None) is not None for name in _GLOSSINESS_NAMES)
    colored = any(value != 1.0 for value in getattr(pbr, "baseColorFactor", None) or ())
    return None if textured or colored else found


def _uv_transform(info: _Info) -> UvTransform:
    transform: dict[str, Any] = info.extensions.get("KHR_texture_transform", {})
    return UvTransform(
        uv_set=transform.get("texCoord", info.uv_set or 0),
        offset=tuple(map(float, transform.get("offset", (0.0, 0.0)))),
        rotation=float(transform.get("rotation", 0.0)),
        scale=tuple(map(float, transform.get("scale", (1.0, 1.0)))),
    )


def _wrap(file: GltfFile, index: int, referrer: str) -> WrapPair:
    """Returns the wrap modes of a texture along u and v; a texture without a sampler repeats."""
    number = file.item("textures", index, referrer).sampler
    if number is None:
        return TextureWrap.REPEAT, TextureWrap.REPEAT
    sampler = file.item("samplers", number, f"textures[{index}]")
    modes = [10497 if mode is None else mode for mode in (sampler.wrapS, sampler.wrapT)]
    if unknown := [mode for mode in modes if mode not in _WRAPS]:
        known = ", ".join(map(str, _WRAPS))
        raise FormatError(file.path, f"samplers[{number}] has wrap mode {unknown[0]!r}, expected one of {known}")
    return _WRAPS[modes[0]], _WRAPS[modes[1]]


def texture_extension(texture: pygltflib.Texture) -> str | None:
    """Returns the name of the extension that defines the format of a texture whose only image is unreadable.

    Returns None for a texture with a readable image (PNG, JPEG or WebP).
    """
    extensions: dict[str, Any] = texture.extensions or {}
    if texture.source is not None or "EXT_texture_webp" in extensions:
        return None
    return next(iter(extensions), None)


class GltfTexels:
    """Decodes the images of a glTF file to texels; each image is decoded once."""

    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._images: dict[int, npt.NDArray[np.uint8]] = {}
        self._total = TextureBytes(file.path)

    def get(self, index: int, referrer: str) -> npt.NDArray[np.uint8] | None:
        """Returns a texture's texels as stored, shape (H, W, 3) or (H, W, 4); None for an unsupported image format.

        Raises:
            FormatError: The index is invalid, or an image is missing or corrupt.
        """
        file = self._file
        texture = file.item("textures", index, referrer)
        extensions: dict[str, Any] = texture.extensions or {}
        if texture_extension(texture) is not None:
            return None
        source = extensions.get("EXT_texture_webp", {}).get("source", texture.source)
        image = file.item("images", source, f"textures[{index}]")
        if source not in self._images:
            label = f"images[{source}]" + (f" {image.name!r}" if image.name else "")
            if image.bufferView is not None:
                data = bytes(file.view_bytes(image.bufferView, label)[0])
            else:
                data = file.resource(image.uri, label)
                label = image.uri if not image.uri.startswith("data:") else label
            self._images[source] = decode_texture(data, file.path, label, self._total)
        return self._images[source]
