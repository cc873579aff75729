"""Uploads assets to the device."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
import warp as wp

from lumisplat.constants import TRIANGLE_BOX_MARGIN
from lumisplat.device.structs.scene import GaussianData, MeshData
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.runtime.buffers import DeviceArray
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.materials import Material
from lumisplat.scene.mesh import Mesh

Key = TypeVar("Key")
TextureKey = tuple[int, tuple[int, ...]]


def upload_gaussians(gaussians: Gaussians, device: str) -> GaussianData:
    """Copies an asset to the device; on the CPU its arrays are shared where their layout allows."""
    data = GaussianData()
    data.means = as_device_array(gaussians.means, wp.vec3, device)
    data.rotations = wp.array(gaussians.rotations_wxyz[:, [1, 2, 3, 0]], dtype=wp.quat, device=device)
    data.scales = as_device_array(gaussians.scales, wp.vec3, device)
    data.opacities = as_device_array(gaussians.opacities, wp.float32, device)
    data.sh = as_device_array(gaussians.sh.reshape(-1, 3), wp.vec3, device)
    data.sh_count = gaussians.sh.shape[1]
    if gaussians.normals is not None:
        data.normals = as_device_array(gaussians.normals, wp.vec3, device)
    if gaussians.albedo is not None:
        data.albedo = wp.array(encode_srgb(gaussians.albedo), dtype=wp.vec3, device=device)
    return data


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
    names = [field.name for field in fields(material) if field.name.endswith("_texture")]
    return [getattr(material, name) for name in names]


def build_triangle_bvh(mesh: Mesh, device: str) -> wp.Bvh:
    """A bounding volume hierarchy over a mesh's triangles in its own space; item k is triangle k.

    Boxes are grown so that rounding never makes a ray miss a triangle that it hits.
    """
    corners = mesh.positions[mesh.indices].astype(np.float64)
    low, high = mesh.bounds()
    margin = TRIANGLE_BOX_MARGIN * np.linalg.norm(high.astype(np.float64) - low)
    down, up = np.float32(-np.inf), np.float32(np.inf)
    lows = np.nextafter((corners.min(axis=1) - margin).astype(np.float32), down)
    highs = np.nextafter((corners.max(axis=1) + margin).astype(np.float32), up)
    return wp.Bvh(wp.array(lows, dtype=wp.vec3, device=device), wp.array(highs, dtype=wp.vec3, device=device))


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
    if device != "cpu":
        return DeviceArray(values, dtype=dtype, device=device)
    return DeviceArray(np.lib.stride_tricks.as_strided(values, writeable=True), dtype=dtype, device=device, copy=False)
