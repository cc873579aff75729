"""The scene on the device. Assets are uploaded once, as long as the same objects come back; poses every frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import Antialiasing, RenderConfig
from lumisplat.constants import JACOBIAN_CLAMP, TILE_PX
from lumisplat.device.structs import CameraData, GaussianData, InstanceData, MeshData, MeshInstanceData
from lumisplat.scene.camera import Camera
from lumisplat.scene.color import decode_srgb
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene


class DeviceScene:
    """Device copies of a scene's assets, and the per-frame tables that place them.

    Args:
        device: Warp device name.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._gaussians: dict[int, tuple[Gaussians, GaussianData]] = {}
        self._meshes: tuple[Mesh, ...] = ()
        self._texture_first: dict[int, int] = {}
        self.version = 0
        """Changes whenever device arrays did, so that captured graphs can tell."""
        self.gaussians: list[GaussianData] = []
        """One entry a splat instance; instances of one asset share it."""
        self.mesh_data = MeshData()
        self.face_counts: list[int] = []
        """Triangles of each mesh instance."""
        self.gaussian_counts: list[int] = []
        """Gaussians of each splat instance."""
        self.camera: Any = wp.zeros(1, dtype=CameraData, device=device)
        self.instances: Any = wp.zeros(0, dtype=InstanceData, device=device)
        self.mesh_instances: Any = wp.zeros(0, dtype=MeshInstanceData, device=device)

    def sync(self, scene: Scene, camera: Camera, config: RenderConfig) -> None:
        """Uploads the assets that are new, drops those no longer used, and writes poses and camera."""
        self._sync_gaussians(scene)
        self._sync_meshes(scene)
        self._place_splats(scene, camera, config)
        self._place_meshes(scene, camera)
        self.camera.assign(camera_table(camera, config))

    @property
    def bytes(self) -> int:
        """Memory of the assets, bytes."""
        arrays = [a for _, d in self._gaussians.values() for a in (d.means, d.rotations, d.scales, d.opacities, d.sh)]
        if self._meshes:
            m = self.mesh_data
            arrays += [m.positions, m.normals, m.uvs, m.colors, m.indices, m.texels]
        return sum(array.capacity for array in arrays)

    def _sync_gaussians(self, scene: Scene) -> None:
        wanted = {id(instance.gaussians): instance.gaussians for instance in scene.splats}
        if wanted.keys() != self._gaussians.keys():
            self._gaussians = {key: held for key, held in self._gaussians.items() if key in wanted}
            for key in wanted.keys() - self._gaussians.keys():
                self._gaussians[key] = (wanted[key], upload_gaussians(wanted[key], self._device))
            self.version += 1
        self.gaussians = [self._gaussians[id(instance.gaussians)][1] for instance in scene.splats]
        self.gaussian_counts = [instance.gaussians.count for instance in scene.splats]

    def _sync_meshes(self, scene: Scene) -> None:
        meshes = tuple({id(instance.mesh): instance.mesh for instance in scene.meshes}.values())
        if [id(mesh) for mesh in meshes] != [id(mesh) for mesh in self._meshes]:
            self._meshes = meshes
            self.mesh_data, self._texture_first = upload_meshes(meshes, self._device)
            self.version += 1
        self.face_counts = [instance.mesh.face_count for instance in scene.meshes]

    def _place_splats(self, scene: Scene, camera: Camera, config: RenderConfig) -> None:
        table = np.zeros(len(scene.splats), dtype=table_dtype(InstanceData))
        first = 0
        for row, instance in zip(_rows(table), scene.splats, strict=True):
            camera_from_object = camera.camera_from_world @ instance.transform
            row["camera_from_object"] = camera_from_object[:3, :3]
            row["camera_from_object_offset"] = camera_from_object[:3, 3]
            row["world_from_object"] = instance.transform[:3, :3] / instance.scale
            row["eye"] = (np.linalg.inv(instance.transform) @ [*camera.eye, 1.0])[:3]
            row["first"] = first
            mode = config.raster.antialiasing
            row["antialiased"] = mode is Antialiasing.ON or (
                mode is Antialiasing.AUTO and instance.gaussians.antialiased
            )
            first += instance.gaussians.count
        self.instances = self._write(self.instances, InstanceData, table)

    def _place_meshes(self, scene: Scene, camera: Camera) -> None:
        face_first = {}
        total = 0
        for mesh in self._meshes:
            face_first[id(mesh)] = total
            total += mesh.face_count
        table = np.zeros(len(scene.meshes), dtype=table_dtype(MeshInstanceData))
        triangle_first = 0
        for row, instance in zip(_rows(table), scene.meshes, strict=True):
            camera_from_object = camera.camera_from_world @ instance.transform
            row["camera_from_object"] = camera_from_object[:3, :3]
            row["camera_from_object_offset"] = camera_from_object[:3, 3]
            normal_matrix = np.linalg.inv(instance.transform[:3, :3]).T
            row["world_from_object_normal"] = normal_matrix / np.abs(normal_matrix).max()
            row["face_first"] = face_first[id(instance.mesh)]
            row["triangle_first"] = triangle_first
            row["has_normals"] = instance.mesh.normals is not None
            material = instance.mesh.material
            row["base_color"] = material.base_color
            texture = material.base_color_texture
            if texture is not None and instance.mesh.uvs is not None:
                row["texture_first"] = self._texture_first[id(texture)]
                row["texture_height"], row["texture_width"] = texture.shape[:2]
            triangle_first += instance.mesh.face_count
        self.mesh_instances = self._write(self.mesh_instances, MeshInstanceData, table)

    def _write(self, held: Any, dtype: Any, table: np.ndarray) -> Any:
        if held.shape[0] != len(table):
            held = wp.zeros(len(table), dtype=dtype, device=self._device)
            self.version += 1
        if len(table):
            held.assign(table)
        return held


def table_dtype(struct: Any) -> np.dtype:
    """NumPy's view of a Warp struct, to fill tables of it row by row."""
    return np.dtype(struct.numpy_dtype())


def camera_table(camera: Camera, config: RenderConfig) -> np.ndarray:
    """The 1-element table that kernels read the frame's camera and settings from."""
    table = np.zeros(1, dtype=table_dtype(CameraData))
    row = _rows(table)[0]
    size, focal = np.array([camera.width, camera.height]), np.array([camera.fx, camera.fy])
    center = np.array([camera.cx, camera.cy])
    margin = (JACOBIAN_CLAMP - 1.0) * 0.5 * size / focal
    row["world_from_camera"] = camera.world_from_camera[:3, :3]
    row["eye"] = camera.eye
    row["focal"], row["center"] = focal, center
    row["jacobian_min"] = -center / focal - margin
    row["jacobian_max"] = (size - center) / focal + margin
    row["width"], row["height"] = camera.width, camera.height
    row["tiles_x"], row["tiles_y"] = -(-camera.width // TILE_PX), -(-camera.height // TILE_PX)
    row["near"] = camera.near
    row["dilation"] = config.raster.dilation
    row["sh_degree"] = config.raster.sh_degree
    row["transmittance_min"] = config.raster.transmittance_min
    row["depth_iso_transmittance"] = config.raster.depth_iso_transmittance
    row["background"] = config.background or (0.0, 0.0, 0.0)
    return table


def upload_gaussians(gaussians: Gaussians, device: str) -> GaussianData:
    """Copies an asset to the device; on the CPU its arrays are shared where their layout allows."""
    data = GaussianData()
    data.means = _shared(gaussians.means, wp.vec3, device)
    data.rotations = wp.array(gaussians.rotations_wxyz[:, [1, 2, 3, 0]], dtype=wp.quat, device=device)
    data.scales = _shared(gaussians.scales, wp.vec3, device)
    data.opacities = _shared(gaussians.opacities, wp.float32, device)
    data.sh = _shared(gaussians.sh.reshape(-1, 3), wp.vec3, device)
    data.sh_count = gaussians.sh.shape[1]
    return data


def upload_meshes(meshes: tuple[Mesh, ...], device: str) -> tuple[MeshData, dict[int, int]]:
    """Concatenates meshes and their textures; also returns the first texel of each texture, by its ``id``."""
    data = MeshData()
    if not meshes:
        return data, {}
    vertex_first = np.cumsum([0, *(mesh.vertex_count for mesh in meshes)])
    indices = np.concatenate([mesh.indices + first for mesh, first in zip(meshes, vertex_first[:-1], strict=True)])

    def attribute(name: str, default: float, width: int) -> np.ndarray:
        filler = [(getattr(mesh, name), (mesh.vertex_count, width)) for mesh in meshes]
        return np.concatenate([np.full(shape, default, np.float32) if a is None else a for a, shape in filler])

    textures = {id(t): t for t in (mesh.material.base_color_texture for mesh in meshes) if t is not None}
    texels, texture_first, count = [np.zeros(1, np.uint32)], {}, 1
    for key, texture in textures.items():
        rgba = np.full((*texture.shape[:2], 4), 255, np.uint8)
        rgba[..., : texture.shape[2]] = texture
        texture_first[key] = count
        texels.append(rgba.reshape(-1).view("<u4"))
        count += texels[-1].size
    data.positions = wp.array(attribute("positions", 0.0, 3), dtype=wp.vec3, device=device)
    data.normals = wp.array(attribute("normals", 0.0, 3), dtype=wp.vec3, device=device)
    data.uvs = wp.array(attribute("uvs", 0.0, 2), dtype=wp.vec2, device=device)
    data.colors = wp.array(attribute("colors", 1.0, 3), dtype=wp.vec3, device=device)
    data.indices = wp.array(indices.astype(np.int32), dtype=wp.vec3i, device=device)
    data.texels = wp.array(np.concatenate(texels), dtype=wp.uint32, device=device)
    data.linear_from_byte = wp.array(
        decode_srgb(np.arange(256) / 255.0).astype(np.float32), dtype=wp.float32, device=device
    )
    return data, texture_first


def _rows(table: np.ndarray) -> list[Any]:
    return [table[i] for i in range(len(table))]


def _shared(values: np.ndarray, dtype: Any, device: str) -> Any:
    # Warp refuses read-only arrays; kernels never write to assets, so a writable view of the same memory is safe.
    if device != "cpu":
        return wp.array(values, dtype=dtype, device=device)
    return wp.array(np.lib.stride_tricks.as_strided(values, writeable=True), dtype=dtype, device=device, copy=False)
