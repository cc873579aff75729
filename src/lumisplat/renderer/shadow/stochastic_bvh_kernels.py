"""Kernel that shrinks BVHs for one stochastic sample of shadows. One thread per node of a BVH level."""

import warp as wp

from lumisplat.constants import BOX_MARGIN, NODE_WIDTH
from lumisplat.device.gaussian.particle import distance_squared
from lumisplat.device.light.shadow_rays import shadow_key
from lumisplat.device.math.random import draw_stratified
from lumisplat.device.splat.projection import ALPHA_LIMIT
from lumisplat.device.structs.bvh import FAR, NO_CHILD, Node, Particle, ShadowData
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

WIDTH = wp.constant(NODE_WIDTH)
MARGIN = wp.constant(wp.float32(BOX_MARGIN))


@wp.kernel
def shrink_nodes(
    start: int,
    node_first: int,
    settings: wp.array[ShadowData],
    owners: wp.array[int],
    instances: wp.array[SplatInstanceData],
    particles: wp.array[Particle],
    nodes: wp.array[Node],
    nodes_out: wp.array[Node],
):
    """Per node of a BVH level: shrinks its boxes to the parts of Gaussians that block light in a stochastic sample.

    A Gaussian blocks light where its alpha exceeds the Gaussian's random number. If the asset has several instances
    (``owners``), the lowest random number of all instances counts; it gives the largest box.
    """
    n = node_first + start + wp.tid()
    view = settings[0]
    key = shadow_key(view)
    kernel = instances[owners[0]].kernel
    node = nodes[n]
    for c in range(WIDTH):
        low = wp.vec3(FAR)
        high = wp.vec3(-FAR)
        link = node.link[c]
        if link < 0:
            particle = particles[~link]
            number = float(1.0)
            for k in range(owners.shape[0]):
                index = instances[owners[k]].first + particle.index
                number = wp.min(number, draw_stratified(key, view.sample, index))
            number = view.acceptance_scale * number
            log_response = wp.log(number) - particle.log_opacity
            if number < ALPHA_LIMIT and log_response < 0.0 and particle.reach2 > 0.0:
                share = wp.sqrt(wp.min(distance_squared(kernel, log_response) / particle.reach2, 1.0))
                corner = wp.vec3(node.low_x[c], node.low_y[c], node.low_z[c])
                opposite = wp.vec3(node.high_x[c], node.high_y[c], node.high_z[c])
                center = 0.5 * corner + 0.5 * opposite
                half = (0.5 * share) * (opposite - corner)
                half += (wp.vec3(wp.max(half)) + wp.abs(center)) * MARGIN
                low = center - half
                high = center + half
        elif link != NO_CHILD:
            child = nodes_out[link]
            low = wp.vec3(wp.min(child.low_x), wp.min(child.low_y), wp.min(child.low_z))
            high = wp.vec3(wp.max(child.high_x), wp.max(child.high_y), wp.max(child.high_z))
        node.low_x[c] = low[0]
        node.low_y[c] = low[1]
        node.low_z[c] = low[2]
        node.high_x[c] = high[0]
        node.high_y[c] = high[1]
        node.high_z[c] = high[2]
    nodes_out[n] = node
