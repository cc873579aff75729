"""The scene on the device: all tables that kernels read, synchronised once per frame."""

from __future__ import annotations

import operator
from dataclasses import replace

import numpy as np

from lumisplat.config import RenderConfig
from lumisplat.constants import NEAR_PLANE
from lumisplat.device.structs.bvh import MeshBvh
from lumisplat.device.structs.camera import CameraData, SampleData
from lumisplat.device.structs.scene import GaussianData, MeshData, MeshInstanceData, SplatInstanceData
from lumisplat.device.structs.shading import ShadingScene
from lumisplat.errors import DeviceError
from lumisplat.renderer.scene.assets import MeshAssets, SplatAsset, sync_splat_assets
from lumisplat.renderer.scene.bvh_scene import BvhScene
from lumisplat.renderer.scene.camera_table import CENTER, camera_table, subpixel, tile_grid
from lumisplat.renderer.scene.captured_emitters import CapturedEmitters
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.scene.instance_tables import mesh_instance_table, splat_instance_table
from lumisplat.renderer.scene.motion import Motion, in_order
from lumisplat.renderer.scene.shading_scene import ShadingTables
from lumisplat.renderer.trees.box_tree import HostBoxTree
from lumisplat.renderer.trees.gaussian_bvh import GaussianBvh
from lumisplat.renderer.trees.mesh_bvh import MeshBvhScene
from lumisplat.runtime.buffers import Buffers, DeviceArray, assign_table
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.struct_tables import table_dtype, upload_structs
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.checks import with_checked
from lumisplat.scene.local_frame import LocalFrame, rendered_frame
from lumisplat.scene.scene import Scene

_ANY_CAMERA = Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


class DeviceScene:
    """Device copies of a scene's Gaussian sets and meshes (assets), and tables of its camera, instances and lights.

    Args:
        launcher: Runs the kernels that build BVHs.
        buffers: Holds the tables.
        config: Settings, which stay the same for the lifetime of the object.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._structure: tuple[list[int], list[int]] | None = None
        self._layout: list[object] | None = None
        """Holders of the assets' device arrays, as of the last upload; `version` grows if an upload replaces one."""
        self._meshes = MeshAssets(launcher.device)
        self._sample = np.zeros(1, dtype=table_dtype(SampleData))
        self._sample["seed"] = config.seed
        self._jitters = self._jitters_meshes = config.jitter
        self._shading = ShadingTables(buffers, config, launcher.device)
        self._mesh_bvh = MeshBvhScene(launcher)
        self.bvh = BvhScene(launcher)
        """BVHs of the Gaussians, synchronised in frames whose rays traverse them."""
        self.motion = Motion(buffers, launcher.device)
        """Transforms of the previous frame, synchronised in real-time frames."""
        self.assets: list[SplatAsset] = []
        """The distinct Gaussian sets of the scene."""
        self.gaussians: DeviceArray
        """``GaussianData`` of each distinct set; written by ``sync``."""
        self.camera, self.splat_camera = (buffers.get(f"camera{name}", CameraData, 1) for name in ("", ".splats"))
        """CameraData tables for meshes (``camera``) and for Gaussians (``splat_camera``). They differ only if meshes
        alone are jittered within the pixel."""
        self.sample = self._buffers.get("sample", SampleData, 1)
        self.splat_instances: DeviceArray
        """``SplatInstanceData`` of each splat instance; written by ``sync``."""
        self.mesh_instances: DeviceArray
        """``MeshInstanceData`` of each mesh instance; written by ``sync``."""
        self.captured_emitters = CapturedEmitters()
        """Captures that are sampled as lights, synchronised in real-time frames."""
        self.image_size = (0, 0)
        """Width and height of the image, pixels."""
        self.has_one_eye = False
        """True if all rays of the camera start at its eye."""
        self.gaussian_count = 0
        """Number of Gaussians over all instances."""
        self.triangle_count = 0
        """Number of triangles over all instances."""
        self.plan: FramePlan
        """Plan of the frame; written by ``sync``."""
        self.version = 0
        """Counter that changes when the device arrays of assets are replaced."""
        self.frame = LocalFrame(np.zeros(3))
        """Origin and unit to which all device data is relative, geometry as well as camera, because float32 is
        imprecise far from 0."""
        self._synced: object = None
        """Value of `graph_key` at the end of the last ``sync``."""

    @staticmethod
    def modules(plan: FramePlan) -> list[KernelModule]:
        """Returns the kernel modules that build the BVHs of a frame."""
        if plan.follows_rays:
            return [*GaussianBvh.MODULES]
        return [*HostBoxTree.MODULES] if plan.is_sampled and plan.has_meshes else []

    @property
    def mesh_data(self) -> MeshData:
        """Arrays of all meshes, one mesh after another."""
        return self._meshes.data

    @property
    def mesh_bvh(self) -> MeshBvh:
        """BVH of the meshes, in the struct for kernels; synchronised in sampled frames."""
        row = self._mesh_bvh.data
        row.instances, row.meshes = self.mesh_instances, self.mesh_data
        return row

    @property
    def shading(self) -> DeviceArray:
        """Shading data of the scene, as a ShadingScene table with one row; synchronised in sampled frames."""
        return self._shading.data

    @property
    def has_emitters(self) -> bool:
        """True if emissive triangles exist and are sampled as lights."""
        return self._shading.has_emitters

    @property
    def lights(self) -> ShadingTables:
        """Lights of the scene, and their names."""
        return self._shading

    @property
    def graph_key(self) -> object:
        """Values that recorded CUDA graphs of the frame's passes contain: a graph is stale once any value changes.

        Data that changes from frame to frame or sample to sample is in arrays whose addresses stay the same.
        """
        tables = self.bvh.graph_key, self._mesh_bvh.graph_key, self._shading.graph_key
        return self.image_size, self.has_one_eye, self.plan, self.version, tables, self._buffers.allocations

    @property
    def bytes(self) -> int:
        """Device memory of assets and BVHs, bytes."""
        splats = sum(asset.bytes for asset in self.assets) + self.bvh.bytes
        return splats + self._meshes.bytes + self._mesh_bvh.bytes

    def sync(self, scene: Scene, camera: Camera, plan: FramePlan) -> None:
        """Uploads new assets, drops unused ones, and writes all tables that the plan needs.

        Raises:
            DeviceError: The device is out of memory.
        """
        self._jitters, self._jitters_meshes = plan.jitters, plan.jitters or plan.jitters_meshes
        scene, camera = self._localised(scene, camera)
        if plan.has_history:  # so that random choices among lights do not depend on their order
            scene = replace(scene, lights=in_order(scene.lights))
        with self._launcher.stage("sync"):
            self._sync_assets(scene, plan)
            self._sync_instances(scene, camera, plan)
            self._camera, self.image_size = camera, camera.image_size
            is_central = camera.model is not CameraModel.ORTHOGRAPHIC and camera.aperture == 0.0
            self.has_one_eye = is_central and camera.camera_from_world_end is None
            if plan.has_history:
                self.motion.sync(
                    scene,
                    camera,
                    self.mesh_data.positions,
                    has_headlight=plan.has_headlight,
                    captures=self.captured_emitters.instances,
                )
            centered = camera_table(camera, CENTER)
            for table in (self.camera, self.splat_camera):
                assign_table(table, centered)
            if plan.is_sampled:
                self._shading.sync(
                    scene,
                    camera,
                    plan,
                    row=self._shading_row(),
                    assets=self.assets,
                    texture_first=self._meshes.texture_first,
                    version=self.version,
                )
        if plan.follows_rays:
            with self._launcher.stage("build"):
                self.bvh.sync(scene, self.assets, self._config, is_lit=plan.is_lit, has_subsets=plan.traces_paths)
        self.plan = plan
        if self._synced != self.graph_key:
            self._launcher.drop_graphs()
            self._synced = self.graph_key

    def take_assets(self, other: DeviceScene) -> None:
        """Takes over another device scene's assets; also its BVHs, if both scenes have one kernel response.

        Args:
            other: A device scene of the same launcher; it must not be used any more.
        """
        self._structure, self._layout, self.version = other._structure, other._layout, other.version
        self._meshes, self._mesh_bvh, self.assets = other._meshes, other._mesh_bvh, other.assets
        if other._layout is not None:
            self.gaussians = other.gaussians
        if other._config.response == self._config.response:  # with another response, Gaussians have other bounds
            self.bvh = other.bvh

    def _localised(self, scene: Scene, camera: Camera) -> tuple[Scene, Camera]:
        """Returns scene and camera relative to an origin near the scene, because float32 is imprecise far from 0.

        A camera with the default near plane gets a nearer one if the scene is small.
        """
        frame, near = rendered_frame(scene)
        if not np.array_equal(frame.origin, self.frame.origin):
            self.motion.forget()
        self.frame = frame
        if camera.near == NEAR_PLANE != near:
            camera = with_checked(camera, near=near)
        return frame.scene(scene), frame.camera(camera)

    def release(self) -> None:
        """Frees all assets on the device; the next ``sync`` uploads its scene anew."""
        self.sync(Scene(), _ANY_CAMERA, FramePlan.of(self._config, Scene()))
        # The empty frame syncs no lights and no BVHs, which also hold assets: they are replaced.
        self._shading = ShadingTables(self._buffers, self._config, self._launcher.device)
        self._mesh_bvh, self.bvh = MeshBvhScene(self._launcher), BvhScene(self._launcher)
        self.captured_emitters = CapturedEmitters()

    def begin_sample(self, index: int) -> None:
        """Starts sample ``index`` of each pixel: sets the camera's sub-pixel offset to that sample's position."""
        self._sample["index"] = index
        assign_table(self.sample, self._sample)
        if self.plan.has_history:
            self.motion.begin_frame(index)
        for table, jitters in ((self.camera, self._jitters_meshes), (self.splat_camera, self._jitters)):
            assign_table(table, camera_table(self._camera, subpixel(index if jitters else 0)))

    @property
    def tile_grid(self) -> tuple[int, int]:
        """Number of tiles across and down the image."""
        return tile_grid(*self.image_size)

    def _shading_row(self) -> ShadingScene:
        """Returns the ShadingScene struct with the current sample, the instances and the meshes filled in."""
        row = ShadingScene()
        row.sample = self.sample
        row.splats, row.mesh_instances, row.meshes = self.splat_instances, self.mesh_instances, self.mesh_data
        return row

    def _sync_assets(self, scene: Scene, plan: FramePlan) -> None:
        structure = [id(i.gaussians) for i in scene.splats], [id(i.mesh) for i in scene.meshes]
        try:
            if structure != self._structure:
                same_meshes = self._structure is not None and structure[1] == self._structure[1]
                self._structure = None  # a failed upload does not count as finished
                self.assets = sync_splat_assets(scene, self.assets, self._launcher.device)
                self._meshes.sync(scene)
                self._note_layout(same_meshes=same_meshes)
                self._structure = structure
            if plan.is_sampled:
                self._mesh_bvh.sync(scene)
        except DeviceError:
            raise
        except RuntimeError as error:
            raise DeviceError(f"{self._launcher.device} has too little memory for the scene: {error}") from None
        self.gaussian_count, self.triangle_count = scene.gaussian_count, scene.face_count

    def _note_layout(self, *, same_meshes: bool) -> None:
        """Increases ``version`` if the last upload replaced device arrays instead of overwriting them."""
        layout: list[object] = [part for asset in self.assets for part in (asset.data, asset.instance_ids)]
        before = self._layout
        same_splats = before is not None and len(layout) == len(before) and all(map(operator.is_, layout, before))
        if not same_splats:
            self.gaussians = upload_structs([asset.data for asset in self.assets], GaussianData, self._launcher.device)
        if not (same_splats and same_meshes):
            self.version += 1
        self._layout = layout

    def _sync_instances(self, scene: Scene, camera: Camera, plan: FramePlan) -> None:
        gaussians = [asset.gaussians for asset in self.assets]
        splats = splat_instance_table(scene, gaussians, camera, self._config, is_lit=plan.is_lit)
        meshes = mesh_instance_table(scene, self._meshes, self._mesh_bvh.boxes, camera, plan)
        self.splat_instances = self._buffers.upload("splat_instances", SplatInstanceData, splats)
        if plan.has_history:
            self.captured_emitters.sync(scene, splats, self._buffers)
        self.mesh_instances = self._buffers.upload("mesh_instances", MeshInstanceData, meshes)
