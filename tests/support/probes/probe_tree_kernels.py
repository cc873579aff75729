"""Kernels that show what Gaussians are to rays, and where bundles of rays enter boxes, many at once."""

import warp as wp

from lumisplat.device.bvh.node_test import enter_children
from lumisplat.device.bvh.ray_packet import packet_of
from lumisplat.device.gaussian.particle import (
    alpha_of_degree,
    ellipsoid_normal,
    particle_box,
    particle_of,
    reach_squared,
)
from lumisplat.device.structs.bvh import Box, Children, Node, Particle, Slabs
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import GaussianData, KernelData, SplatInstanceData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

LANES = 16
Floats, _, gather, slabs_of, *_ = packet_of(LANES)


@wp.kernel
def probe_responses(
    kernels: wp.array(dtype=KernelData),
    opacities: wp.array(dtype=float),
    distances: wp.array(dtype=float),
    reaches: wp.array(dtype=float),
    alphas: wp.array(dtype=float),
):
    """Squared reach, and alpha at a distance."""
    i = wp.tid()
    reaches[i] = reach_squared(kernels[i], opacities[i])
    alphas[i] = alpha_of_degree(kernels[i], wp.log(opacities[i]), distances[i] * distances[i])


@wp.kernel
def probe_particles(
    kernel: KernelData,
    gaussians: GaussianData,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    particles: wp.array(dtype=Particle),
    boxes: wp.array(dtype=Box),
    normals: wp.array(dtype=wp.vec3),
):
    """Gaussians as rays meet them, their boxes, and the normals of their ellipsoids where rays enter them."""
    i = wp.tid()
    particles[i] = particle_of(kernel, gaussians, i)
    boxes[i] = particle_box(kernel, gaussians, i)
    normals[i] = ellipsoid_normal(kernel, gaussians, i, origins[i], directions[i])


@wp.kernel
def probe_bundles(
    rays: RayData,
    limits: wp.array(dtype=Floats),
    instances: wp.array(dtype=SplatInstanceData),
    nodes: wp.array(dtype=Node),
    begins: wp.array(dtype=float),
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    slabs: wp.array(dtype=Slabs),
    entries: wp.array(dtype=Children),
):
    """Bundles in the space of an instance, as slabs and ray by ray, and where they enter the children of a node."""
    i = wp.tid()
    instance = instances[i]
    ox = Floats()
    oy = Floats()
    oz = Floats()
    dx = Floats()
    dy = Floats()
    dz = Floats()
    for lane in range(LANES):
        ray = i * LANES + lane
        o = instance.object_from_world * rays.origin[ray] + instance.object_from_world_offset
        d = instance.object_from_world * rays.direction[ray]
        origins[ray] = o
        directions[ray] = d
        ox[lane] = o[0]
        oy[lane] = o[1]
        oz[lane] = o[2]
        dx[lane] = d[0]
        dy[lane] = d[1]
        dz[lane] = d[2]
    slabs[i] = slabs_of(limits[i], ox, oy, oz, dx, dy, dz)
    entries[i] = enter_children(nodes[i], slabs[i], begins[i])


@wp.kernel
def probe_gather(rays: RayData, waiting: wp.array(dtype=Floats), radius_max: float, members: wp.array(dtype=Floats)):
    """The first bundle of each packet."""
    i = wp.tid()
    members[i] = gather(rays, i * LANES, waiting[i], radius_max)
