"""Uploads assets to the device."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import warp as wp

from lumisplat.device.structs.scene import GaussianData, MeshData
from lumisplat.device.structs.shading import SplatAttributes
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.reflectance import albedo_curves
from lumisplat.runtime.buffers import DeviceArray, device_array
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.materials import Material, texture_names
from lumisplat.scene.mesh import Mesh

Key = TypeVar("Key")
TextureKey = tuple[int, tuple[int, ...]]


def upload_gaussians(gaussians: Gaussians, device: str) -> GaussianData:
    """Copies an asset to the device; on the CPU its arrays are shared where their layout allows."""
    data = GaussianData()
    data.sh_count = gaussians.sh.shape[1]
    for name, dtype, values in _arrays_of(gaussians):
        setattr(data, name, as_device_array(values, dtype, device))
    return data


def upload_attributes(gaussians: Gaussians, data: GaussianData, device: str) -> SplatAttributes:
    """The attributes of an asset's Gaussians that shading reads, some of which are in ``data``."""
    row = SplatAttributes()
    row.means, row.scales, row.normals = data.means, data.scales, data.normals
    for name, dtype, values in _materials_of(gaussians):
        setattr(row, name, as_device_array(values, dtype, device))
    return row


def are_alike(one: Gaussians, other: Gaussians) -> bool:
    """Whether two sets have the same arrays, of the same sizes: as many Gaussians, harmonics and further attributes."""
    names = ("normals", "albedo", "roughness", "metallic")
    absent = [[getattr(gaussians, name) is None for name in names] for gaussians in (one, other)]
    return one.sh.shape == other.sh.shape and absent[0] == absent[1]


def overwrite_gaussians(data: GaussianData, attributes: SplatAttributes, gaussians: Gaussians) -> None:
    """Copies a set to where one like it has been; kernels find it at the same addresses."""
    for owner, arrays in ((data, _arrays_of(gaussians)), (attributes, _materials_of(gaussians))):
        for name, _, values in arrays:
            device_array(getattr(owner, name)).assign(values)


def shares_memory(device: str) -> bool:
    """Whether kernels read the arrays of assets where the host has them: they may not be written to."""
    return device == "cpu"


def _arrays_of(gaussians: Gaussians) -> list[tuple[str, type[object], np.ndarray]]:
    """Names, elements and values of the arrays of `GaussianData`."""
    arrays: list[tuple[str, type[object], np.ndarray]] = [
        ("means", wp.vec3, gaussians.means),
        ("rotations", wp.quat, np.ascontiguousarray(gaussians.rotations_wxyz[:, [1, 2, 3, 0]])),
        ("scales", wp.vec3, gaussians.scales),
        ("opacities", wp.float32, gaussians.opacities),
        ("sh", wp.vec3, gaussians.sh.reshape(-1, 3)),
    ]
    if gaussians.normals is not None:
        arrays.append(("normals", wp.vec3, gaussians.normals))
    if gaussians.albedo is not None:
        arrays.append(("albedo", wp.vec3, encode_srgb(gaussians.albedo)))
    return arrays


def _materials_of(gaussians: Gaussians) -> list[tuple[str, type[object], np.ndarray]]:
    """The same of those of `SplatAttributes` that are not in `GaussianData`."""
    values = (("roughness", gaussians.roughness), ("metallic", gaussians.metallic))
    return [(name, wp.float32, array) for name, array in values if array is not None]


def upload_meshes(meshes: tuple[Mesh, ...], device: str) -> tuple[MeshData, dict[TextureKey, int]]:
    """Uploads meshes and their textures end to end; also returns the first texel of each texture."""
    data = MeshData()
    if not meshes:
        return data, {}
    vertex_first = np.cumsum([0, *(mesh.vertex_count for mesh in meshes)])
    indices = np.concatenate([mesh.indices + first for mesh, first in zip(meshes, vertex_first[:-1], strict=True)])

    def attribute(name: str, default: float, width: int) -> np.ndarray:
        filler = [(getattr(mesh, name), (mesh.vertex_count, width)) for mesh in meshes]
        return np.concatenate([np.full(shape, default, np.float32) if a is None else a for a, shape in filler])

    data.positions = wp.array(attribute("positions", 0.0, 3), dtype=wp.vec3, device=device)
    data.normals = wp.array(attribute("normals", 0.0, 3), dtype=wp.vec3, device=device)
    data.uvs = wp.array(attribute("uvs", 0.0, 2), dtype=wp.vec2, device=device)
    data.colors = wp.array(attribute("colors", 1.0, 3), dtype=wp.vec3, device=device)
    data.indices = wp.array(indices.astype(np.int32), dtype=wp.vec3i, device=device)
    texels, texture_first = pack_textures([texture for mesh in meshes for texture in textures_of(mesh.material)])
    data.texels = wp.array(texels, dtype=wp.uint32, device=device)
    data.linear_from_byte = wp.array(
        decode_srgb(np.arange(256) / 255.0).astype(np.float32), dtype=wp.float32, device=device
    )
    data.unit_from_byte = wp.array((np.arange(256) / 255.0).astype(np.float32), dtype=wp.float32, device=device)
    return data, texture_first


def textures_of(material: Material) -> list[Any]:
    """All textures that a material may have; None: it has no such texture."""
    return [getattr(material, name) for name in texture_names(material)]


def upload_sheen_curves(device: str) -> DeviceArray:
    """The table of albedos of sheen by its roughness."""
    return DeviceArray(albedo_curves().astype(np.float32), dtype=wp.vec4, device=device)


def upload_array(values: np.ndarray, device: str) -> DeviceArray:
    """A copy of an array on the device."""
    return DeviceArray(values, device=device)


def pack_textures(textures: list[Any]) -> tuple[np.ndarray, dict[TextureKey, int]]:
    """RGBA8 texels of all textures end to end, None skipped, and the first texel of each."""
    distinct = {texture_key(texture): texture for texture in textures if texture is not None}
    texels = [np.zeros(1, np.uint32)]  # an array without elements has no address
    for texture in distinct.values():
        rgba = np.full((*texture.shape[:2], 4), 255, np.uint8)
        rgba[..., : texture.shape[2]] = texture
        texels.append(rgba.reshape(-1).view("<u4"))
    starts = first_of({key: texture[..., 0].size for key, texture in distinct.items()})
    return np.concatenate(texels), {key: 1 + first for key, first in starts.items()}


def texture_key(texture: np.ndarray) -> TextureKey:
    """Identity of a texture: two views of one image are the same texture."""
    return texture.ctypes.data, texture.shape


def first_of(counts: dict[Key, int]) -> dict[Key, int]:
    """Where each entry starts if all are stored end to end."""
    return dict(zip(counts, np.cumsum([0, *counts.values()]).tolist(), strict=False))


def as_device_array(values: np.ndarray, dtype: type[object], device: str) -> DeviceArray:
    """An asset's array on the device; on the CPU the same memory."""
    # Warp refuses read-only arrays; kernels never write to assets, so a writable view of the same memory is safe.
    if not shares_memory(device):
        return DeviceArray(values, dtype=dtype, device=device)
    return DeviceArray(np.lib.stride_tricks.as_strided(values, writeable=True), dtype=dtype, device=device, copy=False)
