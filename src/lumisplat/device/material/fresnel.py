"""Smooth surfaces: reflected and refracted directions, and Fresnel reflectances.

Directions are unit vectors, normals unit vectors on the side that the light comes from: ``cosine`` is
``-dot(direction, normal)``. ``eta`` is the index of refraction of that side over that of the other.

The equations are in docs/method/materials.md#smooth-surfaces.
"""

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(8)
NODES = wp.constant(wp.types.vector(length=8, dtype=wp.float32)(*(0.5 * (_POINTS + 1.0)).tolist()))
"""Of the quadrature over the root of the cosine: reflectances rise steeply at grazing angles."""
WEIGHTS = wp.constant(wp.types.vector(length=8, dtype=wp.float32)(*(0.5 * _WEIGHTS).tolist()))


@wp.func
def reflect(direction: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """The reflected direction."""
    return wp.normalize(direction - 2.0 * wp.dot(direction, normal) * normal)


@wp.func
def cosine2_beyond(cosine: float, eta: float) -> float:
    """Squared cosine of the angle of refraction; not above zero: total internal reflection.

    ``1 - eta^2 (1 - cosine^2)``, without cancellation where the indices are nearly equal.
    """
    return (1.0 - eta) * (1.0 + eta) + eta * eta * cosine * cosine


@wp.func
def refract(direction: wp.vec3, normal: wp.vec3, eta: float) -> wp.vec3:
    """The refracted direction, if there is no total internal reflection."""
    cosine = -wp.dot(direction, normal)
    beyond = wp.sqrt(wp.max(cosine2_beyond(cosine, eta), 0.0))
    return wp.normalize(eta * direction + (eta * cosine - beyond) * normal)


@wp.func
def fresnel(cosine: float, eta: float) -> float:
    """Reflectance of a dielectric for unpolarised light; 1 under total internal reflection."""
    beyond2 = cosine2_beyond(cosine, eta)
    if beyond2 <= 0.0:
        return 1.0
    beyond = wp.sqrt(beyond2)
    across = (eta * cosine - beyond) / (eta * cosine + beyond)
    along = (cosine - eta * beyond) / (cosine + eta * beyond)
    return 0.5 * (across * across + along * along)


@wp.func
def dielectric_share(strength: float, cosine: float, eta: float) -> float:
    """Share of the light that a dielectric mirrors; the strength of its reflection does not weaken a total one."""
    if cosine2_beyond(cosine, eta) <= 0.0:
        return 1.0
    return strength * fresnel(cosine, eta)


@wp.func
def mean_fresnel(eta: float) -> float:
    """``fresnel`` of even light from all around, on the side of the lower index; off by at most 7e-6."""
    ratio = wp.min(eta, 1.0 / eta)
    total = float(0.0)
    for k in range(8):
        root = NODES[k]
        total += 4.0 * WEIGHTS[k] * root * root * root * fresnel(root * root, ratio)
    return total


@wp.func
def mean_dielectric_share(strength: float, fresnel_mean: float, eta: float) -> float:
    """``dielectric_share`` of even light from all around.

    Args:
        strength: Of the reflection.
        fresnel_mean: The mean from the side of the lower index, of a strength of 1.
        eta: Above 1 on the side of the higher index, from where the share 1 / eta^2 of the light gets to the other.
    """
    mean = strength * fresnel_mean
    if eta > 1.0:
        return 1.0 - (1.0 - mean) / (eta * eta)
    return mean


@wp.func
def schlick(head_on: wp.vec3, cosine: float) -> wp.vec3:
    """Reflectance of a metal from that at normal incidence (Schlick 1994), linear."""
    grazing = wp.pow(wp.clamp(1.0 - cosine, 0.0, 1.0), 5.0)
    return head_on + grazing * (wp.vec3(1.0) - head_on)
