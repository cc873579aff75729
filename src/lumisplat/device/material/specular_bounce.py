"""Specular bounces at meshes: weights of the surface's own colour, the reflected ray and the refracted ray.

In lit frames, weights apply to linear light. In unlit frames they apply to display-referred colours: Fresnel weights
are unchanged, so that reflection and transmission add up to one, and the colours of tinted materials are encoded like
any other colour.

The equations are in docs/method/materials.md#smooth-surfaces.
"""

import warp as wp

from lumisplat.constants import SPAWN_ERROR, SPAWN_SLENDER
from lumisplat.device.material.bsdf import coat_share, sheen_share
from lumisplat.device.material.media import boundary_of_ray
from lumisplat.device.material.microfacets import cosine2_beyond, dielectric_share, reflect, refract, schlick
from lumisplat.device.math.color import encode_srgb_color, is_black
from lumisplat.device.mesh.mesh_surface import (
    face_normal,
    hit_weights,
    material_at,
    surface_alpha,
    surface_color,
    surface_normal,
)
from lumisplat.device.structs.rays import Bounce, Boundary
from lumisplat.device.structs.scene import ALPHA_BLEND, MeshData, MeshInstanceData, SmoothData
from lumisplat.device.structs.shading import ShadingScene, WaveData

ERROR = wp.constant(wp.float32(SPAWN_ERROR))
SLENDER = wp.constant(wp.float32(SPAWN_SLENDER))


@wp.func
def stays_outside(direction: wp.vec3, normal: wp.vec3, side: wp.vec3, eta: float, passes: bool) -> bool:
    """Returns whether ``normal`` reflects the ray to the triangle's near side and refracts it to the far side.

    ``normal`` is a shading normal, ``side`` the triangle's own normal on the ray's side. ``passes``: the surface
    refracts, so that the second condition applies.
    """
    cosine = -wp.dot(direction, normal)
    if cosine <= 0.0 or wp.dot(reflect(direction, normal), side) <= 0.0:
        return False
    if passes and cosine2_beyond(cosine, eta) > 0.0:
        return wp.dot(refract(direction, normal, eta), side) < 0.0
    return True


@wp.func
def bounce_of(
    material: SmoothData,
    base_color: wp.vec3,
    outward: wp.vec3,
    shading_normal: wp.vec3,
    direction: wp.vec3,
    eta: float,
    lit: bool,
) -> Bounce:
    """Splits a ray's light at a smooth surface into the surface's own colour, a reflected and a refracted ray.

    Metals reflect by Schlick's approximation, dielectrics by Fresnel's equations. The light that a dielectric does not
    reflect is divided between the refracted ray and the base colour, by the material's transmission.

    ``outward`` is the triangle's normal, out of the mesh, and tells from which side the ray comes. ``shading_normal``
    is ignored where it would reflect the ray through the triangle or refract it back. ``eta`` is the index of
    refraction on the ray's side over the index behind the surface. ``lit``: weights are for linear light instead of
    display-referred colours.
    """
    bounce = Bounce()
    bounce.color = base_color
    if not lit:
        bounce.color = encode_srgb_color(base_color)
    # A thin wall has the same medium on both sides: it reflects like a solid, and transmits straight.
    bounce.eta = eta
    if material.thin_walled != 0:
        bounce.eta = 1.0
    bounce.side = outward
    passes = material.transmission > 0.0
    if wp.dot(direction, outward) > 0.0:
        bounce.side = -outward
    bounce.normal = shading_normal
    if wp.dot(shading_normal, bounce.side) < 0.0:
        bounce.normal = -shading_normal
    if material.smooth == 0:
        return bounce
    if not stays_outside(direction, bounce.normal, bounce.side, bounce.eta, passes):
        bounce.normal = bounce.side
    cosine = wp.clamp(-wp.dot(direction, bounce.normal), 0.0, 1.0)
    mirrored = dielectric_share(material.specular, cosine, eta)
    dielectric = 1.0 - material.metallic
    transmitted = dielectric * (1.0 - mirrored) * bounce.color
    bounce.reflected = wp.vec3(dielectric * mirrored)
    if material.metallic > 0.0:
        metal = schlick(base_color, cosine)
        if not lit:
            metal = encode_srgb_color(metal)
        bounce.reflected += material.metallic * metal
    bounce.refracted = material.transmission * transmitted
    bounce.color = (1.0 - material.transmission) * transmitted
    if lit and (material.coat > 0.0 or material.sheen > 0.0):
        left = 1.0 - coat_share(material.coat, material.coat_alpha, cosine)
        left *= 1.0 - material.sheen * wp.min(sheen_share(material.sheen_curve, cosine), 1.0)
        bounce.reflected = left * bounce.reflected
        bounce.refracted = left * bounce.refracted
    return bounce


@wp.func
def straight(outward: wp.vec3, direction: wp.vec3) -> Bounce:
    """Returns the bounce at a surface between equal media: the whole ray passes straight.

    ``outward`` is the triangle's normal, out of the mesh.
    """
    bounce = Bounce()
    bounce.side = outward
    if wp.dot(direction, outward) > 0.0:
        bounce.side = -outward
    bounce.normal = bounce.side
    bounce.eta = 1.0
    bounce.refracted = wp.vec3(1.0)
    return bounce


@wp.func
def sends_rays_on(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> bool:
    """Returns whether the mesh that ray ``i`` hits reflects the ray or lets it pass.

    It does if the mesh is smooth, partly transparent by its alpha, or between equal media.
    """
    material = scene[0].mesh_instances[wave[0].meshes.instance[i]].material
    alpha = scene[0].mesh_instances[wave[0].meshes.instance[i]].alpha
    if material.smooth != 0 or (alpha.mode == ALPHA_BLEND and alpha.is_drawn == 0):
        return True
    return material.is_medium != 0 and not boundary_of_ray(i, scene, wave).exists


@wp.func
def blended(bounce: Bounce, coverage: float) -> Bounce:
    """Returns ``bounce`` for a surface that, by its alpha, covers only the fraction ``coverage`` of the ray.

    The rest of the ray passes the surface: straight, unless the surface refracts.
    """
    if coverage >= 1.0:
        return bounce
    if is_black(bounce.refracted):
        bounce.eta = 1.0
        bounce.normal = bounce.side
    bounce.color = coverage * bounce.color
    bounce.reflected = coverage * bounce.reflected
    bounce.refracted = coverage * bounce.refracted + wp.vec3(1.0 - coverage)
    return bounce


@wp.func
def mesh_coverage(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> float:
    """Returns the alpha of the mesh that ray ``i`` hits: the fraction that it covers; the rest of the ray passes.

    It is 1 if alpha is tested at random, because a ray then hits the mesh completely.
    """
    instance = scene[0].mesh_instances[wave[0].meshes.instance[i]]
    if instance.alpha.is_drawn != 0 or instance.alpha.mode != ALPHA_BLEND:
        return 1.0
    corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
    return surface_alpha(instance, scene[0].meshes, corners, hit_weights(wave[0].meshes.weights[i]))


@wp.func
def bounce_across(
    i: int, boundary: Boundary, lit: bool, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> Bounce:
    """Returns surface colour, reflection and refraction of ray ``i`` at its mesh hit, the interface ``boundary``.

    ``lit``: weights are for linear light instead of display-referred colours.
    """
    instance = scene[0].mesh_instances[wave[0].meshes.instance[i]]
    meshes = scene[0].meshes
    corners = meshes.indices[wave[0].meshes.face[i]]
    weights = hit_weights(wave[0].meshes.weights[i])
    bounce = straight(face_normal(instance, meshes, corners), wave[0].rays.direction[i])
    if boundary.exists:
        bounce = bounce_of(
            material_at(instance, meshes, corners, weights),
            surface_color(instance, meshes, corners, weights),
            face_normal(instance, meshes, corners),
            surface_normal(instance, meshes, corners, weights),
            wave[0].rays.direction[i],
            boundary.eta,
            lit,
        )
    bounce.media = boundary.media
    bounce.media_behind = boundary.media_behind
    return blended(bounce, mesh_coverage(i, scene, wave))


@wp.func
def bounce_of_ray(i: int, lit: bool, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> Bounce:
    """Returns surface colour, reflection and refraction of ray ``i`` at the mesh that it hits.

    ``lit``: weights are for linear light instead of display-referred colours.
    """
    return bounce_across(i, boundary_of_ray(i, scene, wave), lit, scene, wave)


@wp.func
def magnitudes(m: wp.mat33) -> wp.mat33:
    """Returns the matrix of the absolute values of the entries of ``m``."""
    result = wp.mat33(0.0)
    for i in range(3):
        for j in range(3):
            result[i, j] = wp.abs(m[i, j])
    return result


@wp.func
def spawn_point(
    instance: MeshInstanceData, meshes: MeshData, corners: wp.vec3i, weights: wp.vec3, normal: wp.vec3
) -> wp.vec3:
    """Returns a point of a triangle, moved along ``normal`` so that a ray from there does not hit the triangle again.

    The offset bounds the rounding errors of this point and of the next intersection, as far as they affect the distance
    from the triangle's plane (Waechter and Binder 2019, A Fast and Robust Method for Avoiding Self-Intersection). A
    point at an edge is also moved away from the edge, by twice as much: in a corner, the ray would otherwise start
    behind the other wall.

    ``weights`` are barycentric; ``normal``, world space, unit, points to the side on which the ray continues.
    """
    return point_off_triangle(
        instance.world_from_object,
        instance.object_from_world,
        instance.position,
        meshes.positions[corners[0]],
        meshes.positions[corners[1]],
        meshes.positions[corners[2]],
        weights,
        normal,
    )


@wp.func
def point_off_triangle(
    world_from_object: wp.mat33,
    object_from_world: wp.mat33,
    position: wp.vec3,
    v0: wp.vec3,
    v1: wp.vec3,
    v2: wp.vec3,
    weights: wp.vec3,
    normal: wp.vec3,
) -> wp.vec3:
    """Returns ``spawn_point`` of the triangle with these corners in object space, whose origin is at ``position``."""
    local_edge1 = v1 - v0
    local_edge2 = v2 - v0
    local = v0 + weights[1] * local_edge1 + weights[2] * local_edge2
    edge1 = world_from_object * local_edge1
    edge2 = world_from_object * local_edge2
    first = world_from_object * v0
    offset = world_from_object * local
    # The world-space unit normal as a covector of object space: it measures distances along the normal.
    across = wp.abs(wp.transpose(world_from_object) * normal)
    sizes = 2.0 * wp.abs(position) + wp.abs(offset) + magnitudes(world_from_object) * wp.abs(local)
    local_sizes = (
        wp.abs(v0) + wp.abs(local_edge1) + wp.abs(local_edge2) + magnitudes(object_from_world) * wp.abs(offset)
    )
    error = ERROR * (wp.dot(wp.abs(normal), sizes) + wp.dot(across, local_sizes))
    # A hit's distance is the area-weighted mean of the corners' distances. Its rounding error, half of 2^-24 by
    # measurement, is the only error if the plane goes through the origin along two axes.
    area = wp.length(wp.cross(edge1, edge2))
    longest = wp.max(wp.length(edge2 - edge1), wp.max(wp.length(edge1), wp.length(edge2)))
    error += ERROR / 16.0 * longest * wp.min(longest * longest / area, SLENDER)

    # A corner's height over the opposite edge is twice the area over the edge's length.
    share = 2.0 * error / area
    inner = wp.vec3(
        wp.max(weights[0], wp.min(share * wp.length(edge2 - edge1), 0.25)),
        wp.max(weights[1], wp.min(share * wp.length(edge2), 0.25)),
        wp.max(weights[2], wp.min(share * wp.length(edge1), 0.25)),
    )
    inner = inner / (inner[0] + inner[1] + inner[2])
    point = first + inner[1] * edge1 + inner[2] * edge2
    return position + (point + error * normal)
