"""Places actors (Gaussians and meshes) in the world, and darkens captured Gaussians by the shadows that actors cast."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import numpy.typing as npt

from lumisplat.config import AvatarLightingConfig
from lumisplat.config.checks import check_range
from lumisplat.constants import SH_C0, SHADOW_FOOTPRINT
from lumisplat.errors import SceneError, check_instance
from lumisplat.math.arrays import Doubles, FloatArray, float_array
from lumisplat.math.color import decode_srgb
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.progress import Progress
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightDirectional, LightEnvironment, PlacedLight, facing_irradiance
from lumisplat.scene.local_frame import PlacedGaussians, distance_from_body, rendered_frame
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.colors import Subject, scale_light_of
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance, checked_lights
from lumisplat.shadow_maps.casters_and_receivers import Content, MeshesAsGaussians
from lumisplat.shadow_maps.deep_shadow_map import DeepShadowMap
from lumisplat.shadow_maps.light_extent import extent_of, extent_record

PlacedActor = SplatInstance | MeshInstance
"""An actor in one frame: a splat or mesh instance that carries the frame's pose."""


def placed_actors(actors: Iterable[PlacedActor | Gaussians | Mesh]) -> list[PlacedActor]:
    """Converts actors to instances; a bare `Gaussians` or `Mesh` becomes an instance at its stored ``origin``.

    Raises:
        SceneError: ``actors`` is no list, or holds something other than Gaussians, meshes and instances.
    """
    given: object = actors
    return [_placed(actor) for actor in _items("actors", given)]


def actor_flags(name: str, flags: Sequence[bool] | None, count: int) -> Sequence[bool]:
    """Returns one flag for each actor; all True if ``flags`` is None.

    Raises:
        SceneError: ``flags`` is no list of booleans, or has another length.
    """
    if flags is None:
        return [True] * count
    _check_booleans(name, flags)
    if len(flags) != count:
        raise SceneError(f"{name} has {len(flags)} entries, expected {count}, one per actor")
    return flags


def centroid(actors: Sequence[PlacedActor]) -> npt.NDArray[np.float64]:
    """Returns the world-space mean of all actors' Gaussians, weighted by opacity, and of mesh vertices, shape (3,)."""
    sums, total = np.zeros(3), 0.0
    for actor in actors:
        if isinstance(actor, SplatInstance):
            points, weights = actor.gaussians.means, actor.gaussians.opacities.astype(np.float64)
        else:
            points, weights = actor.mesh.positions, np.ones(actor.mesh.vertex_count)
        # Fully transparent actors have a position, too.
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
        raise SceneError(f"{name} is {flags!r:.60}, expected a list of True and False, one per actor")


def shadowed(
    receivers: Subject, lights: Sequence[Light], transmittances: npt.ArrayLike, direct: float = 1.0
) -> Subject:
    """Darkens captured Gaussians by the shadows of casters that were not part of the capture.

    Each channel is multiplied by ``1 - direct (1 - sum_l w_l T_l)``. Here ``w_l`` is light l's fraction of the
    unshadowed irradiance from all lights at the Gaussian, and ``T_l`` is the transmittance of light l. With one light
    and ``direct`` 1 the factor is the transmittance, as in Mir et al. (2026, section 3.3). Gaussians whose light is not
    blocked keep the bits of their colours. Source: docs/method/relighting.md#captured-shadow.

    Args:
        receivers: N Gaussians in world space, or an instance.
        lights: L lights from which the captured colours come; no environment.
        transmittances: Transmittance of each light at each Gaussian, 0..1, shape (L, N), as from
            `DeepShadowMap.transmittance_of`.
        direct: Fraction of the captured radiance that is due to ``lights``, 0..1.

    Returns:
        Receivers of the same type with other ``sh``; the same object if no light is blocked anywhere.

    Raises:
        ConfigError: ``direct`` is outside 0..1.
        SceneError: The receivers or the lights are of another type, there is no light, or transmittances have another
            shape or leave 0..1.
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


def shadow_strength(receivers: Gaussians, lights: Sequence[Light], transmittances: npt.ArrayLike) -> Gaussians:
    """Returns Gaussians in greys of their shadow strength: unlit frames of them are images for the shadow metrics.

    The strength is ``S = 1 - sum_l w_l T_l`` with the fractions and transmittances of `shadowed`: 0 (black) where all
    light arrives, 1 (white) where none does. A frame shows it blended over the Gaussians of each pixel. Source: Mir et
    al. 2026, section 4.2, which measures it by `lumisplat.metrics.sae`, ``sm_iou`` and ``boundary_f``.

    Args:
        receivers: N Gaussians in world space.
        lights: As for `shadowed`.
        transmittances: As for `shadowed`, shape (L, N).

    Returns:
        The Gaussians with SH of degree 0.

    Raises:
        SceneError: As for `shadowed`.
    """
    check_instance(receivers, Gaussians, "shadow_strength takes Gaussians")
    white = replace(receivers, sh=np.full((receivers.count, 1, 3), 0.5 / SH_C0, np.float32))
    lit = decode_srgb(0.5 + SH_C0 * shadowed(white, lights, transmittances).sh.astype(np.float64)).mean(axis=2)
    return replace(white, sh=np.repeat((0.5 - lit)[..., None] / SH_C0, 3, axis=2).astype(np.float32))


def light_shares(
    lights: Sequence[Light], receivers: SplatInstance, captured: Sequence[Light] | None = None
) -> FloatArray:
    """Returns each of L lights' fraction of the unshadowed irradiance at N Gaussians, shape (L, N, 3).

    Every Gaussian counts as facing every light, because normals of captures are unreliable. Fractions are 0 where no
    light arrives.

    Args:
        lights: The lights of the frame.
        receivers: Instance of the Gaussians.
        captured: The same lights as the capture holds them: one that is dimmer now has a smaller fraction, so that its
            shadows fade with it. None, or only lights without power: as they are now.

    Raises:
        SceneError: One light is an environment, which has no position and thus no shadow map.
    """
    for light in lights:
        if isinstance(light, LightEnvironment):
            raise SceneError(
                "lights holds an environment, which has no deep shadow map: give lights with a position or direction"
            )
    before = np.array([_power(light) for light in captured or lights])
    if before.shape != (len(lights), 3) or not before.any():
        captured, before = None, np.array([_power(light) for light in lights])
    arriving = np.array(
        [
            facing_irradiance(replace(now, intensity=held.intensity, color=held.color), receivers.world_means)
            for now, held in zip(lights, captured or lights, strict=True)
        ]
    )
    total = arriving.sum(axis=0)
    shares = np.divide(arriving, total, out=np.zeros_like(arriving), where=total > 0.0)
    now = np.array([_power(light) for light in lights])
    kept = np.minimum(np.divide(now, before, out=np.zeros_like(now), where=before > 0.0), 1.0)
    return (kept[:, None] * shares).astype(np.float32)


def _power(light: Light) -> Doubles:
    """Returns a light's intensity times its colour, shape (3,)."""
    return light.intensity * np.array(light.color, np.float64)


def light_factors(shares: FloatArray, transmittances: npt.NDArray[np.floating], direct: float) -> FloatArray:
    """Returns ``1 - direct sum_l share_l (1 - T_l)``, the shadow factor of N Gaussians' colours, shape (N, 3).

    Args:
        shares: Fraction of each of L lights in the irradiance, shape (L, N, 3).
        transmittances: Transmittance of each light, 0..1, shape (L, N).
        direct: Fraction of the captured radiance that is due to the lights, 0..1.
    """
    blocked = np.einsum("lnc,ln->nc", shares, 1.0 - transmittances)
    # Rounded fractions may sum to slightly more than 1.
    return np.clip(1.0 - direct * blocked, 0.0, 1.0).astype(np.float32)


_log = logging.getLogger("lumisplat")

_SUSPICIOUS_SHADOW = 0.9
"""A warning reports a likely mistake if a light's transmittance is below 0.5 at more than this fraction of the
captured Gaussians."""


def casting_lights(lights: Iterable[Light]) -> tuple[Light, ...]:
    """Returns the enabled lights that cast shadows; environments are left out, because they have no deep shadow map."""
    return tuple(
        light for light in lights if light.enabled and light.casts_shadow and not isinstance(light, LightEnvironment)
    )


class ActorShadows:
    """Darkens captured Gaussians by shadows of moving actors and static meshes: one deep shadow map per light.

    Args:
        receivers: Instances of captures, which do not move.
        lights: At least one light, none of them an environment.
        meshes: Static casters besides the actors.
        captured: The lights as the captures hold them, as for `light_shares`.
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
        captured: Sequence[Light] | None = None,
        config: AvatarLightingConfig,
        device: str = "auto",
        progress: Progress | None = None,
    ) -> None:
        self._receivers, self._lights, self._captured = list(receivers), tuple(lights), captured
        self._direct, self._radius = config.direct, config.shadow_map.region_radius
        # A map keeps its region around the first casters, but actors leave it: the radius is applied here instead.
        self._config = replace(config.shadow_map, region_radius=None)
        self._device, self._progress = device, progress
        self._meshes, self._static_meshes = MeshesAsGaussians(), list(meshes)
        self._maps: list[DeepShadowMap | None] = [None] * len(self._lights)
        """Deep shadow map of the actors for each light, rebuilt every frame. None: not built yet, or for a light that
        has moved since."""
        self._shares = [light_shares(self._lights, receiver, self._captured) for receiver in self._receivers]
        self._origin = rendered_frame(Scene(self._receivers))[0].origin
        """World position of the local coordinates in which actors' Gaussians are stored as float32, shape (3,)."""
        self._means = [receiver.world_means for receiver in self._receivers]
        self._static = np.ones((len(self._lights), sum(map(len, self._means))), dtype=np.float32)
        """Transmittance of L lights at all N captured Gaussians through the meshes of the scene, without actors, shape
        (L, N). A row changes only if its light moves."""
        self._warned_lights: set[int] = set()
        self._warned_of_radius = False
        for row in range(len(self._lights)):
            self._shadow_meshes(row)

    def take_lights(self, lights: Sequence[Light]) -> bool:
        """Takes the lights of the next frames, in the order of those before; False if there are more or fewer.

        Maps are built anew for lights that moved. All others keep theirs, to the bit.
        """
        if len(lights) != len(self._lights):
            return False
        before, self._lights = self._lights, tuple(lights)
        if before == self._lights:
            return True
        self._shares = [light_shares(self._lights, receiver, self._captured) for receiver in self._receivers]
        for row, (old, new) in enumerate(zip(before, self._lights, strict=True)):
            if _source(old) != _source(new):
                self._maps[row] = None
                self._shadow_meshes(row)
        return True

    def _shadow_meshes(self, row: int) -> None:
        """Computes the transmittance of one light through the meshes of the scene."""
        if self._static_meshes:
            shadow = self._build(self._static_meshes, self._lights[row])
            self._static[row] = shadow.transmittance_of(self._receivers)

    def darken(self, casters: Sequence[PlacedActor]) -> list[SplatInstance]:
        """Returns the captures with one frame's shadows; a capture on which no shadow falls stays the same object.

        Args:
            casters: Actors of the frame; the list may be empty.
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
        """Returns the transmittance of L lights through one frame's casters at all N captured Gaussians, (L, N)."""
        self._warn_of_lights_inside(casters)
        # One set for all lights, so that meshes are converted to Gaussians once.
        sh = np.zeros((len(casters.means), 1, 3), dtype=np.float32)
        gaussians = Gaussians(*casters, sh=sh, origin=self._origin)
        maps = [self._rebuilt(row, gaussians) for row in range(len(self._lights))]
        transmittances = np.array([shadow.transmittance_of(self._receivers) for shadow in maps])
        self._warn_of_darkness(transmittances)
        if self._radius is not None:
            transmittances[:, self._is_far(casters, self._radius)] = 1.0
        return transmittances

    def _rebuilt(self, row: int, casters: Gaussians) -> DeepShadowMap:
        """Returns the map of one light with one frame's casters."""
        shadow = self._maps[row]
        if shadow is None:
            shadow = self._maps[row] = self._build(casters, self._lights[row])
        else:
            shadow.rebuild(casters)
        return shadow

    def _is_far(self, casters: PlacedGaussians, radius: float) -> npt.NDArray[np.bool_]:
        """Returns which captured Gaussians are farther than ``radius`` from the actors' box; warns once if all are."""
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
        """Warns once per light that is blocked from nearly all captured Gaussians, as by a caster around the light.

        Args:
            transmittances: Transmittance of L lights at N captured Gaussians, shape (L, N).
        """
        for row in np.flatnonzero((transmittances < 0.5).mean(axis=1) > _SUSPICIOUS_SHADOW).tolist():
            if row not in self._warned_lights:
                self._warned_lights.add(row)
                _log.warning(
                    "light %r hardly reaches the capture: it is inside a caster, or the capture itself is a caster",
                    self._lights[row].name or row,
                )

    def _warn_of_lights_inside(self, casters: PlacedGaussians) -> None:
        """Warns once per light that is inside an actor, because the actor then shadows nearly everything."""
        for row, light in enumerate(self._lights):
            if not isinstance(light, PlacedLight) or row in self._warned_lights:
                continue
            if _is_inside(np.array(light.position) - self._origin, casters):
                self._warned_lights.add(row)
                _log.warning(
                    "light %r is inside an actor, which shadows everything around: move the light, or leave it out",
                    light.name or row,
                )


def _source(light: Light) -> tuple[bool, object, object]:
    """Returns what of a light its shadow map depends on: whether it has a direction, direction or position, extent."""
    extent = extent_record(extent_of(light))
    if isinstance(light, LightDirectional):
        return True, light.direction, extent
    return False, getattr(light, "position", None), extent


def _is_inside(point: npt.NDArray[np.float64], casters: PlacedGaussians) -> bool:
    """Returns whether a point is within `SHADOW_FOOTPRINT` standard deviations of any Gaussian of the casters."""
    offset = (point - casters.means).astype(np.float32)
    near = np.einsum("ij,ij->i", offset, offset) < (SHADOW_FOOTPRINT * casters.scales.max(axis=1)) ** 2
    axes = matrices_from_quaternions(casters.rotations_wxyz[near])
    local = np.einsum("nij,ni->nj", axes, offset[near]) / casters.scales[near]
    return bool((np.einsum("ij,ij->i", local, local) < SHADOW_FOOTPRINT**2).any())
