"""Materials of glTF files: metallic-roughness with textures, the extensions that `MaterialPbr` supports, and unlit."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.gltf.primitive import GltfPrimitive
from lumisplat.io.gltf.textures import GltfTexels, Placement, Textures, material_textures
from lumisplat.scene.materials import Material, MaterialPbr, MaterialSimple
from lumisplat.scene.textures import WrapPair

if TYPE_CHECKING:
    import pygltflib

_log = logging.getLogger("lumisplat")

_LISTED_MAX = 4
"""Largest number of materials that one log line names."""


def warn_unread(file: GltfFile) -> None:
    """Logs the features of the file's materials that are not read, one line per feature.

    These are normals of the clearcoat, thickness, and textures with other coordinates than the base colour.
    """
    materials = file.model.materials or []
    misplaced = {_label(k, material): _textures(material).left_out for k, material in enumerate(materials)}
    named = [f"{', '.join(textures)} of {label}" for label, textures in misplaced.items() if textures]
    if named:
        more = f" and {len(named) - _LISTED_MAX} more materials" if len(named) > _LISTED_MAX else ""
        _log.warning(
            "%s: textures left out, their texture coordinates are not those of the base colour: %s%s",
            file.path,
            "; ".join(named[:_LISTED_MAX]),
            more,
        )
    labelled = [(_label(index, material), material) for index, material in enumerate(materials)]
    lines = {
        f"{texture} of %d materials is not used{why} (first %s)": [
            label for label, material in labelled if texture in _extension(material, extension)
        ]
        for texture, extension, why in (
            ("clearcoatNormalTexture", "clearcoat", ", the coat has the normals of what is below"),
            ("thicknessTexture", "volume", ", rays go through the mesh itself"),
        )
    }
    for line, labels in lines.items():
        if labels:
            _log.warning("%s: " + line, file.path, len(labels), labels[0])


def _inside(material: pygltflib.Material, transmission: float) -> dict[str, Any]:
    """What lies behind a surface that transmits: nothing, without a thickness; else a medium (KHR_materials_volume)."""
    volume = _extension(material, "volume")
    if not volume.get("thicknessFactor", 0.0) > 0.0:
        return {"thin_walled": transmission > 0.0}
    return {
        "attenuation_color": tuple(volume.get("attenuationColor", (1.0, 1.0, 1.0))),
        "attenuation_distance": volume.get("attenuationDistance", math.inf),
    }


def _layers(material: pygltflib.Material) -> dict[str, Any]:
    """The factors of clearcoat and sheen (KHR_materials_clearcoat, KHR_materials_sheen)."""
    coat, sheen = _extension(material, "clearcoat"), _extension(material, "sheen")
    return {
        "clearcoat": coat.get("clearcoatFactor", 0.0),
        "clearcoat_roughness": coat.get("clearcoatRoughnessFactor", 0.0),
        "sheen_color": tuple(sheen.get("sheenColorFactor", (0.0, 0.0, 0.0))),
        "sheen_roughness": sheen.get("sheenRoughnessFactor", 0.0),
    }


def _is_unlit(material: pygltflib.Material) -> bool:
    return "KHR_materials_unlit" in (material.extensions or {})


def _textures(material: pygltflib.Material) -> Textures:
    return material_textures(material, only_color=_is_unlit(material))


def _extension(material: pygltflib.Material, name: str) -> dict[str, Any]:
    """``KHR_materials_{name}`` of a material, empty if it has none."""
    return (material.extensions or {}).get(f"KHR_materials_{name}", {})


def _label(index: int, material: pygltflib.Material) -> str:
    return f"materials[{index}]" + (f" {material.name!r}" if material.name else "")


class GltfMaterials:
    """The materials of a file, each decoded once."""

    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._texels = GltfTexels(file)
        self._materials: dict[int, Material] = {}

    def get(self, index: int | None, referrer: str) -> Material:
        """The material at ``index``; glTF's default material for None.

        Raises:
            FormatError: The index is invalid, a value is out of range, or a texture is missing or corrupt.
        """
        if index is None:
            return MaterialPbr(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=1.0)
        material = self._file.item("materials", index, referrer)
        if index not in self._materials:
            try:
                self._materials[index] = self._decode(material, _label(index, material))
            except FormatError:
                raise
            except SceneError as error:
                raise FormatError(self._file.path, f"{_label(index, material)}: {error}") from None
        return self._materials[index]

    def _decode(self, material: pygltflib.Material, label: str) -> Material:
        pbr = material.pbrMetallicRoughness
        factors = tuple(_or(getattr(pbr, "baseColorFactor", None), (1.0, 1.0, 1.0, 1.0)))
        color, shared = factors[:3], self._textures_and_alpha(material, factors, label)
        if _is_unlit(material):
            return MaterialSimple(base_color=color, name=material.name or "", **shared)
        transmission = _extension(material, "transmission").get("transmissionFactor", 0.0)
        strength = _extension(material, "emissive_strength").get("emissiveStrength", 1.0)
        return MaterialPbr(
            base_color=color,
            metallic=_or(getattr(pbr, "metallicFactor", None), 1.0),
            roughness=_or(getattr(pbr, "roughnessFactor", None), 1.0),
            specular=_extension(material, "specular").get("specularFactor", 1.0),
            # The extension allows 0 for compatibility with older materials; below 1 it has no physical meaning.
            ior=max(_extension(material, "ior").get("ior", 1.5), 1.0),
            transmission=transmission,
            **_inside(material, transmission),
            **_layers(material),
            emissive=tuple(strength * factor for factor in material.emissiveFactor or (0.0, 0.0, 0.0)),
            normal_scale=_or(getattr(material.normalTexture, "scale", None), 1.0),
            occlusion_strength=_or(getattr(material.occlusionTexture, "strength", None), 1.0),
            name=material.name or "",
            **shared,
        )

    def _textures_and_alpha(
        self, material: pygltflib.Material, factors: tuple[float, ...], label: str
    ) -> dict[str, Any]:
        """What all kinds of materials have: texels, how they wrap, and alpha."""
        textures = _textures(material)
        values: dict[str, Any] = {name: self._texels.get(index, label) for name, index in textures.indices.items()}
        with_alpha = {"sheen_roughness_texture"}
        if material.alphaMode not in {None, "OPAQUE"}:
            with_alpha.add("base_color_texture")
        for name in values.keys() - with_alpha:
            values[name] = values[name][:, :, :3]
        values |= _wrap_values(textures.wraps(self._file, label))
        values["alpha_mode"] = str(_or(material.alphaMode, "OPAQUE")).lower()
        values["alpha_cutoff"] = _or(material.alphaCutoff, 0.5)
        values["alpha"] = factors[3] if len(factors) > 3 else 1.0
        return values


def texture_uvs(primitive: GltfPrimitive) -> npt.NDArray[np.float32] | None:
    """Transformed texture coordinates of the base colour texture, else of the material's first texture, shape (V, 2).

    None if the primitive has no such coordinates.

    Raises:
        FormatError: The set or the transform is malformed.
    """
    placement, index = Placement(), primitive.item.material
    if index is not None:
        placement = _textures(primitive.file.item("materials", index, primitive.where)).placement
    uvs = primitive.floats(f"TEXCOORD_{placement.uv_set}", "VEC2")
    return None if uvs is None else placement.transform(uvs)


def _wrap_values(wraps: dict[str, WrapPair]) -> dict[str, Any]:
    """How a material's textures wrap: as the first of them, but for those that are named."""
    if not wraps:
        return {}
    first = next(iter(wraps.values()))
    others = {name: wrap for name, wrap in wraps.items() if wrap != first}
    values: dict[str, Any] = {"wrap_u": first[0], "wrap_v": first[1]}
    return values | ({"texture_wraps": others} if others else {})


def _or(value: Any, default: Any) -> Any:
    return default if value is None else value
