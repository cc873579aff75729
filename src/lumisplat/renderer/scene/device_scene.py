"""The scene on the device. Assets are uploaded once, as long as the same objects come back; poses every frame."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import Antialiasing, RenderConfig
from lumisplat.constants import INSTANCE_BOX_MARGIN, JACOBIAN_CLAMP, RAY_START_BACK, TILE_PX
from lumisplat.device.structs.rays import MeshPlacement
from lumisplat.device.structs.scene import CameraData, GaussianData, InstanceData, MeshData, MeshInstanceData
from lumisplat.errors import DeviceError
from lumisplat.renderer.scene.materials import shading_overrides
from lumisplat.renderer.scene.upload import (
    TextureKey,
    build_triangle_tree,
    first_of,
    texture_key,
    upload_gaussians,
    upload_meshes,
)
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class SplatAsset:
    """A Gaussian set on the device, and where it is placed."""

    gaussians: Gaussians
    data: GaussianData
    instance_ids: Any
    """Indices of its splat instances, on the device."""

    @property
    def placed_count(self) -> int:
        """Gaussians over all of its instances."""
        return self.gaussians.count * self.instance_ids.shape[0]


@dataclass(frozen=True, slots=True)
class TriangleBvh:
    """Where rays look for the triangles of a mesh."""

    mesh: Mesh
    bvh: Any
    corners: np.ndarray
    """Of its bounding box, object space, shape (8, 3)."""

    @classmethod
    def of(cls, mesh: Mesh, device: str) -> TriangleBvh:
        """A tree, built on the device."""
        corners = list(itertools.product(*zip(*mesh.bounds(), strict=True)))
        return cls(mesh, build_triangle_tree(mesh, device), np.array(corners, dtype=np.float64))

    def world_box(self, transform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World-space corners (min, max) around an instance of the mesh, with room for what rounding does to rays."""
        world = self.corners @ transform[:3, :3].T + transform[:3, 3]
        low, high = world.min(axis=0), world.max(axis=0)
        margin = INSTANCE_BOX_MARGIN * np.linalg.norm(high - low) + RAY_START_BACK * np.abs([low, high]).max()
        return low - margin, high + margin


class DeviceScene:
    """Device copies of a scene's assets, and the per-frame tables that place them.

    Args:
        device: Warp device name.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._structure: tuple[list[int], list[int]] | None = None
        self._meshes: dict[int, Mesh] = {}
        self._trees: dict[int, TriangleBvh] = {}
        self._face_first: dict[int, int] = {}
        self.texture_first: dict[TextureKey, int] = {}
        """First texel of each texture."""
        self.version = 0
        """Changes whenever device arrays or what they stand for did, so that captured graphs can tell."""
        self.assets: list[SplatAsset] = []
        self.mesh_data = MeshData()
        self.gaussian_count = 0
        """Gaussians over all instances."""
        self.triangle_count = 0
        """Triangles over all instances."""
        self.camera: Any = wp.zeros(1, dtype=CameraData, device=device)
        self.instances: Any = None
        """Poses of the splat instances."""
        self.mesh_instances: Any = None
        """Poses and materials of the mesh instances."""
        self.placements: Any = None
        """The mesh instances as rays meet them; ``sync_rays`` writes them."""
        self.has_smooth_meshes = False
        """Whether rays go on from some mesh, reflected or refracted."""

    def sync(
        self,
        scene: Scene,
        camera: Camera,
        config: RenderConfig,
        *,
        lit: bool = False,
        offset: tuple[float, float] = (0.5, 0.5),
    ) -> None:
        """Uploads the assets that are new, drops those no longer used, and writes poses and camera.

        Args:
            scene: What there is.
            camera: From where the frame looks.
            config: Its settings.
            lit: Whether it is lit; then sets that reflect light show their own albedo and normals.
            offset: Where in its pixel the sample lies that is rasterised, 0..1.
        """
        structure = [id(i.gaussians) for i in scene.splats], [id(i.mesh) for i in scene.meshes]
        if structure != self._structure:
            self._structure = None  # until all of it is there: a failed upload is not taken for a finished one
            try:
                self._upload(scene)
            except RuntimeError as error:
                raise DeviceError(f"{self._device} has no room for the scene: {error}") from None
            self._structure = structure
        self.place_sample(camera, config, offset)
        if scene.splats:
            self.instances.assign(splat_table(scene, camera, config, lit))
        if scene.meshes:
            self.mesh_instances.assign(self._mesh_table(scene, camera))

    def place_sample(self, camera: Camera, config: RenderConfig, offset: tuple[float, float]) -> None:
        """Writes the camera so that pixels are rasterised at ``offset`` from their corner, 0..1."""
        self.camera.assign(camera_table(camera, config, offset))

    def sync_rays(self, scene: Scene) -> None:
        """Builds the trees of the meshes that rays have not met before, and writes where rays meet the instances.

        After ``sync`` with the same scene. Images that are only rasterised do without.
        """
        held, self._trees = self._trees, {}
        for mesh in {id(instance.mesh): instance.mesh for instance in scene.meshes}.values():
            if id(mesh) in held:
                self._trees[id(mesh)] = held[id(mesh)]
                continue
            try:
                self._trees[id(mesh)] = TriangleBvh.of(mesh, self._device)
            except RuntimeError as error:
                raise DeviceError(f"{self._device} has no room for the scene: {error}") from None
            self.version += 1
        if self.placements is None or self.placements.shape[0] != len(scene.meshes):
            self.placements = wp.zeros(len(scene.meshes), dtype=MeshPlacement, device=self._device)
            self.version += 1
        if scene.meshes:
            self.placements.assign(self._placement_table(scene))
        self.has_smooth_meshes = any(instance.mesh.material.is_smooth for instance in scene.meshes)

    @property
    def bytes(self) -> int:
        """Memory of the assets, bytes."""
        data = [asset.data for asset in self.assets]
        arrays = [array for d in data for array in (d.means, d.rotations, d.scales, d.opacities, d.sh)]
        if self._meshes:
            m = self.mesh_data
            arrays += [m.positions, m.normals, m.uvs, m.colors, m.indices, m.texels]
        arrays += [array for tree in self._trees.values() for array in (tree.bvh.lowers, tree.bvh.uppers)]
        return sum(array.capacity for array in arrays)

    def _upload(self, scene: Scene) -> None:
        placements: dict[int, list[int]] = {}
        for number, instance in enumerate(scene.splats):
            placements.setdefault(id(instance.gaussians), []).append(number)
        # What is not used any more goes before its successors come: the peak is one scene, not both.
        self.assets = [asset for asset in self.assets if id(asset.gaussians) in placements]
        held = {id(asset.gaussians): asset.data for asset in self.assets}
        assets = []
        for key, numbers in placements.items():
            gaussians = scene.splats[numbers[0]].gaussians
            data = held[key] if key in held else upload_gaussians(gaussians, self._device)
            ids = wp.array(numbers, dtype=wp.int32, device=self._device)
            assets.append(SplatAsset(gaussians, data, ids))
        self.assets = assets
        meshes = {id(instance.mesh): instance.mesh for instance in scene.meshes}
        if list(meshes) != list(self._meshes):
            self._meshes, self.mesh_data = {}, MeshData()
            self._face_first = first_of({key: mesh.face_count for key, mesh in meshes.items()})
            self.mesh_data, self.texture_first = upload_meshes(tuple(meshes.values()), self._device)
            self._meshes = meshes
        self.gaussian_count, self.triangle_count = scene.gaussian_count, scene.face_count
        self.instances = wp.zeros(len(scene.splats), dtype=InstanceData, device=self._device)
        self.mesh_instances = wp.zeros(len(scene.meshes), dtype=MeshInstanceData, device=self._device)
        self.version += 1

    def _mesh_table(self, scene: Scene, camera: Camera) -> np.ndarray:
        transforms = np.array([instance.transform for instance in scene.meshes])
        camera_from_object = camera.camera_from_world @ transforms
        normal_matrices = np.linalg.inv(transforms[:, :3, :3]).transpose(0, 2, 1)
        table = np.zeros(len(scene.meshes), dtype=table_dtype(MeshInstanceData))
        table["camera_from_object"] = camera_from_object[:, :3, :3]
        table["camera_from_object_offset"] = camera_from_object[:, :3, 3]
        table["world_from_object_normal"] = normal_matrices / np.abs(normal_matrices).max(axis=(1, 2), keepdims=True)
        table["first"] = np.cumsum([0, *(instance.mesh.face_count for instance in scene.meshes[:-1])])
        for i, instance in enumerate(scene.meshes):
            mesh, row = instance.mesh, table[i : i + 1]
            row["face_first"] = self._face_first[id(mesh)]
            row["has_normals"] = mesh.normals is not None
            row["base_color"] = mesh.material.base_color
            texture = mesh.material.base_color_texture
            if texture is not None and mesh.uvs is not None:
                row["texture_first"] = self.texture_first[texture_key(texture)]
                row["texture_height"], row["texture_width"] = texture.shape[:2]
        return table

    def _placement_table(self, scene: Scene) -> np.ndarray:
        transforms = np.array([instance.transform for instance in scene.meshes])
        table = np.zeros(len(scene.meshes), dtype=table_dtype(MeshPlacement))
        table["world_from_object"] = transforms[:, :3, :3]
        table["object_from_world"] = np.linalg.inv(transforms[:, :3, :3])
        table["position"] = transforms[:, :3, 3]
        for i, instance in enumerate(scene.meshes):
            mesh, material, row = instance.mesh, instance.mesh.material, table[i : i + 1]
            row["low"], row["high"] = self._trees[id(mesh)].world_box(instance.transform)
            row["tree"] = self._trees[id(mesh)].bvh.id
            row["face_first"] = self._face_first[id(mesh)]
            row["material"]["smooth"] = material.is_smooth
            if not isinstance(material, MaterialPbr):
                continue
            for name in ("metallic", "specular", "ior", "transmission"):
                row["material"][name] = getattr(material, name)
        return table


def splat_table(scene: Scene, camera: Camera, config: RenderConfig, lit: bool) -> np.ndarray:
    """The rows that place a scene's splat instances in a frame."""
    transforms = np.array([instance.transform for instance in scene.splats])
    camera_from_object = camera.camera_from_world @ transforms
    table = np.zeros(len(scene.splats), dtype=table_dtype(InstanceData))
    table["camera_from_object"] = camera_from_object[:, :3, :3]
    table["camera_from_object_offset"] = camera_from_object[:, :3, 3]
    table["world_from_object"] = transforms[:, :3, :3] / np.cbrt(np.linalg.det(transforms[:, :3, :3]))[:, None, None]
    table["eye"] = (np.linalg.inv(transforms) @ [*camera.eye, 1.0])[:, :3]
    table["first"] = np.cumsum([0, *(instance.gaussians.count for instance in scene.splats[:-1])])
    table["sh_degree"] = [min(config.raster.sh_degree, instance.sh_degree) for instance in scene.splats]
    for name, values in shading_overrides(scene, lit).items():
        table[name] = values
    forced = config.raster.antialiasing is Antialiasing.ON
    by_file = config.raster.antialiasing is Antialiasing.AUTO
    table["antialiased"] = [forced or (by_file and instance.gaussians.antialiased) for instance in scene.splats]
    return table


def table_dtype(struct: Any) -> np.dtype:
    """NumPy's view of a Warp struct, to fill tables of it row by row."""
    return np.dtype(struct.numpy_dtype())


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Tiles across and down."""
    return -(-camera.width // TILE_PX), -(-camera.height // TILE_PX)


def camera_table(camera: Camera, config: RenderConfig, offset: tuple[float, float] = (0.5, 0.5)) -> np.ndarray:
    """The 1-element table that kernels read the frame's camera and settings from."""
    row = table = np.zeros(1, dtype=table_dtype(CameraData))
    size, focal = np.array([camera.width, camera.height]), np.array([camera.fx, camera.fy])
    # The ray through the offset is that through the pixel's centre of a camera whose centre has moved against it.
    center = np.array([camera.cx, camera.cy]) + 0.5 - np.array(offset)
    margin = (JACOBIAN_CLAMP - 1.0) * 0.5 * size / focal
    row["world_from_camera"] = camera.world_from_camera[:3, :3]
    row["eye"] = camera.eye
    row["focal"], row["center"] = focal, center
    row["jacobian_min"] = -center / focal - margin
    row["jacobian_max"] = (size - center) / focal + margin
    row["width"], row["height"] = camera.width, camera.height
    row["tiles_x"], row["tiles_y"] = tile_grid(camera)
    row["near"] = camera.near
    row["dilation"] = config.raster.dilation
    row["transmittance_min"] = config.raster.transmittance_min
    row["depth_iso_transmittance"] = config.raster.depth_iso_transmittance
    row["background"] = config.background or (0.0, 0.0, 0.0)
    return table
