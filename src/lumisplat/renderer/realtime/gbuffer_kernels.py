"""Kernels that write the G-buffer: the surfaces that camera rays hit, for filters and probes.

The fields are described in docs/method/realtime.md#surfaces.
"""

import warp as wp

from lumisplat.device.camera.pixels import pixel_number
from lumisplat.device.gi.surfaces import (
    InstanceMotion,
    Reprojection,
    SequenceData,
    SurfacePixels,
    diffuse_albedo,
    footprint_alpha2,
    glossy_albedo,
    highlight_width,
    in_previous_image,
    is_same_surface,
    least_cosine,
    mesh_before,
    pixel_before,
    snapped,
    splat_before,
)
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.splat_surface import splat_surface
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)

SAME_PIXEL_PX = 2.0
"""A point continues the history of a previous pixel if the point and the pixel's surface each lie within this many
pixel widths of the other's tangent plane. The limit keeps contact shadows from taking the history of the object that
stands on the surface."""

BORROWED_WEIGHT = 0.03
"""Weight of another pixel's history where jitter uncovers a surface: its light may differ, as beside a panel."""

PIXEL_PX = wp.constant(wp.float32(SAME_PIXEL_PX))
BORROWED = wp.constant(wp.float32(BORROWED_WEIGHT))


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


@wp.kernel
def find_previous(
    start: int,
    size: wp.vec2i,
    surfaces: SurfacePixels,
    before: SurfacePixels,
    sequence: wp.array[SequenceData],
    camera: wp.array[CameraData],
    camera_before: wp.array[CameraData],
    reprojection_out: Reprojection,
):
    """Per pixel: finds the four previous pixels around its reprojected surface, and their bilinear weights.

    A previous pixel counts only if it shows the same surface. If none of the four does and the surface stands still,
    one of the 3 x 3 pixels around that shows it counts alone, but little, because jittered samples may see past edges.
    """
    pixel = start + wp.tid()
    reprojection_out.weights[pixel] = wp.vec4(0.0)
    if surfaces.share[pixel] <= 0.0:
        return
    position = surfaces.previous[pixel]
    if wp.isnan(position[0]):
        return
    at = pixel_before(position, camera_before)
    if at[2] <= 0.0:
        return
    # Histories belong to pixel centres, but the position is that of a jittered sample.
    x = snapped(at[0] - camera[0].offset[0])
    y = snapped(at[1] - camera[0].offset[1])
    stands = x == float(pixel % size[0]) and y == float(pixel // size[0])
    image = sequence[0].before
    there = in_previous_image(wp.vec2(x, y), image)
    x = there[0]
    y = there[1]
    left = int(wp.floor(x))
    top = int(wp.floor(y))
    extent = surfaces.extent[pixel]
    tolerated = wp.max(PIXEL_PX * at[2] / camera_before[0].focal[0], extent)
    cosine_min = least_cosine(extent)
    normal = surfaces.normal[pixel]
    weights = wp.vec4(0.0)
    total = float(0.0)
    for number in range(4):
        column = left + number % 2
        row = top + number // 2
        weight = (1.0 - wp.abs(x - float(column))) * (1.0 - wp.abs(y - float(row)))
        if weight > 0.0 and column >= 0 and column < image.size[0] and row >= 0 and row < image.size[1]:
            if is_same_surface(position, normal, tolerated, cosine_min, row * image.size[0] + column, before):
                weights[number] = weight
                total += weight
    reprojection_out.first[pixel] = top * image.size[0] + left
    is_jittered = camera[0].offset[0] != 0.5 or camera[0].offset[1] != 0.5
    if total == 0.0 and is_jittered and stands:
        for row in range(wp.max(top - 1, 0), wp.min(top + 2, image.size[1])):
            for column in range(wp.max(left - 1, 0), wp.min(left + 2, image.size[0])):
                tap = row * image.size[0] + column
                if total == 0.0 and is_same_surface(position, normal, tolerated, cosine_min, tap, before):
                    reprojection_out.first[pixel] = tap
                    weights[0] = BORROWED
                    total = BORROWED
    # A larger pixel of the previous frame has had fewer samples for each of this frame's pixels.
    reprojection_out.weights[pixel] = wp.min(image.scale[0] * image.scale[1], 1.0) * weights
