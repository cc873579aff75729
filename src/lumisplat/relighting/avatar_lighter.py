"""Avatars in a captured scene: it takes their shadows, they take its light (docs/method/relighting.md)."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.config import AvatarLightingConfig, RenderConfig, check_kind
from lumisplat.constants import LUMINANCE, SH_C0
from lumisplat.errors import SceneError
from lumisplat.relighting.actor_shadows import ActorShadows, casting_lights
from lumisplat.relighting.light_estimation import LightEstimate, estimate_lights
from lumisplat.relighting.probe import EnvironmentProbe
from lumisplat.relighting.probe_transfer import relight
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.renderer.scene.materials import emits_capture_only
from lumisplat.runtime.launcher import Progress
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.estimate_normals import estimate_normals
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance, checked_lights

_log = logging.getLogger("lumisplat")

_DARK = 0.3
"""Mean light, display white is 1, below which actors come out less than half as bright as they are shown."""
_PROBES_HELD = 64
"""Probes that are kept, at most: more than there are actors."""

Actor = SplatInstance | MeshInstance
"""What moves through the scene, as it is at one time."""


class AvatarLighter:
    """Lights actors in a captured scene, and darkens the scene where they stand in its light.

    The captured sets of the scene receive shadows from all actors, through a deep shadow map for each light that is
    rebuilt a frame, and from the scene's own meshes, which count as put there after the capture. Actors made of
    Gaussians are relit by a probe of the scene at their place. They do not shadow each other, nor themselves.

    Actors that are meshes stay meshes. Where there are any, the frame is lit: the lights and, for the rest, a probe at
    the meshes' place light all meshes of the scene, without shadows on these, and captured sets are shown as captured.
    A scene that has lights and something that they light already, a mesh or a set with a material, is another matter:
    its lights stay as they are, and what reflects them gets its shadows from the renderer's rays, and none from here.

    Not safe to share between threads.

    Args:
        scene: What does not move, as captured.
        lights: Where the light in the captured colours comes from; those that cast no shadows, and an environment, only
            light meshes. None: the scene's own, or if none of them casts shadows, those that `estimate_lights` finds
            about the actors of the first frame.
        config: Settings; None: the defaults.
        background: Display-referred sRGB that probes see behind everything, 0..1 each.
        device: As for `create_renderer`.
        progress: Called with a label and a fraction 0..1, while kernels compile.

    Raises:
        ConfigError: ``config`` is no AvatarLightingConfig.
        DeviceError: There is no such device.
        SceneError: The scene is none, it has no captured sets, ``lights`` is no list of lights, or none of them casts
            shadows from somewhere.
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
        if not isinstance(scene, Scene) or not scene.splats:
            raise SceneError("an AvatarLighter takes a Scene that has captured Gaussians")
        self.scene = scene
        """What does not move."""
        self.estimate: LightEstimate | None = None
        """Lights that were found, if none were given."""
        self.lights: tuple[Light, ...] | None = None
        """Those that cast the shadows of actors; None as long as they have not been looked for."""
        self._device, self._progress = device, progress
        self._around = RenderConfig(background=background)
        shining = tuple(light for light in scene.lights if light.enabled)
        # Lights of a scene where nothing reflects them yet can only be those that it was captured in.
        are_captured = lights is None and not scene.meshes and all(map(emits_capture_only, scene.splats))
        self._keeps_lights = bool(shining) and not are_captured
        self._receivers = _receivers(scene, self._keeps_lights)
        self._shadows: ActorShadows | None = None
        self._renderer: Renderer | None = None
        self._probes: dict[bytes, EnvironmentProbe] = {}
        self._normals: dict[int, tuple[Gaussians, npt.NDArray[np.floating]]] = {}
        given = checked_lights(lights) if lights is not None else shining if are_captured else ()
        self._given = tuple(light for light in given if light.enabled)
        self._told_dark = False
        own = casting_lights(scene.lights)
        if lights is not None:
            self.lights = casting_lights(given)
            if not self.lights:
                raise SceneError("none of the lights is enabled, casts shadows and shines from somewhere")
        elif own:
            self.lights = own

    def light(
        self,
        actors: Iterable[Actor | Gaussians | Mesh],
        *,
        casts_shadow: Sequence[bool] | None = None,
        relit: Sequence[bool] | None = None,
    ) -> Scene:
        """The scene with actors in it, for one frame.

        Assets that no shadow falls on stay the same objects, so that a renderer does not upload them again; the same
        actors give the same scene, to the bit.

        Args:
            actors: In world space, or placed there.
            casts_shadow: Whether each darkens the scene; None: all do.
            relit: Whether each takes the light of its place; None: all do.

        Returns:
            The captured sets, darkened, and the actors after them; meshes likewise.

        Raises:
            DeviceError: The device is out of memory.
            SceneError: An actor is neither Gaussians nor a mesh, flags are of another number, or no light is found.
        """
        placed = _placed(actors)
        casting = [a for a, flag in zip(placed, _flags("casts_shadow", casts_shadow, len(placed)), strict=True) if flag]
        takes = _flags("relit", relit, len(placed))
        shown = {id(a.gaussians) for a in placed if isinstance(a, SplatInstance)}
        self._normals = {key: held for key, held in self._normals.items() if key in shown}
        # What reflects is lit by the scene's lights, where there are some.
        reflecting = any(isinstance(a, SplatInstance) and not emits_capture_only(a) for a in placed)
        keeps = self._keeps_lights or (reflecting and bool(self.scene.lights))
        splats = [
            self._relit(a) if flag and not (keeps and not emits_capture_only(a)) else a
            for a, flag in zip(placed, takes, strict=True)
            if isinstance(a, SplatInstance)
        ]
        meshes = [a for a in placed if isinstance(a, MeshInstance)]
        static = list(self.scene.splats)
        if self.config.shadows and self._receivers and (casting or self.scene.meshes):
            for row, instance in zip(self._receivers, self._darkened(casting), strict=True):
                static[row] = instance
        lights = self.scene.lights
        if not keeps:
            # An environment is seen behind everything; what there is besides has nothing to light.
            lights = tuple(light for light in lights if isinstance(light, LightEnvironment))
        if meshes and not keeps:
            # What reflected light in another frame's lights is shown as captured here: only meshes are to be lit.
            static, splats = [_as_captured(i) for i in static], [_as_captured(i) for i in splats]
            lights = self._mesh_lights(meshes)
        return Scene(splats=(*static, *splats), meshes=(*self.scene.meshes, *meshes), lights=lights)

    def _darkened(self, casting: list[Actor]) -> list[SplatInstance]:
        """The receivers, under what casters and the scene's own meshes leave of the lights."""
        if self._shadows is None:
            receivers = [self.scene.splats[row] for row in self._receivers]
            self._shadows = ActorShadows(
                receivers,
                self._found_lights(casting),
                self.scene.meshes,
                config=self.config,
                device=self._device,
                progress=self._progress,
            )
        return self._shadows.darkened(casting)

    def _found_lights(self, actors: Sequence[Actor]) -> tuple[Light, ...]:
        if self.lights is None:
            place = _centroid(actors) if actors else np.mean(self.scene.bounds(), axis=0)
            self.estimate = estimate_lights(self.scene, place, self.config.light_count, config=self.config.estimation)
            # What the lights give, and what comes from elsewhere, is together what the place gets.
            share = self.config.direct * np.pi * _mean_luminance(self._probe(place))
            scale = share / self.config.estimation.irradiance
            self.lights = tuple(replace(light, intensity=scale * light.intensity) for light in self.estimate.lights)
        return self.lights

    def _relit(self, actor: SplatInstance) -> SplatInstance:
        """An actor in the light of its place."""
        if not self.config.relight:
            return actor
        # Normals of what only moves stay the same, and are slow to tell from shapes alone.
        key, gaussians = id(actor.gaussians), actor.gaussians
        if key not in self._normals:
            self._normals[key] = gaussians, estimate_normals(gaussians, self.config.transfer.normals)
        probe = self._probe(_centroid([actor]))
        self._tell_dark(probe)
        return relight(actor, probe, self.config.transfer, self._normals[key][1])

    def _tell_dark(self, probe: EnvironmentProbe) -> None:
        """Says so, once, where actors come out much darker than they are."""
        mean = _mean_luminance(probe)
        if not self._told_dark and mean * self.config.transfer.gamma < _DARK:
            self._told_dark = True
            advice = f": a gamma of up to {1.0 / mean:.2g} brightens them" if mean > 1e-3 else ""
            _log.warning("actors stand in %.2g of display white, and come out as dark%s", mean, advice)

    def _mesh_lights(self, meshes: Sequence[MeshInstance]) -> tuple[Light, ...]:
        """The lights for meshes, and around them what else of the scene's light there is.

        None casts shadows by rays: a lamp that was found is inside its own Gaussians, and what the probe has gathered
        came from the very walls that would block it.
        """
        lights = self._given if casting_lights(self._given) else (*self._found_lights(meshes), *self._given)
        if self.config.relight and not any(isinstance(light, LightEnvironment) for light in lights):
            around = self._probe(_centroid(meshes)).light()
            lights = (*lights, replace(around, intensity=1.0 - self.config.direct, name="around"))
        return tuple(replace(light, casts_shadow=False) for light in lights)

    def _probe(self, place: npt.NDArray[np.float64]) -> EnvironmentProbe:
        """Of the scene, without actors; one that stands still is not asked for again."""
        key = place.tobytes()
        if key not in self._probes:
            if self._renderer is None:
                self._renderer = create_renderer(self._around, self._device, progress=self._progress)
            if len(self._probes) >= _PROBES_HELD:
                self._probes.clear()
            self._probes[key] = EnvironmentProbe.capture(self.scene, place, renderer=self._renderer)
        return self._probes[key]


def _receivers(scene: Scene, lit: bool) -> list[int]:
    """Rows of the splat instances that take shadows from maps."""
    rows = [row for row, instance in enumerate(scene.splats) if not lit or emits_capture_only(instance)]
    others = len(scene.splats) - len(rows)
    if others:
        _log.warning("%d splat sets take their shadows from the renderer's rays, and none from shadow maps", others)
    return rows


def _as_captured(instance: SplatInstance) -> SplatInstance:
    return instance if emits_capture_only(instance) else replace(instance, material=None, shadow_only=False)


def _placed(actors: Iterable[Actor | Gaussians | Mesh]) -> list[Actor]:
    if not isinstance(actors, Iterable):
        raise SceneError(f"actors is one {type(actors).__name__}, expected a list")
    placed: list[Actor] = []
    for actor in actors:
        if isinstance(actor, Gaussians):
            placed.append(SplatInstance(actor))
        elif isinstance(actor, Mesh):
            placed.append(MeshInstance(actor))
        elif isinstance(actor, SplatInstance | MeshInstance):
            placed.append(actor)
        else:
            raise SceneError(f"actors holds a {type(actor).__name__}, expected Gaussians, a Mesh or an instance of one")
    return placed


def _flags(name: str, flags: Sequence[bool] | None, count: int) -> Sequence[bool]:
    if flags is None:
        return [True] * count
    if not isinstance(flags, Sequence) or not all(isinstance(flag, bool | np.bool_) for flag in flags):
        raise SceneError(f"{name} is {flags!r:.60}, expected a list of True and False, one an actor")
    if len(flags) != count:
        raise SceneError(f"{name} has {len(flags)} entries, expected {count}, one an actor")
    return flags


def _centroid(actors: Sequence[Actor]) -> npt.NDArray[np.float64]:
    """World-space mean of the Gaussians of all actors, weighted by opacity; meshes by their vertices, shape (3,)."""
    sums, total = np.zeros(3), 0.0
    for actor in actors:
        if isinstance(actor, SplatInstance):
            points, weights = actor.gaussians.means, actor.gaussians.opacities.astype(np.float64)
        else:
            points, weights = actor.mesh.positions, np.ones(actor.mesh.vertex_count)
        # All transparent: they have a place nevertheless.
        weights = weights if weights.any() else np.ones_like(weights)
        world = points @ actor.transform[:3, :3].T + actor.transform[:3, 3]
        sums += weights @ world
        total += weights.sum()
    return sums / total


def _mean_luminance(probe: EnvironmentProbe) -> float:
    """Of all directions' radiance."""
    return max(float(SH_C0 * probe.coefficients[0] @ np.array(LUMINANCE)), 0.0)
