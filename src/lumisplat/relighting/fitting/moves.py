"""The numbers of a light that its picture is not proportional to: where it is, where it shines, how large it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lumisplat.constants.light_fit import ANGLE_STEP, PLACE_STEP
from lumisplat.math.arrays import Doubles, unit_vector
from lumisplat.scene.lights import AimedLight, Light, LightSpot, PlacedLight, RoundLight

Kind = Literal["position", "direction", "radius", "inner", "outer"]
_ANGLE_GAP = 1e-3
"""Least angle between the inner and the outer cone of a spot, radians."""
_SMALLEST = 1e-3
"""Radius, of the room's size, that lights with one do not fall below."""


@dataclass(frozen=True, slots=True)
class Move:
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


def moves_of(number: int, light: Light, size: float, *, positions: bool, radii: bool, angles: bool) -> list[Move]:
    """The numbers of a light that are asked for.

    Args:
        number: Of the light in the scene.
        light: The light.
        size: Of the room, scene units.
        positions: Places, and of spots and suns directions.
        radii: Of points, spots and spheres that have one.
        angles: The cones of spots.
    """
    moves: list[Move] = []
    if positions and isinstance(light, PlacedLight):
        moves += [Move(number, "position", axis, PLACE_STEP * size) for axis in range(3)]
    if positions and isinstance(light, AimedLight):
        moves += [Move(number, "direction", axis, ANGLE_STEP) for axis in range(2)]
    if radii and isinstance(light, RoundLight) and light.radius > 0.0:
        least = _SMALLEST * size
        moves.append(Move(number, "radius", 0, max(PLACE_STEP * size, 0.1 * light.radius), least))
    if angles and isinstance(light, LightSpot):
        moves += [Move(number, kind, 0, ANGLE_STEP) for kind in ("inner", "outer")]
    return moves


def _tangents(along: Doubles) -> tuple[Doubles, Doubles]:
    """Two unit vectors, perpendicular to a unit one and to each other."""
    first = unit_vector(np.asarray(np.cross(along, np.eye(3)[int(np.abs(along).argmin())]), np.float64))
    return first, np.asarray(np.cross(along, first), np.float64)
