"""Shadows of actors on captured sets: a deep shadow map for each light, rebuilt every frame."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.config import AvatarLightingConfig
from lumisplat.constants import SHADOW_FOOTPRINT
from lumisplat.math.arrays import FloatArray
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.progress import Progress
from lumisplat.relighting.actors import PlacedActor
from lumisplat.relighting.captured_shadow import light_factors, light_shares
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightEnvironment, PlacedLight
from lumisplat.scene.local_frame import rendered_frame
from lumisplat.scene.ops.colors import scale_light_of
from lumisplat.scene.ops.world_space import PlacedGaussians, distance_from_body
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance
from lumisplat.shadow_maps.casters import Content, MeshesAsGaussians
from lumisplat.shadow_maps.deep_shadow_map import DeepShadowMap

_log = logging.getLogger("lumisplat")

_SUSPICIOUS_SHADOW = 0.9
"""Share of the receivers in shadow of a light above which something is likely to be wrong."""


def casting_lights(lights: Iterable[Light]) -> tuple[Light, ...]:
    """Enabled lights that cast shadows, without environments, which have no deep shadow map."""
    return tuple(
        light for light in lights if light.enabled and light.casts_shadow and not isinstance(light, LightEnvironment)
    )


class ActorShadows:
    """Darkens captured sets by the shadows of actors.

    Args:
        receivers: Captured sets, which do not move.
        lights: At least one, none of them an environment.
        meshes: Other casters, which do not move.
        config: Settings.
        device: As for `create_renderer`.
        progress: Called with a label and a fraction 0..1, while kernels compile.
    """

    def __init__(
        self,
        receivers: Sequence[SplatInstance],
        lights: Sequence[Light],
        meshes: Sequence[MeshInstance],
        *,
        config: AvatarLightingConfig,
        device: str = "auto",
        progress: Progress | None = None,
    ) -> None:
        self._receivers, self._lights = list(receivers), tuple(lights)
        self._direct, self._radius = config.direct, config.shadow_map.region_radius
        # A map's region stays around its first casters, but actors walk out of it: the radius is applied here instead.
        self._config = replace(config.shadow_map, region_radius=None)
        self._device, self._progress = device, progress
        self._meshes = MeshesAsGaussians()
        self._maps: list[DeepShadowMap] = []
        """One for each light, once there were actors."""
        self._shares = [light_shares(self._lights, receiver) for receiver in self._receivers]
        self._origin = rendered_frame(Scene(self._receivers))[0].origin
        """World position about which casters are."""
        self._means = [receiver.world_means for receiver in self._receivers]
        self._static = np.ones((len(self._lights), sum(map(len, self._means))), dtype=np.float32)
        """Transmittance of the meshes for each light at all receivers, shape (L, N)."""
        self._warned_lights: set[int] = set()
        self._warned_of_radius = False
        if meshes:
            for row, light in enumerate(self._lights):
                self._static[row] = self._build(meshes, light).transmittance_of(self._receivers)

    def darken(self, casters: Sequence[PlacedActor]) -> list[SplatInstance]:
        """The receivers in the shadow of casters; those without any shadow are the same objects as before.

        Args:
            casters: Actors of this frame; there may be none.
        """
        transmittances = self._static
        if casters:
            transmittances = transmittances * self._transmittances(self._meshes.placed("actors", casters, self._origin))
        ends = np.cumsum([len(means) for means in self._means])
        parts = np.split(transmittances, ends[:-1], axis=1)
        return [
            scale_light_of(receiver, light_factors(shares, part, self._direct))
            for receiver, shares, part in zip(self._receivers, self._shares, parts, strict=True)
        ]

    def _transmittances(self, casters: PlacedGaussians) -> FloatArray:
        """Transmittance of casters for each light at all receivers, shape (L, N)."""
        self._warn_of_lights_inside(casters)
        # One set in the world for all lights: meshes are turned into Gaussians once.
        sh = np.zeros((len(casters.means), 1, 3), dtype=np.float32)
        gaussians = Gaussians(*casters, sh=sh, origin=self._origin)
        if self._maps:
            for shadow in self._maps:
                shadow.rebuild(gaussians)
        else:
            self._maps = [self._build(gaussians, light) for light in self._lights]
        transmittances = np.array([shadow.transmittance_of(self._receivers) for shadow in self._maps])
        self._warn_of_darkness(transmittances)
        if self._radius is not None:
            transmittances[:, self._is_far(casters, self._radius)] = 1.0
        return transmittances

    def _is_far(self, casters: PlacedGaussians, radius: float) -> npt.NDArray[np.bool_]:
        """Which receivers are out of the reach of shadows, shape (N,); warns once if all are."""
        far = distance_from_body(np.concatenate(self._means) - self._origin, casters) > radius
        if far.all() and not self._warned_of_radius:
            self._warned_of_radius = True
            _log.warning("no receivers within %g of the actors: they cast no shadow", radius)
        return far

    def _build(self, casters: Content | Iterable[Content], light: Light) -> DeepShadowMap:
        return DeepShadowMap.build(
            casters, light, self._receivers, self._config, device=self._device, progress=self._progress
        )

    def _warn_of_darkness(self, transmittances: FloatArray) -> None:
        """Warns, once a light, if hardly any of it arrives: it is among the casters, or the captured room is cast."""
        for row in np.flatnonzero((transmittances < 0.5).mean(axis=1) > _SUSPICIOUS_SHADOW).tolist():
            if row not in self._warned_lights:
                self._warned_lights.add(row)
                _log.warning(
                    "light %r hardly reaches the capture: it is inside of what casts, or the capture itself is cast",
                    self._lights[row].name or row,
                )

    def _warn_of_lights_inside(self, casters: PlacedGaussians) -> None:
        """Warns, once a light, if an actor has walked into it: the actor then shadows nearly everything."""
        for row, light in enumerate(self._lights):
            if not isinstance(light, PlacedLight) or row in self._warned_lights:
                continue
            if _is_inside(np.array(light.position) - self._origin, casters):
                self._warned_lights.add(row)
                _log.warning(
                    "light %r is inside an actor, which then shadows all around it: move the light, or leave it out",
                    light.name or row,
                )


def _is_inside(point: npt.NDArray[np.float64], casters: PlacedGaussians) -> bool:
    """Whether a point is in the footprint of any Gaussian."""
    offset = (point - casters.means).astype(np.float32)
    near = np.einsum("ij,ij->i", offset, offset) < (SHADOW_FOOTPRINT * casters.scales.max(axis=1)) ** 2
    axes = matrices_from_quaternions(casters.rotations_wxyz[near])
    local = np.einsum("nij,ni->nj", axes, offset[near]) / casters.scales[near]
    return bool((np.einsum("ij,ij->i", local, local) < SHADOW_FOOTPRINT**2).any())
