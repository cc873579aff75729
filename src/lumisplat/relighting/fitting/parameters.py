"""Unknowns of a light fit: positions, directions and sizes of lights, base colours and exposures."""

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
"""Largest SH degree of a fitted environment; diffuse surfaces hardly depend on degrees above 2 (Ramamoorthi and
Hanrahan 2001)."""

POSITION_STEP = 0.004
"""Step to either side, relative to the scene's size, in central differences of renders with respect to a light's
position."""

ANGLE_STEP = 0.02
"""Step to either side, radians, in central differences of renders with respect to a light's direction or cone angles.
"""

Kind = Literal["position", "direction", "radius", "inner", "outer"]
_ANGLE_GAP = 1e-3
"""Smallest difference between the outer and the inner cone angle of a spot, radians."""
_SMALLEST = 1e-3
"""Lower bound of fitted radii of lights, relative to the size of the scene."""


@dataclass(frozen=True, slots=True)
class LightParameter:
    """One scalar of a light that Gauss-Newton fits: a coordinate, a tilt of the direction, a radius or a cone angle."""

    light: int
    """Index, in the scene's lights, of the light that has the parameter."""
    kind: Kind
    axis: int = 0
    """Coordinate axis of a position, 0, 1, 2 for x, y, z; number, 0 or 1, of the tangent along which a direction is
    tilted; otherwise 0."""
    step: float = 1.0
    """Step to either side in central differences: scene units for positions and radii, radians for directions and
    angles."""
    least: float = 0.0
    """Smallest radius, scene units, if the parameter is a radius; other parameters ignore this field."""

    def applied(self, light: Light, amount: float) -> Light:
        """Returns the light with ``amount`` added to the parameter; radii and angles stay within their bounds."""
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
    """Returns the positions, directions, radii and angles of a light that are searched by Gauss-Newton.

    Args:
        number: Index of the light in the scene.
        light: The light.
        size: Size of the scene, scene units.
        positions: Whether positions, and directions of spots and suns, are fitted.
        radii: Whether radii above 0 of points, spots and spheres are fitted.
        angles: Whether cone angles of spots are fitted.
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
    """Returns two unit vectors perpendicular to a unit vector and to each other."""
    first = unit_vector(np.asarray(np.cross(along, np.eye(3)[int(np.abs(along).argmin())]), np.float64))
    return first, np.asarray(np.cross(along, first), np.float64)


_DARK = 1e-6
"""Linear mean colour of a capture up to which a channel is black, so that no factor can change it."""
_WHITE = 1.0 - 1e-4
"""Linear colour of a Gaussian from which a channel counts as white, so that no factor can make it brighter."""


@dataclass(frozen=True, slots=True)
class BaseColor:
    """One base colour to fit: of a material of meshes, or of a capture, with one factor for all its Gaussians."""

    name: str
    """Name of the material, or else of the first mesh with it; for a capture, name of its instance."""
    meshes: tuple[int, ...] = ()
    """Indices of the scene's mesh instances with this material; empty for a capture."""
    capture: int | None = None
    """Index of the scene's splat instance; None if the base colour is that of a material of meshes."""
    given: Gaussians | None = None
    """Gaussians of the capture before the fit, on which the fitted factors act; None for a material of meshes."""


def base_colors_of(scene: Scene, wanted: bool | Sequence[str]) -> list[BaseColor]:
    """Returns the base colours to fit: one per material of meshes, by the material's name, and one per capture.

    Args:
        scene: The scene.
        wanted: True: all; a list: base colours with these names; False: none.

    Raises:
        SceneError: A name is unknown, or the scene has neither meshes nor captures that reflect light.
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
        raise SceneError("base_colors fits meshes and captures with a material, but the scene has neither")
    if isinstance(wanted, bool):
        return base_colors
    by_name = {base_color.name: base_color for base_color in base_colors}
    for name in wanted:
        if name not in by_name:
            raise SceneError(f"base_colors names the material {name!r}, {suggestion(name, by_name)}")
    return [by_name[name] for name in dict.fromkeys(wanted)]


def share_at_white(scene: Scene, base_color: BaseColor) -> float:
    """Returns the fraction of a capture's Gaussians with a channel that became white in the fit."""
    if base_color.capture is None or base_color.given is None:
        return 0.0
    white = [(base_colors(some) >= _WHITE) for some in (scene.splats[base_color.capture].gaussians, base_color.given)]
    return float((white[0] & ~white[1]).any(axis=1).mean())


def colors_of(scene: Scene, base_colors: Sequence[BaseColor]) -> Doubles:
    """Returns M linear base colours, shape (M, 3): of a material, or the mean over a capture's Gaussians."""
    return np.array([_color(scene, base_color) for base_color in base_colors], np.float64).reshape(-1, 3)


def with_base_colors(scene: Scene, colors: Mapping[BaseColor, Doubles]) -> Scene:
    """Returns the scene with base colours replaced, each of shape (3,); everything else stays the same object.

    The Gaussians of a capture are multiplied by one factor per channel, but not beyond 1.
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
        return np.array(scene.meshes[base_color.meshes[0]].mesh.material.mesh_color, np.float64)
    return base_colors(scene.splats[base_color.capture].gaussians).mean(axis=0)


def _with_mean(gaussians: Gaussians, color: Doubles) -> Gaussians:
    """Returns Gaussians whose mean base colour is ``color``: scaled by one factor per channel, and clamped to 1."""
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
    """Options of a fit, as the caller gave them to `lumisplat.fit_lights`."""

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
    """The unknowns of a light fit, and the scene and exposures from which the fit starts."""

    scene: Scene
    """Scene from which the fit starts, without its environment if an SH environment replaces that."""
    lights: tuple[int, ...]
    """Indices, among the scene's lights, of the lights that are fitted: all that are enabled."""
    degree: int | None
    """Degree of the SH environment that is fitted; None: no SH environment."""
    scales: bool
    """True if intensities and colours of lights are fitted; False: they keep those of the scene."""
    keeps_hues: bool
    """True if a light's colour is held and only its intensity fitted; False: each channel has its own unknown."""
    light_parameters: tuple[LightParameter, ...]
    base_colors: tuple[BaseColor, ...]
    anchors: bool
    """True if all base colours and the lights' powers are fitted. The product of the base colours is then held in each
    channel, because images show only products of base colour and power.
    """
    exposed: tuple[bool, ...]
    """True for each image whose exposure is fitted."""
    gains: Doubles
    """Factors ``2^exposure`` of the V images before the fit, shape (V,)."""
    size: float
    """Size of the scene, scene units: longest side of its box without stray Gaussians."""
    low: Doubles
    """Lower corner, world space, of the box in which lights may move. The box is that of the scene without stray
    Gaussians, enlarged to contain the lights at the start.
    """
    high: Doubles

    @classmethod
    def of(
        cls, scene: Scene, options: FitOptions, exposures: Sequence[float], *, shines: Callable[[], bool]
    ) -> FitTask:
        """Collects the unknowns that the options ask to fit.

        Args:
            scene: The scene as the caller gave it.
            options: The caller's options.
            exposures: Exposures of the images' cameras, stops.
            shines: Returns whether surfaces of the scene emit light. The emission fixes the scale, so that all
                exposures can be fitted.

        Raises:
            ConfigError: There is nothing to fit, or an exposure is invalid.
            SceneError: The scene has no lights to fit, is empty, or has no material of a given name.
        """
        start, degree = _with_sh_environment(scene, options)
        lights = tuple(number for number, light in enumerate(start.lights) if light.enabled)
        if not lights and degree is None:
            raise SceneError(
                "the scene has no lights to fit: add lights at likely positions (ls.inverse.estimate_lights finds "
                "those of a capture), or set environment_degree"
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
                "nothing to fit: intensities is False, and neither positions, radii, angles, base_colors, exposure nor "
                "environment_degree asks for anything that the scene has"
            )
        unknown = [fits_exposure] * len(exposures)
        if fits_exposure and options.intensities and not shines():
            unknown[0] = False  # a stop less exposure equals lights twice as strong
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
    """Returns the scene without an environment that an SH environment replaces, and the SH degree; None: no SH."""
    own = [light for light in scene.lights if isinstance(light, LightEnvironment) and light.enabled]
    degree = options.environment_degree
    if degree == "auto":
        has_image = any(light.image is not None for light in own)
        degree = None if has_image or not options.intensities else 2
    if degree is None or not own:
        return scene, degree
    return replace(scene, lights=tuple(light for light in scene.lights if light is not own[0])), degree


def _stops(exposure: Exposure, cameras: Sequence[float]) -> Doubles:
    """Returns the exposure of each image in stops: the caller's, or else that of the image's camera.

    Raises:
        ConfigError: The exposure is neither a number, nor one number for each image, nor "fit".
    """
    if exposure is None or (isinstance(exposure, str) and exposure == "fit"):
        return np.array(cameras, np.float64)
    given = [exposure] * len(cameras) if is_number(exposure) else list(cast(Sequence[float], exposure))
    if len(given) != len(cameras) or not all(map(is_number, given)):
        raise ConfigError(
            f"exposure is {exposure!r}, expected stops, for all images or for each of the {len(cameras)}, or 'fit'"
        )
    if not np.isfinite(given).all():
        raise ConfigError(f"exposure is {exposure!r}, expected finite stops")
    return np.array(given, np.float64)
