"""Kernel of shadow rays through meshes: computes their transmittance. One thread per ray."""

import warp as wp

from lumisplat.device.bvh.nodes import (
    LinkStackStorage,
    enter_boxes,
    inverse_or_large,
    link_stack,
    load_node,
    push_all_entered,
    push_link,
)
from lumisplat.device.light.shadow_rays import pass_straight
from lumisplat.device.material.media import is_in, passed
from lumisplat.device.mesh.mesh_rays import MeshRay, box_span, intersect_triangle, owns_crossing, ray_in_mesh
from lumisplat.device.mesh.mesh_surface import (
    face_normal,
    hit_weights,
    material_at,
    surface_alpha,
    surface_color,
    surface_normal,
)
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import MeshBvh, MeshTriangle, Node, WaitingLink
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import ALPHA_OPAQUE

# No fused multiply-add: it would let rays through shared edges of triangles.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 4})

EDGE_WEIGHT_MAX = 1e-5
"""A ray through glass may lie on a triangle's edge if a barycentric weight of its hit is below this value. The value
is larger than any rounding error of a weight.
"""

EDGE = wp.constant(wp.float32(EDGE_WEIGHT_MAX))


@struct
class MeshShadowRay:
    """A shadow ray that is traced through meshes, in world space."""

    origin: wp.vec3
    direction: wp.vec3
    t_max: float
    is_opaque: bool
    """True if glass blocks the ray instead of transmitting it."""
    media: wp.vec4i
    """Meshes of glass that the ray's origin is inside, encoded as in ``Boundary``."""


@struct
class MeshPassage:
    """Running results while a shadow ray crosses the triangles of one mesh instance."""

    light: wp.vec3
    """Transmittance of the triangles so far, linear, per channel."""
    inside: float
    """Sum of the distances at which the shadow ray has left the mesh, minus the distances at which the ray has
    entered. ``length_inside`` computes the length inside from this sum."""
    entries: int
    """Number of times that the shadow ray has entered the mesh, minus the number of times that it has left; if
    positive, the ray ends inside the mesh at ``t_max``."""


@wp.func
def pass_triangle(
    triangle: MeshTriangle,
    ray: MeshRay,
    shadow: MeshShadowRay,
    number: int,
    scene: MeshBvh,
    passage: wp.ref[MeshPassage],
):
    """Multiplies the passage's light by the transmittance of a triangle of instance ``number``.

    ``ray`` is the shadow ray in the mesh's object space.
    """
    hit = intersect_triangle(ray.origin, ray.direction, ray.shear, triangle.a, triangle.b, triangle.c)
    t = ray.begin + hit.t
    if not (t > 0.0 and t < shadow.t_max):
        return
    is_glass = not shadow.is_opaque and scene.instances[number].material.smooth != 0
    is_bent = shadow.is_opaque and scene.instances[number].alpha.is_bent != 0
    if not is_glass and (is_bent or scene.instances[number].alpha.mode == ALPHA_OPAQUE):
        passage.light = wp.vec3(0.0)
        return
    weights = hit_weights(hit.weights)
    if wp.min(weights) < EDGE and not owns_crossing(ray.origin, ray.shear, triangle.a, triangle.b, triangle.c):
        return
    instance = scene.instances[number]
    corners = scene.meshes.indices[instance.face_first + triangle.face]
    share = wp.vec3(0.0)
    if is_glass:
        normal = surface_normal(instance, scene.meshes, corners, weights)
        color = surface_color(instance, scene.meshes, corners, weights)
        material = material_at(instance, scene.meshes, corners, weights)
        share = pass_straight(material, color, wp.min(wp.abs(wp.dot(normal, shadow.direction)), 1.0))
        enters = wp.dot(shadow.direction, face_normal(instance, scene.meshes, corners)) < 0.0
        passage.inside += wp.where(enters, -t, t)
        passage.entries += wp.where(enters, 1, -1)
    alpha = surface_alpha(instance, scene.meshes, corners, weights)
    passage.light = wp.cw_mul(passage.light, alpha * share + wp.vec3(1.0 - alpha))


@wp.func
def length_inside(passage: MeshPassage, shadow: MeshShadowRay, number: int) -> float:
    """Returns the length of a shadow ray inside instance ``number``, once all triangles have been crossed."""
    entries = passage.entries
    if is_in(shadow.media, number):
        entries += 1
    inside = passage.inside
    if entries > 0 and shadow.t_max < wp.inf:
        inside += float(entries) * shadow.t_max
    return wp.max(inside, 0.0)


@wp.func
def pass_instance(
    stack: wp.array[WaitingLink],
    top: int,
    number: int,
    shadow: MeshShadowRay,
    scene: MeshBvh,
    light: wp.ref[wp.vec3],
):
    """Multiplies the light by the transmittance of instance ``number``; the traversal uses ``stack`` above ``top``."""
    outer = inverse_or_large(shadow.direction)
    span = box_span(shadow.origin, outer, scene.instances[number].low, scene.instances[number].high)
    if not (span[0] <= span[1] and span[1] > 0.0 and span[0] < shadow.t_max):
        return
    ray = ray_in_mesh(scene.instances[number], shadow.origin, shadow.direction, span[0], 0.0)
    inverse = inverse_or_large(ray.direction)
    asset = scene.instances[number].asset
    passage = MeshPassage()
    passage.light = light
    node = Node()
    height = int(top)
    push_link(stack, height, scene.instances[number].root)
    while height > top and wp.max(passage.light) > 0.0:
        height -= 1
        link = stack[height].link
        if link < 0:
            triangle = scene.assets[asset].triangles[~link]
            pass_triangle(triangle, ray, shadow, number, scene, passage)
        else:
            load_node(scene.assets[asset].nodes, link, node)
            push_all_entered(stack, height, node, enter_boxes(node, ray.origin, inverse), shadow.t_max - ray.begin)
    light = passage.light
    if scene.instances[number].material.is_medium != 0:
        inside = length_inside(passage, shadow, number)
        light = wp.cw_mul(light, passed(scene.instances[number].material.absorption, inside))


@wp.func
def light_past_meshes(shadow: MeshShadowRay, scene: MeshBvh) -> wp.vec3:
    """Returns the product of the transmittances of all meshes on a shadow ray, linear, per channel."""
    light = wp.vec3(1.0)
    inverse = inverse_or_large(shadow.direction)
    storage = LinkStackStorage()
    stack = link_stack(storage)
    node = Node()
    top = int(0)
    push_link(stack, top, 0)
    while top > 0 and wp.max(light) > 0.0:
        top -= 1
        link = stack[top].link
        if link < 0:
            pass_instance(stack, top, scene.tlas_order[~link], shadow, scene, light)
        else:
            load_node(scene.tlas_nodes, link, node)
            push_all_entered(stack, top, node, enter_boxes(node, shadow.origin, inverse), shadow.t_max)
    return light


@wp.kernel
def shadow_by_meshes(
    start: int,
    opaque: wp.array[wp.bool],
    media: wp.array[wp.vec4i],
    meshes_only: bool,
    scene: MeshBvh,
    rays: RayData,
    skips: wp.array[wp.bool],
    light_out: wp.array[wp.vec3],
    limit_out: wp.array[float],
):
    """Per shadow ray: writes the transmittance of all meshes between its origin and ``t_max``.

    Glass blocks a ray if the ray's ``opaque`` is True; with an empty ``opaque``, glass blocks no ray. ``media`` are the
    media around the origins; if empty, all origins are in air. ``limit_out`` is the distance up to which Gaussians may
    block the light that remains. It is 0 if no light remains. With ``meshes_only``, it is also 0 for rays with
    ``skips``, which pass through shadow catchers; only meshes can then block these rays.
    """
    i = start + wp.tid()
    t_max = rays.t_max[i]
    light = wp.vec3(1.0)
    if rays.is_active[i] and t_max > 0.0:
        shadow = MeshShadowRay()
        shadow.origin = rays.origin[i]
        shadow.direction = rays.direction[i]
        shadow.t_max = t_max
        if opaque:
            shadow.is_opaque = opaque[i]
        if media:
            shadow.media = media[i]
        light = light_past_meshes(shadow, scene)
    light_out[i] = light
    is_done = wp.max(light) <= 0.0 or (meshes_only and skips[i])
    limit_out[i] = wp.where(is_done, 0.0, t_max)
