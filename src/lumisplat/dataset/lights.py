"""Random lights for views: rotated environments, suns and point lights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lumisplat.config.dataset import DatasetLights, PosePlaces
from lumisplat.dataset.draws import Draws
from lumisplat.dataset.space import Space, level_axes
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import axis_rotation, multiply_quaternions, quaternions_from_matrices
from lumisplat.scene.lights import Light, LightDirectional, LightEnvironment, LightPoint

_LIGHT_TRIES = 32
"""Number of random positions tried for a point light in the free space of a scene. If none is free, the last is used.
"""
_LIGHT_NEAREST = 0.25
"""The intensity of a point light is computed from its distance to the scene's middle, or this minimum if that is
larger.

The minimum is a fraction of the diagonal of the scene's box. Without it, a light near the middle would get almost no
intensity."""
_LIGHT_CLEARANCE = 0.01
"""Distance that a point light keeps from all surfaces, as a fraction of the diagonal of the scene's box."""


class LightSampler:
    """Samples random lights for each view.

    Args:
        config: Ranges of the lights.
        space: Extent and free space of the scene.
        environments: Environments loaded from files.
        where: How cameras are placed. With `PosePlaces.DOME`, point lights are around the scene, else inside it.
        needs_light: True if the scene has surfaces that are black without light.
    """

    def __init__(
        self,
        config: DatasetLights,
        space: Space,
        environments: Sequence[LightEnvironment],
        *,
        where: PosePlaces,
        needs_light: bool,
    ) -> None:
        self._config, self._space, self._environments, self._where = config, space, list(environments), where
        scene_lights = [light for light in space.scene.lights if light.enabled] if config.own else []
        is_dark = needs_light and not scene_lights and not environments and config.points[1] == 0
        self._suns = config.suns if config.suns is not None else (1, 1) if is_dark else (0, 0)
        self._scene_lights = scene_lights

    @property
    def has_lights(self) -> bool:
        """True if a view may have lights: those of the scene, environments, suns or point lights."""
        return bool(self._scene_lights or self._environments or self._suns[1] or self._config.points[1])

    def lights(self, draws: Draws) -> tuple[Light, ...]:
        """Returns the lights of a view: those of the scene, then random ones (environment, ambient, suns, points)."""
        config = self._config
        angle, brightness = 2.0 * math.pi * draws.unit() * config.turned, draws.factor(config.brightness)
        selector, ambient = draws.unit(), draws.between(config.ambient)
        ambient_color = self._color(draws)
        suns = [self._sun(draws, number) for number in range(draws.whole(self._suns))]
        points = [self._point_light(draws, number) for number in range(draws.whole(config.points))]
        lights = [
            self._rotated(light, angle, brightness) for light in self._scene_lights if not self._is_replaced(light)
        ]
        if self._environments:
            chosen = self._environments[int(selector * len(self._environments))]
            lights.append(self._rotated(chosen, angle, brightness))
        elif (suns or points) and not any(isinstance(light, LightEnvironment) for light in lights) and ambient > 0.0:
            lights.append(LightEnvironment(color=ambient_color, intensity=ambient, visible=False, name="sky"))
        return (*lights, *suns, *points)

    def exposure(self, draws: Draws) -> float:
        """Returns a random exposure for the camera of a view, stops."""
        return draws.between(self._config.exposure)

    def _is_replaced(self, light: Light) -> bool:
        """Returns True for an environment of the scene that is left out, because environments were given as files."""
        return isinstance(light, LightEnvironment) and bool(self._environments)

    def _rotated(self, light: Light, angle: float, brightness: float) -> Light:
        """Rotates an environment about the up axis and multiplies its intensity; returns other lights unchanged.

        Args:
            light: A light.
            angle: Angle of the rotation, radians.
            brightness: Factor of the intensity.
        """
        if not isinstance(light, LightEnvironment):
            return light
        rotation = quaternions_from_matrices(axis_rotation(self._space.up, angle)[None])[0]
        wxyz = multiply_quaternions(rotation, np.asarray(light.rotation_wxyz, dtype=np.float64)[None])[0]
        return replace(light, rotation_wxyz=tuple(wxyz), intensity=light.intensity * brightness)

    def _sun(self, draws: Draws, number: int) -> LightDirectional:
        config, up = self._config, self._space.up
        azimuth, elevation = 2.0 * math.pi * draws.unit(), math.radians(draws.between(config.sun_elevation))
        first, second = level_axes(up)
        towards = math.sin(elevation) * up
        towards = towards + math.cos(elevation) * (math.cos(azimuth) * first + math.sin(azimuth) * second)
        return LightDirectional(
            direction=tuple(-towards),
            color=self._color(draws),
            intensity=draws.between(config.sun_lux),
            angle=math.radians(draws.between(config.sun_angle)),
            name=f"sun {number}",
        )

    def _point_light(self, draws: Draws, number: int) -> LightPoint:
        position = self._light_position(draws)
        distance = max(float(np.linalg.norm(position - self._space.middle)), _LIGHT_NEAREST * self._space.diagonal)
        return LightPoint(
            position=tuple(position),
            color=self._color(draws),
            intensity=draws.between(self._config.point_lux) * distance * distance,
            name=f"lamp {number}",
        )

    def _light_position(self, draws: Draws) -> Doubles:
        """Returns a random world-space position for a point light.

        If cameras are placed around the scene, the light is above and around the scene; otherwise it is in the upper
        part of the scene's free space.
        """
        space = self._space
        if self._where is PosePlaces.DOME:
            direction = draws.direction()
            direction += (abs(direction @ space.up) - direction @ space.up) * space.up
            return space.middle + draws.between((0.6, 1.2)) * space.diagonal * direction
        position = space.middle
        for _ in range(_LIGHT_TRIES):
            position = space.low + draws.units(3) * (space.high - space.low)
            height = space.bottom + draws.between((0.5, 0.95)) * (space.top - space.bottom)
            position = position + (height - position @ space.up) * space.up
            if space.is_free(position, _LIGHT_CLEARANCE * space.diagonal):
                break
        return position

    def _color(self, draws: Draws) -> tuple[float, float, float]:
        red, green, blue = (float(value) for value in 1.0 - self._config.tint * draws.units(3))
        return red, green, blue
