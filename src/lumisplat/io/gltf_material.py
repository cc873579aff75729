"""glTF materials: factors, base colour textures (glTF 2.0 section 3.9), KHR_materials_{ior,specular,transmission}.

glTF tells solid bodies, to which KHR_materials_volume gives a thickness, from thin walls, through which light goes
straight. Ours are all solid: a thin wall bends light as a body would, with a log line. That is right for solid glass
whose volume the exporter left out, and for a pane that is modelled with both of its faces.
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lumisplat.io.gltf_file import GltfFile
from lumisplat.io.image import decode_texture
from lumisplat.scene.materials import MaterialPbr

if TYPE_CHECKING:
    import pygltflib


_log = logging.getLogger("lumisplat")


def warn_unread(file: GltfFile) -> None:
    """Logs what of the file's materials is not read.

    One line per material with a metallic-roughness texture; one each on alpha, on thin walls, and on what varies or
    darkens transmission, for all materials that have it.
    """
    materials = file.model.materials or []
    for index, material in enumerate(materials):
        pbr = material.pbrMetallicRoughness
        if getattr(pbr, "metallicRoughnessTexture", None) is not None:
            _log.warning(
                "%s: the metallicRoughnessTexture of %s is not read: metallic %s and roughness %s everywhere",
                file.path,
                _label(index, material),
                _or(getattr(pbr, "metallicFactor", None), 1.0),
                _or(getattr(pbr, "roughnessFactor", None), 1.0),
            )
    lines = {
        "%d transparent materials are drawn opaque (first %s)": lambda m: m.alphaMode in ("MASK", "BLEND"),
        "%d thin-walled materials bend light as solid bodies do, with an ior of 1 they would not (first %s)": _is_thin,
        "transmissionTexture and attenuation of %d materials are not read (first %s)": _has_varied_transmission,
    }
    for line, concerns in lines.items():
        labels = [_label(index, material) for index, material in enumerate(materials) if concerns(material)]
        if labels:
            _log.warning("%s: " + line, file.path, len(labels), labels[0])


def _is_thin(material: pygltflib.Material) -> bool:
    is_solid = _extension(material, "volume").get("thicknessFactor", 0.0) > 0.0
    return _extension(material, "transmission").get("transmissionFactor", 0.0) > 0.0 and not is_solid


def _has_varied_transmission(material: pygltflib.Material) -> bool:
    return "transmissionTexture" in _extension(material, "transmission") or (
        "attenuationDistance" in _extension(material, "volume")
    )


def _extension(material: pygltflib.Material, name: str) -> dict[str, Any]:
    """``KHR_materials_{name}`` of a material, empty where it has none."""
    return (material.extensions or {}).get(f"KHR_materials_{name}", {})


def _label(index: int, material: pygltflib.Material) -> str:
    return f"materials[{index}]" + (f" {material.name!r}" if material.name else "")


class GltfMaterials:
    """Materials of a file by index, each decoded once."""

    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._materials: dict[int, MaterialPbr] = {}
        self._textures: dict[int, npt.NDArray[np.uint8]] = {}

    def get(self, index: int | None, referrer: str) -> MaterialPbr:
        """The material at ``index``; glTF's default one for None.

        Raises:
            FormatError: A bad index, a value out of its range, or a missing or corrupt texture.
        """
        if index is None:
            return MaterialPbr(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=1.0)
        material = self._file.item("materials", index, referrer)
        if index not in self._materials:
            self._materials[index] = self._decode(material)
        return self._materials[index]

    def _decode(self, material: pygltflib.Material) -> MaterialPbr:
        pbr = material.pbrMetallicRoughness
        texture = getattr(pbr, "baseColorTexture", None)
        texels = self._texture(texture.index, material.name) if texture is not None else None
        return MaterialPbr(
            base_color=tuple(_or(getattr(pbr, "baseColorFactor", None), (1.0, 1.0, 1.0, 1.0)))[:3],
            metallic=_or(getattr(pbr, "metallicFactor", None), 1.0),
            roughness=_or(getattr(pbr, "roughnessFactor", None), 1.0),
            specular=_extension(material, "specular").get("specularFactor", 1.0),
            # The extension allows 0 as a switch of older assets; less than 1 means nothing here.
            ior=max(_extension(material, "ior").get("ior", 1.5), 1.0),
            transmission=_extension(material, "transmission").get("transmissionFactor", 0.0),
            base_color_texture=texels,
            name=material.name or "",
        )

    def _texture(self, index: int, material_name: str | None) -> npt.NDArray[np.uint8]:
        file = self._file
        texture = file.item("textures", index, f"material {material_name!r}")
        webp = (texture.extensions or {}).get("EXT_texture_webp", {})
        source = webp.get("source", texture.source)
        image = file.item("images", source, f"textures[{index}]")
        if source not in self._textures:
            label = f"images[{source}]" + (f" {image.name!r}" if image.name else "")
            if image.bufferView is not None:
                data = bytes(file.view_bytes(image.bufferView, label)[0])
            else:
                data = file.resource(image.uri, label)
                label = image.uri if not image.uri.startswith("data:") else label
            self._textures[source] = decode_texture(data, file.path, label)[:, :, :3]
        return self._textures[source]


def base_color_uvs(file: GltfFile, primitive: pygltflib.Primitive, where: str) -> npt.NDArray[np.float32] | None:
    """The texture coordinates that the base colour texture uses, its KHR_texture_transform applied, shape (V, 2).

    None where the primitive lacks them.

    Raises:
        FormatError: The set or the transform is malformed.
    """
    texture = None
    if primitive.material is not None:
        material = file.item("materials", primitive.material, where)
        texture = getattr(material.pbrMetallicRoughness, "baseColorTexture", None)
    transform: dict[str, Any] = ((texture.extensions if texture else None) or {}).get("KHR_texture_transform", {})
    uv_set = transform.get("texCoord", (texture.texCoord if texture else None) or 0)
    accessor = getattr(primitive.attributes, f"TEXCOORD_{uv_set}", None)
    if accessor is None:
        return None
    uvs = file.floats(accessor, "VEC2", f"{where} TEXCOORD_{uv_set}")
    return transformed_uvs(uvs, transform) if transform else uvs


def transformed_uvs(uvs: npt.NDArray[np.float32], transform: dict[str, Any]) -> npt.NDArray[np.float32]:
    """Scales, rotates, then offsets, shape (V, 2).

    Positive angles turn counter-clockwise as one looks at the image, v down: as Khronos' viewer does, not as the GLSL
    of the extension's text does (github.com/KhronosGroup/glTF issue 1563).
    """
    angle = float(transform.get("rotation", 0.0))
    cos, sin = math.cos(angle), math.sin(angle)
    linear = np.array([[cos, sin], [-sin, cos]]) @ np.diag(transform.get("scale", (1.0, 1.0)))
    return (uvs @ linear.T + transform.get("offset", (0.0, 0.0))).astype(np.float32)


def _or(value: Any, default: Any) -> Any:
    return default if value is None else value
