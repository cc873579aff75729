"""Tests that mirror reflection, refraction and diffuse reflection of smooth materials add up to the incident light."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.device.material.specular_bounce import bounce_of
from lumisplat.device.structs.scene import SmoothData
from lumisplat.device.structs.shading import Bsdf, MaterialData
from lumisplat.renderer.scene.materials import material_table
from lumisplat.runtime.launcher import Launcher
from support.probes import probe_light_kernels

UP = np.array([0.0, 0.0, 1.0])
DEGREES = (0.0, 30.0, 60.0, 75.0, 84.0, 88.0)
WHITE = (1.0, 1.0, 1.0)


def direction(cosine: np.ndarray | float) -> np.ndarray:
    """Returns unit vectors by their cosine with the normal, shape (..., 3)."""
    cosine = np.asarray(cosine)
    return np.stack([np.sqrt(1.0 - cosine**2), np.zeros_like(cosine), cosine], axis=-1)


def mirrored(material: ls.MaterialPbr, cosine: float, inside: bool = False) -> tuple[float, float]:
    """Returns the weights of the reflected and the refracted ray (middle channel)."""
    smooth = SmoothData()
    smooth.smooth = 1
    for name in ("metallic", "specular", "ior", "transmission"):
        setattr(smooth, name, getattr(material, name))
    side = wp.vec3(0.0, 0.0, -1.0 if inside else 1.0)
    eta = material.ior if inside and material.transmission > 0.0 else 1.0 / material.ior
    bounce = bounce_of(smooth, wp.vec3(1.0), side, side, wp.vec3(*-direction(cosine)), eta, True)
    return float(np.array(bounce.reflected)[1]), float(np.array(bounce.refracted)[1])


def scattered(material: ls.MaterialPbr, cosine: float, inside: bool = False) -> float:
    """Returns the fraction of a constant environment's light that the diffuse part reflects (middle channel).

    Integrates by Gauss-Legendre quadrature with nodes concentrated at grazing angles or, inside, at the critical angle.
    """
    mesh = ls.Mesh(np.eye(3), [[0, 1, 2]], material=material)
    table = material_table(ls.Scene(meshes=[mesh]), lambda _: 0, is_lit=True)
    launcher = Launcher("cpu", threads=1)
    bsdf = wp.zeros(1, dtype=Bsdf, device="cpu")
    materials = wp.array(table, dtype=MaterialData, device="cpu")
    launcher.run(probe_light_kernels.probe_material, 1, materials, wp.vec3(1.0), inside, bsdf)
    nodes, weights = np.polynomial.legendre.leggauss(64)
    root = 0.5 * (nodes + 1.0)  # root of the cosine, or of the refracted cosine inside, so that no node is lost
    critical2 = 1.0 - 1.0 / material.ior**2 if inside else 0.0
    lights = direction(np.sqrt(critical2 + (1.0 - critical2) * root**4))
    count = len(lights)
    bsdfs = wp.array(np.repeat(bsdf.numpy(), count), dtype=Bsdf, device="cpu")
    vectors = [np.broadcast_to(v, (count, 3)).astype(np.float32) for v in (UP, direction(cosine), lights)]
    inputs = [wp.array(v, dtype=wp.vec3, device="cpu") for v in vectors]
    values, densities = wp.zeros(count, dtype=wp.vec3, device="cpu"), wp.zeros(count, dtype=float, device="cpu")
    launcher.run(probe_light_kernels.probe_bsdf, count, bsdfs, *inputs, values, densities)
    # The azimuth gives 2 pi; cosine d(cosine) = (1 - critical^2) 2 root^3 d(root).
    return float((values.numpy()[:, 1] * 2.0 * np.pi * (1.0 - critical2) * root**3 * weights).sum())


@pytest.mark.parametrize("degrees", DEGREES)
@pytest.mark.parametrize("ior", [1.0, 1.05, 1.2, 1.5, 2.0, 3.0, 20.0])
def test_smooth_white_material_reflects_all_light(ior: float, degrees: float) -> None:
    """All light is reflected at all angles and indices, for partial metals and for reduced specular reflection."""
    cosine = float(np.cos(np.radians(degrees)))
    for metallic, specular in ((0.0, 1.0), (0.5, 1.0), (0.0, 0.4), (0.3, 0.7)):
        material = ls.MaterialPbr(base_color=WHITE, roughness=0.0, metallic=metallic, specular=specular, ior=ior)
        total = mirrored(material, cosine)[0] + scattered(material, cosine)
        assert total == pytest.approx(1.0, abs=2e-5), (metallic, specular)


@pytest.mark.parametrize("degrees", DEGREES)
@pytest.mark.parametrize("inside", [False, True])
def test_partly_transmitting_smooth_white_material_conserves_energy(inside: bool, degrees: float) -> None:
    """Refraction and diffuse reflection share the light that is not mirrored, also under total internal reflection."""
    cosine = float(np.cos(np.radians(degrees)))
    for specular in (1.0, 0.5):
        material = ls.MaterialPbr(base_color=WHITE, roughness=0.0, transmission=0.6, ior=1.7, specular=specular)
        total = sum(mirrored(material, cosine, inside)) + scattered(material, cosine, inside)
        assert total == pytest.approx(1.0, abs=2e-5)
