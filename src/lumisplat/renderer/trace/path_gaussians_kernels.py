"""Kernels that join the hits of emissive captures and relit sets on rays of paths: one of the two hits ends each ray.

One thread per ray.
"""

import warp as wp

from lumisplat.device.math.random import CAPTURED_OR_RELIT, draw
from lumisplat.device.structs.rays import GaussianHits, RayData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def end_at_surfaces(start: int, limits: wp.array[float], surfaces: GaussianHits, ends_out: wp.array[float]):
    """Writes each ray's end: the distance of its hit on a relit Gaussian or, without a hit, its limit."""
    i = start + wp.tid()
    ends_out[i] = wp.min(limits[i], surfaces.depth[i])


@wp.kernel
def choose_hits(start: int, rays: RayData, surfaces: GaussianHits, captured_inout: GaussianHits):
    """Chooses the relit hit or the capture in front of it; the transmittance of the capture is the relit hit's chance.

    The expected value equals compositing the capture over the relit Gaussian.
    """
    i = start + wp.tid()
    if not (rays.is_active[i] and surfaces.depth[i] < wp.inf):
        return
    hidden = 1.0 - captured_inout.transmittance[i]
    captured_inout.hits[i] = captured_inout.hits[i] + surfaces.hits[i]
    if draw(rays.sample_key[i], CAPTURED_OR_RELIT) < hidden:
        captured_inout.color[i] = captured_inout.color[i] / hidden
        captured_inout.normal[i] = captured_inout.normal[i] / hidden
        captured_inout.transmittance[i] = 0.0
    else:
        captured_inout.color[i] = surfaces.color[i]
        captured_inout.normal[i] = surfaces.normal[i]
        captured_inout.transmittance[i] = surfaces.transmittance[i]
        captured_inout.depth[i] = surfaces.depth[i]
        captured_inout.gaussian[i] = surfaces.gaussian[i]


@wp.kernel
def darken(start: int, rays: RayData, mirrored: wp.array[int], hits_inout: GaussianHits):
    """Subtracts the radiance of darkened captures from the radiance of each ray, unless a mirror reflected the ray."""
    i = start + wp.tid()
    if not rays.is_active[i]:
        return
    if mirrored:
        if mirrored[i] != 0:
            return
    hits_inout.color[i] = wp.max(hits_inout.color[i] - hits_inout.relit_color[i], wp.vec3(0.0))
