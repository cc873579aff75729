"""Kernels of the backward pass of ray tracing: gradients of Gaussians from gradients at rays.

The forward kernel traces the rays once more and lists their hits one by one. ``replay_rays`` blends each ray's hits
again, front to back; one number per ray holds the loss terms of the hits still to come. The hits are then sorted by
Gaussian with a stable sort, and ``gather_gaussians`` sums the gradients of each Gaussian's hits in ray order. No array
element has two writers. The equations are in docs/method/gradients.md.
"""

import warp as wp

from lumisplat.device.camera.pixels import pixel_of_ray
from lumisplat.device.gaussian.hit_gradient import (
    HitMoments,
    RayMotion,
    add_color,
    add_hit,
    add_moments,
    log_alpha_gradient,
    ray_in_object,
)
from lumisplat.device.gaussian.packet_tracing import ray_of
from lumisplat.device.gaussian.ray_compositing import hit_color
from lumisplat.device.splat.blending import instance_of
from lumisplat.device.structs.bvh import SceneBvh, TraceData
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, HitGradients, PixelGradient, RayGradient
from lumisplat.device.structs.rays import HitProfiles, RayData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.kernel
def start_pixels(
    start: int, width: int, height: int, pixels: PixelData, gradient: PixelGradient, rays_out: RayGradient
):
    """Per camera ray: copies the gradients at its pixel; 0 outside the image. Pixels that show a mesh have alpha 1."""
    ray = start + wp.tid()
    at = pixel_of_ray(width, ray)
    rays_out.color[ray] = wp.vec3(0.0)
    rays_out.behind[ray] = 0.0
    if at[0] < width and at[1] < height:
        pixel = at[1] * width + at[0]
        by_color = gradient.color[pixel]
        rays_out.color[ray] = by_color
        rays_out.behind[ray] = wp.dot(by_color, pixels.color[pixel]) - gradient.alpha[pixel] * (
            1.0 - pixels.alpha[pixel]
        )


@wp.kernel
def replay_rays(
    start: int,
    settings: wp.array[TraceData],
    scene: SceneBvh,
    rays: RayData,
    gradient: RayGradient,
    counts: wp.array[int],
    profiles: HitProfiles,
    hits_out: HitGradients,
    keys_out: wp.array[int],
    order_out: wp.array[int],
):
    """Per ray: blends the ray's hits once more, and writes each hit's gradients with its Gaussian as sort key."""
    i = start + wp.tid()
    if counts[i] == 0:
        return
    view = settings[0]
    ray = ray_of(rays, i)
    by_color = gradient.color[i]
    behind = gradient.behind[i]
    before = float(1.0)
    for row in range(profiles.first[i], profiles.first[i] + counts[i]):
        index = profiles.gaussian[row]
        instance = scene.instances[instance_of(scene.instances, index)]
        local_ray = ray_in_object(instance, ray)
        gaussians = scene.assets[instance.asset].gaussians
        eye = local_ray.origin - local_ray.path_length * local_ray.direction
        loss_term = wp.dot(by_color, hit_color(view, instance, gaussians, index - instance.first, eye))
        alpha = profiles.alpha[row]
        weight = before * alpha
        hits_out.ray[row] = i
        hits_out.log_alpha[row] = log_alpha_gradient(alpha, before, loss_term, behind)
        hits_out.weight[row] = weight
        keys_out[row] = index
        order_out[row] = row
        behind -= weight * loss_term
        before = profiles.transmittance[row]


@wp.kernel
def find_runs(start: int, count: int, keys: wp.array[int], begins_out: wp.array[int], ends_out: wp.array[int]):
    """Per hit, in order of Gaussians: writes where the hits of each Gaussian begin and end."""
    entry = start + wp.tid()
    key = keys[entry]
    if entry == 0 or keys[wp.max(entry - 1, 0)] != key:
        begins_out[key] = entry
    if entry == count - 1 or keys[wp.min(entry + 1, count - 1)] != key:
        ends_out[key] = entry + 1


@wp.kernel
def gather_gaussians(
    start: int,
    settings: wp.array[TraceData],
    instances: wp.array[SplatInstanceData],
    instance_ids: wp.array[int],
    gaussians: GaussianData,
    rays: RayData,
    gradient: RayGradient,
    hits: HitGradients,
    order: wp.array[int],
    begins: wp.array[int],
    ends: wp.array[int],
    weights_inout: wp.array[float],
    largest_inout: wp.array[float],
    motions_inout: wp.array[RayMotion],
    gaussians_inout: GaussianGradient,
):
    """Per Gaussian of an asset: sums the gradients of the Gaussian's hits over all instances of the asset.

    All rays from one eye see a Gaussian in the same colour. The colour gradients of consecutive hits by such rays are
    therefore summed before the SH backward pass.
    """
    i = start + wp.tid()
    view = settings[0]
    mean = gaussians.means[i]
    scale = gaussians.scales[i]
    axes = wp.quat_to_matrix(gaussians.rotations[i])
    for number in range(instance_ids.shape[0]):
        instance = instances[instance_ids[number]]
        index = instance.first + i
        if begins[index] == ends[index]:
            continue
        moments = HitMoments()
        eye = wp.vec3(0.0)
        by_color = wp.vec3(0.0)
        motion = motions_inout[index]
        weights = float(weights_inout[index])
        largest = float(largest_inout[index])
        for entry in range(begins[index], ends[index]):
            row = order[entry]
            number_of_ray = hits.ray[row]
            ray = ray_in_object(instance, ray_of(rays, number_of_ray))
            moments = add_hit(moments, instance, mean, axes, scale, ray, hits.log_alpha[row])
            from_eye = ray.origin - ray.path_length * ray.direction
            if entry > begins[index] and wp.length_sq(from_eye - eye) > 0.0:
                motion = add_color(view, instance, gaussians, i, eye, by_color, motion, gaussians_inout)
                by_color = wp.vec3(0.0)
            eye = from_eye
            by_color += hits.weight[row] * gradient.color[number_of_ray]
            weights += hits.weight[row]
            largest = wp.max(largest, hits.weight[row])
        motion = add_color(view, instance, gaussians, i, eye, by_color, motion, gaussians_inout)
        by_rays = add_moments(gaussians, i, axes, moments, gaussians_inout)
        motion.shift += by_rays.shift
        motion.rotation += by_rays.rotation
        motions_inout[index] = motion
        weights_inout[index] = weights
        largest_inout[index] = largest
