"""Lights avatars in a captured scene and casts the avatars' shadows on it (docs/method/relighting.md)."""

from __future__ import annotations

import logging
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lumisplat.config import AvatarLightingConfig, NormalEstimate
from lumisplat.config.checks import check_kind
from lumisplat.constants import LUMINANCE, SH_C0
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray
from lumisplat.progress import Progress
from lumisplat.relighting.actor_light import ActorLight
from lumisplat.relighting.actors import ActorShadows, PlacedActor, actor_flags, casting_lights, centroid, placed_actors
from lumisplat.relighting.light_estimation import LightEstimate, estimate_lights
from lumisplat.relighting.probe import EnvironmentProbe, ProbeCache
from lumisplat.relighting.sun_estimation import SunEstimate, estimate_sun
from lumisplat.renderer.scene.materials import emits_capture_only
from lumisplat.scene.animation.correspondence import carried_normals, correspond
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.colors import scale_light_of
from lumisplat.scene.ops.normals import estimate_normals
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance, checked_lights

_log = logging.getLogger("lumisplat")


@dataclass(frozen=True, slots=True)
class _LightRoles:
    """Roles of lights (the scene's or the user's): which shadow captures, and which illuminate meshes."""

    casting: tuple[Light, ...] | None
    """Lights that actors block from captures. None: neither the user nor the scene gives such lights, so they are
    estimated."""
    on_meshes: tuple[Light, ...]
    """Lights that illuminate mesh actors, if the frame does not keep the scene's own lights."""
    given: tuple[Light, ...]
    """Lights that the user or the scene gives, which light actors made of Gaussians."""
    uses_scene_lights: bool
    """True if a mesh or capture of the scene reflects the scene's own lights: these lights then light every frame."""

    @classmethod
    def of(cls, scene: Scene, lights: Sequence[Light] | None) -> _LightRoles:
        """Finds which lights shadow captures and which light meshes: of ``lights``, or, if None, of the scene's.

        Raises:
            SceneError: ``lights`` is no list of lights, or none of them casts shadows from a position or a direction.
        """
        enabled = tuple(light for light in scene.lights if light.enabled)
        if lights is None:
            # If nothing in the scene reflects its lights, they describe the light of the capture.
            are_captured = not scene.meshes and all(map(emits_capture_only, scene.splats))
            on_meshes = enabled if are_captured else ()
            return cls(casting_lights(scene.lights) or None, on_meshes, enabled, bool(enabled) and not are_captured)
        given = checked_lights(lights)
        if not casting_lights(given):
            raise SceneError(
                "none of the lights can cast shadows: expected one that is enabled, casts shadows and is no environment"
            )
        lights = tuple(light for light in given if light.enabled)
        return cls(casting_lights(given), lights, lights, bool(enabled))


class AvatarLighter:
    """Lights actors in a captured scene, and darkens the scene by the actors' shadows.

    Captured Gaussians receive the shadows of all actors, through one deep shadow map per light that is rebuilt every
    frame. The scene's meshes, as objects placed after the capture, cast shadows on captured Gaussians, too. Actors made
    of Gaussians are relit by an environment probe of the scene at their position. Given lights light such actors, too,
    as far as the scene does not block a light and the probe does not already contain it. Such actors are in the shadows
    of all actors, by rays. Unless ``transfer.gamma`` is given, each actor gets an exposure when it is first lit, so
    that it is as bright as its surroundings (docs/method/relighting.md#exposure).

    Normals of Gaussians that have none are estimated when an actor is first lit, and carried on to later frames with
    the same Gaussians. Frames of a sequence therefore begin with its first: the actors in it then look the same in
    whatever order the other frames are lit. An actor that appears later takes its exposure and normals from the frame
    in which it is first lit.

    Actors that are meshes stay meshes; frames with mesh actors are lit frames. The lights, and a probe at the meshes'
    position for the rest of the light, illuminate all meshes without shadows; captures stay unlit. If the scene's
    lights already illuminate a mesh or a capture with a material, the scene keeps its lights: shadows on reflecting
    surfaces are then those of the renderer's shadow rays, not of shadow maps.

    Not safe to share between threads.

    Args:
        scene: Static scene, as captured.
        lights: Lights from which the captured colours come. Lights that cast no shadows, and an environment, only
            illuminate meshes. None: the scene's lights. If no light of the scene casts shadows, `estimate_lights`
            searches around the actors of the first frame. If `estimate_lights` finds no light, `estimate_sun` searches
            for a sun.
        config: Settings; None: the defaults.
        background: Background of the probes, display-referred sRGB, 0..1 each.
        device: As for `create_renderer`.
        progress: Called with a label and a fraction 0..1, while kernels compile and a sun is searched for.

    Raises:
        ConfigError: ``config`` is no AvatarLightingConfig.
        DeviceError: There is no such device.
        SceneError: The scene is of another type or has no captures, ``lights`` is no list of lights, or none of them
            casts shadows from a position or a direction.
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
        """Settings of relighting and shadows."""
        check_kind("config", self.config, AvatarLightingConfig)
        _check_scene(scene)
        self.scene = scene
        """Static scene, with its captured colours, before any shadow of an actor."""
        self._given = None if lights is None else tuple(checked_lights(lights))
        self._roles = _LightRoles.of(scene, lights)
        self.lights: tuple[Light, ...] | None = self._roles.casting
        """Lights that actors block from captures: given by the user, of the scene, or estimated. None: not estimated
        yet."""
        self.estimate: LightEstimate | None = None
        """Local lights found by `estimate_lights`. None: the user or the scene gave lights, no local light was found,
        or the search has not run yet."""
        self.sun: SunEstimate | None = None
        """Sun found by `estimate_sun`. None: lights were given, local lights were found, or the search has not run
        yet."""
        self._device, self._progress = device, progress
        given = self._roles.given if self.config.lights_on_actors else ()
        self._actor_light = ActorLight(
            scene, given, self.config, background=background, device=device, progress=progress
        )
        self._actor_light.captured = self.lights
        self._receivers = _receivers(scene, self._roles.uses_scene_lights)
        self._shadows: ActorShadows | None = None
        """Shadow maps of actors on the captures; None until a frame needs them."""
        self._normals: dict[Hashable, tuple[Gaussians, FloatArray]] = {}
        """Gaussians of each actor when it was first lit, and their normals, by the actor's key."""

    def update(self, scene: Scene) -> None:
        """Takes the scene at the time of the next frames: the same captures and meshes with other lights or materials.

        Shadow maps of lights that moved are built anew. The other maps stay, and so do probes, which hold the captured
        light, unless the environment changed. A frame depends on the first scene and on this one alone, not on those
        in between.

        Args:
            scene: Scene with the captures and meshes of the first one, in the same order and place.

        Raises:
            SceneError: The scene has other captures or meshes.
        """
        if scene is self.scene:
            return
        _check_scene(scene)
        if _objects(scene) != _objects(self.scene):
            raise SceneError("the scene of a frame has other captures or meshes than the lighter's: make a new lighter")
        was_lit = self._roles.uses_scene_lights
        self.scene, self._roles = scene, _LightRoles.of(scene, self._given)
        self._actor_light.take_lights(self._roles.given if self.config.lights_on_actors else ())
        if self._roles.uses_scene_lights != was_lit:
            self._receivers, self._shadows = _receivers(scene, self._roles.uses_scene_lights), None
        if self._roles.casting is not None:
            self.lights = self._roles.casting
            if self._shadows is not None and not self._shadows.take_lights(self.lights):
                self._shadows = None
        if scene.is_lit_by_default:
            self._actor_light.take_environments([one for one in scene.lights if isinstance(one, LightEnvironment)])

    @property
    def _probes(self) -> ProbeCache:
        return self._actor_light.probes

    def light(
        self,
        actors: Iterable[PlacedActor | Gaussians | Mesh],
        *,
        casts_shadow: Sequence[bool] | None = None,
        relit: Sequence[bool] | None = None,
        keys: Sequence[Hashable] | None = None,
    ) -> Scene:
        """Returns the scene with lit actors in it, for one frame.

        Captures on which no shadow falls stay the same objects, so that a renderer does not upload them again. Equal
        actors give an equal scene, to the bit.

        Args:
            actors: Gaussians and meshes in world space, or instances.
            casts_shadow: Whether each actor casts shadows on the scene; None: all do.
            relit: Whether each actor is relit by the probe at its position; None: all are.
            keys: What identifies each actor in all frames, such as its name: its exposure and normals are kept under
                it. None: the position in ``actors``, so that every frame must list the same actors in the same order.

        Returns:
            A scene with the darkened captures followed by the actors' Gaussians, and the scene's meshes followed by the
            actors' meshes.

        Raises:
            DeviceError: The device is out of memory.
            SceneError: An actor is neither Gaussians nor a mesh, flags have another length, or no light is found.
        """
        placed = placed_actors(actors)
        casts = actor_flags("casts_shadow", casts_shadow, len(placed))
        casting = [actor for actor, flag in zip(placed, casts, strict=True) if flag]
        takes_light = actor_flags("relit", relit, len(placed))
        identities = range(len(placed)) if keys is None else keys
        if len(identities) != len(placed) or len(set(identities)) != len(placed):
            raise SceneError(
                f"keys has {len(set(identities))} different entries, expected {len(placed)}, one per actor"
            )
        uses_scene_lights = self._uses_scene_lights(placed)
        meshes = [actor for actor in placed if isinstance(actor, MeshInstance)]
        sets = self._darken(casting)
        self._actor_light.config = self.config
        splats = [
            self._relight(key, actor, casting)
            if flag and (emits_capture_only(actor) or not uses_scene_lights)
            else actor
            for key, actor, flag in zip(identities, placed, takes_light, strict=True)
            if isinstance(actor, SplatInstance)
        ]
        if uses_scene_lights:
            lights = self.scene.lights
        elif meshes:
            # Only meshes are lit in this frame: reflecting sets become unlit.
            sets, splats = (
                [_as_captured(instance) for instance in sets],
                [_as_captured(instance) for instance in splats],
            )
            lights = self._mesh_lights(meshes)
        else:
            # The environment is the background; nothing reflects the other lights.
            lights = tuple(light for light in self.scene.lights if isinstance(light, LightEnvironment))
        return replace(self.scene, splats=(*sets, *splats), meshes=(*self.scene.meshes, *meshes), lights=lights)

    def _uses_scene_lights(self, actors: list[PlacedActor]) -> bool:
        """Returns whether the scene's own lights light this frame, because the scene or an actor reflects them."""
        reflecting = any(isinstance(actor, SplatInstance) and not emits_capture_only(actor) for actor in actors)
        return self._roles.uses_scene_lights or (reflecting and bool(self.scene.lights))

    def _darken(self, casting: list[PlacedActor]) -> list[SplatInstance]:
        """Returns the scene's captures, darkened by the shadows of the actors ``casting`` and of the scene's meshes."""
        sets = list(self.scene.splats)
        if not (self.config.shadows and self._receivers and (casting or self.scene.meshes)):
            return sets
        if self._shadows is None:
            self._shadows = ActorShadows(
                [sets[row] for row in self._receivers],
                self._casting_lights(casting),
                self.scene.meshes,
                captured=self._actor_light.captured,
                config=self.config,
                device=self._device,
                progress=self._progress,
            )
        for row, darkened in zip(self._receivers, self._shadows.darken(casting), strict=True):
            if darkened.gaussians is not sets[row].gaussians:
                sets[row] = replace(sets[row], gaussians=darkened.gaussians)
        return sets

    def _casting_lights(self, actors: Sequence[PlacedActor]) -> tuple[Light, ...]:
        """Returns the lights that actors block from captures; estimates lights first if none were given."""
        if self.lights is None:
            position = centroid(actors) if actors else np.mean(self.scene.bounds(), axis=0)
            # The lights give the fraction ``direct`` of the irradiance at the position.
            irradiance = self.config.direct * np.pi * _mean_luminance(self._probes.at(position))
            self.lights = self._actor_light.captured = self._estimated_lights(position, irradiance)
        return self.lights

    def _estimated_lights(self, position: npt.NDArray[np.float64], irradiance: float) -> tuple[Light, ...]:
        """Estimates the capture's local lights, or else its sun; together they give ``irradiance`` at ``position``."""
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

    def _relight(self, key: Hashable, actor: SplatInstance, casters: Sequence[PlacedActor]) -> SplatInstance:
        """Returns an actor with its colours scaled by the light at its position; ``key`` identifies it."""
        if not self.config.relight:
            return actor
        normals = self._normals_of(key, actor.gaussians) @ actor.transform[:3, :3].T / actor.scale
        lights = self.lights if self.config.shadows and self.lights is not None else ()
        scales = self._actor_light.scales(key, actor, normals.astype(np.float32), casters, lights)
        return scale_light_of(actor, scales)

    def _normals_of(self, key: Hashable, gaussians: Gaussians) -> FloatArray:
        """Returns the object-space normals of an actor: its own, carried from when it was first lit, or estimated."""
        method = self.config.transfer.normals
        if method is NormalEstimate.AUTO and gaussians.normals is not None:
            return gaussians.normals
        if key in self._normals:
            first, normals = self._normals[key]
            if first is gaussians:
                return normals
            if correspond(first, gaussians):
                return carried_normals(normals, first, gaussians)
        self._normals[key] = gaussians, estimate_normals(gaussians, method)
        return self._normals[key][1]

    def _mesh_lights(self, meshes: Sequence[MeshInstance]) -> tuple[Light, ...]:
        """Returns the lights of mesh actors, and an environment for indirect light from a probe at their centroid.

        None of these lights casts shadows by rays. An estimated light is inside its own Gaussians, which would block
        it. The walls whose light the probe captured would block the environment.
        """
        on_meshes = self._roles.on_meshes
        lights = on_meshes if casting_lights(on_meshes) else (*self._casting_lights(meshes), *on_meshes)
        if self.config.relight and not any(isinstance(light, LightEnvironment) for light in lights):
            around = self._probes.at(centroid(meshes)).light()
            lights = (*lights, replace(around, intensity=1.0 - self.config.direct, name="around"))
        return tuple(replace(light, casts_shadow=False) for light in lights)


def _objects(scene: Scene) -> list[tuple[int, bytes]]:
    """Returns what identifies the captures and meshes of a scene, and their places, whatever their material."""
    splats = [(id(one.gaussians.means), one.transform.tobytes()) for one in scene.splats]
    return splats + [(id(one.mesh.positions), one.transform.tobytes()) for one in scene.meshes]


def _check_scene(scene: object) -> None:
    if not isinstance(scene, Scene) or not scene.splats:
        raise SceneError("AvatarLighter takes a Scene with captured Gaussians")


def _receivers(scene: Scene, is_lit: bool) -> list[int]:
    """Returns indices of the captures that shadow maps darken; if ``is_lit``, no captures with reflecting material."""
    rows = [row for row, instance in enumerate(scene.splats) if not is_lit or emits_capture_only(instance)]
    others = len(scene.splats) - len(rows)
    if others:
        _log.warning(
            "%d of %d captures reflect light: the renderer's shadow rays shadow them, shadow maps do not",
            others,
            len(scene.splats),
        )
    return rows


def _as_captured(instance: SplatInstance) -> SplatInstance:
    return instance if emits_capture_only(instance) else replace(instance, material=None, shadow_catcher=False)


def _mean_luminance(probe: EnvironmentProbe) -> float:
    """Returns the mean luminance of a probe's radiance over all directions, at least 0."""
    return max(float(SH_C0 * probe.coefficients[0] @ np.array(LUMINANCE)), 0.0)
