"""Where the rays of a packet hit a Gaussian, and how much each is absorbed there (docs/method/ray_tracing.md#hits)."""

import functools
from typing import Any, NamedTuple

import warp as wp

from lumisplat.device.bvh.footprint import footprint_variance
from lumisplat.device.bvh.node_test import larger, lesser
from lumisplat.device.bvh.ray_packet import packet_of
from lumisplat.device.gaussian.layers import is_other_layer, thin_axis, world_mean
from lumisplat.device.gaussian.particle import alpha_of_degree
from lumisplat.device.splat.projection import alpha_from_log
from lumisplat.device.structs.bvh import FAR, HIT_FAR, HIT_HULL, HIT_MEAN, HIT_NEAR, HIT_NONE, Particle, SceneBvh
from lumisplat.device.structs.packet import PacketRays
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import KernelData, SplatInstanceData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


class PacketHits(NamedTuple):
    """Functions for a number of lanes."""

    hit_distances: Any
    hit_responses: Any
    alphas_at: Any
    counted_hits: Any


@functools.cache
def packet_hits_of(lanes: int) -> PacketHits:
    """What hits of packets of up to ``lanes`` rays need."""
    LANES = lanes
    Floats, Ints = packet_of(lanes).floats, packet_of(lanes).ints

    @wp.func
    def hit_distances(particle: Particle, scale: float, hit_distance: int, begin: float, packet: PacketRays):
        """Where each ray hits a Gaussian, widened by the ray's footprint.

        Returns the distance by which hits are ordered, FAR where there is none, the squared canonical distance at the
        peak of the response, and what the hit is: HIT_NONE, HIT_FAR, or HIT_NEAR. The peak of a hit lies before
        ``t_max``; that of a near one not beyond ``t_min``, or ``begin`` if that is nearer.
        """
        origin = packet.origin
        direction = packet.direction
        w = particle.canonical_from_object
        mean = particle.mean
        sharp_x = w[0, 0] * w[0, 0] + w[0, 1] * w[0, 1] + w[0, 2] * w[0, 2]
        sharp_y = w[1, 0] * w[1, 0] + w[1, 1] * w[1, 1] + w[1, 2] * w[1, 2]
        sharp_z = w[2, 0] * w[2, 0] + w[2, 1] * w[2, 1] + w[2, 2] * w[2, 2]
        per_length2 = scale * scale
        largest_scale = scale * particle.largest_scale
        t = Floats()
        distance2 = Floats()
        kind = Ints()
        for lane in range(LANES):
            x = origin[0, lane] - mean[0]
            y = origin[1, lane] - mean[1]
            z = origin[2, lane] - mean[2]
            cx = w[0, 0] * x + w[0, 1] * y + w[0, 2] * z
            cy = w[1, 0] * x + w[1, 1] * y + w[1, 2] * z
            cz = w[2, 0] * x + w[2, 1] * y + w[2, 2] * z
            ex = w[0, 0] * direction[0, lane] + w[0, 1] * direction[1, lane] + w[0, 2] * direction[2, lane]
            ey = w[1, 0] * direction[0, lane] + w[1, 1] * direction[1, lane] + w[1, 2] * direction[2, lane]
            ez = w[2, 0] * direction[0, lane] + w[2, 1] * direction[1, lane] + w[2, 2] * direction[2, lane]
            dx = direction[0, lane]
            dy = direction[1, lane]
            dz = direction[2, lane]
            middle = -(x * dx + y * dy + z * dz) * per_length2
            variance = footprint_variance(packet.footprint[lane], packet.path_length[lane] + middle, largest_scale)
            fx = 1.0 / (1.0 + variance * sharp_x)
            fy = 1.0 / (1.0 + variance * sharp_y)
            fz = 1.0 / (1.0 + variance * sharp_z)
            per_unit = 1.0 / wp.sqrt(fx * ex * ex + fy * ey * ey + fz * ez * ez)
            ex = ex * per_unit
            ey = ey * per_unit
            ez = ez * per_unit
            # A cross product: c + t e would cancel for thin Gaussians.
            kx = cy * ez - cz * ey
            ky = cz * ex - cx * ez
            kz = cx * ey - cy * ex
            # In this order: products of two factors of thin axes leave float32.
            d2 = (fy * kx) * (fz * kx) + (fz * ky) * (fx * ky) + (fx * kz) * (fy * kz)
            peak = -(fx * cx * ex + fy * cy * ey + fz * cz * ez) * per_unit
            inside = particle.reach2 - d2
            back = wp.where(hit_distance == HIT_HULL, per_unit * wp.sqrt(larger(inside, 0.0)), 0.0)
            is_hit = wp.where(inside >= 0.0, 1, 0) & wp.where(peak > 0.0, 1, 0)
            is_hit = is_hit & wp.where(peak < packet.t_max[lane], 1, 0)
            kind[lane] = wp.where(peak > lesser(packet.t_min[lane], begin), HIT_FAR, HIT_NEAR) * is_hit
            t[lane] = wp.where(is_hit != 0, wp.where(hit_distance == HIT_MEAN, middle, peak - back), FAR)
            distance2[lane] = d2
        return t, distance2, kind

    @wp.func
    def hit_responses(particle: Particle, begin: float, packet: PacketRays):
        """Whether each ray hits a Gaussian, as ``hit_distances`` has it, without the distance.

        Returns what the hit is, and two numbers whose quotient is the squared canonical distance: most rays do not need
        it.
        """
        origin = packet.origin
        direction = packet.direction
        w = particle.canonical_from_object
        mean = particle.mean
        kind = Ints()
        across2 = Floats()
        along2 = Floats()
        for lane in range(LANES):
            x = origin[0, lane] - mean[0]
            y = origin[1, lane] - mean[1]
            z = origin[2, lane] - mean[2]
            cx = w[0, 0] * x + w[0, 1] * y + w[0, 2] * z
            cy = w[1, 0] * x + w[1, 1] * y + w[1, 2] * z
            cz = w[2, 0] * x + w[2, 1] * y + w[2, 2] * z
            ex = w[0, 0] * direction[0, lane] + w[0, 1] * direction[1, lane] + w[0, 2] * direction[2, lane]
            ey = w[1, 0] * direction[0, lane] + w[1, 1] * direction[1, lane] + w[1, 2] * direction[2, lane]
            ez = w[2, 0] * direction[0, lane] + w[2, 1] * direction[1, lane] + w[2, 2] * direction[2, lane]
            kx = cy * ez - cz * ey
            ky = cz * ex - cx * ez
            kz = cx * ey - cy * ex
            k2 = kx * kx + ky * ky + kz * kz
            e2 = ex * ex + ey * ey + ez * ez
            peak = -(cx * ex + cy * ey + cz * ez)
            hit = wp.where(k2 <= particle.reach2 * e2, 1, 0) & wp.where(peak < packet.t_max[lane] * e2, 1, 0)
            hit = hit & wp.where(peak > 0.0, 1, 0)
            kind[lane] = wp.where(peak > lesser(packet.t_min[lane], begin) * e2, HIT_FAR, HIT_NEAR) * hit
            across2[lane] = k2
            along2[lane] = e2
        return kind, across2, along2

    @wp.func
    def alphas_at(kernel: KernelData, particle: Particle, distance2: Floats) -> Floats:
        """Alphas of a Gaussian at squared canonical distances within its reach."""
        alpha = Floats()
        for lane in range(LANES):
            alpha[lane] = alpha_from_log(particle.log_opacity - 0.5 * distance2[lane])
        if kernel.degree != 2:
            for lane in range(LANES):
                alpha[lane] = alpha_of_degree(kernel, particle.log_opacity, distance2[lane])
        return alpha

    @wp.func
    def counted_hits(
        kind: wp.ref[Ints],
        begin: float,
        packet: PacketRays,
        particle: Particle,
        instance: SplatInstanceData,
        scene: SceneBvh,
        rays: RayData,
        first: int,
    ) -> int:
        """Leaves of near hits those on Gaussians of another layer; returns 0 if no hit is left.

        Args:
            kind: Of the hits.
            begin: As of ``hit_distances``.
            packet: The rays, in the space of the Gaussian.
            particle: The Gaussian.
            instance: Its placement.
            scene: The scene.
            rays: The rays in the world.
            first: The ray of lane 0.
        """
        found = int(0)
        for lane in range(LANES):
            found = found | kind[lane]
        if (found & HIT_NEAR) == 0:
            return found
        kinds = kind
        found = int(0)
        axis = thin_axis(particle, instance)
        if wp.length_sq(axis) == 0.0:
            for lane in range(LANES):
                kinds[lane] = kinds[lane] & HIT_FAR
                found = found | kinds[lane]
            kind = kinds
            return found
        mean = world_mean(particle, instance)
        gaussians = scene.assets[instance.asset].gaussians
        for lane in range(LANES):
            if kinds[lane] == HIT_NEAR:
                near = lesser(packet.t_min[lane], begin)
                if not is_other_layer(first + lane, near, mean, axis, particle, instance, gaussians, rays):
                    kinds[lane] = HIT_NONE
            found = found | kinds[lane]
        kind = kinds
        return found

    return PacketHits(hit_distances, hit_responses, alphas_at, counted_hits)
