"""Captured colours in shadow: what several lights, each behind a deep shadow map, leave of them.

The equations are in docs/method/relighting.md#captured-shadow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lumisplat.config import check_range
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray, float_array
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.ops.irradiance import facing_irradiance
from lumisplat.scene.ops.recolor import scale_light
from lumisplat.scene.scene import SplatInstance, checked_lights

_Receivers = TypeVar("_Receivers", Gaussians, SplatInstance)


def shadowed(
    receivers: _Receivers, lights: Sequence[Light], transmittances: npt.ArrayLike, direct: float = 1.0
) -> _Receivers:
    """Gaussians in the shadow of something that stands before their lights.

    A channel's light becomes ``1 - direct (1 - sum_l w_l T_l)`` of what it was, with ``w_l`` the share of light l in
    the irradiance that all of them give there. With one light and ``direct`` 1 this is its T, as in Mir et al.
    (2026, section 3.3). Where nothing is in the way of any light, colours keep their bits. Source:
    docs/method/relighting.md#captured-shadow.

    Args:
        receivers: Gaussians in world space, or an instance.
        lights: Those that the receivers' captured colours come from; no environment.
        transmittances: Of each light at each Gaussian, 0..1, shape (L, N): `DeepShadowMap.transmittance_of`.
        direct: Share of the receivers' light that comes from these lights, 0..1.

    Returns:
        The same kind of thing, with other ``sh``; itself, where nothing is in the way.

    Raises:
        ConfigError: ``direct`` is outside 0..1.
        SceneError: The receivers are none, there is no light, or something that is none, or transmittances do not fit
            or leave 0..1.
    """
    check_range("direct", direct, 0.0, 1.0)
    if not isinstance(receivers, Gaussians | SplatInstance):
        raise SceneError(f"shadowed takes Gaussians or a SplatInstance, got a {type(receivers).__name__}")
    instance = receivers if isinstance(receivers, SplatInstance) else SplatInstance(receivers)
    lights = checked_lights(lights)
    checked = float_array("transmittances", transmittances)
    shape = (len(lights), instance.gaussians.count)
    if not lights or checked.shape != shape:
        raise SceneError(f"transmittances has shape {checked.shape}, expected {shape}, and at least one light")
    outside = np.count_nonzero((checked < 0.0) | (checked > 1.0))
    if outside:
        raise SceneError(f"transmittances: {outside:,} of {checked.size:,} are outside 0..1")
    factors = light_factors(light_shares(lights, instance), checked, direct)
    return recolored(receivers, factors)


def recolored(receivers: _Receivers, factors: npt.NDArray[np.floating]) -> _Receivers:
    """Receivers under ``factors`` of their light, shape (N, 3); the same object where all are 1."""
    gaussians = receivers.gaussians if isinstance(receivers, SplatInstance) else receivers
    scaled = scale_light(gaussians, factors)
    if scaled is gaussians:
        return receivers
    if isinstance(receivers, Gaussians):
        return scaled
    return replace(receivers, gaussians=scaled)


def light_shares(lights: Sequence[Light], receivers: SplatInstance) -> FloatArray:
    """Share of each light in the irradiance that all give a Gaussian that faces them, a channel: shape (L, N, 3).

    Captures have no normals to speak of, so the cosine is left out. Where no light arrives, all shares are 0.

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
    """What is left of the light of each Gaussian, a channel: shape (N, 3), exactly 1 where nothing is in the way.

    Args:
        shares: Of each light, shape (L, N, 3).
        transmittances: 0..1, shape (L, N).
        direct: 0..1.
    """
    blocked = np.einsum("lnc,ln->nc", shares, 1.0 - transmittances)
    # Shares may sum to a rounding more than 1.
    return np.clip(1.0 - direct * blocked, 0.0, 1.0).astype(np.float32)
