"""A sun on actors made of Gaussians, as far as no probe holds it (docs/method/relighting.md#sun)."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from lumisplat.config import Pipeline, RenderConfig
from lumisplat.constants import LUMINANCE, SH_C0, SUN_WAYS
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.progress import Progress
from lumisplat.relighting.probe import EnvironmentProbe
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.lights import LightDirectional
from lumisplat.scene.scene import Scene, SplatInstance

_log = logging.getLogger("lumisplat")

_BLOCKED = 1e-3
"""A sun of which less than this reaches an actor is told about."""


class SunOnActors:
    """The light of suns on actors.

    Args:
        scene: The scene, without actors: it may be in the way.
        suns: The suns.
        device: As for `create_renderer`.
        progress: Called with a label and a fraction 0..1, while kernels compile.
    """

    def __init__(self, scene: Scene, suns: Sequence[LightDirectional], device: str, progress: Progress | None) -> None:
        self._scene, self._suns = scene, tuple(suns)
        self._device, self._progress = device, progress
        self._renderer: Renderer | None = None
        """Follows the ways to the suns; made for the first actor."""
        self._has_warned = False

    def scales(self, actor: SplatInstance, probe: EnvironmentProbe, normals: FloatArray) -> FloatArray:
        """Light on an actor's Gaussians beyond that of the probe, in units of white surroundings, shape (N, 3).

        Args:
            actor: The actor.
            probe: Of its place.
            normals: Unit normals, world space, shape (N, 3).
        """
        total = np.zeros(normals.shape, np.float32)
        for sun in self._suns:
            visibility = self._visibility(actor, sun)
            self._warn_if_blocked(sun, visibility)
            arriving = sun_beyond(probe, sun) * visibility
            cosines = np.maximum(normals @ -np.array(sun.direction, np.float32), np.float32(0.0))
            total += cosines[:, None] * (arriving / np.pi).astype(np.float32)
        return total

    def _visibility(self, actor: SplatInstance, sun: LightDirectional) -> float:
        """Share of the ways from the actor to a sun that nothing of the scene blocks, 0..1."""
        if self._renderer is None:
            self._renderer = create_renderer(
                RenderConfig(pipeline=Pipeline.TRACE), self._device, progress=self._progress
            )
        means = actor.world_means
        # Evenly over the set: the same ones for an actor that only moves.
        starts = means[np.linspace(0, len(means) - 1, min(SUN_WAYS, len(means))).astype(np.int64)]
        ways = np.broadcast_to(-np.array(sun.direction), starts.shape)
        return float(self._renderer.transmittance(self._scene, starts, ways, sun.shadow_distance).mean())

    def _warn_if_blocked(self, sun: LightDirectional, visibility: float) -> None:
        """Warns, once, of a sun that the scene keeps from an actor: a captured sky would be in its way."""
        if visibility < _BLOCKED and not self._has_warned:
            self._has_warned = True
            name = f"light '{sun.name}'" if sun.name else "the sun"
            text = "%s does not reach an actor: the scene is in its way; if that is a captured sky, set shadow_distance"
            _log.warning(text, name)


def sun_beyond(probe: EnvironmentProbe, sun: LightDirectional) -> Doubles:
    """Irradiance of a surface that faces a sun, without what the probe holds of it, linear Rec.709, shape (3,).

    The probe holds of it, at most, what it gives that surface more than even light of its mean radiance would: a
    captured lamp, or a bright sky around the sun.
    """
    towards = -np.array([sun.direction])
    weights = np.array(LUMINANCE)
    facing = float(probe.irradiance(towards)[0] @ weights)
    even = np.pi * float(SH_C0 * probe.coefficients[0] @ weights)
    irradiance = sun.intensity * np.array(sun.color)
    arriving = float(irradiance @ weights)
    if arriving <= 0.0:
        return np.zeros(3)
    return irradiance * max(0.0, 1.0 - max(0.0, facing - even) / arriving)
