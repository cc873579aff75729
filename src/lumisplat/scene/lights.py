"""Lights, in the units of glTF's KHR_lights_punctual: candela and lux; lights with an area have radiance.

All lights have a ``color`` (linear Rec.709, at least 0, multiplied with the intensity), ``intensity``, ``enabled``,
``casts_shadow`` and ``name``. Positions and directions are in world space.

Each class states what the rest of the package asks of a light: ``kind``, its ``type`` in scene files; ``unit``, that of
its ``intensity``; ``aim_fields``, the fields that say where it shines; ``aim_keys``, what may be given in their place.
The unions below the classes say which of them have a position, a direction, a radius or an area.
"""

from __future__ import annotations

import math
from dataclasses import InitVar, dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.constants import LIGHT_DISTANCE_MIN
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FLOAT32_MAX, Doubles, Flags, FloatArray, float_array, host_array, unit_vector
from lumisplat.scene.checks import check_flag
from lumisplat.scene.light_aims import Vector, facing_edges, towards, vector


@dataclass(frozen=True, slots=True, eq=False)
class LightPoint:
    """A light that shines equally in all directions.

    Irradiance at distance d is ``intensity / d^2``, faded out towards ``range`` by the window that glTF recommends,
    ``clamp(1 - (d / range)^4, 0, 1)``.

    Raises:
        SceneError: A value is not finite, negative or of the wrong shape.
    """

    kind: ClassVar[str] = "point"
    unit: ClassVar[str] = "cd"
    aim_fields: ClassVar[tuple[str, ...]] = ()
    aim_keys: ClassVar[tuple[str, ...]] = ()

    position: Vector
    color: Vector = (1.0, 1.0, 1.0)
    intensity: float = 1.0
    """Candela."""
    range: float = math.inf
    """Distance beyond which it lights nothing, scene units, > 0."""
    radius: float = 0.0
    """Radius of the sphere that it is for soft shadows, scene units; 0: a point."""
    enabled: bool = field(default=True, kw_only=True)
    casts_shadow: bool = field(default=True, kw_only=True)
    name: str = field(default="", kw_only=True)

    if TYPE_CHECKING:  # what is accepted; the fields above are what it becomes

        def __init__(
            self,
            position: npt.ArrayLike,
            color: npt.ArrayLike = (1.0, 1.0, 1.0),
            intensity: float = 1.0,
            range: float = math.inf,
            radius: float = 0.0,
            *,
            enabled: bool = True,
            casts_shadow: bool = True,
            name: str = "",
        ) -> None: ...

    def __post_init__(self) -> None:
        _check_shared(self)
        object.__setattr__(self, "position", vector("position", self.position))
        _check_number("range", self.range, 0.0, above=True, finite=False)
        _check_number("radius", self.radius, 0.0)

    def candela(self, offsets: Doubles) -> Doubles:
        """Returns candela at an intensity of 1, as if all of the light shone from its position; shape (N,).

        Args:
            offsets: From the light's position, scene units, shape (N, 3).
        """
        return _window(self.range, _squared(offsets))


@dataclass(frozen=True, slots=True, eq=False)
class LightSpot:
    """A point light that shines into a cone: at full intensity within ``inner_angle``, fading out to ``outer_angle``.

    Raises:
        SceneError: A value is not finite, negative or of the wrong shape, the direction has no length, or the angles
            are not ``0 <= inner < outer <= pi / 2``.
    """

    kind: ClassVar[str] = "spot"
    unit: ClassVar[str] = "cd"
    aim_fields: ClassVar[tuple[str, ...]] = ("direction",)
    aim_keys: ClassVar[tuple[str, ...]] = ("target",)

    position: Vector
    direction: Vector = (0.0, 0.0, 0.0)
    """Direction in which it shines, of any length; normalised. Needed unless there is a ``target``."""
    color: Vector = (1.0, 1.0, 1.0)
    intensity: float = 1.0
    """Candela along the axis."""
    range: float = math.inf
    """Distance beyond which it lights nothing, scene units, > 0."""
    inner_angle: float = 0.0
    """Angle from the axis, radians."""
    outer_angle: float = math.pi / 4.0
    """Angle from the axis, radians."""
    radius: float = 0.0
    """Radius of the sphere that it is for soft shadows, scene units; 0: a point."""
    enabled: bool = field(default=True, kw_only=True)
    casts_shadow: bool = field(default=True, kw_only=True)
    name: str = field(default="", kw_only=True)
    target: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """In place of ``direction``: world position at which it shines, shape (3,)."""

    if TYPE_CHECKING:  # what is accepted; the fields above are what it becomes

        def __init__(  # noqa: PLR0917
            self,
            position: npt.ArrayLike,
            direction: npt.ArrayLike = (0.0, 0.0, 0.0),
            color: npt.ArrayLike = (1.0, 1.0, 1.0),
            intensity: float = 1.0,
            range: float = math.inf,
            inner_angle: float = 0.0,
            outer_angle: float = math.pi / 4.0,
            radius: float = 0.0,
            *,
            enabled: bool = True,
            casts_shadow: bool = True,
            name: str = "",
            target: npt.ArrayLike | None = None,
        ) -> None: ...

    def __post_init__(self, target: npt.ArrayLike | None) -> None:
        _check_shared(self)
        object.__setattr__(self, "position", vector("position", self.position))
        object.__setattr__(self, "direction", towards("a spot", self.direction, self.position, target))
        _check_number("range", self.range, 0.0, above=True, finite=False)
        _check_number("radius", self.radius, 0.0)
        for name in ("inner_angle", "outer_angle"):
            _check_number(name, getattr(self, name), 0.0)
        if not self.inner_angle < self.outer_angle <= math.pi / 2.0 + 1e-6:
            raise SceneError(
                f"a spot's inner_angle is {self.inner_angle:g} and its outer_angle {self.outer_angle:g}, "
                "expected 0 <= inner < outer <= pi / 2 (radians)"
            )

    def candela(self, offsets: Doubles) -> Doubles:
        """As `LightPoint.candela`."""
        distance2 = _squared(offsets)
        inner, outer = math.cos(self.inner_angle), math.cos(self.outer_angle)
        cosine = offsets @ np.array(self.direction) / np.sqrt(distance2)
        return _window(self.range, distance2) * np.clip((cosine - outer) / max(inner - outer, 1e-30), 0.0, 1.0) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class LightDirectional:
    """Parallel light from infinitely far away: the sun.

    Raises:
        SceneError: A value is not finite, negative or of the wrong shape, the direction has no length, or the angle is
            above pi / 2.
    """

    kind: ClassVar[str] = "directional"
    unit: ClassVar[str] = "lux"
    aim_fields: ClassVar[tuple[str, ...]] = ("direction",)
    aim_keys: ClassVar[tuple[str, ...]] = ("position", "target")

    direction: Vector = (0.0, 0.0, 0.0)
    """Direction in which the light travels, of any length; normalised. Needed unless there is a ``position``."""
    color: Vector = (1.0, 1.0, 1.0)
    intensity: float = 1.0
    """Lux: irradiance of a surface that faces the light."""
    angle: float = 0.0
    """Angular radius for soft shadows, radians; the sun's is 0.00465."""
    enabled: bool = field(default=True, kw_only=True)
    casts_shadow: bool = field(default=True, kw_only=True)
    shadow_distance: float = field(default=math.inf, kw_only=True)
    """What is farther than this from a surface casts no shadow on it, scene units, > 0: a sky of captured Gaussians."""
    name: str = field(default="", kw_only=True)
    position: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """In place of ``direction``: world position from which the light comes towards ``target``, however far away."""
    target: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """World position towards which the light travels from ``position``; None: the origin."""

    if TYPE_CHECKING:  # what is accepted; the fields above are what it becomes

        def __init__(
            self,
            direction: npt.ArrayLike = (0.0, 0.0, 0.0),
            color: npt.ArrayLike = (1.0, 1.0, 1.0),
            intensity: float = 1.0,
            angle: float = 0.0,
            *,
            enabled: bool = True,
            casts_shadow: bool = True,
            shadow_distance: float = math.inf,
            name: str = "",
            position: npt.ArrayLike | None = None,
            target: npt.ArrayLike | None = None,
        ) -> None: ...

    def __post_init__(self, position: npt.ArrayLike | None, target: npt.ArrayLike | None) -> None:
        _check_shared(self)
        if target is not None and position is None:
            raise SceneError("target of a directional light is given without a position, from which the light comes")
        start = (0.0, 0.0, 0.0) if position is None else vector("position", position)
        end = (0.0, 0.0, 0.0) if target is None and position is not None else target
        object.__setattr__(self, "direction", towards("a directional light", self.direction, start, end))
        _check_number("angle", self.angle, 0.0)
        if self.angle > math.pi / 2.0:
            raise SceneError(f"angle is {self.angle:g}, expected at most pi / 2 (radians)")
        _check_number("shadow_distance", self.shadow_distance, 0.0, above=True, finite=False)


@dataclass(frozen=True, slots=True, eq=False)
class LightSphere:
    """A sphere whose surface shines equally in all directions. Only the path pipeline shows it.

    Outside of it, it lights as a ``LightPoint`` of the same radius and of ``intensity * pi * radius^2`` candela does.

    Raises:
        SceneError: A value is not finite, negative or of the wrong shape.
    """

    kind: ClassVar[str] = "sphere"
    unit: ClassVar[str] = "cd/m2"
    aim_fields: ClassVar[tuple[str, ...]] = ()
    aim_keys: ClassVar[tuple[str, ...]] = ()

    position: Vector
    radius: float
    """Scene units, > 0."""
    color: Vector = (1.0, 1.0, 1.0)
    intensity: float = 1.0
    """Radiance: candela per square metre."""
    enabled: bool = field(default=True, kw_only=True)
    casts_shadow: bool = field(default=True, kw_only=True)
    visible: bool = field(default=True, kw_only=True)
    """Whether the path pipeline shows it, to the camera and to surfaces alike. No pipeline lets it block light."""
    name: str = field(default="", kw_only=True)

    if TYPE_CHECKING:  # what is accepted; the fields above are what it becomes

        def __init__(
            self,
            position: npt.ArrayLike,
            radius: float,
            color: npt.ArrayLike = (1.0, 1.0, 1.0),
            intensity: float = 1.0,
            *,
            enabled: bool = True,
            casts_shadow: bool = True,
            visible: bool = True,
            name: str = "",
        ) -> None: ...

    def __post_init__(self) -> None:
        _check_shared(self)
        object.__setattr__(self, "position", vector("position", self.position))
        _check_number("radius", self.radius, 0.0, above=True)
        check_flag("visible", self.visible)

    def candela(self, offsets: Doubles) -> Doubles:
        """As `LightPoint.candela`."""
        return np.full(len(offsets), math.pi * self.radius**2)

    def distances(self, origins: Doubles, directions: Doubles) -> Doubles:
        """Returns where rays enter the sphere from outside, scene units, shape (N,); inf where they miss it.

        Args:
            origins: World space, shape (N, 3).
            directions: Unit, shape (N, 3).
        """
        offsets = origins - np.array(self.position)
        to_middle = -(offsets * directions).sum(axis=1)
        inside = self.radius**2 - ((offsets + to_middle[:, None] * directions) ** 2).sum(axis=1)
        hits = (inside >= 0.0) & (to_middle > 0.0) & ((offsets**2).sum(axis=1) > self.radius**2)
        return np.where(hits, to_middle - np.sqrt(np.maximum(inside, 0.0)), np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class LightRect:
    """A rectangle (or parallelogram) that shines on one side. Only the path pipeline shows it.

    Raises:
        SceneError: A value is not finite, negative or of the wrong shape, or the edges are parallel.
    """

    kind: ClassVar[str] = "rect"
    unit: ClassVar[str] = "cd/m2"
    aim_fields: ClassVar[tuple[str, ...]] = ("edge_u", "edge_v")
    aim_keys: ClassVar[tuple[str, ...]] = ("target", "size")

    position: Vector
    """Centre of the rectangle."""
    edge_u: Vector = (0.0, 0.0, 0.0)
    """One edge, scene units. Both edges are needed unless there is a ``target``."""
    edge_v: Vector = (0.0, 0.0, 0.0)
    """The other edge. The light shines to the side of ``cross(edge_u, edge_v)``."""
    color: Vector = (1.0, 1.0, 1.0)
    intensity: float = 1.0
    """Radiance: candela per square metre."""
    enabled: bool = field(default=True, kw_only=True)
    casts_shadow: bool = field(default=True, kw_only=True)
    visible: bool = field(default=True, kw_only=True)
    """Whether the path pipeline shows it, to the camera and to surfaces alike. No pipeline lets it block light."""
    name: str = field(default="", kw_only=True)
    target: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """In place of the edges: world position towards which it faces."""
    size: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """With ``target``: width, which is level with y along the vertical, and height, scene units, shape (2,)."""

    if TYPE_CHECKING:  # what is accepted; the fields above are what it becomes

        def __init__(
            self,
            position: npt.ArrayLike,
            edge_u: npt.ArrayLike = (0.0, 0.0, 0.0),
            edge_v: npt.ArrayLike = (0.0, 0.0, 0.0),
            color: npt.ArrayLike = (1.0, 1.0, 1.0),
            intensity: float = 1.0,
            *,
            enabled: bool = True,
            casts_shadow: bool = True,
            visible: bool = True,
            name: str = "",
            target: npt.ArrayLike | None = None,
            size: npt.ArrayLike | None = None,
        ) -> None: ...

    def __post_init__(self, target: npt.ArrayLike | None, size: npt.ArrayLike | None) -> None:
        _check_shared(self)
        if target is not None or size is not None:
            edges = facing_edges(self, target, size)
            object.__setattr__(self, "edge_u", edges[0])
            object.__setattr__(self, "edge_v", edges[1])
        for name in ("position", "edge_u", "edge_v"):
            object.__setattr__(self, name, vector(name, getattr(self, name)))
        area = np.linalg.norm(np.cross(self.edge_u, self.edge_v))
        if not area > 1e-9 * np.linalg.norm(self.edge_u) * np.linalg.norm(self.edge_v):
            raise SceneError(f"edge_u {self.edge_u} and edge_v {self.edge_v} span no area")
        check_flag("visible", self.visible)

    @property
    def area_vector(self) -> Doubles:
        """Normal of the side that shines, as long as the area, shape (3,)."""
        return np.asarray(np.cross(self.edge_u, self.edge_v), np.float64)

    def boundary(self) -> Doubles:
        """Returns its corners in order, world space, shape (4, 3)."""
        u, v = np.array(self.edge_u), np.array(self.edge_v)
        return np.array([self.position + 0.5 * (a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])

    def covers(self, offsets: Doubles) -> Flags:
        """Returns which points of its plane lie within it, shape (N,); ``offsets`` are from its position."""
        across = self.area_vector
        shares = np.abs([np.cross(offsets, self.edge_v) @ across, np.cross(self.edge_u, offsets) @ across])
        return np.asarray((shares / (across @ across) <= 0.5).all(axis=0))

    def candela(self, offsets: Doubles) -> Doubles:
        """As `LightPoint.candela`."""
        return _flat_candela(self, offsets)

    def distances(self, origins: Doubles, directions: Doubles) -> Doubles:
        """Returns where rays reach the side that shines, scene units, shape (N,); inf where they miss it."""
        return _flat_distances(self, origins, directions)


@dataclass(frozen=True, slots=True, eq=False)
class LightDisk:
    """A disk that shines on one side. Only the path pipeline shows it.

    Raises:
        SceneError: A value is not finite, negative or of the wrong shape, or the direction has no length.
    """

    kind: ClassVar[str] = "disk"
    unit: ClassVar[str] = "cd/m2"
    aim_fields: ClassVar[tuple[str, ...]] = ("direction",)
    aim_keys: ClassVar[tuple[str, ...]] = ("target",)

    position: Vector
    """Centre of the disk."""
    direction: Vector = (0.0, 0.0, 0.0)
    """Normal of the side that shines, of any length; normalised. Needed unless there is a ``target``."""
    radius: float = 0.5
    """Scene units, > 0."""
    color: Vector = (1.0, 1.0, 1.0)
    intensity: float = 1.0
    """Radiance: candela per square metre."""
    enabled: bool = field(default=True, kw_only=True)
    casts_shadow: bool = field(default=True, kw_only=True)
    visible: bool = field(default=True, kw_only=True)
    """Whether the path pipeline shows it, to the camera and to surfaces alike. No pipeline lets it block light."""
    name: str = field(default="", kw_only=True)
    target: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """In place of ``direction``: world position towards which it faces, shape (3,)."""

    if TYPE_CHECKING:  # what is accepted; the fields above are what it becomes

        def __init__(
            self,
            position: npt.ArrayLike,
            direction: npt.ArrayLike = (0.0, 0.0, 0.0),
            radius: float = 0.5,
            color: npt.ArrayLike = (1.0, 1.0, 1.0),
            intensity: float = 1.0,
            *,
            enabled: bool = True,
            casts_shadow: bool = True,
            visible: bool = True,
            name: str = "",
            target: npt.ArrayLike | None = None,
        ) -> None: ...

    def __post_init__(self, target: npt.ArrayLike | None) -> None:
        _check_shared(self)
        object.__setattr__(self, "position", vector("position", self.position))
        object.__setattr__(self, "direction", towards("a disk", self.direction, self.position, target))
        _check_number("radius", self.radius, 0.0, above=True)
        check_flag("visible", self.visible)

    @property
    def area_vector(self) -> Doubles:
        """Normal of the side that shines, as long as the area, shape (3,)."""
        return math.pi * self.radius**2 * np.array(self.direction)

    def boundary(self) -> Doubles:
        """Returns points of its edge in order, world space, shape (48, 3)."""
        normal, angles = np.array(self.direction), np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)[:, None]
        u = np.cross(np.eye(3)[int(np.abs(normal).argmin())], normal)
        u /= np.linalg.norm(u)
        return self.position + self.radius * (np.cos(angles) * u + np.sin(angles) * np.cross(normal, u))

    def covers(self, offsets: Doubles) -> Flags:
        """Returns which points of its plane lie within it, shape (N,); ``offsets`` are from its position."""
        return np.asarray((offsets**2).sum(axis=1) <= self.radius**2)

    def candela(self, offsets: Doubles) -> Doubles:
        """As `LightPoint.candela`."""
        return _flat_candela(self, offsets)

    def distances(self, origins: Doubles, directions: Doubles) -> Doubles:
        """Returns where rays reach the side that shines, scene units, shape (N,); inf where they miss it."""
        return _flat_distances(self, origins, directions)


@dataclass(frozen=True, slots=True, eq=False)
class LightEnvironment:
    """Light from all directions, infinitely far away: a latitude-longitude image, or one colour.

    The image's upper edge is the environment's +y, its middle column -z, and +x is to the right of the middle:
    ``u = 1/2 + atan2(x, -z) / (2 pi)``, ``v = acos(y) / pi``.

    Raises:
        SceneError: The image is not a finite, non-negative (H, W, 3) array, or another value is out of range.
    """

    kind: ClassVar[str] = "environment"
    unit: ClassVar[str] = "x image"
    aim_fields: ClassVar[tuple[str, ...]] = ()
    aim_keys: ClassVar[tuple[str, ...]] = ()

    image: FloatArray | None = None
    """Linear Rec.709 radiance, shape (H, W, 3); None: 1 everywhere."""
    color: Vector = (1.0, 1.0, 1.0)
    intensity: float = 1.0
    """Factor of the image's radiance."""
    rotation_wxyz: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0)
    """World from environment, a quaternion, scalar first. Scenes with y down need (0, 1, 0, 0), half a turn about x."""
    visible: bool = True
    """Whether it is the background of pictures; mirrors always show it."""
    enabled: bool = field(default=True, kw_only=True)
    casts_shadow: bool = field(default=True, kw_only=True)
    shadow_distance: float = field(default=math.inf, kw_only=True)
    """What is farther than this from a surface casts no shadow on it, scene units, > 0: a sky of captured Gaussians."""
    name: str = field(default="", kw_only=True)

    if TYPE_CHECKING:  # what is accepted; the fields above are what it becomes

        def __init__(
            self,
            image: npt.ArrayLike | None = None,
            color: npt.ArrayLike = (1.0, 1.0, 1.0),
            intensity: float = 1.0,
            rotation_wxyz: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0),
            visible: bool = True,
            *,
            enabled: bool = True,
            casts_shadow: bool = True,
            shadow_distance: float = math.inf,
            name: str = "",
        ) -> None: ...

    def __post_init__(self) -> None:
        _check_shared(self)
        if self.image is not None:
            given = np.asarray(host_array(self.image))
            if given.dtype.kind in "bui":
                raise SceneError(f"environment image is {given.dtype}, expected linear float radiance")
            image = float_array("environment image", self.image)
            if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
                raise SceneError(f"environment image has shape {image.shape}, expected (H, W, 3)")
            negative = int(np.count_nonzero(image < 0.0))
            if negative:
                raise SceneError(f"environment image has {negative:,} negative values")
            object.__setattr__(self, "image", image)
        float_array("rotation_wxyz", self.rotation_wxyz)
        wxyz = np.asarray(host_array(self.rotation_wxyz), dtype=np.float64)
        if wxyz.shape != (4,) or np.linalg.norm(wxyz) == 0.0:
            raise SceneError(f"rotation_wxyz is {self.rotation_wxyz}, expected four numbers that are not all 0")
        object.__setattr__(self, "rotation_wxyz", tuple(float(x) for x in unit_vector(wxyz)))
        check_flag("visible", self.visible)
        _check_number("shadow_distance", self.shadow_distance, 0.0, above=True, finite=False)


FlatLight = LightRect | LightDisk
"""Lights that shine from one side of a plane."""
AreaLight = LightSphere | LightRect | LightDisk
"""Lights whose surface shines: their intensity is a radiance, and paths show them."""
RoundLight = LightPoint | LightSpot | LightSphere | LightDisk
"""Lights at a position that have a radius."""
AimedLight = LightSpot | LightDirectional | LightDisk
"""Lights with a direction."""
PlacedLight = LightPoint | LightSpot | LightSphere | LightRect | LightDisk
"""Lights at a position."""
Light = PlacedLight | LightDirectional | LightEnvironment
"""Any light."""
LIGHT_KINDS: dict[str, type[PlacedLight | LightDirectional]] = {
    one.kind: one for one in (LightPoint, LightSpot, LightDirectional, LightSphere, LightRect, LightDisk)
}
"""Lights by their ``type`` in scene files, where the environment has a table of its own."""


def facing_irradiance(light: Light, points: npt.NDArray[np.floating]) -> Doubles:
    """Returns the unshadowed irradiance of surfaces that face a light, as if all of it shone from its position.

    The formulas are those of device/light/light.py for hard shadows.

    Args:
        light: Any light but an environment.
        points: World space, shape (N, 3).

    Returns:
        Linear Rec.709, shape (N, 3).
    """
    assert not isinstance(light, LightEnvironment)
    power = light.intensity * np.array(light.color)
    if isinstance(light, LightDirectional):
        return np.broadcast_to(power, (len(points), 3)).copy()
    offsets = np.asarray(points, dtype=np.float64) - np.array(light.position)
    return (light.candela(offsets) / _squared(offsets))[:, None] * power


def move_light(light: Light, world_from_light: npt.NDArray[np.float64]) -> Light:
    """Moves a light with the thing that it belongs to; the scale changes neither its intensity nor its range.

    Args:
        light: Any light; environments stay as they are.
        world_from_light: Similarity transform, shape (4, 4).
    """
    linear = world_from_light[:3, :3]
    changes: dict[str, Any] = {
        name: linear @ getattr(light, name) for name in ("direction", "edge_u", "edge_v") if hasattr(light, name)
    }
    if isinstance(light, LightDisk):
        changes["radius"] = light.radius * float(np.cbrt(np.linalg.det(linear)))
    if isinstance(light, PlacedLight):
        changes["position"] = linear @ light.position + world_from_light[:3, 3]
    return replace(light, **changes)


def _squared(offsets: Doubles) -> Doubles:
    """Squared lengths, at least that of the smallest distance to a light, shape (N,)."""
    return np.maximum(np.einsum("ij,ij->i", offsets, offsets), LIGHT_DISTANCE_MIN**2)


def _window(reach: float, distance2: Doubles) -> Doubles:
    """Attenuation towards the end of a light's range (glTF, KHR_lights_punctual)."""
    return np.clip(1.0 - (distance2 / reach**2) ** 2, 0.0, 1.0)


def _flat_candela(light: FlatLight, offsets: Doubles) -> Doubles:
    return np.maximum(offsets @ light.area_vector, 0.0) / np.sqrt(_squared(offsets))


def _flat_distances(light: FlatLight, origins: Doubles, directions: Doubles) -> Doubles:
    offsets, normal = origins - np.array(light.position), light.area_vector
    towards = -directions @ normal
    distances = (offsets @ normal) / np.where(towards > 0.0, towards, 1.0)
    hits = (towards > 0.0) & (distances > 0.0) & light.covers(offsets + distances[:, None] * directions)
    return np.where(hits, distances, np.inf)


def _check_shared(light: Light) -> None:
    """Checks the fields that all lights have, and stores the colour as a tuple."""
    color = vector("color", light.color)
    if min(color) < 0.0:
        raise SceneError(f"color is {color}, expected no negative number")
    object.__setattr__(light, "color", color)
    _check_number("intensity", light.intensity, 0.0)
    for name in ("enabled", "casts_shadow"):
        check_flag(name, getattr(light, name))


def _check_number(name: str, value: object, low: float, *, above: bool = False, finite: bool = True) -> None:
    high = FLOAT32_MAX if finite else math.inf
    if not is_number(value) or not low <= value <= high or (above and value == low):
        bound = f"above {low:g}" if above else f"at least {low:g}"
        raise SceneError(f"{name} is {value}, expected a number {bound}")
