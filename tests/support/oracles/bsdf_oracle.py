"""Evaluates BSDFs in float64 with textbook equations in angles and tangents, one direction per row.

Colours have shape (..., 3), directions (..., 3), unit and away from the surface. Materials are dictionaries with the
field names of `lumisplat.device.structs.shading.Bsdf`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Material = dict[str, Any]

WIDTH_MIN = 1e-6


def cosine(a: Array, b: Array) -> Array:
    """Returns the cosine of the angle between unit vectors."""
    return np.sum(a * b, axis=-1)


def angle(a: Array, b: Array) -> Array:
    """Returns the angle between vectors of any length, without the arc cosine's loss of precision near 0."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), cosine(a, b))


def schlick(normal_incidence: npt.ArrayLike, grazing: float, cos: Array) -> Array:
    """Returns Schlick's approximation of Fresnel reflectance for a cosine of incidence, per channel."""
    head_on = np.asarray(normal_incidence, dtype=np.float64)
    return head_on + (grazing - head_on) * ((1.0 - cos) ** 5)[..., None]


def ggx(theta: Array, alpha: float) -> Array:
    """Returns the microfacet distribution D of Walter et al. 2007, equation 33."""
    below = np.cos(theta) ** 4 * (alpha**2 + np.tan(theta) ** 2) ** 2
    return np.where(theta < 0.5 * np.pi, alpha**2 / (np.pi * below), 0.0)


def smith(theta: Array, alpha: float) -> Array:
    """Returns the masking function G1 of Walter et al. 2007, equation 34."""
    return 2.0 / (1.0 + np.sqrt(1.0 + alpha**2 * np.tan(theta) ** 2))


def _above(normal: Array, view: Array, light: Array) -> npt.NDArray[np.bool_]:
    return (cosine(normal, view) > 0.0) & (cosine(normal, light) > 0.0)


def fresnel(cos: Array, eta: float) -> Array:
    """Returns unpolarised Fresnel reflectance for a ratio of indices ``eta`` up to 1."""
    beyond = np.sqrt(1.0 - eta**2 * (1.0 - cos**2))
    across, along = (eta * cos - beyond) / (eta * cos + beyond), (cos - eta * beyond) / (cos + eta * beyond)
    return 0.5 * (across**2 + along**2)


def directional_albedo(alpha: float, head_on: npt.ArrayLike, grazing: float, cos: Array | None) -> Array:
    """Returns the fitted directional albedo of a specular lobe at ``cos``; None returns the cosine-weighted mean.

    For a reflectance of ``F0 + (F90 - F0) (1 - cos)^5``, the albedo is ``F0 (1 - lost - rising) + F90 rising``.
    ``lost`` is the fraction lost to masking and shadowing, and ``rising`` is the weight of reflectance at grazing
    angles.
    """
    if cos is None:
        rising = np.asarray(1.0 / 21.0 / (1.0 + 2.4 * alpha + 17.0 * alpha**2))
        lost = np.asarray(alpha**2 / (0.26 + 1.05 * alpha + 0.3 * alpha**2))
    else:
        rough = cos + 2.48 * alpha + 38.2 * alpha**2 + 24.7 * alpha**3
        rising = (1.0 - cos) ** 5 * cos / rough + (1.0 - cos) ** 3 * 2.3 * alpha / rough
        lost = alpha**2 * (0.53 + 0.79 * cos) / (cos**2 + 1.15 * alpha - 0.91 * alpha * cos + 0.74 * alpha**2)
    head_on = np.asarray(head_on, dtype=np.float64)
    return head_on * (1.0 - lost - rising)[..., None] + grazing * rising[..., None]


def mirrored_share(material: Material, cos: Array | None) -> Array:
    """Returns the dielectric's specular albedo for light at cosine ``cos``, shape (..., 1); None for uniform light."""
    strength, eta = material["dielectric"], material["eta"]
    if material["alpha"] > 0.0:
        head_on = [strength * ((1.0 - eta) / (1.0 + eta)) ** 2]
        return directional_albedo(material["alpha"], head_on, strength, cos)
    if cos is not None:
        return strength * fresnel(cos, eta)[..., None]
    steps = (np.arange(20_000) + 0.5) / 20_000
    return np.asarray([strength * np.mean(2.0 * steps * fresnel(steps, eta))])


def pbr_diffuse(material: Material, normal: Array, view: Array, light: Array) -> Array:
    """Returns the diffuse lobe of Kelemen and Szirmay-Kalos 2001, which gets the energy the specular lobe leaves."""
    if material["dielectric"] == 0.0:
        return np.broadcast_to(np.asarray(material["diffuse"]) / np.pi, np.broadcast_shapes(view.shape, light.shape))
    let_in = 1.0 - mirrored_share(material, cosine(normal, light))
    let_out = 1.0 - mirrored_share(material, cosine(normal, view))
    mean = 1.0 - mirrored_share(material, None)
    return np.asarray(material["diffuse"]) / np.pi * let_in * let_out / mean


def pbr_specular(material: Material, normal: Array, view: Array, light: Array) -> Array:
    """Returns Cook and Torrance's ``D G F / (4 cos cos)``."""
    if material["alpha"] <= 0.0:
        return np.zeros(np.broadcast_shapes(view.shape, light.shape))
    alpha = max(material["alpha"], WIDTH_MIN)
    half = view + light
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    masks = smith(angle(normal, view), alpha) * smith(angle(normal, light), alpha)
    cosines = 4.0 * cosine(normal, view) * cosine(normal, light)
    facets = ggx(angle(normal, half), alpha) * masks / cosines
    return facets[..., None] * schlick(material["specular"], material["grazing"], cosine(view, half))


def mirrored(normal: Array, view: Array) -> Array:
    """Returns the view direction mirrored at the normal."""
    return 2.0 * cosine(normal, view)[..., None] * normal - view


def simple(material: Material, normal: Array, view: Array, light: Array) -> Array:
    """Returns the sum of Lambert's and Phong's lobes, normalised to reflect at most all light."""
    diffuse, specular = (np.asarray(material[name], dtype=np.float64) for name in ("diffuse", "specular"))
    exponent = material["shininess"]
    cos = cosine(mirrored(normal, view), light)
    phong = np.where(cos > 0.0, np.maximum(cos, 0.0) ** exponent, 0.0) * (exponent + 2.0) / (2.0 * np.pi)
    return (diffuse / np.pi + phong[..., None] * specular) / np.maximum(1.0, diffuse + specular)


def evaluate(material: Material, normal: Array, view: Array, light: Array) -> Array:
    """Returns the BSDF without the cosine."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if material["model"] == "simple":
            value = simple(material, normal, view, light)
        else:
            value = pbr_diffuse(material, normal, view, light) + pbr_specular(material, normal, view, light)
    return np.where(_above(normal, view, light)[..., None], value, 0.0)


def pdf(material: Material, normal: Array, view: Array, light: Array) -> Array:
    """Returns the pdf of sampled directions per steradian: visible microfacets or Phong's lobe, mixed with cosines."""
    lambert = cosine(normal, light) / np.pi
    specular = np.asarray(material["specular"], dtype=np.float64)
    diffuse = np.asarray(material["diffuse"], dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if material["model"] == "simple":
            exponent = material["shininess"]
            cos = cosine(mirrored(normal, view), light)
            lobe = np.where(cos > 0.0, (exponent + 1.0) / (2.0 * np.pi) * np.maximum(cos, 0.0) ** exponent, 0.0)
            parts = specular.mean(), diffuse.mean()
        else:
            alpha = max(material["alpha"], WIDTH_MIN)
            half = view + light
            half = half / np.linalg.norm(half, axis=-1, keepdims=True)
            to_half = cosine(view, half)
            seen = smith(angle(normal, view), alpha) * ggx(angle(normal, half), alpha) * to_half
            lobe = seen / cosine(normal, view) / (4.0 * to_half)
            cos = cosine(normal, view)
            mirror = directional_albedo(material["alpha"], specular, material["grazing"], cos)
            parts = mirror.mean(axis=-1), (diffuse * (1.0 - mirrored_share(material, cos))).mean(axis=-1)
            if material["alpha"] <= 0.0 or material["grazing"] <= 0.0:
                parts = 0.0, 1.0
    total = np.asarray(parts[0] + parts[1])
    share = np.where(total > 0.0, parts[0] / np.where(total > 0.0, total, 1.0), float(material["model"] == "pbr"))
    lobe = np.where(share > 0.0, lobe, 0.0)
    return np.where(_above(normal, view, light), share * lobe + (1.0 - share) * lambert, 0.0)
