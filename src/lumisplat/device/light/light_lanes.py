"""Direct light of hard lights at 16 interactions at a time, on CPUs: loops over the lanes become vector instructions.

The contributions equal those of ``light_center_contribution``, to the bit. Compilers do not vectorise loops with values
of type ``vec3``, so the loops compute component by component.
"""

import warp as wp

from lumisplat.constants import LIGHT_POWER_MAX, PACKET_RAYS
from lumisplat.device.light.light import (
    LIGHT_POINT,
    LIGHT_SPOT,
    NEAREST2,
    TINY,
    attenuated,
    cone_share,
    sample_light,
    window,
)
from lumisplat.device.material.bsdf import diffuse_factor, rough_mirrored_share, schlick_factor
from lumisplat.device.material.microfacets import ALPHA_GGX_MIN, HALF_MIN2, ggx_of_parts, smith_g1
from lumisplat.device.math.color import is_black
from lumisplat.device.math.directions import INV_PI
from lumisplat.device.structs import struct
from lumisplat.device.structs.shading import BSDF_PBR, LightData, WaveData

LANES = wp.constant(PACKET_RAYS)

Floats = wp.types.vector(length=PACKET_RAYS, dtype=wp.float32)

Vec3s = wp.types.matrix(shape=(3, PACKET_RAYS), dtype=wp.float32)

BRIGHTEST = wp.constant(wp.float32(LIGHT_POWER_MAX))


@struct
class LanesStorage:
    """Local variable of a kernel that holds the memory of the arrays of LitLanes."""

    weight: Floats
    position: Vec3s
    normal: Vec3s
    horizon_normal: Vec3s
    wo: Vec3s
    diffuse: Vec3s
    specular: Vec3s
    grazing: Floats
    alpha: Floats
    dielectric: Floats
    eta: Floats
    mean_mirrored: Floats
    direction: Vec3s
    irradiance: Vec3s
    reflected: Vec3s


@struct
class LitLanes:
    """Interactions with plain BSDFs, one in each lane, and the light that they reflect.

    The fields are those of `Interaction`, its BSDF and `LightSample`. Vectors have one row for each component.
    """

    weight: wp.array[float]
    """0: the lane is empty, and its normal is zero."""
    position: wp.array2d[float]
    normal: wp.array2d[float]
    horizon_normal: wp.array2d[float]
    wo: wp.array2d[float]
    diffuse: wp.array2d[float]
    specular: wp.array2d[float]
    grazing: wp.array[float]
    alpha: wp.array[float]
    dielectric: wp.array[float]
    eta: wp.array[float]
    mean_mirrored: wp.array[float]
    direction: wp.array2d[float]
    irradiance: wp.array2d[float]
    reflected: wp.array2d[float]
    """Sum of the contributions of all lights so far."""


@wp.func
def lit_lanes(storage: wp.ref[LanesStorage]) -> LitLanes:
    """Returns LitLanes whose arrays point to the memory of the local variable ``storage``."""
    lanes = LitLanes()
    lanes.weight = wp.array(ptr=wp.address_of(storage.weight), shape=(LANES,), dtype=float)
    lanes.grazing = wp.array(ptr=wp.address_of(storage.grazing), shape=(LANES,), dtype=float)
    lanes.alpha = wp.array(ptr=wp.address_of(storage.alpha), shape=(LANES,), dtype=float)
    lanes.dielectric = wp.array(ptr=wp.address_of(storage.dielectric), shape=(LANES,), dtype=float)
    lanes.eta = wp.array(ptr=wp.address_of(storage.eta), shape=(LANES,), dtype=float)
    lanes.mean_mirrored = wp.array(ptr=wp.address_of(storage.mean_mirrored), shape=(LANES,), dtype=float)
    lanes.position = wp.array(ptr=wp.address_of(storage.position), shape=(3, LANES), dtype=float)
    lanes.normal = wp.array(ptr=wp.address_of(storage.normal), shape=(3, LANES), dtype=float)
    lanes.horizon_normal = wp.array(ptr=wp.address_of(storage.horizon_normal), shape=(3, LANES), dtype=float)
    lanes.wo = wp.array(ptr=wp.address_of(storage.wo), shape=(3, LANES), dtype=float)
    lanes.diffuse = wp.array(ptr=wp.address_of(storage.diffuse), shape=(3, LANES), dtype=float)
    lanes.specular = wp.array(ptr=wp.address_of(storage.specular), shape=(3, LANES), dtype=float)
    lanes.direction = wp.array(ptr=wp.address_of(storage.direction), shape=(3, LANES), dtype=float)
    lanes.irradiance = wp.array(ptr=wp.address_of(storage.irradiance), shape=(3, LANES), dtype=float)
    lanes.reflected = wp.array(ptr=wp.address_of(storage.reflected), shape=(3, LANES), dtype=float)
    return lanes


@wp.func
def has_plain_bsdf(j: int, wave: wp.array[WaveData]) -> bool:
    """Returns whether interaction ``j`` has a plain BSDF: a rough BSDF_PBR without layers and transmission."""
    if wave[0].interactions.model[j] != BSDF_PBR or wave[0].interactions.alpha[j] <= 0.0:
        return False
    if wave[0].interactions.transmitted:
        if not is_black(wave[0].interactions.transmitted[j]):
            return False
    if wave[0].interactions.coat:
        if not is_black(wave[0].interactions.rescattered[j]) or not is_black(wave[0].interactions.sheen[j]):
            return False
        return wave[0].interactions.coat[j] <= 0.0
    return True


@wp.func
def clear_lane(lanes: LitLanes, lane: int):
    """Empties a lane."""
    lanes.weight[lane] = 0.0
    lanes.alpha[lane] = 1.0
    for k in range(3):
        lanes.normal[k, lane] = 0.0
        lanes.reflected[k, lane] = 0.0


@wp.func
def load_lane(lanes: LitLanes, lane: int, j: int, wave: wp.array[WaveData]):
    """Loads interaction ``j``, which must have a plain BSDF, into a lane."""
    lanes.weight[lane] = wave[0].interactions.weight[j]
    lanes.grazing[lane] = wave[0].interactions.grazing[j]
    lanes.alpha[lane] = wave[0].interactions.alpha[j]
    lanes.dielectric[lane] = wave[0].interactions.dielectric[j]
    lanes.eta[lane] = wave[0].interactions.eta[j]
    lanes.mean_mirrored[lane] = wave[0].interactions.mean_mirrored[j]
    for k in range(3):
        lanes.position[k, lane] = wave[0].interactions.position[j][k]
        lanes.normal[k, lane] = wave[0].interactions.normal[j][k]
        lanes.horizon_normal[k, lane] = wave[0].interactions.horizon_normal[j][k]
        lanes.wo[k, lane] = wave[0].interactions.wo[j][k]
        lanes.diffuse[k, lane] = wave[0].interactions.diffuse[j][k]
        lanes.specular[k, lane] = wave[0].interactions.specular[j][k]


@wp.func
def light_lanes(light: LightData, lanes: LitLanes):
    """Samples a hard light at its centre for all lanes: writes directions and irradiances."""
    if light.kind != LIGHT_POINT and light.kind != LIGHT_SPOT:  # noqa: PLR1714
        for lane in range(LANES):
            point = wp.vec3(lanes.position[0, lane], lanes.position[1, lane], lanes.position[2, lane])
            sample = sample_light(light, point, 0, wp.vec2(0.5))
            for k in range(3):
                lanes.direction[k, lane] = sample.direction[k]
                lanes.irradiance[k, lane] = sample.irradiance[k]
        return
    is_spot = light.kind == LIGHT_SPOT
    for lane in range(LANES):
        x = light.position[0] - lanes.position[0, lane]
        y = light.position[1] - lanes.position[1, lane]
        z = light.position[2] - lanes.position[2, lane]
        distance2 = x * x + y * y + z * z
        inverse = 1.0 / wp.sqrt(distance2)
        x = inverse * x
        y = inverse * y
        z = inverse * z
        share = window(light, distance2)
        if is_spot:
            off_x = x + light.direction[0]
            off_y = y + light.direction[1]
            off_z = z + light.direction[2]
            share *= cone_share(light, off_x * off_x + off_y * off_y + off_z * off_z)
        share = attenuated(share, distance2, inverse, NEAREST2)
        touches = distance2 < TINY  # the direction is then undefined
        share = wp.where(touches, 0.0, share)
        lanes.direction[0, lane] = wp.where(touches, 0.0, x)
        lanes.direction[1, lane] = wp.where(touches, 0.0, y)
        lanes.direction[2, lane] = wp.where(touches, 1.0, z)
        for k in range(3):
            lanes.irradiance[k, lane] = wp.min(share * light.power[k], BRIGHTEST)


@wp.func
def reflect_lanes(lanes: LitLanes):
    """Adds the contributions of the sampled light to ``reflected`` of all lanes."""
    for lane in range(LANES):
        normal_x = lanes.normal[0, lane]
        normal_y = lanes.normal[1, lane]
        normal_z = lanes.normal[2, lane]
        x = lanes.direction[0, lane]
        y = lanes.direction[1, lane]
        z = lanes.direction[2, lane]
        cos_light = normal_x * x + normal_y * y + normal_z * z
        cos_view = normal_x * lanes.wo[0, lane] + normal_y * lanes.wo[1, lane] + normal_z * lanes.wo[2, lane]
        height = (
            lanes.horizon_normal[0, lane] * x + lanes.horizon_normal[1, lane] * y + lanes.horizon_normal[2, lane] * z
        )
        half_x = lanes.wo[0, lane] + x
        half_y = lanes.wo[1, lane] + y
        half_z = lanes.wo[2, lane] + z
        half2 = half_x * half_x + half_y * half_y + half_z * half_z
        along = normal_x * half_x + normal_y * half_y + normal_z * half_z
        across_x = normal_y * half_z - normal_z * half_y
        across_y = normal_z * half_x - normal_x * half_z
        across_z = normal_x * half_y - normal_y * half_x
        across2 = across_x * across_x + across_y * across_y + across_z * across_z

        dielectric = lanes.dielectric[lane]
        enters = 1.0 - rough_mirrored_share(dielectric, lanes.eta[lane], lanes.alpha[lane], cos_light)
        leaves = 1.0 - rough_mirrored_share(dielectric, lanes.eta[lane], lanes.alpha[lane], cos_view)
        scattered = diffuse_factor(enters, leaves, lanes.mean_mirrored[lane])
        if dielectric <= 0.0:
            scattered = INV_PI
        alpha = wp.max(lanes.alpha[lane], ALPHA_GGX_MIN)
        masks = smith_g1(cos_view, alpha) * smith_g1(cos_light, alpha)
        facets = ggx_of_parts(along, across2, half2, alpha) * masks
        if lanes.grazing[lane] <= 0.0 or half2 <= HALF_MIN2:
            facets = 0.0
        rises = schlick_factor(0.5 * wp.sqrt(half2))
        is_dark = cos_light <= 0.0 or height <= 0.0 or cos_view <= 0.0
        for k in range(3):
            reflectance = lanes.specular[k, lane] + rises * (lanes.grazing[lane] - lanes.specular[k, lane])
            value = scattered * lanes.diffuse[k, lane] + facets * reflectance
            color = lanes.weight[lane] * (value * (cos_light * lanes.irradiance[k, lane]))
            lanes.reflected[k, lane] += wp.where(is_dark, 0.0, color)
