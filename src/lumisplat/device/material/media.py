"""Participating media inside meshes: the current medium of a ray, its absorption, and interfaces between media.

A ray stores the mesh instances that it is inside of, in the order in which it entered them. Where several meshes
overlap, the mesh of highest priority is the medium; of equal priorities, the last one entered. A surface between equal
media is ignored (after Schmidt and Budge 2002). Thin walls and opaque meshes are not media.

The equations are in docs/method/materials.md#media.
"""

import warp as wp

from lumisplat.device.mesh.mesh_surface import face_normal
from lumisplat.device.structs.rays import Boundary
from lumisplat.device.structs.scene import MeshInstanceData
from lumisplat.device.structs.shading import ShadingScene, WaveData

NESTED = wp.constant(4)
"""Largest number of meshes with a medium that a ray can be inside of at once; more are not recorded."""
AIR = wp.constant(-1)


@wp.func
def is_in(media: wp.vec4i, number: int) -> bool:
    """Returns whether mesh instance ``number`` is among the media."""
    for k in range(NESTED):
        if media[k] == number + 1:
            return True
    return False


@wp.func
def entered(media: wp.vec4i, number: int) -> wp.vec4i:
    """Returns the media of a ray after it has entered mesh instance ``number``."""
    for k in range(NESTED):
        if media[k] == 0:
            media[k] = number + 1
            return media
    return media


@wp.func
def exited(media: wp.vec4i, number: int) -> wp.vec4i:
    """Returns the media of a ray after it has left mesh instance ``number``; removes the instance's last entry."""
    slot = int(-1)
    for k in range(NESTED):
        if media[k] == number + 1:
            slot = k
    if slot < 0:
        return media
    for k in range(NESTED - 1):
        if k >= slot:
            media[k] = media[k + 1]
    media[NESTED - 1] = 0
    return media


@wp.func
def current(media: wp.vec4i, instances: wp.array[MeshInstanceData]) -> int:
    """Returns the index of the mesh whose medium a ray travels in: highest priority, last entered; AIR: none."""
    number = AIR
    highest = int(0)
    for k in range(NESTED):
        if media[k] > 0:
            priority = instances[media[k] - 1].material.priority
            if number == AIR or priority >= highest:
                number = media[k] - 1
                highest = priority
    return number


@wp.func
def index_of(number: int, instances: wp.array[MeshInstanceData]) -> float:
    """Returns the index of refraction of mesh instance ``number``, or of air."""
    if number == AIR:
        return 1.0
    return instances[number].material.ior


@wp.func
def index_around(media: wp.vec4i, instances: wp.array[MeshInstanceData]) -> float:
    """Returns the index of refraction of the medium that a ray travels in."""
    if media[0] == 0:
        return 1.0
    return index_of(current(media, instances), instances)


@wp.func
def boundary_of(number: int, from_inside: bool, media: wp.vec4i, instances: wp.array[MeshInstanceData]) -> Boundary:
    """Returns the interface that the surface of mesh instance ``number`` forms for a ray.

    ``from_inside``: the ray arrives from the inside of the mesh; a mesh that is not a medium has no inside. ``media``
    are those that the ray is inside of before the surface.
    """
    boundary = Boundary()
    boundary.media = media
    boundary.media_behind = media
    boundary.exists = True
    if instances[number].material.is_medium == 0:
        boundary.eta = index_around(media, instances) / instances[number].material.ior
        return boundary
    if from_inside:
        if not is_in(media, number):
            boundary.is_unentered = True
            boundary.media = entered(media, number)
        boundary.media_behind = exited(boundary.media, number)
    else:
        boundary.media_behind = entered(media, number)
    before = current(boundary.media, instances)
    behind = current(boundary.media_behind, instances)
    boundary.exists = before != behind
    boundary.eta = index_of(before, instances) / index_of(behind, instances)
    return boundary


@wp.func
def media_of_ray(i: int, wave: wp.array[WaveData]) -> wp.vec4i:
    """Returns the media that ray ``i`` is inside of at its origin; none if the wave does not record media."""
    if wave[0].media:
        return wave[0].media[i]
    return wp.vec4i(0)


@wp.func
def boundary_of_ray(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> Boundary:
    """Returns the interface between media at the mesh surface that ray ``i`` hits."""
    number = wave[0].meshes.instance[i]
    from_inside = bool(False)
    if scene[0].mesh_instances[number].material.is_medium != 0:
        corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
        outward = face_normal(scene[0].mesh_instances[number], scene[0].meshes, corners)
        from_inside = wp.dot(wave[0].rays.direction[i], outward) > 0.0
    return boundary_of(number, from_inside, media_of_ray(i, wave), scene[0].mesh_instances)


@wp.func
def media_before(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> wp.vec4i:
    """Returns the media that ray ``i`` is inside of just before its hit.

    If it hits a mesh from the inside without having entered it, the mesh counts as entered.
    """
    if wave[0].meshes.face[i] >= 0:
        return boundary_of_ray(i, scene, wave).media
    return media_of_ray(i, wave)


@wp.func
def passed(absorption: wp.vec3, distance: float) -> wp.vec3:
    """Returns the linear transmittance over a distance in a medium (Beer's law)."""
    return wp.vec3(
        wp.where(absorption[0] > 0.0, wp.exp(-absorption[0] * distance), 1.0),
        wp.where(absorption[1] > 0.0, wp.exp(-absorption[1] * distance), 1.0),
        wp.where(absorption[2] > 0.0, wp.exp(-absorption[2] * distance), 1.0),
    )


@wp.func
def absorption_in(media: wp.vec4i, instances: wp.array[MeshInstanceData]) -> wp.vec3:
    """Returns the absorption coefficient, per scene unit, of the medium that a ray travels in."""
    number = current(media, instances)
    if number == AIR:
        return wp.vec3(0.0)
    return instances[number].material.absorption


@wp.func
def absorption_on_ray(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> wp.vec3:
    """Returns the absorption coefficient, linear, per scene unit, of the medium along ray ``i`` up to its hit."""
    return absorption_in(media_before(i, scene, wave), scene[0].mesh_instances)


@wp.func
def passed_by_ray(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> wp.vec3:
    """Returns the linear transmittance of the medium along ray ``i`` up to its first surface, Gaussians or mesh."""
    if scene[0].settings[0].absorbs == 0:
        return wp.vec3(1.0)
    distance = wp.min(wave[0].meshes.t[i], wave[0].gaussians.depth[i])
    return passed(absorption_on_ray(i, scene, wave), distance)


@wp.func
def scattered_media(
    i: int,
    by_mesh: bool,
    direction: wp.vec3,
    normal: wp.vec3,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
) -> wp.vec4i:
    """Returns the media of a ray that a surface scatters into ``direction``; they change if it passes a mesh surface.

    ``by_mesh``: a mesh scatters the ray, instead of the Gaussians in front of it. ``normal`` is the surface normal on
    the side from which the ray arrives.
    """
    if not by_mesh:
        return media_before(i, scene, wave)
    boundary = boundary_of_ray(i, scene, wave)
    if wp.dot(direction, normal) < 0.0:
        return boundary.media_behind
    return boundary.media
