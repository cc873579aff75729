"""A bundle of rays side by side: what bounds it, and where its rays meet a Gaussian.

Loops over the lanes become vector instructions, so a bundle's types and functions are made for its number of rays.

The equations are in docs/method/ray_tracing.md#hits.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from lumisplat.constants import COHERENT_SPREAD
from lumisplat.device.bvh.node_test import larger, slabs_around
from lumisplat.device.structs.bvh import FAR, Particle, Slabs
from lumisplat.device.structs.rays import RayData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

PACKET_OPTIONS = {
    "enable_backward": False,
    # Loops over lanes and children must stay loops for the vectoriser, and multiply-adds are to be fused.
    "max_unroll": 4,
    "cpu_compiler_flags": "-march=native -ffp-contract=fast -mllvm=-inline-threshold=9000"
    " -mllvm=-inline-cold-callsite-threshold=3000 -mllvm=-slp-recursion-max-depth=4",
}
"""Of the modules that follow bundles."""

SPREAD_MAX = wp.constant(wp.float32(COHERENT_SPREAD))


class RayPacket(NamedTuple):
    """Types and functions for a number of rays."""

    floats: Any
    """Vector of a number a ray."""
    ints: Any
    gather: Any
    slabs_of: Any
    meet_particle: Any
    pass_particle: Any


@functools.cache
def packet_of(lanes: int) -> RayPacket:
    """What ``lanes`` rays side by side need."""
    LANES = lanes
    Floats = wp.types.vector(length=lanes, dtype=wp.float32)
    Ints = wp.types.vector(length=lanes, dtype=wp.int32)

    @wp.func
    def gather(rays: RayData, first: int, waiting: Floats, radius_max: float) -> Floats:
        """The next bundle: of the rays whose number is positive, the first, and those that start and point as it does.

        Nearly so, that is. Returns their numbers, and -FAR for the others.
        """
        origin = wp.vec3()
        along = wp.vec3()
        found = int(0)
        members = Floats(-FAR)
        for lane in range(LANES):
            if waiting[lane] > 0.0:
                if found == 0:
                    origin = rays.origin[first + lane]
                    along = rays.direction[first + lane]
                apart = wp.length(rays.origin[first + lane] - origin)
                bend = wp.length(rays.direction[first + lane] - along)
                if found == 0 or (apart <= radius_max and bend <= SPREAD_MAX):
                    members[lane] = waiting[lane]
                found = int(1)
        return members

    @wp.func
    def slabs_of(limit: Floats, ox: Floats, oy: Floats, oz: Floats, dx: Floats, dy: Floats, dz: Floats) -> Slabs:
        """What bounds the rays whose limit is positive: a box around their origins, least and largest slopes."""
        low = wp.vec3(FAR)
        high = wp.vec3(-FAR)
        slow = wp.vec3(FAR)
        fast = wp.vec3(-FAR)
        for lane in range(LANES):
            if limit[lane] > 0.0:
                origin = wp.vec3(ox[lane], oy[lane], oz[lane])
                direction = wp.vec3(dx[lane], dy[lane], dz[lane])
                low = wp.min(low, origin)
                high = wp.max(high, origin)
                slow = wp.min(slow, direction)
                fast = wp.max(fast, direction)
        return slabs_around(low, high, slow, fast)

    @wp.func
    def meet_particle(
        particle: Particle,
        hull: int,
        ox: Floats,
        oy: Floats,
        oz: Floats,
        dx: Floats,
        dy: Floats,
        dz: Floats,
        t_min: Floats,
        t_max: Floats,
    ):
        """Where each ray hits a Gaussian, FAR where it does not, and the squared canonical distance there.

        Its response must peak between ``t_min`` and ``t_max``, wherever on its hull it counts as hit.
        """
        w = particle.canonical_from_object
        mean = particle.mean
        t = Floats()
        distance2 = Floats()
        for lane in range(LANES):
            x = ox[lane] - mean[0]
            y = oy[lane] - mean[1]
            z = oz[lane] - mean[2]
            cx = w[0, 0] * x + w[0, 1] * y + w[0, 2] * z
            cy = w[1, 0] * x + w[1, 1] * y + w[1, 2] * z
            cz = w[2, 0] * x + w[2, 1] * y + w[2, 2] * z
            ex = w[0, 0] * dx[lane] + w[0, 1] * dy[lane] + w[0, 2] * dz[lane]
            ey = w[1, 0] * dx[lane] + w[1, 1] * dy[lane] + w[1, 2] * dz[lane]
            ez = w[2, 0] * dx[lane] + w[2, 1] * dy[lane] + w[2, 2] * dz[lane]
            per_unit = 1.0 / wp.sqrt(ex * ex + ey * ey + ez * ez)
            ex = ex * per_unit
            ey = ey * per_unit
            ez = ez * per_unit
            # A cross product: c + t e would cancel for thin Gaussians.
            kx = cy * ez - cz * ey
            ky = cz * ex - cx * ez
            kz = cx * ey - cy * ex
            d2 = kx * kx + ky * ky + kz * kz
            peak = -(cx * ex + cy * ey + cz * ez) * per_unit
            inside = particle.reach2 - d2
            back = wp.where(hull != 0, per_unit * wp.sqrt(larger(inside, 0.0)), 0.0)
            met = wp.where(inside >= 0.0, 1, 0) & wp.where(peak > t_min[lane], 1, 0)
            met = met & wp.where(peak < t_max[lane], 1, 0)
            t[lane] = wp.where(met != 0, peak - back, FAR)
            distance2[lane] = d2
        return t, distance2

    @wp.func
    def pass_particle(
        particle: Particle,
        ox: Floats,
        oy: Floats,
        oz: Floats,
        dx: Floats,
        dy: Floats,
        dz: Floats,
        t_min: Floats,
        t_max: Floats,
    ):
        """Whether each ray hits a Gaussian, as ``meet_particle`` does, without telling where.

        Returns 0 or 1, and two numbers whose quotient is the squared canonical distance: most rays do not need it.
        """
        w = particle.canonical_from_object
        mean = particle.mean
        met = Ints()
        across2 = Floats()
        along2 = Floats()
        for lane in range(LANES):
            x = ox[lane] - mean[0]
            y = oy[lane] - mean[1]
            z = oz[lane] - mean[2]
            cx = w[0, 0] * x + w[0, 1] * y + w[0, 2] * z
            cy = w[1, 0] * x + w[1, 1] * y + w[1, 2] * z
            cz = w[2, 0] * x + w[2, 1] * y + w[2, 2] * z
            ex = w[0, 0] * dx[lane] + w[0, 1] * dy[lane] + w[0, 2] * dz[lane]
            ey = w[1, 0] * dx[lane] + w[1, 1] * dy[lane] + w[1, 2] * dz[lane]
            ez = w[2, 0] * dx[lane] + w[2, 1] * dy[lane] + w[2, 2] * dz[lane]
            kx = cy * ez - cz * ey
            ky = cz * ex - cx * ez
            kz = cx * ey - cy * ex
            k2 = kx * kx + ky * ky + kz * kz
            e2 = ex * ex + ey * ey + ez * ez
            peak = -(cx * ex + cy * ey + cz * ez)
            hit = wp.where(k2 <= particle.reach2 * e2, 1, 0) & wp.where(peak > t_min[lane] * e2, 1, 0)
            met[lane] = hit & wp.where(peak < t_max[lane] * e2, 1, 0)
            across2[lane] = k2
            along2[lane] = e2
        return met, across2, along2

    return RayPacket(Floats, Ints, gather, slabs_of, meet_particle, pass_particle)
