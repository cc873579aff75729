"""Tables of a scene's instances: one row per splat instance and one per mesh instance, written every frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lumisplat.config import Antialiasing, HitDistance, RenderConfig
from lumisplat.device.structs.bvh import HIT_HULL, HIT_MEAN, HIT_PEAK
from lumisplat.device.structs.scene import (
    ALPHA_BLEND,
    ALPHA_MASK,
    ALPHA_OPAQUE,
    KernelData,
    MeshInstanceData,
    SplatInstanceData,
)
from lumisplat.renderer.scene.assets import MeshAssets
from lumisplat.renderer.scene.frame_plan import FramePlan, may_jitter
from lumisplat.renderer.scene.materials import (
    fill_layers,
    is_medium,
    is_relit,
    shading_overrides,
    tint_of,
    write_texture,
)
from lumisplat.renderer.trees.mesh_bvh import InstanceBoxes
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.materials import AlphaMode, MaterialPbr, wraps_of
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

KERNEL_LINEAR_SLOPE = 0.329630334487
"""Slope of the linear kernel (degree 0), ``max(1 - slope d, 0)`` at d standard deviations, from NVIDIA's 3DGRT: the
response at d = 3 equals that of a Gaussian, exp(-4.5).
"""

_ALPHA_MODES = {AlphaMode.OPAQUE: ALPHA_OPAQUE, AlphaMode.MASK: ALPHA_MASK, AlphaMode.BLEND: ALPHA_BLEND}
_HIT_DISTANCES = {HitDistance.MEAN: HIT_MEAN, HitDistance.PEAK: HIT_PEAK, HitDistance.HULL: HIT_HULL}


def splat_instance_table(
    scene: Scene, assets: Sequence[Gaussians], camera: Camera, config: RenderConfig, *, is_lit: bool
) -> np.ndarray:
    """Returns the table of a scene's splat instances.

    Args:
        scene: The scene with the instances.
        assets: The distinct Gaussian sets, in the order of the device's assets.
        camera: The camera of the frame.
        config: Settings of the frame.
        is_lit: Whether the frame is lit; then sets that reflect light use the albedo and normals stored with them.
    """
    table = np.zeros(len(scene.splats), dtype=table_dtype(SplatInstanceData))
    if not scene.splats:
        return table
    asset_index = {id(gaussians): index for index, gaussians in enumerate(assets)}
    world_from_object = np.array([instance.transform for instance in scene.splats])
    object_from_world = np.linalg.inv(world_from_object)
    camera_from_object = camera.camera_from_world @ world_from_object
    scales = np.array([instance.scale for instance in scene.splats])
    table["camera_from_object"] = camera_from_object[:, :3, :3]
    table["camera_from_object_offset"] = camera_from_object[:, :3, 3]
    table["object_from_world"] = object_from_world[:, :3, :3]
    table["object_from_world_offset"] = object_from_world[:, :3, 3]
    table["world_from_object"] = world_from_object[:, :3, :3] / scales[:, None, None]
    table["scale"] = scales
    table["eye"] = (object_from_world @ [*camera.eye, 1.0])[:, :3]
    table["first"] = np.cumsum([0, *(instance.gaussians.count for instance in scene.splats[:-1])])
    table["asset"] = [asset_index[id(instance.gaussians)] for instance in scene.splats]
    table["sh_degree"] = [instance.sh_degree for instance in scene.splats]
    own = (instance.depth_iso_transmittance for instance in scene.splats)
    table["depth_iso_transmittance"] = [-1.0 if iso is None else iso for iso in own]
    table["shadow_catcher"] = [instance.shadow_catcher for instance in scene.splats]
    table["relit"] = [is_lit and is_relit(instance) for instance in scene.splats]
    for name, values in shading_overrides(scene, is_lit).items():
        table[name] = values
    table["tint"] = [tint_of(instance) if is_lit else (1.0, 1.0, 1.0) for instance in scene.splats]
    antialiasing = config.raster.antialiasing
    table["antialiased"] = [is_antialiased(instance.gaussians, antialiasing) for instance in scene.splats]
    table["undilated"] = (
        table["antialiased"] * table["relit"] * (config.pipeline.is_sequence and may_jitter(config, is_lit=is_lit))
    )
    table["footprint"] = [footprint_of(instance.gaussians, config) for instance in scene.splats]
    table["hit_distance"] = [hit_distance_of(instance, config, is_lit=is_lit) for instance in scene.splats]
    for row, instance in zip(table, scene.splats, strict=True):
        kernel = kernel_data(instance.gaussians, config)
        for name in ("degree", "falloff", "min_response", "adaptive"):
            row["kernel"][name] = getattr(kernel, name)
    return table


def hit_distance_of(instance: SplatInstance, config: RenderConfig, *, is_lit: bool) -> int:
    """Returns at which point rays hit the Gaussians of an instance: HIT_PEAK, HIT_HULL or HIT_MEAN.

    The settings may choose. If they do not, relit sets in lit frames have HIT_PEAK. All others have HIT_MEAN, because
    training orders Gaussians by their means.
    """
    if config.trace.hit_distance is not None:
        return _HIT_DISTANCES[config.trace.hit_distance]
    return HIT_PEAK if is_lit and is_relit(instance) else HIT_MEAN


def is_antialiased(gaussians: Gaussians, antialiasing: Antialiasing) -> bool:
    """Returns whether a set's Gaussians are antialiased: for ``AUTO`` as they were trained, else by the setting."""
    return antialiasing is Antialiasing.ON or (antialiasing is Antialiasing.AUTO and gaussians.antialiased)


def footprint_of(gaussians: Gaussians, config: RenderConfig) -> float:
    """Returns the standard deviation, in pixel widths, by which rays widen a set's Gaussians (``dilation``).

    The deviation is 0 for Gaussians that count as antialiased, because training compensated their opacities.
    """
    return 0.0 if is_antialiased(gaussians, config.trace.antialiasing) else float(np.sqrt(config.trace.dilation))


def mesh_instance_table(
    scene: Scene, assets: MeshAssets, boxes: InstanceBoxes, camera: Camera, plan: FramePlan
) -> np.ndarray:
    """Returns the table of a scene's mesh instances.

    ``boxes`` holds the instances' BVH roots and bounds, if rays may hit meshes.
    """
    table = np.zeros(len(scene.meshes), dtype=table_dtype(MeshInstanceData))
    if not scene.meshes:
        return table
    transforms = np.array([instance.transform for instance in scene.meshes])
    camera_from_object = camera.camera_from_world @ transforms
    object_from_world = np.linalg.inv(transforms[:, :3, :3])
    normal_matrices = object_from_world.transpose(0, 2, 1)
    table["camera_from_object"] = camera_from_object[:, :3, :3]
    table["camera_from_object_offset"] = camera_from_object[:, :3, 3]
    table["world_from_object"] = transforms[:, :3, :3]
    table["world_from_object_normal"] = normal_matrices / np.abs(normal_matrices).max(axis=(1, 2), keepdims=True)
    table["object_from_world"] = object_from_world
    table["position"] = transforms[:, :3, 3]
    table["keeps_directions"] = (transforms[:, :3, :3] == np.eye(3)).all(axis=(1, 2))
    table["first"] = np.cumsum([0, *(instance.mesh.face_count for instance in scene.meshes[:-1])])
    if len(boxes.roots):
        table["low"], table["high"] = boxes.low, boxes.high
        table["asset"], table["root"] = boxes.assets, boxes.roots
    first_with = {id(instance.mesh): number for number, instance in reversed(list(enumerate(scene.meshes)))}
    for number in first_with.values():
        _write_mesh(table[number : number + 1], scene.meshes[number], assets, plan)
    firsts = [first_with[id(instance.mesh)] for instance in scene.meshes]
    for name in ("face_first", "has_normals", "base_color", "texture", "alpha", "material"):
        table[name] = table[name][firsts]
    return table


def _write_mesh(row: np.ndarray, instance: MeshInstance, assets: MeshAssets, plan: FramePlan) -> None:
    """Writes those fields of a mesh instance's row that are equal for all instances of its mesh."""
    mesh, material = instance.mesh, instance.mesh.material
    row["face_first"] = assets.face_first(mesh)
    row["has_normals"] = mesh.normals is not None
    row["base_color"] = material.mesh_color
    texture = material.base_color_texture
    if texture is not None and mesh.uvs is not None:
        write_texture(row["texture"], texture, wraps_of(material, "base_color_texture"), assets.texture_first)
    row["alpha"]["mode"] = _ALPHA_MODES[material.alpha_mode]
    row["alpha"]["factor"], row["alpha"]["cutoff"] = material.alpha, material.alpha_cutoff
    is_body = plan.has_media and is_medium(instance, traces_paths=plan.traces_paths)
    row["alpha"]["is_drawn"] = plan.draws_alpha and not is_body
    row["alpha"]["is_bent"] = plan.traces_paths and is_body
    row["material"]["smooth"] = material.is_smooth
    if isinstance(material, MaterialPbr):
        row["material"]["metallic"] = material.mesh_metallic
        for name in ("specular", "ior", "transmission", "thin_walled", "priority"):
            row["material"][name] = getattr(material, name)
        row["material"]["is_medium"] = is_medium(instance, traces_paths=plan.traces_paths)
        row["material"]["absorption"] = absorption_of(material)
        fill_layers(row["material"], material)
        row["material"]["sheen"] = max(material.sheen_color)
        row["material"]["varied"] = assets.varied(mesh)


def absorption_of(material: MaterialPbr) -> np.ndarray:
    """Returns the absorption coefficient inside a mesh of this material, per scene unit, by channel, shape (3,)."""
    transmitted = np.maximum(material.attenuation_color, np.finfo(np.float32).tiny)
    return -np.log(transmitted) / material.attenuation_distance


def kernel_data(gaussians: Gaussians, config: RenderConfig) -> KernelData:
    """Returns the kernel response of a capture's Gaussians. The settings may replace the capture's kernel degree."""
    response = config.response
    kernel = KernelData()
    kernel.degree = gaussians.kernel_degree if response.kernel_degree is None else response.kernel_degree
    kernel.falloff = KERNEL_LINEAR_SLOPE if kernel.degree == 0 else 4.5 / 3.0**kernel.degree
    kernel.min_response = response.min_response
    kernel.adaptive = int(response.adaptive_clamping)
    return kernel
