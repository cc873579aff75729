"""Reads and writes glTF materials: metallic-roughness with textures, the KHR extensions, and unlit materials.

Textures are written as PNG.
"""

from __future__ import annotations

import io
import logging
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.gltf.container import GltfDocument, GltfFile, GltfPrimitive
from lumisplat.io.gltf.textures import (
    WRAP_NUMBERS,
    GltfTexels,
    Textures,
    UvTransform,
    material_textures,
    specular_glossiness,
    texture_extension,
)
from lumisplat.math.arrays import Doubles
from lumisplat.scene.materials import AlphaMode, Material, MaterialPbr, MaterialSimple, Texture, WrapPair, wraps_of

if TYPE_CHECKING:
    import pygltflib

_log = logging.getLogger("lumisplat")

_DIELECTRIC = 0.04
"""Reflectance at normal incidence of a dielectric with an index of refraction of 1.5."""

_LISTED_MAX = 4
"""Largest number of materials that one log line names."""


_READ = {
    "KHR_gaussian_splatting",
    "KHR_lights_punctual",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
    "EXT_mesh_gpu_instancing",
    *("EXT_texture_webp", "EXT_texture_avif", "KHR_texture_basisu", "MSFT_texture_dds"),
    *(f"KHR_materials_{name}" for name in ("unlit", "emissive_strength", "ior", "specular", "transmission", "volume")),
    *(f"KHR_materials_{name}" for name in ("clearcoat", "sheen", "pbrSpecularGlossiness")),
}
"""Extensions that are not reported as unread: Lumisplat reads them, or another log line reports their loss."""
_WITHOUT_EFFECT = (
    "KHR_xmp",
    "KHR_materials_variants",  # the default variant is used
    "KHR_animation_pointer",
    "KHR_audio",
    "KHR_draco_mesh_compression",  # optional: the file has the uncompressed mesh, too
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
    "KHR_interactivity",
    "KHR_node_hoverability",
    "KHR_node_selectability",
    "KHR_physics",
    "KHR_implicit_shapes",
    "EXT_structural_metadata",
    "EXT_mesh_features",
    "EXT_instance_features",
    "MSFT_lod",  # the finest level is used
    "VRM",
)
"""Beginnings of extension names that are not reported as unread, because they do not change the image."""

_Item = dict[str, Any]


def warn_unread(file: GltfFile) -> None:
    """Logs features of a file that are not read but may change the image, one line per feature.

    Such features are unknown extensions, textures in unsupported formats, clearcoat normal, thickness and specular
    textures, and textures whose coordinates differ from those of the base colour.
    """
    materials = file.model.materials or []
    if others := sorted(name for name in file.extensions - _READ if not name.startswith(_WITHOUT_EFFECT)):
        _log.warning("%s: extensions not read, though they may change the image: %s", file.path, ", ".join(others))
    unsupported = [name for texture in file.model.textures or () if (name := texture_extension(texture))]
    if unsupported:
        count = f"{len(unsupported):,} texture{'s' * (len(unsupported) > 1)}"
        _log.warning("%s: %s left out: %s is not read", file.path, count, ", ".join(sorted(set(unsupported))))
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
        f"{texture} of %d material%s is not used{why} (first %s)": [
            label for label, material in labelled if texture in _extension(material, extension)
        ]
        for texture, extension, why in (
            ("clearcoatNormalTexture", "clearcoat", ", the clearcoat uses the normals of the base layer"),
            ("thicknessTexture", "volume", ", rays measure thickness through the mesh itself"),
            ("specularTexture", "specular", ""),
            ("specularColorTexture", "specular", ""),
            ("specularColorFactor", "specular", ""),
        )
    }
    for line, labels in lines.items():
        if labels:
            _log.warning("%s: " + line, file.path, len(labels), "s" * (len(labels) > 1), labels[0])
    glossy = [label for label, one in labelled if "specularGlossinessTexture" in (specular_glossiness(one) or {})]
    if glossy:
        _log.warning(
            "%s: specular colour textures are not read: %d material%s of specular-glossiness become dielectrics "
            "(first %s)",
            file.path,
            len(glossy),
            "s" * (len(glossy) > 1),
            glossy[0],
        )


def _inside(material: pygltflib.Material, transmission: float) -> dict[str, Any]:
    """Returns absorption fields for the interior of a transmissive surface (KHR_materials_volume).

    Without a thickness there is no interior: the surface is ``thin_walled``.
    """
    volume = _extension(material, "volume")
    if not volume.get("thicknessFactor", 0.0) > 0.0:
        return {"thin_walled": transmission > 0.0}
    return {
        "attenuation_color": tuple(volume.get("attenuationColor", (1.0, 1.0, 1.0))),
        "attenuation_distance": volume.get("attenuationDistance", math.inf),
    }


def _layers(material: pygltflib.Material) -> dict[str, Any]:
    """Returns the clearcoat and sheen fields of a material, from KHR_materials_clearcoat and KHR_materials_sheen."""
    coat, sheen = _extension(material, "clearcoat"), _extension(material, "sheen")
    return {
        "clearcoat": coat.get("clearcoatFactor", 0.0),
        "clearcoat_roughness": coat.get("clearcoatRoughnessFactor", 0.0),
        "sheen_color": tuple(sheen.get("sheenColorFactor", (0.0, 0.0, 0.0))),
        "sheen_roughness": sheen.get("sheenRoughnessFactor", 0.0),
    }


def _metallic_roughness(material: pygltflib.Material) -> dict[str, Any]:
    """Returns metallic-roughness factors, converted from specular-glossiness if the material uses that.

    Without textures, the conversion finds the base colour and metalness that reproduce the diffuse and specular
    colours, with dielectrics reflecting 4 %. A material with a specular texture is read as a dielectric, and so is a
    material without a specularFactor, whose default would be white.
    """
    glossiness = specular_glossiness(material)
    if glossiness is None:
        pbr = material.pbrMetallicRoughness
        return {} if pbr is None else vars(pbr)
    diffuse = [float(value) for value in glossiness.get("diffuseFactor", (1.0, 1.0, 1.0, 1.0))]
    specular = [float(value) for value in glossiness.get("specularFactor", ())]
    textured = "specularGlossinessTexture" in glossiness
    color, metallic = np.array(diffuse[:3]), 0.0
    if len(specular) == 3 and not textured and "diffuseTexture" not in glossiness:
        color, metallic = _metal_of(color, np.array(specular))
    rough = 1.0 if textured else 1.0 - float(glossiness.get("glossinessFactor", 1.0))
    return {
        "baseColorFactor": [*color.tolist(), *diffuse[3:]],
        "metallicFactor": metallic,
        "roughnessFactor": rough,
    }


def _metal_of(diffuse: Doubles, specular: Doubles) -> tuple[Doubles, float]:
    """Returns the base colour and metalness that reproduce a diffuse and a specular colour, shape (3,) each.

    With d and s the brightest channels of the two colours, d (1 - s) is reflected diffusely and s specularly. A base
    colour b with metalness m gives d (1 - s) = b (1 - m) (1 - F) and s = F (1 - m) + b m, with F = 0.04. Eliminating b
    leaves a quadratic equation for m.
    """
    scattered, mirrored = float(diffuse.max()), float(specular.max())
    if mirrored <= _DIELECTRIC:
        return diffuse, 0.0
    # F m^2 + (d (1 - s) / (1 - F) + s - 2 F) m + F - s = 0
    linear = scattered * (1.0 - mirrored) / (1.0 - _DIELECTRIC) + mirrored - 2.0 * _DIELECTRIC
    root = math.sqrt(linear * linear - 4.0 * _DIELECTRIC * (_DIELECTRIC - mirrored))
    metallic = min(max((root - linear) / (2.0 * _DIELECTRIC), 0.0), 1.0)
    by_diffuse = diffuse * (1.0 - mirrored) / ((1.0 - _DIELECTRIC) * max(1.0 - metallic, 1e-6))
    by_specular = (specular - _DIELECTRIC * (1.0 - metallic)) / max(metallic, 1e-6)
    return np.clip(by_diffuse + (by_specular - by_diffuse) * metallic * metallic, 0.0, 1.0), metallic


def _roughness_texels(texels: npt.NDArray[np.uint8], glossiness: dict[str, Any]) -> npt.NDArray[np.uint8]:
    """Converts a specularGlossinessTexture, with glossiness in alpha, to a texture with roughness in green.

    Roughness is 1 minus ``glossinessFactor`` times the glossiness.
    """
    alpha = texels[..., 3] if texels.shape[2] == 4 else np.full(texels.shape[:2], 255, np.uint8)
    roughness = 255.0 - float(glossiness.get("glossinessFactor", 1.0)) * alpha
    return np.stack([np.zeros_like(alpha), np.clip(roughness + 0.5, 0, 255).astype(np.uint8), 0 * alpha], axis=2)


def _is_unlit(material: pygltflib.Material) -> bool:
    return "KHR_materials_unlit" in (material.extensions or {})


def _textures(material: pygltflib.Material) -> Textures:
    return material_textures(material, only_color=_is_unlit(material))


def _extension(material: pygltflib.Material, name: str) -> dict[str, Any]:
    """Returns the ``KHR_materials_{name}`` object of a material, empty if the material lacks it."""
    return (material.extensions or {}).get(f"KHR_materials_{name}", {})


def _label(index: int, material: pygltflib.Material) -> str:
    return f"materials[{index}]" + (f" {material.name!r}" if material.name else "")


class GltfMaterials:
    """Reads the materials of a glTF file; each is decoded once."""

    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._texels = GltfTexels(file)
        self._materials: dict[int, Material] = {}

    def get(self, index: int | None, referrer: str) -> Material:
        """Returns the material at ``index``, or glTF's default material for None.

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
        pbr = _metallic_roughness(material)
        factors = tuple(_value_or(pbr.get("baseColorFactor"), (1.0, 1.0, 1.0, 1.0)))
        color, shared = factors[:3], self._textures_and_alpha(material, factors, label)
        if _is_unlit(material):
            return MaterialSimple(base_color=color, name=material.name or "", **shared)
        transmission = _extension(material, "transmission").get("transmissionFactor", 0.0)
        strength = _extension(material, "emissive_strength").get("emissiveStrength", 1.0)
        emissive = tuple(strength * factor for factor in material.emissiveFactor or (0.0, 0.0, 0.0))
        return MaterialPbr(
            base_color=color,
            metallic=_value_or(pbr.get("metallicFactor"), 1.0),
            roughness=_value_or(pbr.get("roughnessFactor"), 1.0),
            specular=_extension(material, "specular").get("specularFactor", 1.0),
            # The extension allows 0 for compatibility with older materials; below 1 it has no physical meaning.
            ior=max(_extension(material, "ior").get("ior", 1.5), 1.0),
            transmission=transmission,
            **_inside(material, transmission),
            **_layers(material),
            emissive=emissive,
            double_sided=bool(material.doubleSided) or not any(emissive),  # reflection is two-sided in either case
            normal_scale=_value_or(getattr(material.normalTexture, "scale", None), 1.0),
            occlusion_strength=_value_or(getattr(material.occlusionTexture, "strength", None), 1.0),
            name=material.name or "",
            **shared,
        )

    def _textures_and_alpha(
        self, material: pygltflib.Material, factors: tuple[float, ...], label: str
    ) -> dict[str, Any]:
        """Returns the fields that all material classes have: textures, wrap modes and alpha.

        Args:
            material: The material.
            factors: Base colour factors; the fourth, if present, is alpha.
            label: Name of the material in messages.
        """
        textures = _textures(material)
        read = {name: self._texels.get(index, label) for name, index in textures.indices.items()}
        values: dict[str, Any] = {name: texels for name, texels in read.items() if texels is not None}
        glossiness = specular_glossiness(material)
        if glossiness is not None and "metallic_roughness_texture" in values:
            values["metallic_roughness_texture"] = _roughness_texels(values["metallic_roughness_texture"], glossiness)
        with_alpha = {"sheen_roughness_texture"}
        if material.alphaMode not in {None, "OPAQUE"}:
            with_alpha.add("base_color_texture")
        for name in values.keys() - with_alpha:
            values[name] = values[name][:, :, :3]
        wraps = textures.wraps(self._file, label)
        values |= _wrap_values({name: wrap for name, wrap in wraps.items() if name in values})
        values["alpha_mode"] = str(_value_or(material.alphaMode, "OPAQUE")).lower()
        values["alpha_cutoff"] = _value_or(material.alphaCutoff, 0.5)
        values["alpha"] = factors[3] if len(factors) > 3 else 1.0
        return values


def texture_uvs(primitive: GltfPrimitive) -> npt.NDArray[np.float32] | None:
    """Returns the transformed texture coordinates of a primitive's V vertices, shape (V, 2).

    The base colour texture, or without one the material's first texture, selects the coordinates. None is returned if
    the primitive lacks the selected coordinates.

    Raises:
        FormatError: The coordinates or the transform are malformed.
    """
    uv_transform, index = UvTransform(), primitive.item.material
    if index is not None:
        uv_transform = _textures(primitive.file.item("materials", index, primitive.where)).uv_transform
    uvs = primitive.floats(f"TEXCOORD_{uv_transform.uv_set}", "VEC2")
    return None if uvs is None else uv_transform.apply(uvs)


def _wrap_values(wraps: dict[str, WrapPair]) -> dict[str, Any]:
    """Returns wrap fields of a material: ``wrap_u`` and ``wrap_v`` of the first texture, and ``texture_wraps``.

    ``texture_wraps`` has the modes of textures that differ from the first.
    """
    if not wraps:
        return {}
    first = next(iter(wraps.values()))
    others = {name: wrap for name, wrap in wraps.items() if wrap != first}
    values: dict[str, Any] = {"wrap_u": first[0], "wrap_v": first[1]}
    return values | ({"texture_wraps": others} if others else {})


def _value_or(value: Any, default: Any) -> Any:
    return default if value is None else value


class MaterialWriter:
    """Writes the materials and textures of a scene; a material that several meshes use is written once.

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
        """Names of the `MaterialSimple` materials that glTF can only approximate."""
        self.ranked = 0
        """Number of materials whose ``priority`` in nested media is lost, because glTF cannot store it."""

    def index(self, material: Material, *, textured: bool) -> int:
        """Returns the index of a material in the file, and writes the material on first use.

        Args:
            material: The material.
            textured: Whether the mesh has texture coordinates. Without them the material is written without textures.
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
            "baseColorFactor": [*material.mesh_color, material.alpha],
            "metallicFactor": material.mesh_metallic,
            "roughnessFactor": material.mesh_roughness,
            "baseColorTexture": texture("base_color_texture"),
            "metallicRoughnessTexture": texture("metallic_roughness_texture"),
        }
        normals, occlusion = texture("normal_texture"), texture("occlusion_texture")
        strength = max(1.0, *material.emissive)
        item: _Item = {
            "pbrMetallicRoughness": _without_none(surface),
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
            extensions |= self._document.use("KHR_materials_clearcoat", **_without_none(coat))
        if any(material.sheen_color):
            sheen: _Item = {
                "sheenColorFactor": list(material.sheen_color),
                "sheenRoughnessFactor": material.sheen_roughness,
                "sheenColorTexture": texture("sheen_color_texture"),
                "sheenRoughnessTexture": texture("sheen_roughness_texture"),
            }
            extensions |= self._document.use("KHR_materials_sheen", **_without_none(sheen))
        self.ranked += material.priority != 0
        return _without_none(item) | _common_fields(material) | ({"extensions": extensions} if extensions else {})

    def _transmission(self, material: MaterialPbr, texture: _Item | None) -> _Item:
        """Returns KHR_materials_transmission, and for a solid also KHR_materials_volume with thickness 1.

        glTF has no flag for solids: any thickness above 0 means a solid.
        """
        factors = _without_none({"transmissionFactor": material.transmission, "transmissionTexture": texture})
        extensions = self._document.use("KHR_materials_transmission", **factors)
        if material.is_solid:
            volume: _Item = {"thicknessFactor": 1.0, "attenuationColor": list(material.attenuation_color)}
            if math.isfinite(material.attenuation_distance):
                volume["attenuationDistance"] = material.attenuation_distance
            extensions |= self._document.use("KHR_materials_volume", **volume)
        return extensions

    def _simple(self, material: MaterialSimple, textured: bool) -> _Item:
        """Returns a `MaterialSimple` as glTF: unlit if it only emits its colour, else an approximation that is lit."""
        surface: _Item = {
            "baseColorFactor": [*material.base_color, material.alpha],
            "baseColorTexture": self._texture(material, "base_color_texture") if textured else None,
            "metallicFactor": 0.0,
        }
        if material.emissive == (1.0, 1.0, 1.0) and not any((*material.diffuse, *material.specular)):
            unlit = self._document.use("KHR_materials_unlit")
            return {"pbrMetallicRoughness": _without_none(surface), "extensions": unlit} | _common_fields(material)
        self.approximated.append(material.name or "a simple material")
        reflected = [color * share for color, share in zip(material.base_color, material.diffuse, strict=True)]
        surface["baseColorFactor"] = [*reflected, material.alpha]
        # A Phong lobe of exponent n is about as wide as a microfacet lobe with alpha^2 = 2 / (n + 2).
        surface["roughnessFactor"] = (2.0 / (material.shininess + 2.0)) ** 0.25 if any(material.specular) else 1.0
        shining = [color * factor for color, factor in zip(material.base_color, material.emissive, strict=True)]
        strength = max(1.0, *shining)
        item: _Item = {
            "pbrMetallicRoughness": _without_none(surface),
            "emissiveFactor": [one / strength for one in shining],
        }
        if strength > 1.0:
            item["extensions"] = self._document.use("KHR_materials_emissive_strength", emissiveStrength=strength)
        return item | _common_fields(material)

    def _texture(self, material: Material, name: str) -> _Item | None:
        """Returns the textureInfo for a material field; None if the field has no texture."""
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


def _without_none(item: _Item) -> _Item:
    """Returns a JSON item without the keys whose value is None."""
    return {key: value for key, value in item.items() if value is not None}


def _common_fields(material: Material) -> _Item:
    """Returns the name, sidedness and alpha mode of a glTF material.

    Materials are double-sided, except emissive materials that emit from one side and solid transmissive materials.
    """
    item: _Item = {"name": material.name} if material.name else {}
    if material.is_emissive or not (isinstance(material, MaterialPbr) and material.is_solid):
        item["doubleSided"] = not isinstance(material, MaterialPbr) or material.double_sided
    if material.alpha_mode is not AlphaMode.OPAQUE:
        item["alphaMode"] = material.alpha_mode.value.upper()
    return item | ({"alphaCutoff": material.alpha_cutoff} if material.alpha_mode is AlphaMode.MASK else {})
