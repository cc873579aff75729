"""What of a light reaches the origins of rays. First past meshes, one item a ray; then through Gaussians.

Nothing has to be in order: shares of light multiply. So Gaussians are met in whatever order the trees hand them out,
by bundles of rays as in ``trace_kernels``, without lists and in a single pass.
"""

import functools
from typing import Any

import warp as wp

from lumisplat.constants import COHERENT_SPREAD, NODE_WIDTH, TRAVERSE_STACK
from lumisplat.device.bundle import bundle_of
from lumisplat.device.gaussian import alpha_from_log
from lumisplat.device.mesh_surface import hit_weights, surface_color, surface_normal
from lumisplat.device.particle import alpha_of_degree
from lumisplat.device.random import draw_mixed, mix
from lumisplat.device.ray_mesh import box_span, inverse_or_large, ray_in_mesh
from lumisplat.device.ray_structs import MeshPlacement, RayData
from lumisplat.device.ray_triangle import meet_triangle
from lumisplat.device.shade import pass_straight, shadow_of
from lumisplat.device.structs import MeshData, MeshInstanceData
from lumisplat.device.trace_structs import FAR, Node, ShadowData, Slabs, TreeAsset, TreeInstance
from lumisplat.device.traverse import enter_children, larger, lesser, shaft_in_object, slabs_of
from lumisplat.render.trace_kernels import OPTIONS

# As for all that meets triangles: fused products would let rays through shared edges.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

EXACT = 0
STOCHASTIC = 1

METHOD_STOCHASTIC = wp.constant(STOCHASTIC)
WIDTH = wp.constant(NODE_WIDTH)
SPREAD_MAX = wp.constant(wp.float32(COHERENT_SPREAD))

StackFloats = wp.types.vector(length=TRAVERSE_STACK, dtype=wp.float32)
StackInts = wp.types.vector(length=TRAVERSE_STACK, dtype=wp.int32)


@wp.kernel
def shade_by_meshes(
    start: int,
    placements: wp.array(dtype=MeshPlacement),
    instances: wp.array(dtype=MeshInstanceData),
    meshes: MeshData,
    rays: RayData,
    light_out: wp.array(dtype=wp.vec3),
    limit_out: wp.array(dtype=float),
):
    """Multiplies what all triangles between the origin and ``t_max`` let through, in any order.

    ``limit_out`` is as far as Gaussians have to be looked for: not at all where no light is left.
    """
    i = start + wp.tid()
    t_max = rays.t_max[i]
    light = wp.vec3(1.0)
    if t_max > 0.0:
        origin = rays.origin[i]
        direction = rays.direction[i]
        inverse = inverse_or_large(direction)
        for number in range(placements.shape[0]):
            span = box_span(origin, inverse, placements[number].low, placements[number].high)
            if span[0] <= span[1] and span[1] > 0.0 and span[0] < t_max and wp.max(light) > 0.0:
                placement = placements[number]
                ray = ray_in_mesh(placement, origin, direction, span[0], 0.0)
                query = wp.bvh_query_ray(placement.tree, ray.origin, ray.direction)
                item = int(0)
                while wp.max(light) > 0.0 and wp.bvh_query_next(query, item, t_max - ray.begin):
                    corners = meshes.indices[placement.face_first + item]
                    hit = meet_triangle(
                        ray.origin,
                        ray.direction,
                        ray.shear,
                        meshes.positions[corners[0]],
                        meshes.positions[corners[1]],
                        meshes.positions[corners[2]],
                    )
                    t = ray.begin + hit.t
                    if t > 0.0 and t < t_max:
                        weights = hit_weights(hit.weights)
                        instance = instances[number]
                        normal = surface_normal(instance, meshes, corners, weights)
                        color = surface_color(instance, meshes, corners, weights)
                        cosine = wp.min(wp.abs(wp.dot(normal, direction)), 1.0)
                        light = wp.cw_mul(light, pass_straight(placement.material, color, cosine))
    light_out[i] = light
    limit_out[i] = wp.where(wp.max(light) > 0.0, t_max, -wp.inf)


@functools.cache
def occluder(lanes: int) -> Any:
    """The kernel for packets of ``lanes`` rays."""
    LANES = lanes
    Floats, _, shaft_of, meet_particle = bundle_of(lanes)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def shade_by_gaussians(
        start: int,
        settings: wp.array(dtype=ShadowData),
        instances: wp.array(dtype=TreeInstance),
        assets: wp.array(dtype=TreeAsset),
        top_nodes: wp.array(dtype=Node),
        radius_max: float,
        rays: RayData,
        limits: wp.array(dtype=float),
        skips: wp.array(dtype=int),
        light_inout: wp.array(dtype=wp.vec3),
    ):
        """Multiplies the light of each ray with what all Gaussians up to its limit let through."""
        first = (start + wp.tid()) * LANES
        view = settings[0]
        least = wp.max(view.transmittance_min, view.threshold)

        whole = Floats(-FAR)
        left = Floats(1.0)  # transmittances
        live = int(0)
        skipping = int(1)
        for lane in range(LANES):
            if limits[first + lane] > rays.t_min[first + lane]:
                whole[lane] = wp.min(limits[first + lane], FAR)
                live += 1
                skipping &= skips[first + lane]
        if live == 0:
            return
        # Rays that part are no bundle: each goes alone.
        bundles = int(1)
        shaft = shaft_of(rays, first, whole)
        if shaft.spread > SPREAD_MAX or shaft.radius > radius_max:
            bundles = int(LANES)
        for bundle in range(bundles):
            limit = Floats()  # negative: there is no ray
            alive = Floats()  # transmittance where there is one
            for lane in range(LANES):
                limit[lane] = whole[lane]
                if bundles > 1 and lane != bundle:
                    limit[lane] = -FAR
            if bundles > 1:
                if limit[bundle] < 0.0:
                    continue
                shaft = shaft_of(rays, first, limit)
            t_min = Floats()
            begin = float(FAR)
            reach = float(-FAR)
            for lane in range(LANES):
                t_min[lane] = rays.t_min[first + lane]
                if limit[lane] > 0.0:
                    begin = lesser(begin, t_min[lane])
                    reach = larger(reach, limit[lane])
                    alive[lane] = 1.0

            # The nodes that wait, nearest on top.
            entry = StackFloats()
            link = StackInts()
            owner = StackInts()  # instance whose tree the node is of; -1: the tree of the instances
            owner[0] = -1
            top = int(1)
            current = int(-2)
            instance = TreeInstance()
            slabs = Slabs()
            end = Floats()
            ox = Floats()
            oy = Floats()
            oz = Floats()
            dx = Floats()
            dy = Floats()
            dz = Floats()
            while top > 0:
                top -= 1
                if owner[top] != current:
                    current = owner[top]
                    if current < 0:
                        slabs = slabs_of(shaft)
                    else:
                        instance = instances[current]
                        slabs = slabs_of(shaft_in_object(shaft, instance))
                        for lane in range(LANES):
                            o = instance.object_from_world * rays.origin[first + lane]
                            o += instance.object_from_world_offset
                            d = instance.object_from_world * rays.direction[first + lane]
                            ox[lane] = o[0]
                            oy[lane] = o[1]
                            oz[lane] = o[2]
                            dx[lane] = d[0]
                            dy[lane] = d[1]
                            dz[lane] = d[2]
                            end[lane] = limit[lane]
                            if (instance.shadow_only & skips[first + lane]) != 0:
                                end[lane] = -FAR
                node = Node()
                if current < 0:
                    node = top_nodes[link[top]]
                else:
                    node = assets[instance.asset].nodes[link[top]]
                links = node.link
                entries = enter_children(node, slabs, begin)
                base = int(top)
                changed = int(0)
                for c in range(WIDTH):
                    if entries[c] <= reach:
                        if links[c] >= 0 or current < 0:
                            # A node waits in its place among its siblings; an instance as its root.
                            j = int(top)
                            while j > base and entry[wp.max(j - 1, 0)] < entries[c]:
                                entry[j] = entry[j - 1]
                                link[j] = link[j - 1]
                                owner[j] = owner[j - 1]
                                j -= 1
                            entry[j] = entries[c]
                            link[j] = wp.max(links[c], 0)
                            owner[j] = wp.where(links[c] < 0, ~links[c], current)
                            top += 1
                        else:
                            particle = assets[instance.asset].particles[~links[c]]
                            t, distance2 = meet_particle(particle, 0, ox, oy, oz, dx, dy, dz, t_min, end)
                            found = int(0)
                            alpha = Floats()
                            for lane in range(LANES):
                                found += wp.where(t[lane] < FAR, 1, 0)
                                alpha[lane] = alpha_from_log(particle.log_opacity - 0.5 * distance2[lane])
                            if found > 0:
                                if instance.kernel.degree != 2:
                                    for lane in range(LANES):
                                        alpha[lane] = alpha_of_degree(
                                            instance.kernel, particle.log_opacity, distance2[lane]
                                        )
                                if view.method == METHOD_STOCHASTIC:
                                    dimension = mix(wp.uint32(instance.first + particle.index))
                                    for lane in range(LANES):
                                        number = draw_mixed(rays.stream[first + lane], dimension)
                                        alpha[lane] = wp.where(number < alpha[lane], 1.0, 0.0)
                                changed = int(1)
                                for lane in range(LANES):
                                    alive[lane] = alive[lane] * (1.0 - wp.where(t[lane] < FAR, alpha[lane], 0.0))
                if changed != 0:
                    most = float(0.0)
                    for lane in range(LANES):
                        most = larger(most, alive[lane])
                    if most <= least:
                        top = int(0)
            for lane in range(LANES):
                if limit[lane] > 0.0:
                    left[lane] = alive[lane]

        for lane in range(LANES):
            if whole[lane] > 0.0:
                shade = shadow_of(view, left[lane], wp.vec3(0.0))
                light_inout[first + lane] = wp.cw_mul(light_inout[first + lane], shade)

    return shade_by_gaussians
