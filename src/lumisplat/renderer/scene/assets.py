"""Gaussian sets and meshes on the device, uploaded once and reused as long as scenes contain the same objects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import warp as wp

from lumisplat.device.structs.scene import GaussianData, MeshData, VariedData
from lumisplat.device.structs.shading import SplatAttributes
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.reflectance import albedo_curves
from lumisplat.renderer.scene.materials import varied_table, varies
from lumisplat.runtime.buffers import DeviceArray, bytes_of, device_array
from lumisplat.runtime.struct_tables import upload_table
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.materials import Material, MaterialPbr, texture_names
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene

Key = TypeVar("Key")
Result = TypeVar("Result")
TextureKey = tuple[int, tuple[int, ...]]


class AssetCache(Generic[Result]):
    """Caches a function's result for each asset; results that the latest call did not request are dropped."""

    def __init__(self, find: Callable[[Any], Result]) -> None:
        self._find = find
        self._cached: list[tuple[object, Result]] = []

    def of(self, assets: Sequence[Mesh | Gaussians]) -> list[Result]:
        """Returns the function's result for each asset, computed only if not cached."""
        cached = {id(asset): found for asset, found in self._cached}
        for asset in assets:
            if id(asset) not in cached:
                cached[id(asset)] = self._find(asset)
        self._cached = [(asset, cached[id(asset)]) for asset in assets]
        return [found for _, found in self._cached]


@dataclass(frozen=True, slots=True)
class SplatAsset:
    """A Gaussian set on the device, and the splat instances that use the set."""

    gaussians: Gaussians
    data: GaussianData
    attributes: SplatAttributes
    instances: tuple[int, ...]
    """Indices of the splat instances that use the set."""
    instance_ids: DeviceArray
    """Indices of the splat instances that use the set, on the device."""

    @property
    def instanced_count(self) -> int:
        """Number of Gaussians over all instances of the set."""
        return self.gaussians.count * self.instance_ids.shape[0]

    @property
    def bytes(self) -> int:
        """Device memory of the set's arrays, bytes."""
        d = self.data
        return bytes_of(d.means, d.rotations, d.scales, d.opacities, d.sh)


def sync_splat_assets(scene: Scene, cached: list[SplatAsset], device: str) -> list[SplatAsset]:
    """Returns the assets of a scene, in the order of their first instances; uploads sets that are not cached.

    A new set may replace a cached set with arrays of equal sizes, as in animations: its values are then copied into the
    old arrays. On the CPU this does not happen, because kernels read the host's arrays.

    Args:
        scene: The scene with the instances.
        cached: Assets on the device. Assets without an instance are removed from this list first, and their memory is
            freed or reused, so that the device never holds two scenes.
        device: Warp device name.
    """
    numbers: dict[int, list[int]] = {}
    for number, instance in enumerate(scene.splats):
        numbers.setdefault(id(instance.gaussians), []).append(number)
    sets = [scene.splats[instances[0]].gaussians for instances in numbers.values()]
    still_used = {id(asset.gaussians): asset for asset in cached if id(asset.gaussians) in numbers}
    replaced = {
        id(gaussians): asset
        for asset, gaussians in zip(cached, sets, strict=False)
        if not shares_memory(device)
        and not {id(asset.gaussians), id(gaussians)} & still_used.keys()
        and are_alike(asset.gaussians, gaussians)
    }
    cached[:] = still_used.values()
    assets: list[SplatAsset] = []
    for gaussians, instances in zip(sets, numbers.values(), strict=True):
        asset = still_used.get(id(gaussians)) or replaced.pop(id(gaussians), None)
        if asset is None or asset.instances != tuple(instances):
            ids = DeviceArray(np.array(instances, np.int32), device=device)
        else:
            ids = asset.instance_ids
        data, attributes = _on_device(gaussians, asset, device)
        assets.append(SplatAsset(gaussians, data, attributes, tuple(instances), ids))
    return assets


def _on_device(gaussians: Gaussians, asset: SplatAsset | None, device: str) -> tuple[GaussianData, SplatAttributes]:
    """Returns a set's device arrays: new ones for ``asset`` None, else those of ``asset``, overwritten if needed."""
    if asset is None:
        data = upload_gaussians(gaussians, device)
        return data, upload_attributes(gaussians, data, device)
    if asset.gaussians is not gaussians:
        overwrite_gaussians(asset.data, asset.attributes, gaussians)
    return asset.data, asset.attributes


def upload_gaussians(gaussians: Gaussians, device: str) -> GaussianData:
    """Copies a Gaussian set to the device. On the CPU, kernels share the host's arrays where the layout allows."""
    data = GaussianData()
    data.sh_count = gaussians.sh.shape[1]
    for name, dtype, values in _arrays_of(gaussians):
        setattr(data, name, as_device_array(values, dtype, device))
    return data


def upload_attributes(gaussians: Gaussians, data: GaussianData, device: str) -> SplatAttributes:
    """Returns the attributes of Gaussians that shading reads; some of the arrays are shared with ``data``."""
    row = SplatAttributes()
    row.means, row.scales, row.normals = data.means, data.scales, data.normals
    for name, dtype, values in _materials_of(gaussians):
        setattr(row, name, as_device_array(values, dtype, device))
    return row


def are_alike(one: Gaussians, other: Gaussians) -> bool:
    """Returns whether two sets have the same attributes, and equal numbers of Gaussians and SH coefficients."""
    names = ("normals", "albedo", "roughness", "metallic")
    absent = [[getattr(gaussians, name) is None for name in names] for gaussians in (one, other)]
    return one.sh.shape == other.sh.shape and absent[0] == absent[1]


def overwrite_gaussians(data: GaussianData, attributes: SplatAttributes, gaussians: Gaussians) -> None:
    """Copies a set into the device arrays of a set with equal sizes, so that the addresses in kernels remain valid."""
    for owner, arrays in ((data, _arrays_of(gaussians)), (attributes, _materials_of(gaussians))):
        for name, _, values in arrays:
            device_array(getattr(owner, name)).assign(values)


def shares_memory(device: str) -> bool:
    """Returns whether kernels on the device read the host's arrays directly; such arrays must not be overwritten."""
    return device == "cpu"


def _arrays_of(gaussians: Gaussians) -> list[tuple[str, type[object], np.ndarray]]:
    """Returns names, element types and values of the arrays in `GaussianData`."""
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
    """Returns names, element types and values of the arrays that only `SplatAttributes` has."""
    values = (("roughness", gaussians.roughness), ("metallic", gaussians.metallic))
    return [(name, wp.float32, array) for name, array in values if array is not None]


class MeshAssets:
    """The distinct meshes of a scene, one after another in shared device arrays.

    Args:
        device: Warp device name.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._meshes: dict[int, Mesh] = {}
        self._face_first: dict[int, int] = {}
        self._texture_first: dict[TextureKey, int] = {}
        self._varied: dict[int, int] = {}
        self.data = MeshData()

    def sync(self, scene: Scene) -> None:
        """Uploads the scene's meshes if they are not those of the last call."""
        meshes = {id(instance.mesh): instance.mesh for instance in scene.meshes}
        if list(meshes) == list(self._meshes):
            return
        self._meshes, self.data = {}, MeshData()
        self._face_first = first_of({key: mesh.face_count for key, mesh in meshes.items()})
        self.data, self._texture_first = upload_meshes(tuple(meshes.values()), self._device)
        self._upload_varied(meshes)
        self._meshes = meshes

    def _upload_varied(self, meshes: dict[int, Mesh]) -> None:
        """Uploads a VariedData row for each mesh whose transmission, clearcoat or sheen varies by textures."""
        materials = {key: mesh.material for key, mesh in meshes.items() if varies(mesh)}
        self._varied = {key: 1 + number for number, key in enumerate(materials)}
        found = [material for material in materials.values() if isinstance(material, MaterialPbr)]
        self.data.varied = upload_table(varied_table(found, self.texture_first), VariedData, self._device)
        if any(material.sheen_roughness_texture is not None for material in found):
            self.data.sheen_curves = DeviceArray(albedo_curves().astype(np.float32), dtype=wp.vec4, device=self._device)

    def face_first(self, mesh: Mesh) -> int:
        """Returns the index of a mesh's first face in the shared arrays."""
        return self._face_first[id(mesh)]

    def varied(self, mesh: Mesh) -> int:
        """Returns a mesh's index in ``data.varied``; 0: no texture varies the mesh's transmission or layers."""
        return self._varied.get(id(mesh), 0)

    def texture_first(self, texture: np.ndarray) -> int:
        """Returns the index of a texture's first texel in the shared arrays."""
        return self._texture_first[texture_key(texture)]

    @property
    def bytes(self) -> int:
        """Device memory of meshes and textures, bytes."""
        m = self.data
        return bytes_of(m.positions, m.normals, m.uvs, m.colors, m.indices, m.texels) if self._meshes else 0


def upload_meshes(meshes: tuple[Mesh, ...], device: str) -> tuple[MeshData, dict[TextureKey, int]]:
    """Uploads meshes and their textures one after another; also returns the index of each texture's first texel."""
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
    """Returns the material's textures; None for each texture that the material lacks."""
    return [getattr(material, name) for name in texture_names(material)]


def pack_textures(textures: list[Any]) -> tuple[np.ndarray, dict[TextureKey, int]]:
    """Returns the RGBA8 texels of all textures that are not None, one after another, and the first index of each."""
    distinct = {texture_key(texture): texture for texture in textures if texture is not None}
    texels = [np.zeros(1, np.uint32)]  # an array without elements has no address
    for texture in distinct.values():
        rgba = np.full((*texture.shape[:2], 4), 255, np.uint8)
        rgba[..., : texture.shape[2]] = texture
        texels.append(rgba.reshape(-1).view("<u4"))
    starts = first_of({key: texture[..., 0].size for key, texture in distinct.items()})
    return np.concatenate(texels), {key: 1 + first for key, first in starts.items()}


def texture_key(texture: np.ndarray) -> TextureKey:
    """Returns a key that identifies a texture; equal for two array views of one image."""
    return texture.ctypes.data, texture.shape


def first_of(counts: dict[Key, int]) -> dict[Key, int]:
    """Returns the start index of each key's elements in a list that concatenates ``counts[key]`` elements per key."""
    return dict(zip(counts, np.cumsum([0, *counts.values()]).tolist(), strict=False))


def as_device_array(values: np.ndarray, dtype: type[object], device: str) -> DeviceArray:
    """Returns an asset's NumPy array as a device array; on the CPU, both share memory."""
    # Warp refuses read-only arrays; kernels never write to assets, so a writable view of the same memory is safe.
    if not shares_memory(device):
        return DeviceArray(values, dtype=dtype, device=device)
    return DeviceArray(np.lib.stride_tricks.as_strided(values, writeable=True), dtype=dtype, device=device, copy=False)
