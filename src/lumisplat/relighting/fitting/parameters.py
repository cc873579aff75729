"""Parameters of a fit of lights: positions, directions and sizes of lights, base colours, exposure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from lumisplat.config.checks import check_flag, check_whole, is_number, suggestion
from lumisplat.errors import ConfigError, SceneError
from lumisplat.math.arrays import Doubles, read_only_view, unit_vector
from lumisplat.renderer.scene.materials import is_relit, material_of
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import AimedLight, Light, LightEnvironment, LightSpot, PlacedLight, RoundLight
from lumisplat.scene.ops.colors import base_colors, scale_light
from lumisplat.scene.scene import Scene

FIT_DEGREE_MAX = 4
"""Of an environment's harmonics: matt surfaces take in hardly more than degree 2 (Ramamoorthi and Hanrahan 2001)."""

POSITION_STEP = 0.004
"""Of the room's size: half the way between two pictures of a derivative."""

ANGLE_STEP = 0.02
"""The same of directions and cones, radians."""

Kind = Literal["position", "direction", "radius", "inner", "outer"]
_ANGLE_GAP = 1e-3
"""Least angle between the inner and the outer cone of a spot, radians."""
_SMALLEST = 1e-3
"""Radius, of the room's size, that lights with one do not fall below."""


@dataclass(frozen=True, slots=True)
class LightParameter:
    """One number of one light."""

    light: int
    """Number of the light in the scene."""
    kind: Kind
    axis: int = 0
    """Of a position x, y or z; of a direction one of two tangents."""
    step: float = 1.0
    """Half the way between the two pictures of its derivative."""
    least: float = 0.0
    """Of radii."""

    def applied(self, light: Light, amount: float) -> Light:
        """The light with this number larger by an amount, within its bounds."""
        if self.kind == "position":
            assert isinstance(light, PlacedLight)
            return replace(light, position=np.add(light.position, amount * np.eye(3)[self.axis]))
        if self.kind == "direction":
            assert isinstance(light, AimedLight)
            along = np.array(light.direction)
            tangent = _tangents(along)[self.axis]
            return replace(light, direction=math.cos(amount) * along + math.sin(amount) * tangent)
        if self.kind == "radius":
            assert isinstance(light, RoundLight)
            return replace(light, radius=max(light.radius + amount, self.least))
        assert isinstance(light, LightSpot)
        if self.kind == "inner":
            return replace(light, inner_angle=min(max(light.inner_angle + amount, 0.0), light.outer_angle - _ANGLE_GAP))
        outer = min(max(light.outer_angle + amount, light.inner_angle + _ANGLE_GAP), math.pi / 2.0)
        return replace(light, outer_angle=outer)


def light_parameters_of(
    number: int, light: Light, size: float, *, positions: bool, radii: bool, angles: bool
) -> list[LightParameter]:
    """The numbers of a light that are asked for.

    Args:
        number: Of the light in the scene.
        light: The light.
        size: Of the room, scene units.
        positions: Places, and of spots and suns directions.
        radii: Of points, spots and spheres that have one.
        angles: The cones of spots.
    """
    light_parameters: list[LightParameter] = []
    if positions and isinstance(light, PlacedLight):
        light_parameters += [LightParameter(number, "position", axis, POSITION_STEP * size) for axis in range(3)]
    if positions and isinstance(light, AimedLight):
        light_parameters += [LightParameter(number, "direction", axis, ANGLE_STEP) for axis in range(2)]
    if radii and isinstance(light, RoundLight) and light.radius > 0.0:
        least = _SMALLEST * size
        light_parameters.append(
            LightParameter(number, "radius", 0, max(POSITION_STEP * size, 0.1 * light.radius), least)
        )
    if angles and isinstance(light, LightSpot):
        light_parameters += [LightParameter(number, kind, 0, ANGLE_STEP) for kind in ("inner", "outer")]
    return light_parameters


def _tangents(along: Doubles) -> tuple[Doubles, Doubles]:
    """Two unit vectors, perpendicular to a unit one and to each other."""
    first = unit_vector(np.asarray(np.cross(along, np.eye(3)[int(np.abs(along).argmin())]), np.float64))
    return first, np.asarray(np.cross(along, first), np.float64)


_DARK = 1e-6
"""Linear colour up to which a channel is black, whatever it is multiplied by."""
_WHITE = 1.0 - 1e-4
"""Linear colour from which on a channel is white."""


@dataclass(frozen=True, slots=True)
class BaseColor:
    """A material of meshes, or the colours of a capture, which share one factor a channel."""

    name: str
    """Of the material, else of its first mesh; of the capture's instance."""
    meshes: tuple[int, ...] = ()
    """Mesh instances of the scene that have it."""
    capture: int | None = None
    """Splat instance of the scene, in place of meshes."""
    given: Gaussians | None = None
    """Its Gaussians as they came."""


def base_colors_of(scene: Scene, wanted: bool | Sequence[str]) -> list[BaseColor]:
    """The base colours that are asked for: of meshes' materials, equal names being one material, and of captures.

    Args:
        scene: The scene.
        wanted: True: all; names: only these.

    Raises:
        SceneError: A name is unknown, or there are neither meshes nor captures that light is reflected by.
    """
    if isinstance(wanted, bool) and not wanted:
        return []
    groups: dict[object, list[int]] = {}
    for number, instance in enumerate(scene.meshes):
        groups.setdefault(instance.mesh.material.name or id(instance.mesh.material), []).append(number)
    base_colors = [BaseColor(_name(scene, numbers[0]), tuple(numbers)) for numbers in groups.values()]
    taken = {base_color.name for base_color in base_colors}
    for number, instance in enumerate(scene.splats):
        if is_relit(instance) and not any(material_of(instance).emissive):
            name = instance.name or f"capture {number}"
            name = f"{name} (capture)" if name in taken else name
            base_colors.append(BaseColor(name, capture=number, given=instance.gaussians))
    if not base_colors:
        raise SceneError("base colours are those of meshes and of captures with a material, and the scene has neither")
    if isinstance(wanted, bool):
        return base_colors
    by_name = {base_color.name: base_color for base_color in base_colors}
    for name in wanted:
        if name not in by_name:
            raise SceneError(f"base_colors names the material {name!r}, {suggestion(name, by_name)}")
    return [by_name[name] for name in dict.fromkeys(wanted)]


def share_at_white(scene: Scene, base_color: BaseColor) -> float:
    """Of a capture's Gaussians, how many have become as bright as white in some channel."""
    if base_color.capture is None or base_color.given is None:
        return 0.0
    white = [(base_colors(some) >= _WHITE) for some in (scene.splats[base_color.capture].gaussians, base_color.given)]
    return float((white[0] & ~white[1]).any(axis=1).mean())


def colors_of(scene: Scene, base_colors: Sequence[BaseColor]) -> Doubles:
    """The base colours, linear, shape (M, 3); of a capture, the mean over its Gaussians."""
    return np.array([_color(scene, base_color) for base_color in base_colors], np.float64).reshape(-1, 3)


def with_base_colors(scene: Scene, colors: Mapping[BaseColor, Doubles]) -> Scene:
    """The scene with other base colours, each of shape (3,); all else stays the same objects.

    The Gaussians of a capture become brighter or darker by one factor a channel; none becomes brighter than 1 by it.
    """
    meshes, splats = list(scene.meshes), list(scene.splats)
    for base_color, color in colors.items():
        held = np.clip(color, 0.0, 1.0)
        for number in base_color.meshes:
            mesh = meshes[number].mesh
            material = replace(mesh.material, base_color=tuple(held.tolist()))
            meshes[number] = replace(meshes[number], mesh=replace(mesh, material=material))
        if base_color.capture is not None and base_color.given is not None:
            splats[base_color.capture] = replace(
                splats[base_color.capture], gaussians=_with_mean(base_color.given, held)
            )
    return replace(scene, meshes=tuple(meshes), splats=tuple(splats))


def _color(scene: Scene, base_color: BaseColor) -> Doubles:
    if base_color.capture is None:
        return np.array(scene.meshes[base_color.meshes[0]].mesh.material.base_color, np.float64)
    return base_colors(scene.splats[base_color.capture].gaussians).mean(axis=0)


def _with_mean(gaussians: Gaussians, color: Doubles) -> Gaussians:
    """Gaussians under one factor a channel, by which their mean is this colour."""
    own = base_colors(gaussians)
    mean = own.mean(axis=0)
    gain = np.divide(color, mean, out=np.ones(3), where=mean > _DARK)
    factors = np.minimum(gain, np.maximum(1.0 / np.maximum(own, _DARK), 1.0))
    if gaussians.albedo is None:
        return scale_light(gaussians, factors)
    return replace(gaussians, albedo=read_only_view((factors * own).astype(np.float32)))


def _name(scene: Scene, number: int) -> str:
    instance = scene.meshes[number]
    return instance.mesh.material.name or instance.name or instance.mesh.name or f"mesh {number}"


Exposure = float | Sequence[float] | Literal["fit"] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """What a caller asks for, as of `lumisplat.fit_lights`."""

    environment_degree: int | Literal["auto"] | None = "auto"
    intensities: bool = True
    keep_hues: bool = False
    positions: bool = False
    radii: bool = False
    angles: bool = False
    base_colors: bool | Sequence[str] = False
    exposure: Exposure = None

    def __post_init__(self) -> None:
        for name in ("intensities", "keep_hues", "positions", "radii", "angles"):
            check_flag(name, getattr(self, name))
        if self.environment_degree is not None and self.environment_degree != "auto":
            check_whole("environment_degree", self.environment_degree, 0, FIT_DEGREE_MAX)
        if isinstance(self.base_colors, str):
            raise ConfigError(f"base_colors is '{self.base_colors}', expected True or a list of names of materials")


@dataclass(frozen=True, slots=True, eq=False)
class FitTask:
    """The unknowns of a fit."""

    scene: Scene
    """Where it begins: without its environment, if harmonics replace it."""
    lights: tuple[int, ...]
    """Numbers of the lights that are fitted: those that are enabled."""
    degree: int | None
    """Of the environment's harmonics; None: there are none."""
    scales: bool
    """Whether powers of lights are unknown."""
    keeps_hues: bool
    """Whether the channels of a light share one unknown."""
    light_parameters: tuple[LightParameter, ...]
    base_colors: tuple[BaseColor, ...]
    anchors: bool
    """Whether the base colours' mean is held, for only its product with the lights' strength is known."""
    exposed: tuple[bool, ...]
    """Which photographs' exposures are unknown."""
    gains: Doubles
    """Factors of the exposures where it begins, shape (V,)."""
    size: float
    """Of the room, scene units: the longest side of the box that holds the scene."""
    low: Doubles
    """Of a box for lamps: that of the scene, and of the lamps as they are."""
    high: Doubles

    @classmethod
    def of(
        cls, scene: Scene, options: FitOptions, exposures: Sequence[float], *, shines: Callable[[], bool]
    ) -> FitTask:
        """The unknowns.

        Args:
            scene: The scene as it was given.
            options: What is asked for.
            exposures: Of the photographs' cameras, stops.
            shines: Says whether something in the scene shines that is not fitted.

        Raises:
            ConfigError: Nothing is asked for, or an exposure is none.
            SceneError: The scene has no lights to fit, is empty, or has no such material.
        """
        start, degree = _with_sh_environment(scene, options)
        lights = tuple(number for number, light in enumerate(start.lights) if light.enabled)
        if not lights and degree is None:
            raise SceneError(
                "the scene has no lights to fit: put lamps where they may be (ls.inverse.estimate_lights finds some of "
                "a capture), or ask for an environment_degree"
            )
        low, high = start.bulk_bounds()
        size = float((high - low).max())
        light_parameters = [
            parameter
            for number in lights
            for parameter in light_parameters_of(
                number,
                start.lights[number],
                size,
                positions=options.positions,
                radii=options.radii,
                angles=options.angles,
            )
        ]
        base_colors = base_colors_of(start, options.base_colors)
        fits_exposure = isinstance(options.exposure, str) and options.exposure == "fit"
        if not (options.intensities or light_parameters or base_colors or fits_exposure or degree is not None):
            raise ConfigError(
                "nothing is left to find: intensities are kept, and neither places, sizes, colours, an exposure nor an "
                "environment are asked for, or the scene has none that could change"
            )
        unknown = [fits_exposure] * len(exposures)
        if fits_exposure and options.intensities and not shines():
            unknown[0] = False  # else all lights could be twice as strong, and the exposure a stop less
        every = isinstance(options.base_colors, bool) or len(base_colors) == len(base_colors_of(start, True))
        fitted = [start.lights[number] for number in lights]
        placed = [light.position for light in fitted if isinstance(light, PlacedLight)]
        positions = np.array(placed, np.float64).reshape(-1, 3)
        return cls(
            scene=start,
            lights=lights,
            degree=degree,
            scales=options.intensities,
            keeps_hues=options.keep_hues,
            light_parameters=tuple(light_parameters),
            base_colors=tuple(base_colors),
            anchors=bool(base_colors) and options.intensities and every,
            exposed=tuple(unknown),
            gains=np.exp2(_stops(options.exposure, exposures)),
            size=size,
            low=np.minimum(low, positions.min(axis=0, initial=np.inf)),
            high=np.maximum(high, positions.max(axis=0, initial=-np.inf)),
        )


def _with_sh_environment(scene: Scene, options: FitOptions) -> tuple[Scene, int | None]:
    """The scene, without the environment that harmonics replace, and their degree."""
    own = [light for light in scene.lights if isinstance(light, LightEnvironment) and light.enabled]
    degree = options.environment_degree
    if degree == "auto":
        has_image = any(light.image is not None for light in own)
        degree = None if has_image or not options.intensities else 2
    if degree is None or not own:
        return scene, degree
    return replace(scene, lights=tuple(light for light in scene.lights if light is not own[0])), degree


def _stops(exposure: Exposure, cameras: Sequence[float]) -> Doubles:
    """The exposure of each photograph, as it is given, else as its camera says.

    Raises:
        ConfigError: It is neither a number, nor one a photograph, nor "fit".
    """
    if exposure is None or (isinstance(exposure, str) and exposure == "fit"):
        return np.array(cameras, np.float64)
    given = [exposure] * len(cameras) if is_number(exposure) else list(cast(Sequence[float], exposure))
    if len(given) != len(cameras) or not all(map(is_number, given)):
        raise ConfigError(
            f"exposure is {exposure!r}, expected stops, for all photographs or for each of the {len(cameras)}, or 'fit'"
        )
    if not np.isfinite(given).all():
        raise ConfigError(f"exposure is {exposure!r}, expected finite stops")
    return np.array(given, np.float64)
