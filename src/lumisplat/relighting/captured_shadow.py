"""Captured colours in shadow: the share of their light that remains behind a deep shadow map for each light.

The equations are in docs/method/relighting.md#captured-shadow.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lumisplat.config import check_range
from lumisplat.errors import SceneError, check_instance
from lumisplat.math.arrays import FloatArray, float_array
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightEnvironment, facing_irradiance
from lumisplat.scene.ops.colors import Subject, scale_light_of
from lumisplat.scene.scene import SplatInstance, checked_lights


def shadowed(
    receivers: Subject, lights: Sequence[Light], transmittances: npt.ArrayLike, direct: float = 1.0
) -> Subject:
    """Captured Gaussians in the shadow of casters that were not captured.

    A channel's light becomes ``1 - direct (1 - sum_l w_l T_l)`` of what it was, with ``w_l`` the share of light l in
    the irradiance that all of them give there. With one light and ``direct`` 1 this is its T, as in Mir et al.
    (2026, section 3.3). Colours that no light is blocked from keep their bits. Source:
    docs/method/relighting.md#captured-shadow.

    Args:
        receivers: Gaussians in world space, or an instance.
        lights: Those that the receivers' captured colours come from; no environment.
        transmittances: Of each light at each Gaussian, 0..1, shape (L, N): `DeepShadowMap.transmittance_of`.
        direct: Share of the receivers' light that comes from these lights, 0..1.

    Returns:
        Receivers of the same type, with other ``sh``; the same object if no light is blocked anywhere.

    Raises:
        ConfigError: ``direct`` is outside 0..1.
        SceneError: The receivers or the lights are of another type, there is no light, or transmittances do not fit or
            leave 0..1.
    """
    check_range("direct", direct, 0.0, 1.0)
    check_instance(receivers, Gaussians | SplatInstance, "shadowed takes Gaussians or a SplatInstance")
    instance = receivers if isinstance(receivers, SplatInstance) else SplatInstance(receivers)
    lights = checked_lights(lights)
    checked = float_array("transmittances", transmittances)
    shape = (len(lights), instance.gaussians.count)
    if not lights or checked.shape != shape:
        raise SceneError(f"transmittances has shape {checked.shape}, expected {shape}, and at least one light")
    outside = np.count_nonzero((checked < 0.0) | (checked > 1.0))
    if outside:
        raise SceneError(f"transmittances: {outside:,} of {checked.size:,} are outside 0..1")
    return scale_light_of(receivers, light_factors(light_shares(lights, instance), checked, direct))


def light_shares(lights: Sequence[Light], receivers: SplatInstance) -> FloatArray:
    """Share of each light in the irradiance that all give a Gaussian that faces them, per channel, shape (L, N, 3).

    There is no cosine, because captures have no normals to rely on. Shares are 0 if no light arrives.

    Raises:
        SceneError: There is an environment among the lights: it has no place, so no shadow map.
    """
    for light in lights:
        if isinstance(light, LightEnvironment):
            raise SceneError("an environment shines from everywhere: it has no deep shadow map")
    arriving = np.array([facing_irradiance(light, receivers.world_means) for light in lights])
    total = arriving.sum(axis=0)
    return np.divide(arriving, total, out=np.zeros_like(arriving), where=total > 0.0).astype(np.float32)


def light_factors(shares: FloatArray, transmittances: npt.NDArray[np.floating], direct: float) -> FloatArray:
    """Share of the light that each Gaussian keeps, per channel, shape (N, 3); exactly 1 if no light is blocked.

    Args:
        shares: Of each light, shape (L, N, 3).
        transmittances: 0..1, shape (L, N).
        direct: 0..1.
    """
    blocked = np.einsum("lnc,ln->nc", shares, 1.0 - transmittances)
    # Rounded shares may sum to slightly more than 1.
    return np.clip(1.0 - direct * blocked, 0.0, 1.0).astype(np.float32)
