"""Shadows of actors on captured sets: a deep shadow map a light, rebuilt every frame."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.config import AvatarLightingConfig
from lumisplat.constants import SHADOW_FOOTPRINT
from lumisplat.math.rotations import matrices_from_quaternions
from lumisplat.relighting.captured_shadow import light_factors, light_shares, recolored
from lumisplat.runtime.launcher import Progress
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightDirectional, LightEnvironment
from lumisplat.scene.ops.world_gaussians import PlacedGaussians, center_of
from lumisplat.scene.scene import MeshInstance, SplatInstance
from lumisplat.shadow_maps.casters import MeshesAsGaussians
from lumisplat.shadow_maps.deep_shadow_map import DeepShadowMap

_log = logging.getLogger("lumisplat")

_MOSTLY = 0.9
"""Share of the receivers in shadow from which on something is likely to be wrong."""


def casting_lights(lights: Iterable[Light]) -> tuple[Light, ...]:
    """Those that shine, cast shadows, and do so from somewhere: all but environments."""
    return tuple(
        light for light in lights if light.enabled and light.casts_shadow and not isinstance(light, LightEnvironment)
    )


class ActorShadows:
    """What actors leave of the lights of some receivers.

    Args:
        receivers: Captured sets, which do not move.
        lights: None of them an environment, at least one.
        meshes: What else does not move and casts shadows.
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
        # A map's region stays where its first casters were; actors walk out of it, so the radius is applied here.
        self._config = replace(config.shadow_map, region_radius=None)
        self._device, self._progress = device, progress
        self._turned = MeshesAsGaussians()
        self._maps: list[DeepShadowMap] = []
        self._shares = [light_shares(self._lights, receiver) for receiver in self._receivers]
        self._means = [receiver.world_means for receiver in self._receivers]
        count = sum(len(means) for means in self._means)
        self._static = np.ones((len(self._lights), count), dtype=np.float32)
        self._told_lights: set[int] = set()
        self._told_of_region = False
        if meshes:
            for row, light in enumerate(self._lights):
                self._static[row] = self._built(meshes, light).transmittance_of(self._receivers)

    def darkened(self, casters: Sequence[SplatInstance | MeshInstance]) -> list[SplatInstance]:
        """The receivers in the shadow of casters; those that no shadow falls on are the same objects as before.

        Args:
            casters: Of this frame; there may be none.
        """
        arriving = self._static
        if casters:
            arriving = arriving * self._behind(self._turned.placed("actors", casters))
        ends = np.cumsum([len(means) for means in self._means])
        return [
            recolored(receiver, light_factors(shares, part, self._direct))
            for receiver, shares, part in zip(
                self._receivers, self._shares, np.split(arriving, ends[:-1], axis=1), strict=True
            )
        ]

    def _behind(self, placed: PlacedGaussians) -> npt.NDArray[np.float32]:
        """Transmittance of casters for each light at all receivers, shape (L, N)."""
        self._warn_of_lights_inside(placed)
        # One set in the world for all lights: meshes are turned into Gaussians once.
        blockers = Gaussians(*placed, sh=np.zeros((len(placed.means), 1, 3), dtype=np.float32))
        if self._maps:
            for shadow in self._maps:
                shadow.rebuild(blockers)
        else:
            self._maps = [self._built(blockers, light) for light in self._lights]
        passing = np.array([shadow.transmittance_of(self._receivers) for shadow in self._maps])
        self._warn_of_darkness(passing)
        if self._radius is not None:
            far = np.abs(np.concatenate(self._means) - center_of(placed)).max(axis=1) > self._radius
            passing[:, far] = 1.0
            if far.all() and not self._told_of_region:
                self._told_of_region = True
                _log.warning("no receivers within %g of the actors: they cast no shadow", self._radius)
        return passing

    def _warn_of_darkness(self, passing: npt.NDArray[np.float32]) -> None:
        """Says so, once a light, where hardly anything is left of it: it is among the casters, or they are the room."""
        for row in np.flatnonzero((passing < 0.5).mean(axis=1) > _MOSTLY):
            if row not in self._told_lights:
                self._told_lights.add(int(row))
                _log.warning(
                    "light %r hardly reaches the capture: it is inside of what casts, or the capture itself is cast",
                    self._lights[row].name or int(row),
                )

    def _built(self, casters: object, light: Light) -> DeepShadowMap:
        return DeepShadowMap.build(
            casters,  # type: ignore[arg-type]
            light,
            self._receivers,
            self._config,
            device=self._device,
            progress=self._progress,
        )

    def _warn_of_lights_inside(self, placed: PlacedGaussians) -> None:
        """Says so, once a light, where an actor has walked into a light: it then shadows nearly everything."""
        for row, light in enumerate(self._lights):
            if isinstance(light, LightDirectional) or row in self._told_lights:
                continue
            offset = (np.array(light.position) - placed.means).astype(np.float32)  # type: ignore[union-attr]
            near = np.einsum("ij,ij->i", offset, offset) < (SHADOW_FOOTPRINT * placed.scales.max(axis=1)) ** 2
            axes = matrices_from_quaternions(placed.rotations_wxyz[near])
            local = np.einsum("nij,ni->nj", axes, offset[near]) / placed.scales[near]
            if (np.einsum("ij,ij->i", local, local) < SHADOW_FOOTPRINT**2).any():
                self._told_lights.add(row)
                _log.warning(
                    "light %r is inside an actor, which then shadows all around it: move the light, or leave it out",
                    light.name or row,
                )
