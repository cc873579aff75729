"""Gradient of the radiance of lit Gaussians with respect to their materials.

The module has no other kernel: Warp differentiates nested functions (``wp.grad``) correctly only if no other kernel of
the module has called them; otherwise their derivatives are 0.
"""

import warp as wp

from lumisplat.device.material.microfacets import opaque_dot
from lumisplat.device.math.directions import flipped_to_front
from lumisplat.device.training import DirectionalLight, GaussianMaterials, MaterialGradient, incident_radiance

wp.set_module_options({"enable_backward": False})


@wp.kernel
def differentiate(
    start: int,
    eye: wp.vec3,
    materials: GaussianMaterials,
    light: DirectionalLight,
    by_radiance: wp.array[wp.vec3],
    gradient_out: MaterialGradient,
):
    """Computes the gradient with respect to albedo, roughness and normal. One thread per Gaussian.

    A view direction below the horizon of the Gaussian's plane is mirrored to above it. The derivative with respect to
    the normal treats the mirrored direction as constant.
    """
    i = start + wp.tid()
    by_albedo = wp.vec3(0.0)
    by_roughness = float(0.0)
    by_normal = wp.vec3(0.0)
    given = by_radiance[i]
    if wp.dot(given, given) > 0.0:
        normal = materials.normals[i]
        view = flipped_to_front(wp.normalize(eye - materials.means[i]), normal)
        for k in range(light.directions.shape[0]):
            direction = light.directions[k]
            if wp.dot(normal, direction) > 0.0:
                weighted = light.solid_angle * wp.cw_mul(given, incident_radiance(light, i, k))
                normal_part, albedo_part, roughness_part, _metallic, _view, _direction, _spread, _weights = wp.grad(
                    opaque_dot
                )(
                    normal,
                    materials.albedo[i],
                    materials.roughness[i],
                    materials.metallic,
                    view,
                    direction,
                    light.spread,
                    weighted,
                )
                by_normal += normal_part
                by_albedo += albedo_part
                by_roughness += roughness_part
    gradient_out.albedo[i] = by_albedo
    gradient_out.roughness[i] = by_roughness
    gradient_out.normals[i] = by_normal
