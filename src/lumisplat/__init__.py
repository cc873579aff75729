"""Lumisplat lights 3D Gaussian scenes: captures, meshes and lights, rendered together on CPU and CUDA."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lumisplat.baking.bake import bake
    from lumisplat.config import (
        Absorption,
        Antialiasing,
        AtlasLayout,
        AvatarLightingConfig,
        DatasetConfig,
        DatasetLights,
        DatasetObjects,
        DatasetPoses,
        DeepShadowConfig,
        DelightConfig,
        Densification,
        FilterConfig,
        GaussianSurface,
        HitDistance,
        LearningRates,
        LightEstimationConfig,
        MaterialsConfig,
        NormalEstimate,
        NormalMethod,
        PathConfig,
        PathPrimary,
        Pipeline,
        PosePlaces,
        ProbeConfig,
        Projection,
        RadianceCacheConfig,
        RasterConfig,
        RasterStrategy,
        RealtimeConfig,
        RealtimeQuality,
        ReceiverSampling,
        RelightConfig,
        RenderConfig,
        ResponseConfig,
        ShadowConfig,
        ShadowMethod,
        Shadows,
        ToneMap,
        TraceConfig,
        TraceStrategy,
        TrainConfig,
    )
    from lumisplat.dataset.finish import DatasetSummary, finish_dataset
    from lumisplat.dataset.render import render_dataset
    from lumisplat.dataset.settings_file import load_dataset_config
    from lumisplat.dataset.things import DatasetThing
    from lumisplat.dataset.view import DatasetView
    from lumisplat.dataset.views import DatasetViews
    from lumisplat.demo.scene import demo_cameras, demo_scene
    from lumisplat.demo.scene_lit import demo_scene_lit
    from lumisplat.errors import (
        ConfigError,
        DeviceError,
        FormatError,
        LumisplatError,
        MissingExtraError,
        MissingFileError,
        SceneError,
        StoppedError,
    )
    from lumisplat.frame.deep import DeepFrame
    from lumisplat.frame.frame import Frame
    from lumisplat.frame.mattes import Matte, Mattes
    from lumisplat.frame.sample_part import SamplePart
    from lumisplat.io import (
        check_format,
        load,
        load_animation,
        load_camera_path,
        load_cameras,
        load_config,
        load_image,
        load_radiance,
        load_rig,
        load_sequence,
        save,
        save_animation,
        save_cameras,
        save_config,
    )
    from lumisplat.io.blocks.storage import BlockIndex, open_blocks, write_blocks
    from lumisplat.io.blocks.stream import PlyStream, can_stream, stream_ply
    from lumisplat.io.blocks.views import (
        BlockPart,
        WorkerPlan,
        all_blocks,
        load_blocks,
        plan_views,
        thin_blocks,
        visible_blocks,
    )
    from lumisplat.io.document.entries import SceneEntry
    from lumisplat.io.document.scene_document import SceneDocument
    from lumisplat.io.images.joined_windows import join_windows
    from lumisplat.io.training_images.loading import Photograph, Photographs, load_photographs
    from lumisplat.io.training_images.poses import find_poses
    from lumisplat.io.training_images.video_frames import extract_frames
    from lumisplat.machine.diagnosis import Diagnosis, diagnose
    from lumisplat.metrics.images import flip, ms_ssim, ms_ssim_scales, psnr, ssim
    from lumisplat.metrics.lighting import LitPoints, apf_y, ncm_ab, paa_y
    from lumisplat.metrics.shadows import boundary_f, sae, sm_iou
    from lumisplat.relighting.avatar_lighter import AvatarLighter
    from lumisplat.relighting.capture_gain import estimate_capture_gain
    from lumisplat.relighting.captured_shadow import shadowed
    from lumisplat.relighting.delight.delight import delight, estimate_materials
    from lumisplat.relighting.delight.material_estimate import MaterialEstimate
    from lumisplat.relighting.evaluation.evaluate import evaluate_materials
    from lumisplat.relighting.evaluation.results import MaterialEvaluation, MaterialView, RelitFigures
    from lumisplat.relighting.fitting.fit_lights import fit_lights
    from lumisplat.relighting.fitting.results import FittedView, LightFit
    from lumisplat.relighting.light_estimation import LightEstimate, estimate_lights
    from lumisplat.relighting.probe import EnvironmentProbe
    from lumisplat.relighting.probe_transfer import relight
    from lumisplat.relighting.sun_estimation import SunEstimate, estimate_sun
    from lumisplat.relighting.surface_measure import surface_remark
    from lumisplat.renderer.deep import render_deep
    from lumisplat.renderer.gradients.results import RayGradients, SetGradient, SplatGradients
    from lumisplat.renderer.mattes import render_mattes
    from lumisplat.renderer.one_shot import focused, render, trace_rays, transmittance
    from lumisplat.renderer.ray_gradients import ray_gradients
    from lumisplat.renderer.ray_profiles import RayProfile
    from lumisplat.renderer.ray_queries import RayHits
    from lumisplat.renderer.renderer import Renderer, create_renderer
    from lumisplat.renderer.shared_samples import merge_samples, render_samples, sample_blocks
    from lumisplat.renderer.splat_gradients import DifferentiableRenderer, splat_gradients
    from lumisplat.renderer.surface_features import SurfaceFeatures
    from lumisplat.scene.animation.actors import Actor, Animation
    from lumisplat.scene.animation.camera_path import CameraPath
    from lumisplat.scene.animation.keyframes import Keyframes
    from lumisplat.scene.animation.rig import Rig
    from lumisplat.scene.animation.rigged_gaussians import RiggedGaussians, bind_gaussians
    from lumisplat.scene.animation.sequence import GaussianSequence
    from lumisplat.scene.camera import Camera, CameraModel
    from lumisplat.scene.editing.crop import crop
    from lumisplat.scene.editing.decimate import decimate
    from lumisplat.scene.editing.floaters import remove_floaters
    from lumisplat.scene.editing.levelling import UpEstimate, find_up, level
    from lumisplat.scene.editing.merge import merge
    from lumisplat.scene.editing.morton import sort_morton
    from lumisplat.scene.editing.select import select
    from lumisplat.scene.editing.sh_degree import limit_sh_degree
    from lumisplat.scene.editing.transform import transform
    from lumisplat.scene.gaussians import Gaussians
    from lumisplat.scene.lights import (
        LightDirectional,
        LightDisk,
        LightEnvironment,
        LightPoint,
        LightRect,
        LightSphere,
        LightSpot,
    )
    from lumisplat.scene.materials import AlphaMode, MaterialPbr, MaterialSimple
    from lumisplat.scene.mesh import Mesh
    from lumisplat.scene.ops.estimate_normals import estimate_normals
    from lumisplat.scene.ops.framing import frame_camera
    from lumisplat.scene.ops.ground import stand_on_ground
    from lumisplat.scene.ops.insertion import insert
    from lumisplat.scene.ops.orbit import orbit_cameras
    from lumisplat.scene.ops.recolor import scale_light
    from lumisplat.scene.ops.smooth_normals import smooth_normals
    from lumisplat.scene.primitives import box, plane, sphere
    from lumisplat.scene.sampling.mesh_sampling import gaussians_from_mesh
    from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance
    from lumisplat.scene.textures import TextureWrap
    from lumisplat.shadow_maps.deep_shadow_map import DeepShadowMap
    from lumisplat.training.held_out import HeldOutScore
    from lumisplat.training.materials.find_materials import FoundMaterials, find_materials
    from lumisplat.training.run_folder import forget_training
    from lumisplat.training.train import TrainResult, train
    from lumisplat.training.trainer import DivergedError
    from lumisplat.viewer.view import view
    from lumisplat.viewer.viewer import Viewer

__version__ = "0.1.0"

# Public name -> module, imported on first use: `lumisplat --help` must not load Warp, and io needs no GPU.
_MODULE_OF = {
    "Absorption": "config",
    "Actor": "scene.animation.actors",
    "AlphaMode": "scene.materials",
    "Animation": "scene.animation.actors",
    "Antialiasing": "config",
    "AtlasLayout": "config",
    "AvatarLighter": "relighting.avatar_lighter",
    "AvatarLightingConfig": "config",
    "BlockIndex": "io.blocks.storage",
    "BlockPart": "io.blocks.views",
    "Camera": "scene.camera",
    "CameraModel": "scene.camera",
    "CameraPath": "scene.animation.camera_path",
    "ConfigError": "errors",
    "DatasetConfig": "config",
    "DatasetLights": "config",
    "DatasetObjects": "config",
    "DatasetPoses": "config",
    "DatasetSummary": "dataset.finish",
    "DatasetThing": "dataset.things",
    "DatasetView": "dataset.view",
    "DatasetViews": "dataset.views",
    "DeepFrame": "frame.deep",
    "DeepShadowConfig": "config",
    "DeepShadowMap": "shadow_maps.deep_shadow_map",
    "DelightConfig": "config",
    "Densification": "config",
    "DeviceError": "errors",
    "Diagnosis": "machine.diagnosis",
    "DifferentiableRenderer": "renderer.splat_gradients",
    "DivergedError": "training.trainer",
    "EnvironmentProbe": "relighting.probe",
    "FilterConfig": "config",
    "FittedView": "relighting.fitting.results",
    "FormatError": "errors",
    "FoundMaterials": "training.materials.find_materials",
    "Frame": "frame.frame",
    "GaussianSequence": "scene.animation.sequence",
    "GaussianSurface": "config",
    "Gaussians": "scene.gaussians",
    "HeldOutScore": "training.held_out",
    "HitDistance": "config",
    "Keyframes": "scene.animation.keyframes",
    "LearningRates": "config",
    "LightDirectional": "scene.lights",
    "LightDisk": "scene.lights",
    "LightEnvironment": "scene.lights",
    "LightEstimate": "relighting.light_estimation",
    "LightEstimationConfig": "config",
    "LightFit": "relighting.fitting.results",
    "LightPoint": "scene.lights",
    "LightRect": "scene.lights",
    "LightSphere": "scene.lights",
    "LightSpot": "scene.lights",
    "LitPoints": "metrics.lighting",
    "LumisplatError": "errors",
    "MaterialEstimate": "relighting.delight.material_estimate",
    "MaterialEvaluation": "relighting.evaluation.results",
    "MaterialPbr": "scene.materials",
    "MaterialSimple": "scene.materials",
    "MaterialView": "relighting.evaluation.results",
    "MaterialsConfig": "config",
    "Matte": "frame.mattes",
    "Mattes": "frame.mattes",
    "Mesh": "scene.mesh",
    "MeshInstance": "scene.scene",
    "MissingExtraError": "errors",
    "MissingFileError": "errors",
    "NormalEstimate": "config",
    "NormalMethod": "config",
    "PathConfig": "config",
    "PathPrimary": "config",
    "Photograph": "io.training_images.loading",
    "Photographs": "io.training_images.loading",
    "Pipeline": "config",
    "PlyStream": "io.blocks.stream",
    "PosePlaces": "config",
    "ProbeConfig": "config",
    "Projection": "config",
    "RadianceCacheConfig": "config",
    "RasterConfig": "config",
    "RasterStrategy": "config",
    "RayGradients": "renderer.gradients.results",
    "RayHits": "renderer.ray_queries",
    "RayProfile": "renderer.ray_profiles",
    "RealtimeConfig": "config",
    "RealtimeQuality": "config",
    "ReceiverSampling": "config",
    "RelightConfig": "config",
    "RelitFigures": "relighting.evaluation.results",
    "RenderConfig": "config",
    "Renderer": "renderer.renderer",
    "ResponseConfig": "config",
    "Rig": "scene.animation.rig",
    "RiggedGaussians": "scene.animation.rigged_gaussians",
    "SamplePart": "frame.sample_part",
    "Scene": "scene.scene",
    "SceneDocument": "io.document.scene_document",
    "SceneEntry": "io.document.entries",
    "SceneError": "errors",
    "SetGradient": "renderer.gradients.results",
    "ShadowConfig": "config",
    "ShadowMethod": "config",
    "Shadows": "config",
    "SplatGradients": "renderer.gradients.results",
    "SplatInstance": "scene.scene",
    "StoppedError": "errors",
    "SunEstimate": "relighting.sun_estimation",
    "SurfaceFeatures": "renderer.surface_features",
    "TextureWrap": "scene.textures",
    "ToneMap": "config",
    "TraceConfig": "config",
    "TraceStrategy": "config",
    "TrainConfig": "config",
    "TrainResult": "training.train",
    "UpEstimate": "scene.editing.levelling",
    "Viewer": "viewer.viewer",
    "WorkerPlan": "io.blocks.views",
    "all_blocks": "io.blocks.views",
    "apf_y": "metrics.lighting",
    "bake": "baking.bake",
    "bind_gaussians": "scene.animation.rigged_gaussians",
    "boundary_f": "metrics.shadows",
    "box": "scene.primitives",
    "can_stream": "io.blocks.stream",
    "check_format": "io",
    "create_renderer": "renderer.renderer",
    "crop": "scene.editing.crop",
    "decimate": "scene.editing.decimate",
    "delight": "relighting.delight.delight",
    "demo_cameras": "demo.scene",
    "demo_scene": "demo.scene",
    "demo_scene_lit": "demo.scene_lit",
    "diagnose": "machine.diagnosis",
    "estimate_capture_gain": "relighting.capture_gain",
    "estimate_lights": "relighting.light_estimation",
    "estimate_materials": "relighting.delight.delight",
    "estimate_normals": "scene.ops.estimate_normals",
    "estimate_sun": "relighting.sun_estimation",
    "evaluate_materials": "relighting.evaluation.evaluate",
    "extract_frames": "io.training_images.video_frames",
    "find_materials": "training.materials.find_materials",
    "find_poses": "io.training_images.poses",
    "find_up": "scene.editing.levelling",
    "finish_dataset": "dataset.finish",
    "fit_lights": "relighting.fitting.fit_lights",
    "flip": "metrics.images",
    "focused": "renderer.one_shot",
    "forget_training": "training.run_folder",
    "frame_camera": "scene.ops.framing",
    "gaussians_from_mesh": "scene.sampling.mesh_sampling",
    "insert": "scene.ops.insertion",
    "join_windows": "io.images.joined_windows",
    "level": "scene.editing.levelling",
    "limit_sh_degree": "scene.editing.sh_degree",
    "load": "io",
    "load_animation": "io",
    "load_blocks": "io.blocks.views",
    "load_camera_path": "io",
    "load_cameras": "io",
    "load_config": "io",
    "load_dataset_config": "dataset.settings_file",
    "load_image": "io",
    "load_photographs": "io.training_images.loading",
    "load_radiance": "io",
    "load_rig": "io",
    "load_sequence": "io",
    "merge": "scene.editing.merge",
    "merge_samples": "renderer.shared_samples",
    "ms_ssim": "metrics.images",
    "ms_ssim_scales": "metrics.images",
    "ncm_ab": "metrics.lighting",
    "open_blocks": "io.blocks.storage",
    "orbit_cameras": "scene.ops.orbit",
    "paa_y": "metrics.lighting",
    "plan_views": "io.blocks.views",
    "plane": "scene.primitives",
    "psnr": "metrics.images",
    "ray_gradients": "renderer.ray_gradients",
    "relight": "relighting.probe_transfer",
    "remove_floaters": "scene.editing.floaters",
    "render": "renderer.one_shot",
    "render_dataset": "dataset.render",
    "render_deep": "renderer.deep",
    "render_mattes": "renderer.mattes",
    "render_samples": "renderer.shared_samples",
    "sae": "metrics.shadows",
    "sample_blocks": "renderer.shared_samples",
    "save": "io",
    "save_animation": "io",
    "save_cameras": "io",
    "save_config": "io",
    "scale_light": "scene.ops.recolor",
    "select": "scene.editing.select",
    "shadowed": "relighting.captured_shadow",
    "sm_iou": "metrics.shadows",
    "smooth_normals": "scene.ops.smooth_normals",
    "sort_morton": "scene.editing.morton",
    "sphere": "scene.primitives",
    "splat_gradients": "renderer.splat_gradients",
    "ssim": "metrics.images",
    "stand_on_ground": "scene.ops.ground",
    "stream_ply": "io.blocks.stream",
    "surface_remark": "relighting.surface_measure",
    "thin_blocks": "io.blocks.views",
    "trace_rays": "renderer.one_shot",
    "train": "training.train",
    "transform": "scene.editing.transform",
    "transmittance": "renderer.one_shot",
    "view": "viewer.view",
    "visible_blocks": "io.blocks.views",
    "write_blocks": "io.blocks.storage",
}

__all__ = [
    "Absorption",
    "Actor",
    "AlphaMode",
    "Animation",
    "Antialiasing",
    "AtlasLayout",
    "AvatarLighter",
    "AvatarLightingConfig",
    "BlockIndex",
    "BlockPart",
    "Camera",
    "CameraModel",
    "CameraPath",
    "ConfigError",
    "DatasetConfig",
    "DatasetLights",
    "DatasetObjects",
    "DatasetPoses",
    "DatasetSummary",
    "DatasetThing",
    "DatasetView",
    "DatasetViews",
    "DeepFrame",
    "DeepShadowConfig",
    "DeepShadowMap",
    "DelightConfig",
    "Densification",
    "DeviceError",
    "Diagnosis",
    "DifferentiableRenderer",
    "DivergedError",
    "EnvironmentProbe",
    "FilterConfig",
    "FittedView",
    "FormatError",
    "FoundMaterials",
    "Frame",
    "GaussianSequence",
    "GaussianSurface",
    "Gaussians",
    "HeldOutScore",
    "HitDistance",
    "Keyframes",
    "LearningRates",
    "LightDirectional",
    "LightDisk",
    "LightEnvironment",
    "LightEstimate",
    "LightEstimationConfig",
    "LightFit",
    "LightPoint",
    "LightRect",
    "LightSphere",
    "LightSpot",
    "LitPoints",
    "LumisplatError",
    "MaterialEstimate",
    "MaterialEvaluation",
    "MaterialPbr",
    "MaterialSimple",
    "MaterialView",
    "MaterialsConfig",
    "Matte",
    "Mattes",
    "Mesh",
    "MeshInstance",
    "MissingExtraError",
    "MissingFileError",
    "NormalEstimate",
    "NormalMethod",
    "PathConfig",
    "PathPrimary",
    "Photograph",
    "Photographs",
    "Pipeline",
    "PlyStream",
    "PosePlaces",
    "ProbeConfig",
    "Projection",
    "RadianceCacheConfig",
    "RasterConfig",
    "RasterStrategy",
    "RayGradients",
    "RayHits",
    "RayProfile",
    "RealtimeConfig",
    "RealtimeQuality",
    "ReceiverSampling",
    "RelightConfig",
    "RelitFigures",
    "RenderConfig",
    "Renderer",
    "ResponseConfig",
    "Rig",
    "RiggedGaussians",
    "SamplePart",
    "Scene",
    "SceneDocument",
    "SceneEntry",
    "SceneError",
    "SetGradient",
    "ShadowConfig",
    "ShadowMethod",
    "Shadows",
    "SplatGradients",
    "SplatInstance",
    "StoppedError",
    "SunEstimate",
    "SurfaceFeatures",
    "TextureWrap",
    "ToneMap",
    "TraceConfig",
    "TraceStrategy",
    "TrainConfig",
    "TrainResult",
    "UpEstimate",
    "Viewer",
    "WorkerPlan",
    "all_blocks",
    "apf_y",
    "bake",
    "bind_gaussians",
    "boundary_f",
    "box",
    "can_stream",
    "check_format",
    "create_renderer",
    "crop",
    "decimate",
    "delight",
    "demo_cameras",
    "demo_scene",
    "demo_scene_lit",
    "diagnose",
    "estimate_capture_gain",
    "estimate_lights",
    "estimate_materials",
    "estimate_normals",
    "estimate_sun",
    "evaluate_materials",
    "extract_frames",
    "find_materials",
    "find_poses",
    "find_up",
    "finish_dataset",
    "fit_lights",
    "flip",
    "focused",
    "forget_training",
    "frame_camera",
    "gaussians_from_mesh",
    "insert",
    "join_windows",
    "level",
    "limit_sh_degree",
    "load",
    "load_animation",
    "load_blocks",
    "load_camera_path",
    "load_cameras",
    "load_config",
    "load_dataset_config",
    "load_image",
    "load_photographs",
    "load_radiance",
    "load_rig",
    "load_sequence",
    "merge",
    "merge_samples",
    "ms_ssim",
    "ms_ssim_scales",
    "ncm_ab",
    "open_blocks",
    "orbit_cameras",
    "paa_y",
    "plan_views",
    "plane",
    "psnr",
    "ray_gradients",
    "relight",
    "remove_floaters",
    "render",
    "render_dataset",
    "render_deep",
    "render_mattes",
    "render_samples",
    "sae",
    "sample_blocks",
    "save",
    "save_animation",
    "save_cameras",
    "save_config",
    "scale_light",
    "select",
    "shadowed",
    "sm_iou",
    "smooth_normals",
    "sort_morton",
    "sphere",
    "splat_gradients",
    "ssim",
    "stand_on_ground",
    "stream_ply",
    "surface_remark",
    "thin_blocks",
    "trace_rays",
    "train",
    "transform",
    "transmittance",
    "view",
    "visible_blocks",
    "write_blocks",
]


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'lumisplat' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"lumisplat.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
