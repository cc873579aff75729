"""Kernels that write the G-buffer: the surfaces that camera rays hit, for filters and probes.

The fields are described in docs/method/realtime.md#surfaces.
"""

import warp as wp

from lumisplat.device.camera.pixels import pixel_number
from lumisplat.device.gi.surfaces import (
    InstanceMotion,
    SurfacePixels,
    diffuse_albedo,
    footprint_alpha2,
    glossy_albedo,
    highlight_width,
    mesh_before,
    splat_before,
)
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.splat_surface import splat_surface
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)


@wp.func
def store_surface(j: int, pixel: int, camera: wp.array[CameraData], wave: wp.array[WaveData], out: SurfacePixels):
    """Writes the fields that splat and mesh surfaces have in common, from interaction ``j`` of a ray."""
    position = wave[0].interactions.position[j]
    out.share[pixel] = wave[0].interactions.weight[j]
    out.position[pixel] = position
    out.normal[pixel] = wave[0].interactions.normal[j]
    out.distance[pixel] = wp.length(position - camera[0].eye)
    interaction = load_interaction(j, wave)
    cosine = wp.max(wp.dot(interaction.normal, interaction.wo), 0.0)
    out.albedo[pixel] = diffuse_albedo(interaction.bsdf, cosine)
    out.glossy_albedo[pixel] = glossy_albedo(interaction.bsdf, cosine)
    out.alpha[pixel] = highlight_width(interaction.bsdf)


@wp.kernel
def store_splat_surfaces(
    start: int,
    camera: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    assets: wp.array[GaussianData],
    motions: wp.array[InstanceMotion],
    wave: wp.array[WaveData],
    surfaces_out: SurfacePixels,
):
    """Per ray: writes the surface of the Gaussians that the ray's pixel shows."""
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    surfaces_out.share[pixel] = 0.0
    if not (wave[0].rays.is_active[i] and wave[0].interactions.exists[i]) or wave[0].interactions.shadow_catcher[i]:
        return
    store_surface(i, pixel, camera, wave, surfaces_out)
    surface = splat_surface(i, True, scene, wave)
    instance = scene[0].splats[surface.instance]
    largest = wp.max(scene[0].attributes[instance.asset].scales[surface.gaussian])
    surfaces_out.extent[pixel] = instance.scale * largest
    surfaces_out.previous[pixel] = splat_before(
        wave[0].interactions.position[i], surface.instance, surface.gaussian, scene[0].splats, assets, motions
    )


@wp.kernel
def store_mesh_surfaces(
    start: int,
    camera: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    motions: wp.array[InstanceMotion],
    wave: wp.array[WaveData],
    surfaces_out: SurfacePixels,
):
    """Per ray: writes the surface of the mesh that the ray's pixel shows."""
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    surfaces_out.share[pixel] = 0.0
    j = wave[0].rays.is_active.shape[0] + i
    if not (wave[0].rays.is_active[i] and wave[0].interactions.exists[j]):
        return
    store_surface(j, pixel, camera, wave, surfaces_out)
    hit = wave[0].meshes
    surfaces_out.extent[pixel] = 0.0
    surfaces_out.previous[pixel] = mesh_before(
        wave[0].interactions.position[j], hit.instance[i], hit.face[i], hit.weights[i], scene[0].meshes, motions
    )


@wp.kernel
def measure_footprints(start: int, size: wp.vec2i, camera: wp.array[CameraData], surfaces_inout: SurfacePixels):
    """Per pixel: writes how far the normals of its surface widen highlights, from those of its neighbours."""
    pixel = start + wp.tid()
    if surfaces_inout.share[pixel] > 0.0:
        surfaces_inout.footprint[pixel] = footprint_alpha2(pixel, size, surfaces_inout, camera)
