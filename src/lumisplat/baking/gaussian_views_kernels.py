"""Kernels that view single Gaussians, each as if a camera ray had hit no other Gaussian. One thread per view.

``hit_gaussians`` writes the hit of a view's ray on its Gaussian, and integrators shade this hit like any other. A
second ray, from the Gaussian towards the camera, measures from how far away the Gaussian is visible. The equations are
in docs/method/relighting.md#baking.
"""

import warp as wp

from lumisplat.device.gaussian.particle import canonical_from_object, gaussian_color, gaussian_facing, reach_squared
from lumisplat.device.math.directions import TWO_PI
from lumisplat.device.math.random import branch_key, pixel_key_of, sample_key_of, sobol_2d
from lumisplat.device.splat.blending import instance_of
from lumisplat.device.splat.projection import tinted, towards
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import SampleData
from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})

# Random branches that no integrator uses.
POINT_BRANCH = wp.constant((1 << 20) + 8)
"""Random stream of the first two coordinates of the point at which a Gaussian is viewed; no integrator uses it."""
THIRD_BRANCH = wp.constant((1 << 20) + 9)
"""Random stream of the third coordinate of the point at which a Gaussian is viewed; no integrator uses it."""


@struct
class GaussianViews:
    """Gaussian and viewing direction of each view; a view shows one Gaussian from one direction."""

    gaussian: wp.array[int]
    """Index of the view's Gaussian among all Gaussians of the scene."""
    direction: wp.array[wp.vec3]
    """Unit direction of the view, from the camera to the Gaussian, world space."""


@struct
class ViewSums:
    """Sums over the samples of each view of a Gaussian; radiance has separate sums for even and odd samples."""

    even: wp.array[wp.vec3]
    """Sum of the linear radiance of a view over its even samples, without captured colours."""
    odd: wp.array[wp.vec3]
    count: wp.array[int]
    """Number of finite samples of the view, over which the sums are; other samples are dropped."""
    captured: wp.array[wp.vec3]
    """Display-referred captured colour of the view's Gaussian if it is unlit; not a sum, as it is equal in all
    samples."""
    captured_weight: wp.array[float]
    """1 for a view of an unlit Gaussian, which shows its captured colour, else 0; not a sum."""
    factor: wp.array[wp.vec3]
    """Factor of an unlit Gaussian's captured colour that shadows leave, 0..1; only without path tracing."""
    unshadowed: wp.array[wp.vec3]
    """Irradiance of a shadow catcher from the scene's lights, as if the objects added to the scene were absent; path
    tracing only. The fields from here to ``open`` are those of `RayRadiance`."""
    shadowed: wp.array[wp.vec3]
    emitted_unshadowed: wp.array[wp.vec3]
    emitted_shadowed: wp.array[wp.vec3]
    ambient: wp.array[wp.vec3]
    open: wp.array[wp.vec3]
    distance: wp.array[float]
    """Distance from which the Gaussian is visible along the view: to the first occluder, scene units."""


@wp.func
def normal_point(key: wp.uint32, sample: int, reach: float) -> wp.vec3:
    """Samples a standard normal point in 3D, moved towards the origin to a distance of at most ``reach``."""
    u = sobol_2d(branch_key(key, POINT_BRANCH), sample)
    v = sobol_2d(branch_key(key, THIRD_BRANCH), sample)
    radius = wp.sqrt(-2.0 * wp.log(1.0 - u[0]))
    height = wp.sqrt(-2.0 * wp.log(1.0 - v[0])) * wp.cos(TWO_PI * v[1])
    point = wp.vec3(radius * wp.cos(TWO_PI * u[1]), radius * wp.sin(TWO_PI * u[1]), height)
    return point * wp.min(1.0, reach / wp.max(wp.length(point), 1.0e-12))


@wp.func
def store_hit(
    i: int,
    sh_degree: int,
    instance: SplatInstanceData,
    gaussians: GaussianData,
    k: int,
    direction: wp.vec3,
    hits: GaussianHits,
):
    """Stores the hit of a ray on Gaussian ``k`` of an instance, at the ray's origin, as if there were no others.

    Args:
        i: Index of the ray.
        sh_degree: Largest SH degree to evaluate.
        instance: The instance.
        gaussians: Gaussians of the instance's set.
        k: Index of the Gaussian in the set.
        direction: Unit direction of the ray, object space.
        hits: Receives the hit.
    """
    eye = gaussians.means[k] - direction
    color = wp.vec3(0.0)
    if instance.shows_albedo != 0:
        color = gaussians.albedo[k]
    else:
        color = gaussian_color(gaussians, k, eye, wp.min(sh_degree, instance.sh_degree))
    normal = gaussian_facing(gaussians, k, eye)
    if instance.stored_normals != 0:
        normal = towards(gaussians.normals[k], -direction, 0.0)
    hits.color[i] = tinted(instance, color)
    hits.normal[i] = instance.world_from_object * normal
    hits.transmittance[i] = 0.0
    hits.depth[i] = 0.0
    hits.gaussian[i] = instance.first + k
    hits.hits[i] = 1


@wp.func
def start_ray(
    i: int,
    number: int,
    origin: wp.vec3,
    direction: wp.vec3,
    t_min: float,
    sample: SampleData,
    rays: RayData,
):
    """Starts a ray with a footprint of 0 and no maximum length; ``number`` seeds its random numbers."""
    rays.is_active[i] = True
    rays.origin[i] = origin
    rays.direction[i] = direction
    rays.t_min[i] = t_min
    rays.normal[i] = wp.vec3(0.0)  # no layer is skipped, as for camera rays
    rays.t_max[i] = wp.inf
    rays.path_length[i] = 0.0
    rays.spread[i] = 0.0
    rays.sample_key[i] = sample_key_of(number, sample.index, sample.seed)
    rays.pixel_key[i] = pixel_key_of(number, sample.seed)
    rays.sample[i] = sample.index


@wp.kernel
def hit_gaussians(
    start: int,
    first: int,
    count: int,
    sh_degree: int,
    spread: float,
    scene: wp.array[ShadingScene],
    assets: wp.array[GaussianData],
    views: GaussianViews,
    rays_out: RayData,
    meshes_out: MeshHits,
    hits_out: GaussianHits,
    outward_out: RayData,
):
    """Writes the ray of each view with the hit on its Gaussian, and a second ray from the Gaussian to the camera.

    Args:
        start: View of the first thread.
        first: Number of the first view among all views of the set.
        count: Number of views; views from ``count`` on become inactive rays.
        sh_degree: Largest SH degree to evaluate.
        spread: Standard deviation of the viewed points, relative to that of the Gaussian.
        scene: The scene.
        assets: Distinct Gaussian sets of the scene.
        views: The views.
        rays_out: Rays of length 0 at the viewed points.
        meshes_out: Mesh hits of ``rays_out``; no ray hits a mesh.
        hits_out: Hits on the Gaussians.
        outward_out: Rays from the viewed points to the camera, starting beyond Gaussians of the same layer.
    """
    i = start + wp.tid()
    rays_out.is_active[i] = False
    outward_out.is_active[i] = False
    meshes_out.t[i] = wp.inf
    meshes_out.face[i] = -1
    meshes_out.instance[i] = -1
    meshes_out.weights[i] = wp.vec2(0.0)
    if i >= count:
        return
    sample = scene[0].sample[0]
    settings = scene[0].settings[0]
    instance = scene[0].splats[instance_of(scene[0].splats, views.gaussian[i])]
    gaussians = assets[instance.asset]
    k = views.gaussian[i] - instance.first
    scales = gaussians.scales[k]
    along = wp.normalize(instance.object_from_world * views.direction[i])

    # The peak of the response on the ray through a random point, computed in canonical space.
    reach = wp.sqrt(wp.max(reach_squared(instance.kernel, gaussians.opacities[k]), 0.0))
    point = spread * normal_point(pixel_key_of(first + i, sample.seed), sample.index, reach)
    slope = canonical_from_object(gaussians.rotations[k], scales) * along
    peak = point - (wp.dot(point, slope) / wp.dot(slope, slope)) * slope
    position = gaussians.means[k] + wp.quat_rotate(gaussians.rotations[k], wp.cw_mul(scales, peak))
    origin = instance.scale * (instance.world_from_object * (position - instance.object_from_world_offset))

    store_hit(i, sh_degree, instance, gaussians, k, along, hits_out)
    start_ray(i, first + i, origin, views.direction[i], 0.0, sample, rays_out)
    offset = settings.shadow_offset * instance.scale * wp.max(scales) + settings.shadow_offset_absolute
    start_ray(i, first + i, origin, -views.direction[i], offset, sample, outward_out)


@wp.func
def is_finite(color: wp.vec3) -> bool:
    """Returns whether all channels are finite."""
    return wp.isfinite(color[0] + color[1] + color[2])


@wp.kernel
def add_views(
    start: int,
    sample: int,
    far: float,
    wave: wp.array[WaveData],
    ends: MeshHits,
    hidden: GaussianHits,
    sums_inout: ViewSums,
):
    """Adds one shaded sample of each view to the view's sums. One thread per view.

    Args:
        start: View of the first thread.
        sample: Number of the sample; sample 0 first clears the sums.
        far: Largest distance of a camera from a Gaussian, scene units.
        wave: The shaded rays, one for each view.
        ends: Mesh hits of the rays from the Gaussians to the camera.
        hidden: Gaussian hits of the rays from the Gaussians to the camera.
        sums_inout: Sums of the views.
    """
    i = start + wp.tid()
    if sample == 0:
        sums_inout.even[i] = wp.vec3(0.0)
        sums_inout.odd[i] = wp.vec3(0.0)
        sums_inout.count[i] = 0
        sums_inout.captured[i] = wp.vec3(0.0)
        sums_inout.captured_weight[i] = 0.0
        sums_inout.factor[i] = wp.vec3(0.0)
        sums_inout.unshadowed[i] = wp.vec3(0.0)
        sums_inout.shadowed[i] = wp.vec3(0.0)
        sums_inout.emitted_unshadowed[i] = wp.vec3(0.0)
        sums_inout.emitted_shadowed[i] = wp.vec3(0.0)
        sums_inout.ambient[i] = wp.vec3(0.0)
        sums_inout.open[i] = wp.vec3(0.0)
        sums_inout.distance[i] = 0.0
    if not wave[0].rays.is_active[i]:
        return
    sums_inout.distance[i] += wp.min(wp.min(ends.t[i], hidden.depth[i]), far)
    light = wave[0].radiance.light[i]
    unshadowed = wp.vec3(0.0)
    shadowed = wp.vec3(0.0)
    emitted_unshadowed = wp.vec3(0.0)
    emitted_shadowed = wp.vec3(0.0)
    if wave[0].radiance.unshadowed:
        unshadowed = wave[0].radiance.unshadowed[i]
        shadowed = wave[0].radiance.shadowed[i]
        emitted_unshadowed = wave[0].radiance.emitted_unshadowed[i]
        emitted_shadowed = wave[0].radiance.emitted_shadowed[i]
    if not (is_finite(light) and is_finite(unshadowed + emitted_unshadowed) and is_finite(shadowed + emitted_shadowed)):
        return
    sums_inout.count[i] += 1
    if sample % 2 == 0:
        sums_inout.even[i] += light
    else:
        sums_inout.odd[i] += light
    sums_inout.captured[i] = wave[0].radiance.captured[i]
    sums_inout.captured_weight[i] = wave[0].radiance.captured_weight[i]
    sums_inout.unshadowed[i] += unshadowed
    sums_inout.shadowed[i] += shadowed
    sums_inout.emitted_unshadowed[i] += emitted_unshadowed
    sums_inout.emitted_shadowed[i] += emitted_shadowed
    if wave[0].radiance.ambient:
        sums_inout.ambient[i] += wave[0].radiance.ambient[i]
        sums_inout.open[i] += wave[0].radiance.open[i]
    if wave[0].radiance.capture_factor:
        sums_inout.factor[i] += wave[0].radiance.capture_factor[i]
