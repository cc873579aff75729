"""The light that arrives at actors made of Gaussians: of a probe, of given lights, and of what a capture leaves open.

Sources: docs/method/relighting.md#light-on-actors and #exposure.
"""

from __future__ import annotations

import logging
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lumisplat.config import AvatarLightingConfig, Pipeline, RenderConfig
from lumisplat.constants import LUMINANCE, SH_C0, SHADOW_OFFSET
from lumisplat.math.arrays import Doubles, FloatArray, weighted_quantile
from lumisplat.math.color import decode_srgb
from lumisplat.metrics.materials import BLACK
from lumisplat.progress import Progress
from lumisplat.relighting.actors import PlacedActor, centroid, light_factors, light_shares
from lumisplat.relighting.irradiance import ALBEDO_HIGH, LIGHTEST
from lumisplat.relighting.probe import EnvironmentProbe, ProbeCache
from lumisplat.relighting.probe_transfer import light_scales
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightDirectional, LightEnvironment, PlacedLight, facing_irradiance
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

_log = logging.getLogger("lumisplat")

LIGHT_RAYS = 256
"""Largest number of shadow rays from an actor through the scene to a light."""

LAMP_MARGIN = 0.1
"""Fraction of the distance to a light with a position that shadow rays through the scene leave out: the Gaussians of
the captured lamp."""

ACTOR_ALBEDO_HIGH = 0.5
"""Assumed albedo of the lightest surfaces of an actor in their largest channel: skin and cloth. Places have walls and
paint of `ALBEDO_HIGH`."""

CAPTURED_LIGHT_MIN = 0.5
"""Smallest light in which an actor of unknown albedo is taken to have been captured, as irradiance over pi in units of
display white: it may have no light surfaces. The largest is 1: cameras expose so."""

AROUND_REACH = 3.0
"""Radius, in diagonals of an actor's box, within which surfaces tell the light at its position."""

AROUND_COUNT_MIN = 100
"""Smallest number of captured Gaussians within `AROUND_REACH` that tell the light; with fewer, all of them do."""

OPEN_MIN = 0.05
"""Smallest fraction of directions without a capture that counts as open sky."""

SKY_MAX = 4.0
"""Largest estimated radiance of the open directions, in units of display white."""


@dataclass(frozen=True, slots=True)
class Exposure:
    """Light in which an actor was captured, and the light at its position; both from their lightest surfaces.

    If the albedo of an actor is known, that tells the light in which it was captured.
    """

    captured: float
    """Irradiance over pi of the actor in its capture, in units of display white."""
    around: float
    """Irradiance over pi at the actor's position, in the same units."""
    sky: float
    """Radiance of the directions that the captures leave open."""
    gain: float
    """Factor on all light, before it is divided by ``captured``."""

    @property
    def gamma(self) -> float:
        """Factor by which light multiplies the actor's captured colours."""
        return self.gain / self.captured


class ActorLight:
    """Computes the factors by which light multiplies the captured colours of actors made of Gaussians.

    Args:
        scene: The scene without actors.
        lights: Given lights that light actors; no environment.
        config: Settings.
        background: Background of the probes, display-referred sRGB, 0..1 each.
        device: As for `create_renderer`.
        progress: Called with a label and a fraction 0..1, while kernels compile.
    """

    def __init__(
        self,
        scene: Scene,
        lights: Sequence[Light],
        config: AvatarLightingConfig,
        *,
        background: tuple[float, float, float],
        device: str,
        progress: Progress | None,
    ) -> None:
        self._scene, self.config = scene, config
        self._device, self._progress = device, progress
        self.take_lights(lights)
        self.probes = ProbeCache(scene, background, device, progress)
        has_environment = any(isinstance(light, LightEnvironment) and light.enabled for light in scene.lights)
        self._sees_black = not any(background) and not has_environment
        self._through_scene: Renderer | None = None
        self._through_actors: Renderer | None = None
        """Renderers of shadow rays; None until the first ray."""
        self.captured: tuple[Light, ...] | None = None
        """The lights of the first scene that actors block, as the captures hold them; None: not known yet."""
        self._exposures: dict[Hashable, Exposure] = {}
        """Exposure of each actor, by its key, estimated when it is first lit."""
        self._warned: set[int] = set()

    def take_lights(self, lights: Sequence[Light]) -> None:
        """Takes the given lights of the next frames. Environments are left out: probes capture them."""
        self._lights = tuple(light for light in lights if not isinstance(light, LightEnvironment))

    def take_environments(self, environments: Sequence[LightEnvironment]) -> None:
        """Lets probes capture the first scene with other environments; equal objects change nothing.

        Exposures stay, so that actors follow an environment that fades.
        """
        lights = self._scene.lights
        if [id(one) for one in lights if isinstance(one, LightEnvironment)] != [*map(id, environments)]:
            others = (light for light in lights if not isinstance(light, LightEnvironment))
            self._scene = replace(self._scene, lights=(*others, *environments))
            self.probes.take_scene(self._scene)

    def scales(
        self,
        key: Hashable,
        actor: SplatInstance,
        normals: FloatArray,
        casters: Sequence[PlacedActor],
        captured_lights: Sequence[Light],
    ) -> FloatArray:
        """Returns the factor of each channel at the N Gaussians of an actor, shape (N, 3).

        Args:
            key: What identifies the actor in all frames.
            actor: The actor.
            normals: Unit normals, world space, shape (N, 3).
            casters: Actors that cast shadows on it; may include itself.
            captured_lights: Lights from which the captured light comes, which casters block; may be empty.
        """
        transfer = self.config.transfer
        center = centroid([actor])
        probe, sky = self.probes.at(center), self.probes.open_at(center)
        shares = [share_beyond(probe, light, center) for light in self._lights]
        beyond = [
            share * self._visibility(actor, light) if share > 0.0 else 0.0
            for light, share in zip(self._lights, shares, strict=True)
        ]
        if key not in self._exposures:
            self._exposures[key] = self._exposure(actor, center, probe, sky, beyond)
        exposure = self._exposures[key]
        total = light_scales(probe, normals, transfer)
        blocking = _Blocking(self, actor, normals, casters)
        if captured_lights:
            # Only the part of a light that the probe holds is in the captured light.
            outside = {id(light): share for light, share in zip(self._lights, shares, strict=True)}
            passed = [
                1.0 - (1.0 - outside.get(id(light), 0.0)) * (1.0 - blocking.transmittance(light))
                for light in captured_lights
            ]
            fractions = light_shares(captured_lights, actor, self.captured)
            total *= light_factors(fractions, np.array(passed), self.config.direct)
        if exposure.sky > 0.0:
            total += np.float32(exposure.sky) * light_scales(sky, normals, transfer)
        for light, share in zip(self._lights, beyond, strict=True):
            if share > 0.0:
                facing = facing_irradiance(light, actor.world_means) * (share / np.pi)
                received = blocking.cosines(light) * blocking.transmittance(light)
                total += (facing * received[:, None]).astype(np.float32)
        return np.float32(exposure.gamma) * np.minimum(total, np.float32(transfer.scale_max))

    def _visibility(self, actor: SplatInstance, light: Light) -> float:
        """Returns the mean transmittance, 0..1, of up to `LIGHT_RAYS` rays from an actor through the scene to a light.

        It warns once per light that the scene blocks.
        """
        if not light.casts_shadow:
            return 1.0
        if self._through_scene is None:
            self._through_scene = self._tracer()
        means = actor.world_means
        # Evenly spaced indices: the same Gaussians in every frame.
        starts = means[np.linspace(0, len(means) - 1, min(LIGHT_RAYS, len(means))).astype(np.int64)]
        directions, distances = _towards(light, starts)
        reach = np.minimum((1.0 - LAMP_MARGIN) * distances, _shadow_distance(light))
        seen = float(self._through_scene.transmittance(self._scene, starts, directions, reach).mean())
        row = self._lights.index(light)
        if seen < 1e-3 and row not in self._warned:
            self._warned.add(row)
            name = f"light '{light.name}'" if light.name else "a light"
            text = "%s does not reach an actor: the scene blocks it; if a captured sky does, set shadow_distance"
            _log.warning(text, name)
        return seen

    def blocked_by_actors(
        self, light: Light, starts: Doubles, casters: Sequence[PlacedActor]
    ) -> npt.NDArray[np.float32]:
        """Returns the transmittance through casters from N points, shape (N, 3), towards a light, shape (N,)."""
        if self._through_actors is None:
            self._through_actors = self._tracer()
        scene = Scene(
            [one for one in casters if isinstance(one, SplatInstance)],
            [one for one in casters if isinstance(one, MeshInstance)],
        )
        directions, distances = _towards(light, starts)
        reach = np.minimum(distances, _shadow_distance(light))
        return self._through_actors.transmittance(scene, starts, directions, reach)

    def _tracer(self) -> Renderer:
        return create_renderer(RenderConfig(pipeline=Pipeline.TRACE), self._device, progress=self._progress)

    def _exposure(
        self,
        actor: SplatInstance,
        center: Doubles,
        probe: EnvironmentProbe,
        sky: EnvironmentProbe,
        beyond: Sequence[float],
    ) -> Exposure:
        """Estimates the exposure of an actor, and logs it; if ``gamma`` is given, returns that alone.

        Args:
            actor: The actor.
            center: Position of the probe, shape (3,).
            probe: The captured light at that position.
            sky: The fraction of each direction that no capture covers, as SH.
            beyond: Fraction of each light that is not in the probe and passes through the scene.
        """
        if self.config.transfer.gamma is not None:
            return Exposure(1.0, 1.0, 0.0, self.config.transfer.gamma)
        captured = _captured_light(actor.gaussians)
        around = self._light_around(actor, center)
        weights = np.array(LUMINANCE)
        held = max(float(SH_C0 * probe.coefficients[0] @ weights), 0.0)
        # A light gives a sphere a quarter of the irradiance that it gives a surface that faces it, on average.
        added = sum(
            share * float(facing_irradiance(light, center[None])[0] @ weights) / (4.0 * np.pi)
            for light, share in zip(self._lights, beyond, strict=True)
        )
        is_open = float(np.clip(SH_C0 * sky.coefficients[0, 0], 0.0, 1.0))
        missing = max(around - held - added, 0.0)
        radiance = min(missing / is_open, SKY_MAX) if self._sees_black and is_open > OPEN_MIN else 0.0
        gain = max(around / max(held + added + is_open * radiance, 1e-3), 1.0)
        exposure = Exposure(captured, around, radiance, gain)
        name = f"actor {actor.name!r}" if actor.name else "an actor"
        _log.warning(
            "%s is lit at %.2g of its captured brightness, to match its surroundings (light there %.2g, in its own "
            "capture %.2g, display white 1); RelightConfig.gamma=1 takes the light as the captures hold it instead "
            "(in a scene.toml: gamma in [animation.lighting.transfer])",
            *(name, exposure.gamma * (held + added + is_open * radiance), around, captured),
        )
        return exposure

    def _light_around(self, actor: SplatInstance, center: Doubles) -> float:
        """Returns the irradiance over pi near an actor that makes the albedo of the lightest surfaces typical."""
        low, high = Scene([actor]).bounds()
        reach = AROUND_REACH * float(np.linalg.norm(np.subtract(high, low)))
        near = [np.linalg.norm(one.world_means - center, axis=1) <= reach for one in self._scene.splats]
        if sum(map(np.count_nonzero, near)) < AROUND_COUNT_MIN:
            near = [np.ones(len(rows), bool) for rows in near]
        parts = [
            _colors_and_areas(one.gaussians, one.scale, rows)
            for one, rows in zip(self._scene.splats, near, strict=True)
        ]
        colors, areas = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return weighted_quantile(colors, areas, LIGHTEST) / ALBEDO_HIGH


class _Blocking:
    """Shadows that actors cast on one actor: transmittances and cosines by light, computed once each.

    Args:
        light: Traces the rays.
        actor: The actor with N Gaussians that receives shadows.
        normals: Their unit normals, world space, shape (N, 3).
        casters: Actors that cast shadows.
    """

    def __init__(
        self, light: ActorLight, actor: SplatInstance, normals: FloatArray, casters: Sequence[PlacedActor]
    ) -> None:
        self._light, self._normals = light, normals
        self._casters = casters if light.config.shadows else ()
        self._means = actor.world_means
        self._lift = SHADOW_OFFSET * actor.scale * float(np.median(actor.gaussians.scales.max(axis=1)))
        self._found: dict[int, Doubles] = {}
        self._cosines: dict[int, Doubles] = {}

    def cosines(self, light: Light) -> Doubles:
        """Returns the cosine between each normal and the direction to a light, at least 0, shape (N,)."""
        if id(light) not in self._cosines:
            directions, _ = _towards(light, self._means)
            self._cosines[id(light)] = np.maximum(np.einsum("ni,ni->n", self._normals, directions), 0.0)
        return self._cosines[id(light)]

    def transmittance(self, light: Light) -> Doubles:
        """Returns the transmittance of the casters from each Gaussian to a light, (N,); 1 for those that face away."""
        if id(light) not in self._found:
            found = np.ones(len(self._means))
            facing = np.flatnonzero(self.cosines(light) > 0.0)
            if self._casters and light.casts_shadow and facing.size:
                starts = self._means[facing] + self._lift * self._normals[facing]
                found[facing] = self._light.blocked_by_actors(light, starts, self._casters)
            self._found[id(light)] = found
        return self._found[id(light)]


def share_beyond(probe: EnvironmentProbe, light: Light, position: Doubles) -> float:
    """Returns the fraction of a light's irradiance at a position that a probe there does not hold, 0..1.

    The luminance that the probe holds of the light is ``min(E_light, max(E_probe - pi L_mean, 0))``. E_probe is the
    probe's irradiance on a surface that faces the light, and L_mean the probe's mean radiance. The excess of the probe
    may also come from another light or the bright sky around a sun.
    """
    weights = np.array(LUMINANCE)
    directions, _ = _towards(light, position[None])
    arriving = float(facing_irradiance(light, position[None])[0] @ weights)
    if arriving <= 0.0:
        return 0.0
    facing = float(probe.irradiance(directions)[0] @ weights)
    constant = np.pi * float(SH_C0 * probe.coefficients[0] @ weights)
    return max(0.0, 1.0 - max(0.0, facing - constant) / arriving)


def _towards(light: Light, points: Doubles) -> tuple[Doubles, Doubles]:
    """Returns unit directions from N points to the centre of a light, (N, 3), and distances, (N,); inf for a sun."""
    if isinstance(light, LightDirectional):
        return np.broadcast_to(-np.array(light.direction, np.float64), points.shape), np.full(len(points), np.inf)
    assert isinstance(light, PlacedLight)
    offsets = np.array(light.position, np.float64) - points
    distances = np.linalg.norm(offsets, axis=1)
    return offsets / np.maximum(distances, np.finfo(float).tiny)[:, None], distances


def _shadow_distance(light: Light) -> float:
    """Returns the distance beyond which nothing blocks a sun, scene units; inf for other lights."""
    return light.shadow_distance if isinstance(light, LightDirectional) else np.inf


def _colors_and_areas(gaussians: Gaussians, scale: float, rows: npt.NDArray[np.bool_]) -> tuple[Doubles, Doubles]:
    """Returns the largest channel of the linear mean colours of chosen Gaussians, and their areas times opacity."""
    colors = np.clip(SH_C0 * gaussians.sh[rows, 0].astype(np.float64) + 0.5, 0.0, 1.0)
    wide = np.sort(gaussians.scales[rows].astype(np.float64) * scale, axis=1)
    return decode_srgb(colors).max(axis=1), wide[:, 1] * wide[:, 2] * gaussians.opacities[rows]


def _captured_light(gaussians: Gaussians) -> float:
    """Returns the irradiance over pi in which an actor was captured, in units of display white.

    It is the mean ratio of its colours to its albedo, which actors made of meshes have. Without an albedo, the lightest
    surfaces are taken to have a typical one.
    """
    colors, areas = _colors_and_areas(gaussians, 1.0, np.ones(gaussians.count, bool))
    if not areas.any():
        return 1.0
    if gaussians.albedo is None:
        return float(np.clip(weighted_quantile(colors, areas, LIGHTEST) / ACTOR_ALBEDO_HIGH, CAPTURED_LIGHT_MIN, 1.0))
    shown, reflected = (float(np.average(values, weights=areas)) for values in (colors, gaussians.albedo.max(axis=1)))
    return max(shown, BLACK) / max(reflected, BLACK)
