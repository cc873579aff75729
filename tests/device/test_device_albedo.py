"""Tests that the albedos that demodulate light before denoising equal the integrals of the BSDFs."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.device.structs.shading import Bsdf
from lumisplat.runtime.launcher import Launcher
from support.probes import probe_light_kernels
from support.probes.bsdf_rows import bsdf_row, direction, samples_of

COLOR = (0.8, 0.5, 0.2)
MATERIALS = {
    "paint": ls.MaterialPbr(base_color=COLOR, roughness=0.6),
    "metal": ls.MaterialPbr(base_color=COLOR, roughness=0.5, metallic=1.0),
    "rough metal": ls.MaterialPbr(base_color=COLOR, roughness=0.8, metallic=1.0),
    "coat": ls.MaterialPbr(base_color=COLOR, roughness=0.6, clearcoat=1.0, clearcoat_roughness=0.3),
    "coat on metal": ls.MaterialPbr(base_color=COLOR, roughness=0.6, metallic=1.0, clearcoat=0.8),
    "sheen": ls.MaterialPbr(base_color=COLOR, roughness=0.8, sheen_color=(0.9, 0.5, 0.2), sheen_roughness=0.4),
    "rough glass": ls.MaterialPbr(base_color=COLOR, roughness=0.5, transmission=1.0),
    "frosted in part": ls.MaterialPbr(base_color=COLOR, roughness=0.7, transmission=0.5),
}


def albedos(row: npt.NDArray[np.void], cosine: float) -> npt.NDArray[np.float64]:
    """Returns the device's albedos at a cosine of view and normal: rows diffuse, glossy, transmitted; columns RGB."""
    found = wp.zeros((1, 3), dtype=wp.vec3, device="cpu")
    inputs = wp.array(row, dtype=Bsdf, device="cpu"), wp.array([cosine], dtype=float, device="cpu")
    Launcher("cpu", threads=1).run(probe_light_kernels.probe_albedos, 1, *inputs, found)
    return found.numpy()[0].astype(np.float64)


def furnace_integral(row: npt.NDArray[np.void], cosine: float) -> npt.NDArray[np.float64]:
    """Returns the radiance under a constant environment of radiance 1, estimated by BSDF samples.

    The rows are light from above and from below the surface, shape (2, 3).
    """
    found = samples_of(row, direction(cosine, 0.3), 40_000)
    is_above = found["direction"][:, 2:] > 0.0
    weights = found["weight"].astype(np.float64)
    return np.stack([np.where(is_above, weights, 0.0).mean(0), np.where(is_above, 0.0, weights).mean(0)])


@pytest.mark.parametrize("cosine", [0.95, 0.5, 0.2])
@pytest.mark.parametrize("name", MATERIALS)
def test_albedo_given_to_the_denoiser_equals_the_bsdf_integral_in_a_constant_environment(
    name: str, cosine: float
) -> None:
    """Diffuse plus glossy albedo equals the integral of reflected light, transmitted albedo that of transmitted light.

    The tolerance covers the curve fit of the energy that microfacets lose. The fit is worst for rough metals and at
    grazing angles.
    """
    for compensates in (False, True):
        row = bsdf_row(MATERIALS[name], compensates=compensates)
        above, below = furnace_integral(row, cosine)
        diffuse, glossy, transmitted = albedos(row, cosine)
        np.testing.assert_allclose(diffuse + glossy, above, rtol=0.13 if name == "rough metal" else 0.07, atol=0.01)
        np.testing.assert_allclose(transmitted, below, rtol=0.1 if cosine > 0.2 else 0.2, atol=0.01)


def test_multiple_scattering_raises_the_glossy_albedo_of_rough_metals() -> None:
    """Compensation adds the light that scatters several times between microfacets to the glossy albedo."""
    plain, whole = (bsdf_row(MATERIALS["rough metal"], compensates=compensates) for compensates in (False, True))
    assert albedos(whole, 0.5)[1][0] > 1.15 * albedos(plain, 0.5)[1][0]
