"""Kernels that evaluate Gaussians for rays, and intersect ray packets with boxes, for their tests."""

import warp as wp

from lumisplat.device.bvh.nodes import enter_children, mean_entries
from lumisplat.device.bvh.packet import packet_of
from lumisplat.device.gaussian.particle import (
    alpha_of_degree,
    ellipsoid_normal,
    particle_box,
    particle_of,
    reach_squared,
)
from lumisplat.device.structs.bvh import Box, Children, Node, Particle, Slabs
from lumisplat.device.structs.rays import Ray, RayData
from lumisplat.device.structs.scene import GaussianData, KernelData, SplatInstanceData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

LANES = 16
TOOLS = packet_of(LANES)
Floats, RaysStorage, packet_rays = TOOLS.floats, TOOLS.rays_storage, TOOLS.packet_rays
take_coherent, slabs_of = TOOLS.take_coherent, TOOLS.slabs_of


@wp.kernel
def probe_responses(
    kernels: wp.array(dtype=KernelData),
    opacities: wp.array(dtype=float),
    distances: wp.array(dtype=float),
    reaches: wp.array(dtype=float),
    alphas: wp.array(dtype=float),
):
    """Evaluates squared reach, and alpha at a distance."""
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
    """Converts Gaussians to particles and boxes, and evaluates ellipsoid normals where rays enter."""
    i = wp.tid()
    particles[i] = particle_of(kernel, gaussians, i)
    boxes[i] = particle_box(kernel, gaussians, i)
    instance = SplatInstanceData()
    instance.kernel = kernel
    instance.scale = 1.0
    normals[i] = ellipsoid_normal(instance, gaussians, i, origins[i], directions[i], Ray())


@wp.kernel
def probe_packets(
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
    """Transforms packets to the space of an instance, as slabs and ray by ray, and intersects a node's children."""
    i = wp.tid()
    instance = instances[i]
    storage = RaysStorage()
    packet = packet_rays(storage)
    limit = limits[i]
    for lane in range(LANES):
        ray = i * LANES + lane
        o = instance.object_from_world * rays.origin[ray] + instance.object_from_world_offset
        d = instance.object_from_world * rays.direction[ray]
        origins[ray] = o
        directions[ray] = d
        packet.limit[lane] = limit[lane]
        for k in range(3):
            packet.origin[k, lane] = o[k]
            packet.direction[k, lane] = d[k]
    slabs[i] = slabs_of(packet)
    entries[i] = enter_children(nodes[i], slabs[i], begins[i])


@wp.kernel
def probe_mean_entries(
    slabs: wp.array(dtype=Slabs),
    nodes: wp.array(dtype=Node),
    begins: wp.array(dtype=float),
    ends: wp.array(dtype=float),
    entries: wp.array(dtype=Children),
):
    """Computes a lower bound of the distances of means in each child box of a node, within a range of distances."""
    i = wp.tid()
    entered = enter_children(nodes[i], slabs[i], 0.0)
    entries[i] = mean_entries(nodes[i], slabs[i], entered, begins[i], ends[i])


@wp.kernel
def probe_take_coherent(
    rays: RayData, waiting: wp.array(dtype=Floats), radius_max: float, taken: wp.array(dtype=Floats)
):
    """Takes the first coherent packet of each item; ``waiting`` keeps the remaining rays."""
    i = wp.tid()
    left = waiting[i]
    taken[i] = take_coherent(rays, i * LANES, left, radius_max)
    waiting[i] = left
