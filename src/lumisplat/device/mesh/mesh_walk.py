"""The nearest triangle on a ray: through the tree over the instances, and those of their meshes.

Of triangles that are equally near, that of the first instance counts, and in it the first face: so the order of visits
does not matter.
"""

import warp as wp

from lumisplat.device.bvh.ray_nodes import enter_boxes, inverse_or_large, load_node, push_entered, push_link
from lumisplat.device.mesh.mesh_surface import hit_weights, meets_alpha
from lumisplat.device.mesh.ray_mesh import box_span, ray_in_mesh
from lumisplat.device.mesh.ray_triangle import intersect_triangle
from lumisplat.device.structs.bvh import MeshBvh, MeshTriangle, Node
from lumisplat.device.structs.packet import WaitingLink
from lumisplat.device.structs.rays import MeshHit, MeshRay
from lumisplat.device.structs.scene import ALPHA_OPAQUE

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def is_nearer(t: float, local_t: float, face: int, instance: int, nearest: MeshHit) -> bool:
    """Whether a hit is nearer than the nearest so far, or as near and the first of both."""
    if t != nearest.t or nearest.face < 0:
        return t < nearest.t
    if instance != nearest.instance:
        return instance < nearest.instance
    return local_t < nearest.local_t or (local_t == nearest.local_t and face < nearest.face)


@wp.func
def keep_nearest(
    triangle: MeshTriangle,
    ray: MeshRay,
    number: int,
    t_min: float,
    sample_key: wp.uint32,
    scene: MeshBvh,
    nearest: wp.ref[MeshHit],
):
    """Replaces the nearest hit by that of a triangle of instance ``number``, if there is a nearer one."""
    hit = intersect_triangle(ray.origin, ray.direction, ray.shear, triangle.a, triangle.b, triangle.c)
    t = ray.begin + hit.t
    if t > t_min and is_nearer(t, hit.t, triangle.face, number, nearest):
        if scene.instances[number].alpha.mode != ALPHA_OPAQUE:
            face = scene.instances[number].face_first + triangle.face
            where = hit_weights(hit.weights)
            if not meets_alpha(scene.instances[number], scene.meshes, face, where, sample_key):
                return
        nearest.t = t
        nearest.local_t = hit.t
        nearest.face = triangle.face
        nearest.instance = number
        nearest.weights = hit.weights


@wp.func
def walk_instance(
    stack: wp.array[WaitingLink],
    top: int,
    number: int,
    origin: wp.vec3,
    direction: wp.vec3,
    t_min: float,
    sample_key: wp.uint32,
    scene: MeshBvh,
    nearest: wp.ref[MeshHit],
):
    """Finds the nearest triangle of instance ``number``, on the stack above ``top``."""
    span = box_span(origin, inverse_or_large(direction), scene.instances[number].low, scene.instances[number].high)
    if not (span[0] <= span[1] and span[1] > t_min and span[0] <= nearest.t):
        return
    ray = ray_in_mesh(scene.instances[number], origin, direction, span[0], t_min)
    inverse = inverse_or_large(ray.direction)
    asset = scene.instances[number].asset
    node = Node()
    height = int(top)
    push_link(stack, height, scene.instances[number].root)
    while height > top:
        height -= 1
        reach = nearest.t - ray.begin
        if stack[height].entry <= reach:
            link = stack[height].link
            if link < 0:
                keep_nearest(scene.assets[asset].triangles[~link], ray, number, t_min, sample_key, scene, nearest)
            else:
                load_node(scene.assets[asset].nodes, link, node)
                push_entered(stack, height, node, enter_boxes(node, ray.origin, inverse), reach)


@wp.func
def nearest_triangle(
    stack: wp.array[WaitingLink],
    origin: wp.vec3,
    direction: wp.vec3,
    t_min: float,
    t_max: float,
    sample_key: wp.uint32,
    scene: MeshBvh,
) -> MeshHit:
    """The nearest triangle between two distances; without one, ``t_max`` is the distance of the hit."""
    nearest = MeshHit()
    nearest.t = t_max
    nearest.face = -1
    nearest.instance = -1
    inverse = inverse_or_large(direction)
    node = Node()
    top = int(0)
    push_link(stack, top, 0)
    while top > 0:
        top -= 1
        if stack[top].entry <= nearest.t:
            link = stack[top].link
            if link < 0:
                walk_instance(stack, top, scene.tlas_order[~link], origin, direction, t_min, sample_key, scene, nearest)
            else:
                load_node(scene.tlas_nodes, link, node)
                push_entered(stack, top, node, enter_boxes(node, origin, inverse), nearest.t)
    return nearest
