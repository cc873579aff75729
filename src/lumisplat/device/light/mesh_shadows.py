"""Shadow rays through meshes: the transmittance of all triangles on a ray (docs/method/shadows.md)."""

import warp as wp

from lumisplat.device.bvh.nodes import (
    enter_boxes,
    first_lane,
    lanes_within,
    lesser,
    load_node,
    push_lanes,
)
from lumisplat.device.light.shadow_rays import pass_straight
from lumisplat.device.material.media import is_in, passed
from lumisplat.device.math.memory import from_zero
from lumisplat.device.mesh.mesh_rays import (
    Crossings,
    MeshRay,
    TriangleHit,
    axis_last,
    box_span,
    cross_triangles,
    hit_of,
    load_turned,
    mesh_ray,
    owns_crossing,
    ray_in_mesh,
)
from lumisplat.device.mesh.mesh_surface import (
    face_normal,
    hit_weights,
    material_at,
    surface_alpha,
    surface_color,
    surface_normal,
)
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import FAR, MeshBvh, Node, TriangleLeaf
from lumisplat.device.structs.scene import ALPHA_OPAQUE

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
    hit: TriangleHit,
    face: int,
    ray: MeshRay,
    shadow: MeshShadowRay,
    number: int,
    scene: MeshBvh,
    passage: wp.ref[MeshPassage],
):
    """Multiplies the passage's light by the transmittance of a hit triangle, ``face``, of instance ``number``.

    ``ray`` is the shadow ray in the mesh's object space.
    """
    t = ray.begin + hit.t
    if not (t > 0.0 and t < shadow.t_max):
        return
    is_glass = not shadow.is_opaque and scene.instances[number].material.smooth != 0
    is_bent = shadow.is_opaque and scene.instances[number].alpha.is_bent != 0
    if not is_glass and (is_bent or scene.instances[number].alpha.mode == ALPHA_OPAQUE):
        passage.light = wp.vec3(0.0)
        return
    weights = hit_weights(hit.weights)
    instance = scene.instances[number]
    corners = scene.meshes.indices[instance.face_first + face]
    if wp.min(weights) < EDGE:
        a = scene.meshes.positions[corners[0]]
        b = scene.meshes.positions[corners[1]]
        c = scene.meshes.positions[corners[2]]
        if not owns_crossing(ray.origin, ray.shear, a, b, c):
            return
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
    stack: wp.array[int],
    bottom: int,
    number: int,
    world: MeshRay,
    shadow: MeshShadowRay,
    scene: MeshBvh,
    light: wp.ref[wp.vec3],
):
    """Multiplies the light by the transmittance of instance ``number``.

    ``world`` is the shadow ray in world space. The traversal uses ``stack`` from ``bottom`` on.
    """
    span = box_span(world.origin, world.inverse, scene.instances[number].low, scene.instances[number].high)
    if not (span[0] <= span[1] and span[1] > 0.0 and span[0] < shadow.t_max):
        return
    ray = ray_in_mesh(scene.instances[number], world, span[0], 0.0)
    nodes = scene.assets[scene.instances[number].asset].nodes
    leaves = scene.assets[scene.instances[number].asset].leaves
    passage = MeshPassage()
    passage.light = light
    turned = axis_last(ray.origin, ray.shear.axis)
    reach = lesser(shadow.t_max - ray.begin, FAR)
    node = Node()
    leaf = TriangleLeaf()
    crossings = Crossings()
    top = int(bottom)
    stack[from_zero(top)] = scene.instances[number].root
    top += 1
    while top > bottom:
        top -= 1
        link = stack[from_zero(top)]
        if link < 0:
            load_turned(leaves, ~link, ray.shear.axis, leaf)
            hits = cross_triangles(leaf, turned, ray.shear, crossings)
            while hits != 0:
                c = first_lane(hits)
                hits = hits & (hits - 1)
                hit = hit_of(crossings, c, ray.shear.inverse)
                pass_triangle(hit, leaves[~link].face[c], ray, shadow, number, scene, passage)
                if wp.max(passage.light) <= 0.0:
                    top = bottom
        else:
            load_node(nodes, link, node)
            push_lanes(stack, top, node.link, lanes_within(enter_boxes(node, ray.origin, ray.inverse), reach))
    light = passage.light
    if scene.instances[number].material.is_medium != 0:
        inside = length_inside(passage, shadow, number)
        light = wp.cw_mul(light, passed(scene.instances[number].material.absorption, inside))


@wp.func
def light_past_meshes(stack: wp.array[int], shadow: MeshShadowRay, scene: MeshBvh) -> wp.vec3:
    """Returns the product of the transmittances of all meshes on a shadow ray, linear, per channel."""
    light = wp.vec3(1.0)
    world = mesh_ray(shadow.origin, shadow.direction)
    reach = lesser(shadow.t_max, FAR)
    node = Node()
    stack[0] = 0
    top = int(1)
    while top > 0:
        top -= 1
        link = stack[from_zero(top)]
        if link < 0:
            pass_instance(stack, top, scene.tlas_order[~link], world, shadow, scene, light)
            if wp.max(light) <= 0.0:
                top = 0
        else:
            load_node(scene.tlas_nodes, link, node)
            push_lanes(stack, top, node.link, lanes_within(enter_boxes(node, world.origin, world.inverse), reach))
    return light
