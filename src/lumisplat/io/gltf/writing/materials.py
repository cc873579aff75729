"""Materials as those of glTF files: metallic-roughness with extensions, unlit ones, and their textures as PNG."""

from __future__ import annotations

import io
import math
from typing import Any

from lumisplat.io.gltf.textures import WRAP_NUMBERS
from lumisplat.io.gltf.writing.document import GltfDocument
from lumisplat.scene.materials import AlphaMode, Material, MaterialPbr, MaterialSimple, wraps_of
from lumisplat.scene.textures import Texture, WrapPair

_Item = dict[str, Any]


class MaterialWriter:
    """Appends the materials and textures of a scene, each once.

    Args:
        document: The file.
    """

    def __init__(self, document: GltfDocument) -> None:
        self._document = document
        self._materials: dict[tuple[int, bool], int] = {}
        self._images: dict[int, int] = {}
        self._textures: dict[tuple[int, WrapPair], int] = {}
        self._samplers: dict[WrapPair, int] = {}
        self.approximated: list[str] = []
        """Names of materials that glTF has nothing like."""
        self.ranked = 0
        """How many have a ``priority``, which glTF does not know."""

    def index(self, material: Material, *, textured: bool) -> int:
        """The index of a material in the file.

        Args:
            material: The material.
            textured: Whether the mesh has texture coordinates; else it is written without textures.
        """
        key = (id(material), textured)
        if key not in self._materials:
            if isinstance(material, MaterialPbr):
                item = self._pbr(material, textured)
            else:
                item = self._simple(material, textured)
            self._materials[key] = self._document.add("materials", item)
        return self._materials[key]

    def _pbr(self, material: MaterialPbr, textured: bool) -> _Item:
        def texture(name: str) -> _Item | None:
            return self._texture(material, name) if textured else None

        surface: _Item = {
            "baseColorFactor": [*material.base_color, material.alpha],
            "metallicFactor": material.metallic,
            "roughnessFactor": material.roughness,
            "baseColorTexture": texture("base_color_texture"),
            "metallicRoughnessTexture": texture("metallic_roughness_texture"),
        }
        normals, occlusion = texture("normal_texture"), texture("occlusion_texture")
        strength = max(1.0, *material.emissive)
        item: _Item = {
            "pbrMetallicRoughness": _given(surface),
            "normalTexture": normals and normals | {"scale": material.normal_scale},
            "occlusionTexture": occlusion and occlusion | {"strength": material.occlusion_strength},
            "emissiveTexture": texture("emissive_texture"),
            "emissiveFactor": [factor / strength for factor in material.emissive],
        }
        extensions: _Item = {}
        if strength > 1.0:
            extensions |= self._document.use("KHR_materials_emissive_strength", emissiveStrength=strength)
        if material.specular != 1.0:
            extensions |= self._document.use("KHR_materials_specular", specularFactor=material.specular)
        if material.ior != 1.5:
            extensions |= self._document.use("KHR_materials_ior", ior=material.ior)
        if material.transmission > 0.0:
            extensions |= self._transmission(material, texture("transmission_texture"))
        if material.clearcoat > 0.0:
            coat: _Item = {
                "clearcoatFactor": material.clearcoat,
                "clearcoatRoughnessFactor": material.clearcoat_roughness,
                "clearcoatTexture": texture("clearcoat_texture"),
                "clearcoatRoughnessTexture": texture("clearcoat_roughness_texture"),
            }
            extensions |= self._document.use("KHR_materials_clearcoat", **_given(coat))
        if any(material.sheen_color):
            sheen: _Item = {
                "sheenColorFactor": list(material.sheen_color),
                "sheenRoughnessFactor": material.sheen_roughness,
                "sheenColorTexture": texture("sheen_color_texture"),
                "sheenRoughnessTexture": texture("sheen_roughness_texture"),
            }
            extensions |= self._document.use("KHR_materials_sheen", **_given(sheen))
        self.ranked += material.priority != 0
        return _given(item) | _shared(material) | ({"extensions": extensions} if extensions else {})

    def _transmission(self, material: MaterialPbr, texture: _Item | None) -> _Item:
        """What light does that goes through; a thickness, of whatever size, says that there is an inside."""
        factors = _given({"transmissionFactor": material.transmission, "transmissionTexture": texture})
        extensions = self._document.use("KHR_materials_transmission", **factors)
        if material.is_solid:
            volume: _Item = {"thicknessFactor": 1.0, "attenuationColor": list(material.attenuation_color)}
            if math.isfinite(material.attenuation_distance):
                volume["attenuationDistance"] = material.attenuation_distance
            extensions |= self._document.use("KHR_materials_volume", **volume)
        return extensions

    def _simple(self, material: MaterialSimple, textured: bool) -> _Item:
        """An unlit material if it is one; else the nearest of metallic roughness, which is not near."""
        surface: _Item = {
            "baseColorFactor": [*material.base_color, material.alpha],
            "baseColorTexture": self._texture(material, "base_color_texture") if textured else None,
            "metallicFactor": 0.0,
        }
        if material.emissive == (1.0, 1.0, 1.0) and not any((*material.diffuse, *material.specular)):
            unlit = self._document.use("KHR_materials_unlit")
            return {"pbrMetallicRoughness": _given(surface), "extensions": unlit} | _shared(material)
        self.approximated.append(material.name or "a simple material")
        reflected = [color * share for color, share in zip(material.base_color, material.diffuse, strict=True)]
        surface["baseColorFactor"] = [*reflected, material.alpha]
        # Phong's lobe of exponent n is about as wide as that of a microfacet distribution with alpha^2 = 2 / (n + 2).
        surface["roughnessFactor"] = (2.0 / (material.shininess + 2.0)) ** 0.25 if any(material.specular) else 1.0
        shining = [color * factor for color, factor in zip(material.base_color, material.emissive, strict=True)]
        strength = max(1.0, *shining)
        item: _Item = {"pbrMetallicRoughness": _given(surface), "emissiveFactor": [one / strength for one in shining]}
        if strength > 1.0:
            item["extensions"] = self._document.use("KHR_materials_emissive_strength", emissiveStrength=strength)
        return item | _shared(material)

    def _texture(self, material: Material, name: str) -> _Item | None:
        """A texture of a material; None: it has none of that name."""
        texels: Texture | None = getattr(material, name)
        if texels is None:
            return None
        wraps = wraps_of(material, name)
        key = (id(texels), wraps)
        if key not in self._textures:
            item = {"source": self._image(texels), "sampler": self._sampler(wraps)}
            self._textures[key] = self._document.add("textures", item)
        return {"index": self._textures[key]}

    def _image(self, texels: Texture) -> int:
        from PIL import Image

        if id(texels) not in self._images:
            buffer = io.BytesIO()
            Image.fromarray(texels).save(buffer, format="PNG")
            item = {"bufferView": self._document.view(buffer.getvalue()), "mimeType": "image/png"}
            self._images[id(texels)] = self._document.add("images", item)
        return self._images[id(texels)]

    def _sampler(self, wraps: WrapPair) -> int:
        if wraps not in self._samplers:
            wrap_s, wrap_t = (WRAP_NUMBERS[wrap] for wrap in wraps)
            self._samplers[wraps] = self._document.add("samplers", {"wrapS": wrap_s, "wrapT": wrap_t})
        return self._samplers[wraps]


def _given(item: _Item) -> _Item:
    """An item without what is None."""
    return {key: value for key, value in item.items() if value is not None}


def _shared(material: Material) -> _Item:
    """What materials of all kinds have. Surfaces have two sides, unless they emit from one or are bodies of glass."""
    item: _Item = {"name": material.name} if material.name else {}
    if material.is_emissive or not (isinstance(material, MaterialPbr) and material.is_solid):
        item["doubleSided"] = not isinstance(material, MaterialPbr) or material.double_sided
    if material.alpha_mode is not AlphaMode.OPAQUE:
        item["alphaMode"] = material.alpha_mode.value.upper()
    return item | ({"alphaCutoff": material.alpha_cutoff} if material.alpha_mode is AlphaMode.MASK else {})
