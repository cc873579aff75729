"""Avatars in a captured scene: it takes their shadows, they take its light (docs/method/relighting.md)."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lumisplat.config import AvatarLightingConfig
from lumisplat.config.checks import check_kind
from lumisplat.constants import LUMINANCE, SH_C0
from lumisplat.errors import SceneError
from lumisplat.progress import Progress
from lumisplat.relighting.actors import ActorShadows, PlacedActor, actor_flags, casting_lights, centroid, placed_actors
from lumisplat.relighting.light_estimation import LightEstimate, estimate_lights
from lumisplat.relighting.probe import EnvironmentProbe, ProbeCache
from lumisplat.relighting.probe_transfer import SunOnActors, light_scales
from lumisplat.relighting.sun_estimation import SunEstimate, estimate_sun
from lumisplat.renderer.scene.materials import emits_capture_only
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightDirectional, LightEnvironment
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.colors import scale_light_of
from lumisplat.scene.ops.normals import estimate_normals
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance, checked_lights

_log = logging.getLogger("lumisplat")

_DARK = 0.3
"""Mean radiance, display white is 1, below which actors are shown less than half as bright as they were captured."""


@dataclass(frozen=True, slots=True)
class _LightRoles:
    """What the lights of a scene, and those that are given besides, are for."""

    casting: tuple[Light, ...] | None
    """They cast the shadows of actors; None: lights have to be estimated."""
    on_meshes: tuple[Light, ...]
    """They light meshes in frames that are lit for actors."""
    as_captured: bool
    """Whether the scene's own lights are in all frames, because they light something in it."""

    @classmethod
    def of(cls, scene: Scene, lights: Sequence[Light] | None) -> _LightRoles:
        """The roles of a scene's lights, and of those that are given.

        Raises:
            SceneError: ``lights`` is no list of lights, or none of them casts shadows from a place or a direction.
        """
        enabled = tuple(light for light in scene.lights if light.enabled)
        if lights is None:
            # Lights of a scene in which nothing reflects them can only be those that it was captured in.
            are_captured = not scene.meshes and all(map(emits_capture_only, scene.splats))
            on_meshes = enabled if are_captured else ()
            return cls(casting_lights(scene.lights) or None, on_meshes, bool(enabled) and not are_captured)
        given = checked_lights(lights)
        if not casting_lights(given):
            raise SceneError("none of the lights is enabled, casts shadows and shines from somewhere")
        return cls(casting_lights(given), tuple(light for light in given if light.enabled), bool(enabled))


class AvatarLighter:
    """Lights actors in a captured scene, and darkens the scene where they stand in its light.

    The captured sets of the scene receive shadows from all actors, through a deep shadow map for each light that is
    rebuilt every frame, and from the scene's own meshes, which count as put there after the capture. Actors made of
    Gaussians are relit by a probe of the scene at their place, and by the suns that are given, as far as the scene does
    not block them and the probe does not hold them. They shadow neither each other nor themselves.

    Actors that are meshes stay meshes, and make the frame a lit one: the lights, and a probe at the meshes' place for
    the rest of the light, light all meshes of the scene, without shadows on these; captured sets are shown as captured.
    A scene whose own lights already light something in it, a mesh or a set with a material, keeps these lights: what
    reflects them gets its shadows from the renderer's rays, and none from shadow maps.

    Not safe to share between threads.

    Args:
        scene: What does not move, as captured.
        lights: The lights that the captured colours come from; those that cast no shadows, and an environment, only
            light meshes. None: the scene's own, or if none of them casts shadows, those that `estimate_lights` finds
            around the actors of the first frame, or if it finds none, the sun of `estimate_sun`.
        config: Settings; None: the defaults.
        background: Display-referred sRGB behind everything in the probes, 0..1 each.
        device: As for `create_renderer`.
        progress: Called with a label and a fraction 0..1, while kernels compile and a sun is looked for.

    Raises:
        ConfigError: ``config`` is no AvatarLightingConfig.
        DeviceError: There is no such device.
        SceneError: The scene is of another type or has no captured sets, ``lights`` is no list of lights, or none of
            them casts shadows from a place or a direction.
    """

    def __init__(
        self,
        scene: Scene,
        lights: Sequence[Light] | None = None,
        config: AvatarLightingConfig | None = None,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        device: str = "auto",
        progress: Progress | None = None,
    ) -> None:
        self.config = AvatarLightingConfig() if config is None else config
        """Settings."""
        check_kind("config", self.config, AvatarLightingConfig)
        _check_scene(scene)
        self.scene = scene
        """What does not move."""
        self._roles = _LightRoles.of(scene, lights)
        self.lights: tuple[Light, ...] | None = self._roles.casting
        """Those that cast the shadows of actors; None: not estimated yet."""
        self.estimate: LightEstimate | None = None
        """The lights that were estimated, if none were given."""
        self.sun: SunEstimate | None = None
        """The sun that was estimated, if no lights were given or found."""
        self._device, self._progress = device, progress
        self._probes = ProbeCache(scene, background, device, progress)
        suns = [light for light in self.lights or () if isinstance(light, LightDirectional)]
        self._suns = SunOnActors(scene, suns, device, progress) if suns and self.config.sun_on_actors else None
        self._receivers = _receivers(scene, self._roles.as_captured)
        self._shadows: ActorShadows | None = None
        """Of the receivers, once shadows were needed."""
        self._normals: dict[int, tuple[Gaussians, npt.NDArray[np.floating]]] = {}
        """Gaussians of the last frame's actors and their normals, by the Gaussians' id."""
        self._warned_of_darkness = False

    def light(
        self,
        actors: Iterable[PlacedActor | Gaussians | Mesh],
        *,
        casts_shadow: Sequence[bool] | None = None,
        relit: Sequence[bool] | None = None,
    ) -> Scene:
        """The scene with actors in it, for one frame.

        Sets without any shadow stay the same objects, so that a renderer does not upload them again; the same actors
        give the same scene, to the bit.

        Args:
            actors: In world space, or instances.
            casts_shadow: Whether each darkens the scene; None: all do.
            relit: Whether each is relit by the probe of its place; None: all are.

        Returns:
            The captured sets, darkened, and the actors after them; meshes likewise.

        Raises:
            DeviceError: The device is out of memory.
            SceneError: An actor is neither Gaussians nor a mesh, flags are of another number, or no light is found.
        """
        placed = placed_actors(actors)
        casts = actor_flags("casts_shadow", casts_shadow, len(placed))
        casting = [actor for actor, flag in zip(placed, casts, strict=True) if flag]
        takes_light = actor_flags("relit", relit, len(placed))
        self._forget_normals(placed)
        uses_scene_lights = self._uses_scene_lights(placed)
        splats = [
            self._relight(actor) if flag and (emits_capture_only(actor) or not uses_scene_lights) else actor
            for actor, flag in zip(placed, takes_light, strict=True)
            if isinstance(actor, SplatInstance)
        ]
        meshes = [actor for actor in placed if isinstance(actor, MeshInstance)]
        sets = self._darken(casting)
        if uses_scene_lights:
            lights = self.scene.lights
        elif meshes:
            # Only meshes are to be lit: sets that would reflect the lights of another frame are shown as captured.
            sets, splats = (
                [_as_captured(instance) for instance in sets],
                [_as_captured(instance) for instance in splats],
            )
            lights = self._mesh_lights(meshes)
        else:
            # An environment is seen behind everything; other lights have nothing to light.
            lights = tuple(light for light in self.scene.lights if isinstance(light, LightEnvironment))
        return replace(self.scene, splats=(*sets, *splats), meshes=(*self.scene.meshes, *meshes), lights=lights)

    def _uses_scene_lights(self, actors: list[PlacedActor]) -> bool:
        """Whether the scene's lights stay in the frame: they light something in it, or an actor that reflects."""
        reflecting = any(isinstance(actor, SplatInstance) and not emits_capture_only(actor) for actor in actors)
        return self._roles.as_captured or (reflecting and bool(self.scene.lights))

    def _darken(self, casting: list[PlacedActor]) -> list[SplatInstance]:
        """The scene's sets in the shadow of casters and of the scene's own meshes."""
        sets = list(self.scene.splats)
        if not (self.config.shadows and self._receivers and (casting or self.scene.meshes)):
            return sets
        if self._shadows is None:
            self._shadows = ActorShadows(
                [sets[row] for row in self._receivers],
                self._casting_lights(casting),
                self.scene.meshes,
                config=self.config,
                device=self._device,
                progress=self._progress,
            )
        for row, darkened in zip(self._receivers, self._shadows.darken(casting), strict=True):
            sets[row] = darkened
        return sets

    def _casting_lights(self, actors: Sequence[PlacedActor]) -> tuple[Light, ...]:
        """The lights that cast shadows, estimated around the actors if there are none yet."""
        if self.lights is None:
            position = centroid(actors) if actors else np.mean(self.scene.bounds(), axis=0)
            # The lights give ``direct`` of the irradiance at the place, its surroundings the rest.
            irradiance = self.config.direct * np.pi * _mean_luminance(self._probes.at(position))
            self.lights = self._estimated_lights(position, irradiance)
        return self.lights

    def _estimated_lights(self, position: npt.NDArray[np.float64], irradiance: float) -> tuple[Light, ...]:
        """The lamps of the capture, or its sun; together they give a place an irradiance."""
        try:
            self.estimate = estimate_lights(
                self.scene, position, self.config.light_count, config=self.config.estimation
            )
        except SceneError as nothing_found:
            self.sun = estimate_sun(self.scene, position, progress=self._progress)
            if self.sun is None:
                raise
            _log.warning("%s", nothing_found)
            return (replace(self.sun.light, intensity=irradiance),)
        scale = irradiance / self.config.estimation.irradiance
        return tuple(replace(light, intensity=scale * light.intensity) for light in self.estimate.lights)

    def _relight(self, actor: SplatInstance) -> SplatInstance:
        """An actor in the light of its place."""
        if not self.config.relight:
            return actor
        # Normals of an actor that only moves stay the same, and take long to estimate.
        key, gaussians = id(actor.gaussians), actor.gaussians
        if key not in self._normals:
            self._normals[key] = gaussians, estimate_normals(gaussians, self.config.transfer.normals)
        probe = self._probes.at(centroid([actor]))
        transfer = self.config.transfer
        normals = (self._normals[key][1] @ actor.transform[:3, :3].T / actor.scale).astype(np.float32)
        scales = light_scales(probe, normals, transfer)
        if self._suns is not None:
            scales = np.minimum(scales + self._suns.scales(actor, probe, normals), np.float32(transfer.scale_max))
        self._warn_of_darkness(float((scales @ np.array(LUMINANCE)).mean()))
        return scale_light_of(actor, transfer.gamma * scales)

    def _forget_normals(self, actors: list[PlacedActor]) -> None:
        """Drops the normals of Gaussians that are not in the frame."""
        present = {id(actor.gaussians) for actor in actors if isinstance(actor, SplatInstance)}
        self._normals = {key: held for key, held in self._normals.items() if key in present}

    def _warn_of_darkness(self, mean: float) -> None:
        """Warns, once, if actors become much darker than they were captured, by the mean light on them."""
        if not self._warned_of_darkness and mean * self.config.transfer.gamma < _DARK:
            self._warned_of_darkness = True
            gamma = self.config.transfer.gamma
            as_dark = "as dark" if gamma == 1.0 else f"at {gamma * mean:.2g} of what they were captured"
            message = f"actors stand in {mean:.2g} of display white, and come out {as_dark}"
            if mean > 1e-3:
                message += (
                    f": a RelightConfig.gamma of {_DARK / mean:.2g} shows them half as bright as they were captured, "
                    f"{1.0 / mean:.2g} as bright (in a scene.toml: gamma in [animation.lighting.transfer])"
                )
            _log.warning("%s", message)

    def _mesh_lights(self, meshes: Sequence[MeshInstance]) -> tuple[Light, ...]:
        """The lights for meshes, and an environment of the rest of the light at their place.

        None casts shadows by rays: an estimated lamp is inside its own Gaussians, and the light of the probe comes from
        the very walls that would block it.
        """
        on_meshes = self._roles.on_meshes
        lights = on_meshes if casting_lights(on_meshes) else (*self._casting_lights(meshes), *on_meshes)
        if self.config.relight and not any(isinstance(light, LightEnvironment) for light in lights):
            around = self._probes.at(centroid(meshes)).light()
            lights = (*lights, replace(around, intensity=1.0 - self.config.direct, name="around"))
        return tuple(replace(light, casts_shadow=False) for light in lights)


def _check_scene(scene: object) -> None:
    if not isinstance(scene, Scene) or not scene.splats:
        raise SceneError("an AvatarLighter takes a Scene that has captured Gaussians")


def _receivers(scene: Scene, is_lit: bool) -> list[int]:
    """Rows of the splat instances that shadow maps darken: in lit scenes, those that reflect get shadows from rays."""
    rows = [row for row, instance in enumerate(scene.splats) if not is_lit or emits_capture_only(instance)]
    others = len(scene.splats) - len(rows)
    if others:
        _log.warning(
            "%d of %d captures reflect light: their shadows are from the renderer's rays, and none from shadow maps",
            others,
            len(scene.splats),
        )
    return rows


def _as_captured(instance: SplatInstance) -> SplatInstance:
    return instance if emits_capture_only(instance) else replace(instance, material=None, shadow_catcher=False)


def _mean_luminance(probe: EnvironmentProbe) -> float:
    """Of the radiance from all directions, at least 0."""
    return max(float(SH_C0 * probe.coefficients[0] @ np.array(LUMINANCE)), 0.0)
