"""Kernels of BVHs over Gaussians: they compute boxes, Morton codes, and the particle records that rays read.

``box_gaussians`` and ``code_gaussians`` have one thread per Gaussian, ``gather_particles`` one per particle in BVH
order. A particle is the record of one Gaussian.
"""

import warp as wp

from lumisplat.device.gaussian.particle import particle_box, particle_of
from lumisplat.device.math.sorting import morton_code
from lumisplat.device.structs.bvh import Box, Particle
from lumisplat.device.structs.scene import GaussianData, KernelData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.kernel
def box_gaussians(
    start: int, kernel: KernelData, gaussians: GaussianData, items: wp.array[int], boxes_out: wp.array[Box]
):
    """Per Gaussian in ``items``: writes the tight box around the points where its response is not cut off."""
    i = start + wp.tid()
    boxes_out[i] = particle_box(kernel, gaussians, items[i])


@wp.kernel
def code_gaussians(
    start: int,
    low: wp.vec3,
    per_cell: wp.vec3,
    gaussians: GaussianData,
    codes_out: wp.array[int],
    items_out: wp.array[int],
):
    """Writes the Morton code of each mean on a grid of 1024^3 cells; means outside the grid take the nearest cell."""
    i = start + wp.tid()
    codes_out[i] = morton_code(gaussians.means[i], low, per_cell)
    items_out[i] = i


@wp.kernel
def gather_particles(
    start: int,
    kernel: KernelData,
    gaussians: GaussianData,
    items: wp.array[int],
    particles_out: wp.array[Particle],
    boxes_out: wp.array[Box],
):
    """Per Gaussian: writes its particle (record that rays read) and its box in the order of the BVH's leaves."""
    i = start + wp.tid()
    particles_out[i] = particle_of(kernel, gaussians, items[i])
    boxes_out[i] = particle_box(kernel, gaussians, items[i])
