"""What Gaussians show of even light, by which it is shared among them (docs/method/relighting.md#baking)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumisplat.math.arrays import Doubles
from lumisplat.renderer.scene.materials import material_of, shading_overrides
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.ops.colors import base_colors
from lumisplat.scene.scene import Scene, SplatInstance


def reflected_colors(instance: SplatInstance) -> Doubles:
    """About what the Gaussians of a set show in even light of radiance 1, linear, shape (N, 3).

    By the colours that they are shaded with: those that were captured, of sets that shine by them, whatever their
    albedo. What the surface of a dielectric mirrors is white, so that black ones that are glossy are not black.
    """
    (by_albedo,) = shading_overrides(Scene([instance]), lit=True)["own_colors"]
    gaussians = instance.gaussians if by_albedo else replace(instance.gaussians, albedo=None)
    colors, material = base_colors(gaussians), material_of(instance)
    if not isinstance(material, MaterialPbr):
        return colors * np.add(np.add(material.emissive, material.ambient), material.diffuse) + material.specular
    metallic = np.full(gaussians.count, material.metallic) if gaussians.metallic is None else gaussians.metallic
    mirrored = ((1.0 - metallic) * material.specular * ((material.ior - 1.0) / (material.ior + 1.0)) ** 2)[:, None]
    return mirrored + (1.0 - mirrored) * colors
