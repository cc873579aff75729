"""Lumisplat lights 3D Gaussian scenes: captures, meshes and lights, rendered together on CPU and CUDA."""

from lumisplat import (
    avatars as avatars,
)
from lumisplat import (
    config as config,
)
from lumisplat import (
    dataset as dataset,
)
from lumisplat import (
    diagnostics as diagnostics,
)
from lumisplat import (
    editing as editing,
)
from lumisplat import (
    errors as errors,
)
from lumisplat import (
    farm as farm,
)
from lumisplat import (
    gradients as gradients,
)
from lumisplat import (
    inverse as inverse,
)
from lumisplat import (
    io as io,
)
from lumisplat import (
    layers as layers,
)
from lumisplat import (
    metrics as metrics,
)
from lumisplat import (
    rays as rays,
)
from lumisplat import (
    training as training,
)
from lumisplat.baking.bake import bake as bake
from lumisplat.config import (
    DelightConfig as DelightConfig,
)
from lumisplat.config import (
    PathConfig as PathConfig,
)
from lumisplat.config import (
    Pipeline as Pipeline,
)
from lumisplat.config import (
    RasterConfig as RasterConfig,
)
from lumisplat.config import (
    RealtimeConfig as RealtimeConfig,
)
from lumisplat.config import (
    RenderConfig as RenderConfig,
)
from lumisplat.config import (
    ShadowConfig as ShadowConfig,
)
from lumisplat.config import (
    Shadows as Shadows,
)
from lumisplat.config import (
    ToneMap as ToneMap,
)
from lumisplat.config import (
    TraceConfig as TraceConfig,
)
from lumisplat.config import (
    TrainConfig as TrainConfig,
)
from lumisplat.demo.scene import (
    demo_cameras as demo_cameras,
)
from lumisplat.demo.scene import (
    demo_scene as demo_scene,
)
from lumisplat.demo.scene import (
    demo_scene_lit as demo_scene_lit,
)
from lumisplat.errors import (
    ConfigError as ConfigError,
)
from lumisplat.errors import (
    DeviceError as DeviceError,
)
from lumisplat.errors import (
    FormatError as FormatError,
)
from lumisplat.errors import (
    LumisplatError as LumisplatError,
)
from lumisplat.errors import (
    SceneError as SceneError,
)
from lumisplat.frame.frame import Frame as Frame
from lumisplat.io.load_save import (
    load as load,
)
from lumisplat.io.load_save import (
    load_animation as load_animation,
)
from lumisplat.io.load_save import (
    load_cameras as load_cameras,
)
from lumisplat.io.load_save import (
    load_config as load_config,
)
from lumisplat.io.load_save import (
    load_image as load_image,
)
from lumisplat.io.load_save import (
    save as save,
)
from lumisplat.io.load_save import (
    save_animation as save_animation,
)
from lumisplat.io.load_save import (
    save_cameras as save_cameras,
)
from lumisplat.io.load_save import (
    save_config as save_config,
)
from lumisplat.relighting.avatar_lighter import AvatarLighter as AvatarLighter
from lumisplat.relighting.delight import delight as delight
from lumisplat.relighting.fitting.fit_lights import fit_lights as fit_lights
from lumisplat.relighting.probe_transfer import relight as relight
from lumisplat.renderer.gradients.differentiable_renderer import (
    DifferentiableRenderer as DifferentiableRenderer,
)
from lumisplat.renderer.gradients.differentiable_renderer import (
    splat_gradients as splat_gradients,
)
from lumisplat.renderer.one_shot import render as render
from lumisplat.renderer.one_shot import trace_rays as trace_rays
from lumisplat.renderer.one_shot import transmittance as transmittance
from lumisplat.renderer.rays import RayHits as RayHits
from lumisplat.renderer.renderer import Renderer as Renderer
from lumisplat.renderer.renderer import create_renderer as create_renderer
from lumisplat.scene.animation.actors import Actor as Actor
from lumisplat.scene.animation.actors import Animation as Animation
from lumisplat.scene.animation.camera_path import CameraPath as CameraPath
from lumisplat.scene.animation.keyframes import Keyframes as Keyframes
from lumisplat.scene.animation.rigged_gaussians import (
    RiggedGaussians as RiggedGaussians,
)
from lumisplat.scene.animation.rigged_gaussians import (
    bind_gaussians as bind_gaussians,
)
from lumisplat.scene.camera import Camera as Camera
from lumisplat.scene.camera import CameraModel as CameraModel
from lumisplat.scene.editing.transform import merge as merge
from lumisplat.scene.editing.transform import transform as transform
from lumisplat.scene.gaussians import Gaussians as Gaussians
from lumisplat.scene.lights import (
    LightDirectional as LightDirectional,
)
from lumisplat.scene.lights import (
    LightDisk as LightDisk,
)
from lumisplat.scene.lights import (
    LightEnvironment as LightEnvironment,
)
from lumisplat.scene.lights import (
    LightPoint as LightPoint,
)
from lumisplat.scene.lights import (
    LightRect as LightRect,
)
from lumisplat.scene.lights import (
    LightSphere as LightSphere,
)
from lumisplat.scene.lights import (
    LightSpot as LightSpot,
)
from lumisplat.scene.materials import (
    AlphaMode as AlphaMode,
)
from lumisplat.scene.materials import (
    MaterialPbr as MaterialPbr,
)
from lumisplat.scene.materials import (
    MaterialSimple as MaterialSimple,
)
from lumisplat.scene.materials import TextureWrap as TextureWrap
from lumisplat.scene.mesh import Mesh as Mesh
from lumisplat.scene.ops.insertion import insert as insert
from lumisplat.scene.ops.insertion import stand_on_ground as stand_on_ground
from lumisplat.scene.ops.mesh_sampling import gaussians_from_mesh as gaussians_from_mesh
from lumisplat.scene.ops.normals import estimate_normals as estimate_normals
from lumisplat.scene.ops.views import frame_camera as frame_camera
from lumisplat.scene.ops.views import orbit_cameras as orbit_cameras
from lumisplat.scene.primitives import box as box
from lumisplat.scene.primitives import plane as plane
from lumisplat.scene.primitives import sphere as sphere
from lumisplat.scene.scene import MeshInstance as MeshInstance
from lumisplat.scene.scene import Scene as Scene
from lumisplat.scene.scene import SplatInstance as SplatInstance
from lumisplat.shadow_maps.deep_shadow_map import DeepShadowMap as DeepShadowMap
from lumisplat.training.train import train as train
from lumisplat.viewer.viewer import Viewer as Viewer
from lumisplat.viewer.viewer import view as view

__version__: str
