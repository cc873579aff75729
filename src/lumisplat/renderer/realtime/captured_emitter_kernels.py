"""Kernels that sample captures as area lights for the surfaces of pixels. One thread per camera ray.

The method is in docs/method/realtime.md#captured-emitters.
"""

import warp as wp

from lumisplat.constants import EMITTER_OPAQUE, LIGHT_POWER_MAX
from lumisplat.device.camera.pixels import pixel_number
from lumisplat.device.gi.captured_emitters import EmitterBox, chosen_box, direction_pdf, point_in, total_weight
from lumisplat.device.gi.secondary_rays import lobe_share
from lumisplat.device.gi.surfaces import KnownLight, PixelLight, highlight_width
from lumisplat.device.light.direct_light import contribution_of
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.shadow_rays import start_shadow_ray
from lumisplat.device.material.bsdf import diffuse_share
from lumisplat.device.math.color import captured_color, is_black, luminance
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData
from lumisplat.device.structs.shading import LightSample, ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)

POINT_BRANCH = wp.constant(9)
"""Number that derives a random key from a ray's key: the key for the random point in a box around a capture."""
BOX_BRANCH = wp.constant(10)
"""Number that derives a random key from a ray's key: the key for choosing a box around a capture, and the depth in the
box."""
RAY_BRANCH = wp.constant(11)
"""Number that derives a random key from a camera ray's key: the key of a ray from a surface towards captures. That key
decides which Gaussians the ray hits."""
ROULETTE_BRANCH = wp.constant(12)
"""Number that derives a random key from a ray's key: the key that decides whether a ray towards captures is sent."""
KNOWN_SHARE = wp.constant(wp.float32(0.5))
"""A ray that is expected to add less than this fraction of a pixel's known light is sent with a chance in proportion.
"""
CHANCE_MIN = wp.constant(wp.float32(0.1))
"""Smallest chance with which a ray is sent."""
OPAQUE = wp.constant(wp.float32(EMITTER_OPAQUE))
TINY = wp.constant(wp.float32(1e-30))
BRIGHTEST = wp.constant(wp.vec3(LIGHT_POWER_MAX, LIGHT_POWER_MAX, LIGHT_POWER_MAX))


@wp.kernel
def start_captured_rays(
    start: int,
    follows_lobes: bool,
    boxes: wp.array[EmitterBox],
    camera: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    slots: wp.array[int],
    known: KnownLight,
    light_out: PixelLight,
    rays_out: RayData,
):
    """Per camera ray: starts a ray from one surface of its pixel to a random point in the boxes around captures.

    Where the pixel is known to be bright, few rays are sent, each with a higher weight (Russian roulette).

    Args:
        start: Offset added to the thread index.
        follows_lobes: Whether other rays, sent within highlights, also hit captures. If so, this kernel samples only
            the fraction of each highlight that those rays do not cover.
        boxes: Boxes around the captures.
        camera: Camera of the frame.
        scene: The scene.
        wave: The camera rays; each pixel's light sample has its number in a low-discrepancy sequence.
        slots: For each camera ray, which of its two surfaces has a light sample; -1: none.
        known: Known light of the frame.
        light_out: Reflected radiance for incoming radiance 1, divided by the pdf of the direction.
        rays_out: The rays; they end behind the boxes.
    """
    i = start + wp.tid()
    rays_out.is_active[i] = False
    slot = slots[i]
    pixel = pixel_number(i, camera)
    if slot < 0 or pixel < 0:
        return
    j = slot * wave[0].rays.is_active.shape[0] + i
    interaction = load_interaction(j, wave)
    interaction.weight = 1.0
    key = wave[0].rays.pixel_key[i]
    number = wave[0].rays.sample[i]
    which = sobol_2d(branch_key(key, BOX_BRANCH), number)
    point = interaction.position
    total = total_weight(point, boxes)
    box = boxes[chosen_box(which[0], total, point, boxes)]
    sample = LightSample()
    sample.direction = wp.normalize(point_in(box, sobol_2d(branch_key(key, POINT_BRANCH), number), which[1]) - point)
    pdf_and_distance = direction_pdf(point, sample.direction, total, boxes)
    if not (pdf_and_distance[0] > 0.0 and pdf_and_distance[0] < wp.inf):
        return
    sample.distance = pdf_and_distance[1]
    sample.irradiance = wp.vec3(1.0 / pdf_and_distance[0])
    contribution = contribution_of(interaction, sample, 1.0)
    if is_black(contribution.color):
        return
    faces = wp.dot(box.half, wp.vec3(box.half[1], box.half[2], box.half[0]))
    radiance = scene[0].settings[0].capture_gain * box.power / (8.0 * faces)
    expected = radiance * luminance(contribution.color)
    bright = luminance(known.diffuse[pixel] + known.glossy[pixel])
    chance = wp.clamp(expected / wp.max(KNOWN_SHARE * bright, TINY), CHANCE_MIN, 1.0)
    if sobol_2d(branch_key(key, ROULETTE_BRANCH), number)[0] >= chance:
        return
    contribution.color = contribution.color / chance
    share = diffuse_share(interaction.bsdf, interaction.normal, interaction.wo, contribution.direction)
    diffuse = wp.cw_mul(share, contribution.color)
    rest = float(1.0)
    if follows_lobes:
        rest -= lobe_share(highlight_width(interaction.bsdf))
    light_out.diffuse[i] = diffuse
    light_out.glossy[i] = rest * (contribution.color - diffuse)
    start_shadow_ray(i, j, scene[0].settings[0].light_count, contribution, scene, wave, rays_out)
    rays_out.pixel_key[i] = branch_key(key, RAY_BRANCH)
    rays_out.sample_key[i] = branch_key(wave[0].rays.sample_key[i], RAY_BRANCH)
    rays_out.sample[i] = number


@wp.kernel
def end_behind_glass(
    start: int,
    scene: wp.array[ShadingScene],
    rays: RayData,
    meshes: MeshHits,
    ends_out: wp.array[float],
    is_glass_out: wp.array[int],
):
    """Per ray towards captures: writes its end, the distance of the mesh that it hits; rays that hit glass go on."""
    i = start + wp.tid()
    is_glass_out[i] = 0
    ends_out[i] = 0.0
    if not rays.is_active[i]:
        return
    ends_out[i] = meshes.t[i]
    if meshes.face[i] >= 0:
        material = scene[0].mesh_instances[meshes.instance[i]].material
        if material.smooth != 0 and material.transmission > 0.0:
            is_glass_out[i] = 1
            ends_out[i] = rays.t_max[i]


@wp.kernel
def start_through_glass(start: int, is_glass: wp.array[int], emitted: GaussianHits, rays_inout: RayData):
    """Per ray towards captures: ends rays that hit glass at the capture behind the glass; deactivates other rays."""
    i = start + wp.tid()
    if is_glass[i] == 0:
        rays_inout.is_active[i] = False
    rays_inout.t_max[i] = wp.min(rays_inout.t_max[i], emitted.depth[i])


@wp.kernel
def add_captured_light(
    start: int,
    scene: wp.array[ShadingScene],
    emitted: GaussianHits,
    reflected: PixelLight,
    is_glass: wp.array[int],
    passed: wp.array[wp.vec3],
    visibility: wp.array[wp.vec3],
    light_inout: PixelLight,
    rays_inout: RayData,
):
    """Multiplies a light sample by the visibility of its shadow ray, and adds the light of captures.

    Args:
        start: Offset added to the thread index.
        scene: The scene.
        emitted: Hits of the rays towards captures; their ``relit_color`` is the radiance of captures.
        reflected: Reflected radiance for incoming radiance 1, written by ``start_captured_rays``.
        is_glass: 1: the ray hits glass first.
        passed: Transmittance of the glass.
        visibility: Visibility along the sample's shadow ray, if the shadow ray is active.
        light_inout: The light samples.
        rays_inout: Shadow rays of the samples; none is active afterwards.
    """
    i = start + wp.tid()
    if rays_inout.is_active[i]:
        light_inout.diffuse[i] = wp.cw_mul(light_inout.diffuse[i], visibility[i])
        light_inout.glossy[i] = wp.cw_mul(light_inout.glossy[i], visibility[i])
        rays_inout.is_active[i] = False
    if emitted.relit_weight[i] <= 0.0:
        return
    radiance = scene[0].settings[0].capture_gain * captured_color(emitted.relit_color[i], emitted.relit_weight[i])
    if emitted.transmittance[i] <= OPAQUE:
        radiance = radiance / (1.0 - emitted.transmittance[i])
    if is_glass[i] != 0:
        radiance = wp.cw_mul(radiance, passed[i])
    light_inout.diffuse[i] += wp.min(wp.cw_mul(reflected.diffuse[i], radiance), BRIGHTEST)
    light_inout.glossy[i] += wp.min(wp.cw_mul(reflected.glossy[i], radiance), BRIGHTEST)
