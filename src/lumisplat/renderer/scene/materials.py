"""Tables of materials that kernels read."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lumisplat.constants import CATCHER_AMBIENT, COAT_ROUGHNESS_MIN, SHEEN_ROUGHNESS_MIN
from lumisplat.device.structs.scene import WRAP_CLAMP, WRAP_MIRROR, WRAP_REPEAT, VariedData
from lumisplat.device.structs.shading import BSDF_PBR, BSDF_SIMPLE, MaterialData
from lumisplat.math.reflectance import albedo_curve, mean_fresnel
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.scene.lights import LightEnvironment
from lumisplat.scene.materials import (
    Color,
    Material,
    MaterialPbr,
    MaterialSimple,
    TextureWrap,
    WrapPair,
    wraps_of,
)
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

TextureFirst = Callable[[np.ndarray], int]

_WRAPS = {TextureWrap.REPEAT: WRAP_REPEAT, TextureWrap.MIRROR: WRAP_MIRROR, TextureWrap.CLAMP: WRAP_CLAMP}
_VARIED = {
    "transmission_texture": "transmission_texture",
    "clearcoat_texture": "coat_texture",
    "clearcoat_roughness_texture": "coat_roughness_texture",
    "sheen_color_texture": "sheen_texture",
    "sheen_roughness_texture": "sheen_roughness_texture",
}
"""Names of the texture fields of VariedData, by the name of the corresponding field of a material."""
_TEXTURES = ("metallic_roughness_texture", "normal_texture", "occlusion_texture", "emissive_texture")


_GUESSED = (CATCHER_AMBIENT, CATCHER_AMBIENT, CATCHER_AMBIENT)


def emits_capture_only(instance: SplatInstance) -> bool:
    """Returns whether a splat set only emits its captured colours and reflects no light."""
    material = material_of(instance)
    if instance.shadow_catcher or isinstance(material, MaterialPbr):
        return False
    return material.emissive == (1.0, 1.0, 1.0) and not any(material.ambient + material.diffuse + material.specular)


def catcher_ambient(instance: SplatInstance, scene: Scene, *, is_sequence: bool) -> Color:
    """Returns the ambient light on a shadow catcher, by channel: the catcher's reflected radiance over its albedo.

    A catcher without a material gets a default if the scene has no environment, which would be ambient light already.
    In scenes without lights only real-time frames (``is_sequence``) have it: paths find the light of captures on
    catchers by rays, and in the other pipelines nothing casts shadows there.
    """
    if instance.material is not None:
        return instance.material.ambient if isinstance(instance.material, MaterialSimple) else _GUESSED
    lights = [light for light in scene.lights if light.enabled]
    if any(isinstance(light, LightEnvironment) for light in lights) or not (lights or is_sequence):
        return (0.0, 0.0, 0.0)
    return _GUESSED


def is_relit(instance: SplatInstance) -> bool:
    """Returns whether a splat set is relit: in lit frames, it reflects lights and hides its captured colours."""
    material = material_of(instance)
    ambient = material.ambient if isinstance(material, MaterialSimple) else (0.0, 0.0, 0.0)
    return not instance.shadow_catcher and min(np.add(material.emissive, ambient)) < 1.0


def is_medium(instance: MeshInstance, *, traces_paths: bool) -> bool:
    """Returns whether rays refract into a mesh of solid transmissive material; into a rough one, only paths do."""
    material = instance.mesh.material
    return (material.is_smooth or traces_paths) and isinstance(material, MaterialPbr) and material.is_solid


def is_rough_glass(instance: MeshInstance) -> bool:
    """Returns whether the surface of a mesh scatters transmitted light (rough glass), which only paths follow."""
    material = instance.mesh.material
    return isinstance(material, MaterialPbr) and material.transmission > 0.0 and not material.is_smooth


def absorbs(instance: MeshInstance) -> bool:
    """Returns whether a mesh contains a medium that absorbs light."""
    material = instance.mesh.material
    return isinstance(material, MaterialPbr) and math.isfinite(material.attenuation_distance)


_AS_CAPTURED = MaterialSimple()
"""Material of a splat set that has none: it emits its captured colours."""


def material_of(instance: SplatInstance) -> Material:
    """Returns the material of a splat set, or `_AS_CAPTURED` if it has none."""
    return instance.material or _AS_CAPTURED


def shading_overrides(scene: Scene, lit: bool) -> dict[str, list[bool]]:
    """Returns which splat instances use the normals, and which the albedo, stored with their Gaussians.

    Instances that reflect light use the normals. Instances that also emit no captured colours use the albedo.
    """
    reflects = [lit and not emits_capture_only(instance) for instance in scene.splats]
    return {
        "stored_normals": [r and i.gaussians.normals is not None for r, i in zip(reflects, scene.splats, strict=True)],
        "shows_albedo": [
            r and i.gaussians.albedo is not None and not i.shadow_catcher and not any(material_of(i).emissive)
            for r, i in zip(reflects, scene.splats, strict=True)
        ],
    }


def tint_of(instance: SplatInstance) -> Color:
    """Returns the factor on the colour of a splat set in lit frames: the base colour of its `MaterialPbr`.

    It is white for sets that show captured colours, as shadow catchers and sets that emit them fully do.
    """
    material = material_of(instance)
    if not isinstance(material, MaterialPbr) or not is_relit(instance):
        return (1.0, 1.0, 1.0)
    return material.values_on(instance.gaussians).base_color


def material_table(
    scene: Scene,
    texture_first: TextureFirst,
    *,
    is_lit: bool,
    compensates: bool = False,
    is_sequence: bool = False,
) -> np.ndarray:
    """Returns one row of MaterialData per instance: splats first, then meshes.

    Args:
        scene: The scene with the instances.
        texture_first: Returns the index of a texture's first texel.
        is_lit: Whether the frame is lit; if not, all splats only emit their captured colours.
        compensates: Whether to add the energy that rough metals lose if only single scattering is computed.
        is_sequence: Whether the frame is one of `Pipeline.REALTIME`.
    """
    table = np.zeros(len(scene.splats) + len(scene.meshes), dtype=table_dtype(MaterialData))
    table["compensates"] = compensates
    rows: list[Any] = list(table)
    for row, splats in zip(rows, scene.splats, strict=False):
        material = material_of(splats)
        _fill(row, material)
        if isinstance(material, MaterialPbr):
            _, row["metallic"], row["roughness"] = material.values_on(splats.gaussians)
        row["emits_capture_only"] = not is_lit or emits_capture_only(splats)
        row["keeps_capture"] = not is_lit or not is_relit(splats)
        if splats.shadow_catcher:
            row["shadow_catcher"] = 1
            row["emissive"] = 1.0
            row["ambient"] = catcher_ambient(splats, scene, is_sequence=is_sequence)
    for row, meshes in zip(rows[len(scene.splats) :], scene.meshes, strict=True):
        _fill(row, meshes.mesh.material)
        _fill_textures(row, meshes.mesh, texture_first)
    return table


def _fill(row: Any, material: Material) -> None:
    row["emissive"] = material.emissive
    if isinstance(material, MaterialSimple):
        row["model"], row["double_sided"] = BSDF_SIMPLE, 1
        for name in ("ambient", "diffuse", "specular", "shininess"):
            row[name] = getattr(material, name)
        row["roughness"] = 1.0  # so that it never counts as smooth
        return
    row["model"] = BSDF_PBR
    row["specular_strength"] = material.specular
    row["fresnel_mean"] = mean_fresnel(material.ior)
    fill_layers(row, material)
    row["sheen"] = material.sheen_color
    row["sheen_alpha"] = max(material.sheen_roughness, SHEEN_ROUGHNESS_MIN) ** 2
    row["metallic"], row["roughness"] = material.mesh_metallic, material.mesh_roughness
    for name in ("double_sided", "ior", "transmission", "thin_walled"):
        row[name] = getattr(material, name)
    row["normal_scale"], row["occlusion_strength"] = material.normal_scale, material.occlusion_strength


def _fill_textures(row: Any, mesh: Mesh, texture_first: TextureFirst) -> None:
    if mesh.uvs is None or not isinstance(mesh.material, MaterialPbr):
        return
    for name in _TEXTURES:
        texture = getattr(mesh.material, name)
        if texture is not None:
            write_texture(row[name], texture, wraps_of(mesh.material, name), texture_first)


def varies(mesh: Mesh) -> bool:
    """Returns whether textures vary a mesh's transmission, clearcoat or sheen."""
    has_any = any(getattr(mesh.material, name, None) is not None for name in _VARIED)
    return has_any and mesh.uvs is not None


def varied_table(materials: Sequence[MaterialPbr], texture_first: TextureFirst) -> np.ndarray:
    """Returns rows of VariedData: row 0 stays empty and stands for "not varied", then one row for each material."""
    table = np.zeros(1 + len(materials), dtype=table_dtype(VariedData))
    for row, material in zip(list[Any](table)[1:], materials, strict=True):
        row["transmission"], row["coat"], row["sheen"] = material.transmission, material.clearcoat, material.sheen_color
        row["coat_roughness"], row["sheen_roughness"] = material.clearcoat_roughness, material.sheen_roughness
        if any(material.sheen_color):
            row["sheen_curve"] = albedo_curve(material.sheen_roughness)
        for name, field in _VARIED.items():
            texture = getattr(material, name)
            if texture is not None:
                write_texture(row[field], texture, wraps_of(material, name), texture_first)
    return table


def fill_layers(row: Any, material: MaterialPbr) -> None:
    """Fills clearcoat, and the albedo curve of the sheen, in a material's row.

    The caller fills colour and roughness of the sheen, which the material structs store differently.
    """
    row["coat"] = material.clearcoat
    row["coat_alpha"] = max(material.clearcoat_roughness, COAT_ROUGHNESS_MIN) ** 2
    if any(material.sheen_color):
        row["sheen_curve"] = albedo_curve(material.sheen_roughness)


def has_layers(material: Material | None) -> bool:
    """Returns whether a material has clearcoat or sheen."""
    return isinstance(material, MaterialPbr) and (material.clearcoat > 0.0 or any(material.sheen_color))


def write_texture(row: Any, texture: np.ndarray, wraps: WrapPair, texture_first: TextureFirst) -> None:
    """Fills a row of TextureData with a texture's first texel, size and wrap modes."""
    row["first"] = texture_first(texture)
    row["height"], row["width"] = texture.shape[:2]
    row["wrap_u"], row["wrap_v"] = (_WRAPS[wrap] for wrap in wraps)
