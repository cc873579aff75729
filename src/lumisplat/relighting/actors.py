"""Actors of a frame, Gaussians and meshes placed in the world, and the shadows that they cast on captured sets."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import numpy.typing as npt

from lumisplat.config import AvatarLightingConfig
from lumisplat.config.checks import check_range
from lumisplat.constants import SHADOW_FOOTPRINT
from lumisplat.errors import SceneError, check_instance
from lumisplat.math.arrays import FloatArray, float_array
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.progress import Progress
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightEnvironment, PlacedLight, facing_irradiance
from lumisplat.scene.local_frame import PlacedGaussians, distance_from_body, rendered_frame
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.colors import Subject, scale_light_of
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance, checked_lights
from lumisplat.shadow_maps.casters_and_receivers import Content, MeshesAsGaussians
from lumisplat.shadow_maps.deep_shadow_map import DeepShadowMap

PlacedActor = SplatInstance | MeshInstance
"""What moves through the scene, as it is at one time."""


def placed_actors(actors: Iterable[PlacedActor | Gaussians | Mesh]) -> list[PlacedActor]:
    """Actors as instances.

    Raises:
        SceneError: It is no list, or holds something else.
    """
    given: object = actors
    return [_placed(actor) for actor in _items("actors", given)]


def actor_flags(name: str, flags: Sequence[bool] | None, count: int) -> Sequence[bool]:
    """One flag for each actor; all True if none are given.

    Raises:
        SceneError: They are no list of booleans, or of another number.
    """
    if flags is None:
        return [True] * count
    _check_booleans(name, flags)
    if len(flags) != count:
        raise SceneError(f"{name} has {len(flags)} entries, expected {count}, one an actor")
    return flags


def centroid(actors: Sequence[PlacedActor]) -> npt.NDArray[np.float64]:
    """World-space mean of the Gaussians of all actors, weighted by opacity; meshes by their vertices, shape (3,)."""
    sums, total = np.zeros(3), 0.0
    for actor in actors:
        if isinstance(actor, SplatInstance):
            points, weights = actor.gaussians.means, actor.gaussians.opacities.astype(np.float64)
        else:
            points, weights = actor.mesh.positions, np.ones(actor.mesh.vertex_count)
        # Actors that are transparent throughout have a place nevertheless.
        weights = weights if weights.any() else np.ones_like(weights)
        world = points @ actor.transform[:3, :3].T + actor.transform[:3, 3]
        sums += weights @ world
        total += weights.sum()
    return sums / total


def _items(name: str, values: object) -> Iterable[object]:
    if not isinstance(values, Iterable):
        raise SceneError(f"{name} is one {type(values).__name__}, expected a list")
    return cast("Iterable[object]", values)


def _placed(actor: object) -> PlacedActor:
    if isinstance(actor, Gaussians):
        return SplatInstance(actor)
    if isinstance(actor, Mesh):
        return MeshInstance(actor)
    if isinstance(actor, SplatInstance | MeshInstance):
        return actor
    raise SceneError(f"actors holds a {type(actor).__name__}, expected Gaussians, a Mesh or an instance of one")


def _check_booleans(name: str, flags: object) -> None:
    if not isinstance(flags, Sequence) or not all(
        isinstance(flag, bool | np.bool_) for flag in cast("Sequence[object]", flags)
    ):
        raise SceneError(f"{name} is {flags!r:.60}, expected a list of True and False, one an actor")


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
    return scale_light_of(receivers, _light_factors(_light_shares(lights, instance), checked, direct))


def _light_shares(lights: Sequence[Light], receivers: SplatInstance) -> FloatArray:
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


def _light_factors(shares: FloatArray, transmittances: npt.NDArray[np.floating], direct: float) -> FloatArray:
    """Share of the light that each Gaussian keeps, per channel, shape (N, 3); exactly 1 if no light is blocked.

    Args:
        shares: Of each light, shape (L, N, 3).
        transmittances: 0..1, shape (L, N).
        direct: 0..1.
    """
    blocked = np.einsum("lnc,ln->nc", shares, 1.0 - transmittances)
    # Rounded shares may sum to slightly more than 1.
    return np.clip(1.0 - direct * blocked, 0.0, 1.0).astype(np.float32)


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
        self._shares = [_light_shares(self._lights, receiver) for receiver in self._receivers]
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
            scale_light_of(receiver, _light_factors(shares, part, self._direct))
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
