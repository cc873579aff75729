"""Lumisplat lights 3D Gaussian scenes: captures, meshes and lights, rendered together on CPU and CUDA."""

from lumisplat import (
    avatars as avatars,
    config as config,
    dataset as dataset,
    diagnostics as diagnostics,
    editing as editing,
    errors as errors,
    farm as farm,
    gradients as gradients,
    inverse as inverse,
    io as io,
    layers as layers,
    lights as lights,
    metrics as metrics,
    rays as rays,
    training as training,
)
from lumisplat.baking.bake import bake as bake
from lumisplat.config import (
    PathConfig as PathConfig,
    Pipeline as Pipeline,
    RasterConfig as RasterConfig,
    RealtimeConfig as RealtimeConfig,
    RenderConfig as RenderConfig,
    ShadowConfig as ShadowConfig,
    Shadows as Shadows,
    ToneMap as ToneMap,
    TraceConfig as TraceConfig,
    TrainConfig as TrainConfig,
)
from lumisplat.demo.scene import (
    demo_cameras as demo_cameras,
    demo_scene as demo_scene,
    demo_scene_lit as demo_scene_lit,
)
from lumisplat.errors import (
    ConfigError as ConfigError,
    DeviceError as DeviceError,
    FormatError as FormatError,
    LumisplatError as LumisplatError,
    SceneError as SceneError,
)
from lumisplat.frame.frame import Frame as Frame
from lumisplat.io.load_save import (
    load as load,
    load_animation as load_animation,
    load_cameras as load_cameras,
    load_config as load_config,
    load_image as load_image,
    save as save,
    save_animation as save_animation,
    save_cameras as save_cameras,
    save_config as save_config,
)
from lumisplat.relighting.avatar_lighter import AvatarLighter as AvatarLighter
from lumisplat.relighting.delight import delight as delight
from lumisplat.relighting.fitting.fit_lights import fit_lights as fit_lights
from lumisplat.relighting.probe_transfer import relight as relight
from lumisplat.renderer.gradients.differentiable_renderer import (
    DifferentiableRenderer as DifferentiableRenderer,
    splat_gradients as splat_gradients,
)
from lumisplat.renderer.one_shot import render as render, trace_rays as trace_rays, transmittance as transmittance
from lumisplat.renderer.rays import RayHits as RayHits
from lumisplat.renderer.renderer import Renderer as Renderer, create_renderer as create_renderer
from lumisplat.scene.animation.actors import Actor as Actor, Animation as Animation
from lumisplat.scene.animation.camera_path import CameraPath as CameraPath
from lumisplat.scene.animation.keyframes import Keyframes as Keyframes
from lumisplat.scene.animation.rigged_gaussians import (
    RiggedGaussians as RiggedGaussians,
    bind_gaussians as bind_gaussians,
)
from lumisplat.scene.camera import Camera as Camera, CameraModel as CameraModel
from lumisplat.scene.editing.transform import merge as merge, transform as transform
from lumisplat.scene.gaussians import Gaussians as Gaussians
from lumisplat.scene.lights import (
    LightDirectional as LightDirectional,
    LightDisk as LightDisk,
    LightEnvironment as LightEnvironment,
    LightPoint as LightPoint,
    LightRect as LightRect,
    LightSphere as LightSphere,
    LightSpot as LightSpot,
)
from lumisplat.scene.materials import (
    AlphaMode as AlphaMode,
    MaterialPbr as MaterialPbr,
    MaterialSimple as MaterialSimple,
    TextureWrap as TextureWrap,
)
from lumisplat.scene.mesh import Mesh as Mesh
from lumisplat.scene.ops.insertion import insert as insert, stand_on_ground as stand_on_ground
from lumisplat.scene.ops.mesh_sampling import gaussians_from_mesh as gaussians_from_mesh
from lumisplat.scene.ops.normals import estimate_normals as estimate_normals
from lumisplat.scene.ops.views import frame_camera as frame_camera, orbit_cameras as orbit_cameras
from lumisplat.scene.primitives import box as box, plane as plane, sphere as sphere
from lumisplat.scene.scene import MeshInstance as MeshInstance, Scene as Scene, SplatInstance as SplatInstance
from lumisplat.shadow_maps.deep_shadow_map import DeepShadowMap as DeepShadowMap
from lumisplat.training.train import train as train
from lumisplat.viewer.viewer import Viewer as Viewer, view as view

__version__: str
__all__: list[str]
