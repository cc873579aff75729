"""Lights in the units of glTF's KHR_lights_punctual (candela and lux); area lights have radiance.

All lights have a ``color`` (linear Rec.709, non-negative, multiplied by the intensity), ``intensity``, ``enabled``,
``casts_shadow`` and ``name``. Positions and directions are in world space.

Each class states what the rest of the package needs to know about a light: ``kind``, its ``type`` in scene files;
``unit`` of its ``intensity``; ``aim_fields``, the fields that orient it; ``aim_keys``, keys that may replace these.
The unions below the classes list which lights have a position, a direction, a radius or an area.
"""

from __future__ import annotations

import math
from dataclasses import InitVar, field, replace
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import Range, quoted
from lumisplat.config.setting import frozen, given
from lumisplat.constants import LIGHT_DISTANCE_MIN
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, Flags, FloatArray, finite_numbers, float_array, host_array, unit_vector
from lumisplat.scene.checks import COLOR, Vector, take_scene_fields


def vector(name: str, values: npt.ArrayLike) -> Vector:
    """Converts ``values`` to three Python floats; errors call the values ``name``.

    Raises:
        SceneError: The values are not three finite numbers.
    """
    array = float_array(name, values)
    if array.shape != (3,):
        raise SceneError(f"{name} has shape {array.shape}, expected three numbers")
    x, y, z = (float(v) for v in np.asarray(host_array(values), dtype=np.float64))
    return x, y, z


def to_vector(values: npt.ArrayLike, name: str = "vector") -> Vector:
    """Converts three finite numbers to a vector: `vector` in the form that dataclass fields need as a converter."""
    return vector(name, values)


def direction_of(name: str, values: npt.ArrayLike) -> Vector:
    """Converts ``values`` to a unit vector; errors call the values ``name``.

    Raises:
        SceneError: The direction has no length, or is not three finite numbers.
    """
    given = np.array(vector(name, values))
    if np.linalg.norm(given) == 0.0:
        raise SceneError(f"{name} has no length, expected a direction")
    x, y, z = (float(v) for v in unit_vector(given))
    return x, y, z


def towards(kind: str, direction: npt.ArrayLike, start: Vector, target: npt.ArrayLike | None) -> Vector:
    """Returns the unit vector of ``direction``, or from ``start`` to ``target``; ``kind`` names the light in errors.

    Raises:
        SceneError: Both ``direction`` (not 0) and ``target`` are given, or none of the two, or ``target`` equals
            ``start``.
    """
    is_given = bool(np.any(np.asarray(vector("direction", direction)) != 0.0))
    if target is None:
        if not is_given:
            raise SceneError(f"direction has no length: {kind} needs a direction or a target")
        return direction_of("direction", direction)
    if is_given:
        raise SceneError(f"direction and target of {kind} are both given: give one of them")
    along = np.subtract(vector("target", target), start)
    if not along.any():
        raise SceneError(f"target of {kind} is at its position: move one of them")
    return direction_of("direction", along)


def facing_edges(
    position: Vector, edges: tuple[Vector, Vector], target: npt.ArrayLike | None, size: npt.ArrayLike | None
) -> tuple[Vector, Vector]:
    """Returns the edges of a rectangle that faces ``target``, ``size`` (width, height) long; the first is horizontal.

    Raises:
        SceneError: Only one of target and size is given, edges are given in addition, or the size is not positive.
    """
    if target is None or size is None:
        raise SceneError("target and size of a rect must be given together")
    if np.any(edges):
        raise SceneError("edges and target of a rect are both given: give the edges, or target and size")
    sizes = finite_numbers(size, (2,))
    if sizes is None or not (sizes > 0.0).all():
        raise SceneError(f"size is {size}, expected two positive numbers, width and height")
    forward = np.array(towards("a rect", (0.0, 0.0, 0.0), position, target))
    # edge_u is horizontal; for a light that faces straight up or down, z replaces y.
    across = np.cross((0.0, 1.0, 0.0) if abs(forward[1]) < 0.999999 else (0.0, 0.0, 1.0), forward)
    across /= np.linalg.norm(across)
    return vector("edge_u", sizes[0] * across), vector("edge_v", sizes[1] * np.cross(forward, across))


RIGHT_ANGLE = math.pi / 2.0 + 1e-6
"""Upper limit, radians, of cone angles and of a sun's angular radius: pi / 2 with a tolerance for rounding."""


def _radiance(values: npt.ArrayLike | None, name: str = "image") -> FloatArray | None:
    """Converts the radiance image of an environment to a float array; None stays None.

    Raises:
        SceneError: The image is not a finite, non-negative float array of shape (H, W, 3).
    """
    if values is None:
        return None
    given = np.asarray(host_array(values))
    if given.dtype.kind in "bui":
        raise SceneError(f"environment {name} is {given.dtype}, expected linear float radiance")
    image = float_array(f"environment {name}", values)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise SceneError(f"environment {name} has shape {image.shape}, expected (H, W, 3)")
    negative = int(np.count_nonzero(image < 0.0))
    if negative:
        raise SceneError(f"environment {name} has {negative:,} negative values")
    return image


def _unit_quaternion(values: npt.ArrayLike, name: str = "rotation_wxyz") -> tuple[float, float, float, float]:
    """Converts ``values`` to a quaternion of length 1, scalar first.

    Raises:
        SceneError: The quaternion is not four finite numbers, or all four are 0.
    """
    float_array(name, values)
    wxyz = np.asarray(host_array(values), dtype=np.float64)
    if wxyz.shape != (4,) or np.linalg.norm(wxyz) == 0.0:
        raise SceneError(f"{name} is {quoted(values)}, expected four numbers that are not all 0")
    w, x, y, z = (float(number) for number in unit_vector(wxyz))
    return w, x, y, z


@frozen
class LightPoint:
    """A point light that shines equally in all directions.

    The irradiance of a surface that faces the light at distance d is ``intensity / d^2``, faded out towards ``range``
    by the window that glTF recommends, ``clamp(1 - (d / range)^4, 0, 1)``.

    Raises:
        SceneError: A colour, intensity, range or radius is out of its range, or a value is not a finite number (except
            ``range``) or of the wrong shape.
    """

    kind: ClassVar[str] = "point"
    unit: ClassVar[str] = "cd"
    aim_fields: ClassVar[tuple[str, ...]] = ()
    aim_keys: ClassVar[tuple[str, ...]] = ()

    position: Vector = given(converter=to_vector)
    """World position of the light's centre, scene units, shape (3,)."""
    color: Vector = given(converter=COLOR, default=(1.0, 1.0, 1.0))
    """Linear Rec.709 colour, multiplied by ``intensity``."""
    intensity: Annotated[float, Range(0.0, unit="cd")] = 1.0
    """Luminous intensity, candela, equal in all directions; channels are ``color`` times this."""
    range: Annotated[float, Range(0.0, unit="scene units", above=True, infinite=True)] = math.inf
    """Distance beyond which the light has no effect."""
    radius: Annotated[float, Range(0.0, unit="scene units")] = 0.0
    """Radius of the light for soft shadows; 0: hard shadows. `Pipeline.PATH`, `Pipeline.REALTIME`, the setting
    ``shadows="soft"`` and deep shadow maps use it."""
    enabled: bool = field(default=True, kw_only=True)
    """Whether the light shines; False turns it off."""
    casts_shadow: bool = field(default=True, kw_only=True)
    """Whether objects block the light; False: it shines through everything."""
    name: str = field(default="", kw_only=True)
    """Name of the light; in EXR files, also the name of the layer with this light's contribution."""

    __post_init__ = take_scene_fields

    def candela(self, offsets: Doubles) -> Doubles:
        """Returns the candela that a light of ``intensity`` 1 emits from its centre towards N points, shape (N,).

        Args:
            offsets: Points minus the light's position, scene units, shape (N, 3).
        """
        return _window(self.range, _squared(offsets))


@frozen
class LightSpot:
    """A spot light: full intensity within ``inner_angle`` of its axis, fading to zero at ``outer_angle``.

    Raises:
        SceneError: A colour or number is out of its range, a vector is not three finite numbers, the direction has no
            length or is given together with ``target``, or the angles are not ``0 <= inner < outer <= pi / 2``.
    """

    kind: ClassVar[str] = "spot"
    unit: ClassVar[str] = "cd"
    aim_fields: ClassVar[tuple[str, ...]] = ("direction",)
    aim_keys: ClassVar[tuple[str, ...]] = ("target",)

    position: Vector = given(converter=to_vector)
    """World position of the cone's apex, scene units, shape (3,)."""
    direction: Vector = given(converter=to_vector, default=(0.0, 0.0, 0.0))
    """Axis of the cone, any length; normalised. Required unless there is a ``target``."""
    color: Vector = given(converter=COLOR, default=(1.0, 1.0, 1.0))
    """Linear Rec.709 colour, multiplied by ``intensity``."""
    intensity: Annotated[float, Range(0.0, unit="cd")] = 1.0
    """Luminous intensity, candela, within ``inner_angle`` of the axis."""
    range: Annotated[float, Range(0.0, unit="scene units", above=True, infinite=True)] = math.inf
    """Distance beyond which the light has no effect."""
    inner_angle: Annotated[float, Range(0.0, RIGHT_ANGLE, "radians")] = 0.0
    """Angle from the axis up to which the light has full intensity."""
    outer_angle: Annotated[float, Range(0.0, RIGHT_ANGLE, "radians")] = math.pi / 4.0
    """Angle from the axis at which the light has faded to zero."""
    radius: Annotated[float, Range(0.0, unit="scene units")] = 0.0
    """Radius of the light for soft shadows; 0: hard shadows. `Pipeline.PATH`, `Pipeline.REALTIME`, the setting
    ``shadows="soft"`` and deep shadow maps use it."""
    enabled: bool = field(default=True, kw_only=True)
    """Whether the light shines; False turns it off."""
    casts_shadow: bool = field(default=True, kw_only=True)
    """Whether objects block the light; False: it shines through everything."""
    name: str = field(default="", kw_only=True)
    """Name of the light; in EXR files, also the name of the layer with this light's contribution."""
    target: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """Point that the light aims at, world position, shape (3,); given instead of ``direction``."""

    def __post_init__(self, target: npt.ArrayLike | None) -> None:
        take_scene_fields(self)
        object.__setattr__(self, "direction", towards("a spot", self.direction, self.position, target))
        if not self.inner_angle < self.outer_angle:
            raise SceneError(
                f"a spot's inner_angle is {self.inner_angle:g} and its outer_angle {self.outer_angle:g}, "
                "expected 0 <= inner < outer <= pi / 2 (radians)"
            )

    def candela(self, offsets: Doubles) -> Doubles:
        """Returns the candela that a spot of ``intensity`` 1 emits towards N points, shape (N,).

        Args:
            offsets: Points minus the spot's position, scene units, shape (N, 3).
        """
        distance2 = _squared(offsets)
        inner, outer = math.cos(self.inner_angle), math.cos(self.outer_angle)
        cosine = offsets @ np.array(self.direction) / np.sqrt(distance2)
        return _window(self.range, distance2) * np.clip((cosine - outer) / max(inner - outer, 1e-30), 0.0, 1.0) ** 2


@frozen
class LightDirectional:
    """Parallel light from infinitely far away, such as the sun.

    Raises:
        SceneError: A colour or number is out of its range, a vector is not three finite numbers, the direction has no
            length or is given together with ``position``, or ``target`` is given without ``position``.
    """

    kind: ClassVar[str] = "directional"
    unit: ClassVar[str] = "lux"
    aim_fields: ClassVar[tuple[str, ...]] = ("direction",)
    aim_keys: ClassVar[tuple[str, ...]] = ("position", "target")

    direction: Vector = given(converter=to_vector, default=(0.0, 0.0, 0.0))
    """Direction in which the light travels, any length; normalised. Required unless there is a ``position``."""
    color: Vector = given(converter=COLOR, default=(1.0, 1.0, 1.0))
    """Linear Rec.709 colour, multiplied by ``intensity``."""
    intensity: Annotated[float, Range(0.0, unit="lux")] = 1.0
    """Illuminance, lux, of a surface that faces the light."""
    angle: Annotated[float, Range(0.0, RIGHT_ANGLE, "radians")] = 0.0
    """Angular radius (half the visible angle) of the light for soft shadows; the sun's is 0.27 degrees (0.0047).
    `Pipeline.PATH`, `Pipeline.REALTIME`, the setting ``shadows="soft"`` and deep shadow maps use it."""
    enabled: bool = field(default=True, kw_only=True)
    """Whether the light shines; False turns it off."""
    casts_shadow: bool = field(default=True, kw_only=True)
    """Whether objects block the light; False: it shines through everything."""
    shadow_distance: Annotated[float, Range(0.0, unit="scene units", above=True, infinite=True)] = field(
        default=math.inf, kw_only=True
    )
    """Largest distance from a surface at which objects still block the light; inf: all do. A finite value lets the
    light pass the Gaussians of a captured sky."""
    name: str = field(default="", kw_only=True)
    """Name of the light; in EXR files, also the name of the layer with this light's contribution."""
    position: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """World position, at any distance, from which the light travels towards ``target``; given instead of ``direction``.
    """
    target: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """World position towards which the light travels, if ``position`` is given; None: the origin."""

    def __post_init__(self, position: npt.ArrayLike | None, target: npt.ArrayLike | None) -> None:
        take_scene_fields(self)
        if target is not None and position is None:
            raise SceneError("target of a directional light is given without a position that the light comes from")
        start = (0.0, 0.0, 0.0) if position is None else vector("position", position)
        end = (0.0, 0.0, 0.0) if target is None and position is not None else target
        object.__setattr__(self, "direction", towards("a directional light", self.direction, start, end))


@frozen
class LightSphere:
    """A spherical area light. Frames show the sphere itself only with the path pipeline.

    Points outside the sphere receive the light of a ``LightPoint`` of the same radius with ``intensity * pi *
    radius^2`` candela.

    Raises:
        SceneError: A colour, intensity or radius is out of its range, or the position is not three finite numbers.
    """

    kind: ClassVar[str] = "sphere"
    unit: ClassVar[str] = "cd/m2"
    aim_fields: ClassVar[tuple[str, ...]] = ()
    aim_keys: ClassVar[tuple[str, ...]] = ()

    position: Vector = given(converter=to_vector)
    """World position of the sphere's centre, scene units, shape (3,)."""
    radius: Annotated[float, Range(0.0, unit="scene units", above=True)]
    """Radius of the sphere."""
    color: Vector = given(converter=COLOR, default=(1.0, 1.0, 1.0))
    """Linear Rec.709 colour, multiplied by ``intensity``."""
    intensity: Annotated[float, Range(0.0, unit="cd/m2")] = 1.0
    """Radiance (luminance) of the surface, candela per square metre, multiplied by ``color``."""
    enabled: bool = field(default=True, kw_only=True)
    """Whether the light shines; False turns it off."""
    casts_shadow: bool = field(default=True, kw_only=True)
    """Whether objects block the light; False: it shines through everything."""
    visible: bool = field(default=True, kw_only=True)
    """Whether the path pipeline shows the sphere to the camera and in reflections. Area lights never shadow other
    lights.
    """
    name: str = field(default="", kw_only=True)
    """Name of the light; in EXR files, also the name of the layer with this light's contribution."""

    __post_init__ = take_scene_fields

    def candela(self, offsets: Doubles) -> Doubles:
        """Returns the candela that a sphere of ``intensity`` 1 emits towards N points, ``pi radius^2``, shape (N,)."""
        return np.full(len(offsets), math.pi * self.radius**2)

    def distances(self, origins: Doubles, directions: Doubles) -> Doubles:
        """Returns the distances at which rays enter the sphere from outside, scene units, shape (N,); inf for misses.

        Args:
            origins: Ray origins, world space, shape (N, 3).
            directions: Unit ray directions, shape (N, 3).
        """
        offsets = origins - np.array(self.position)
        to_middle = -(offsets * directions).sum(axis=1)
        inside = self.radius**2 - ((offsets + to_middle[:, None] * directions) ** 2).sum(axis=1)
        hits = (inside >= 0.0) & (to_middle > 0.0) & ((offsets**2).sum(axis=1) > self.radius**2)
        return np.where(hits, to_middle - np.sqrt(np.maximum(inside, 0.0)), np.inf)


@frozen
class LightRect:
    """A rectangle or parallelogram that shines on one side. Frames show the light itself only with the path pipeline.

    Raises:
        SceneError: A colour, intensity or size is out of its range, a vector is not finite numbers of the right shape,
            the edges are parallel, or they are given together with ``target``.
    """

    kind: ClassVar[str] = "rect"
    unit: ClassVar[str] = "cd/m2"
    aim_fields: ClassVar[tuple[str, ...]] = ("edge_u", "edge_v")
    aim_keys: ClassVar[tuple[str, ...]] = ("target", "size")

    position: Vector = given(converter=to_vector)
    """World position of the rectangle's centre, scene units, shape (3,)."""
    edge_u: Vector = given(converter=to_vector, default=(0.0, 0.0, 0.0))
    """First edge of the rectangle as a world-space vector, scene units. Both edges are required unless there is a
    ``target``."""
    edge_v: Vector = given(converter=to_vector, default=(0.0, 0.0, 0.0))
    """Second edge as a world-space vector, scene units. The light shines to the side of ``cross(edge_u, edge_v)``."""
    color: Vector = given(converter=COLOR, default=(1.0, 1.0, 1.0))
    """Linear Rec.709 colour, multiplied by ``intensity``."""
    intensity: Annotated[float, Range(0.0, unit="cd/m2")] = 1.0
    """Radiance (luminance) of the emitting side, candela per square metre, multiplied by ``color``."""
    enabled: bool = field(default=True, kw_only=True)
    """Whether the light shines; False turns it off."""
    casts_shadow: bool = field(default=True, kw_only=True)
    """Whether objects block the light; False: it shines through everything."""
    visible: bool = field(default=True, kw_only=True)
    """Whether the path pipeline shows the light to the camera and in reflections. Area lights never shadow other
    lights.
    """
    name: str = field(default="", kw_only=True)
    """Name of the light; in EXR files, also the name of the layer with this light's contribution."""
    target: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """Point that the light faces, world position, shape (3,); given with ``size`` instead of the edges."""
    size: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """Width and height, scene units, shape (2,), of a rectangle given by ``target``. The edge along the width is
    horizontal, with y as the vertical."""

    def __post_init__(self, target: npt.ArrayLike | None, size: npt.ArrayLike | None) -> None:
        take_scene_fields(self)
        if target is not None or size is not None:
            edges = facing_edges(self.position, (self.edge_u, self.edge_v), target, size)
            object.__setattr__(self, "edge_u", edges[0])
            object.__setattr__(self, "edge_v", edges[1])
        area = np.linalg.norm(np.cross(self.edge_u, self.edge_v))
        if not area > 1e-9 * np.linalg.norm(self.edge_u) * np.linalg.norm(self.edge_v):
            raise SceneError(f"edge_u {self.edge_u} and edge_v {self.edge_v} span no area: they must not be parallel")

    @property
    def area_vector(self) -> Doubles:
        """Normal of the emitting side times the rectangle's area, world space, shape (3,)."""
        return np.asarray(np.cross(self.edge_u, self.edge_v), np.float64)

    def boundary(self) -> Doubles:
        """Returns the four corners in order around the rectangle, world space, shape (4, 3)."""
        u, v = np.array(self.edge_u), np.array(self.edge_v)
        return np.array([self.position + 0.5 * (a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])

    def covers(self, offsets: Doubles) -> Flags:
        """Returns whether each of N points of the rectangle's plane lies inside the rectangle, shape (N,).

        Args:
            offsets: Points in the rectangle's plane minus its centre, world space, shape (N, 3).
        """
        across = self.area_vector
        shares = np.abs([np.cross(offsets, self.edge_v) @ across, np.cross(self.edge_u, offsets) @ across])
        return np.asarray((shares / (across @ across) <= 0.5).all(axis=0))

    def candela(self, offsets: Doubles) -> Doubles:
        """Returns the candela that radiance 1 sends towards N points: area times cosine, shape (N,).

        Args:
            offsets: Points minus the rectangle's centre, scene units, shape (N, 3).
        """
        return _flat_candela(self, offsets)

    def distances(self, origins: Doubles, directions: Doubles) -> Doubles:
        """Returns the distances at which N rays hit the emitting side, scene units, shape (N,); inf for misses.

        Args:
            origins: Ray origins, world space, shape (N, 3).
            directions: Unit ray directions, shape (N, 3).
        """
        return _flat_distances(self, origins, directions)


@frozen
class LightDisk:
    """A disk-shaped area light that shines on one side. Frames show the disk itself only with the path pipeline.

    Raises:
        SceneError: A colour, intensity or radius is out of its range, a vector is not three finite numbers, or the
            direction has no length or is given together with ``target``.
    """

    kind: ClassVar[str] = "disk"
    unit: ClassVar[str] = "cd/m2"
    aim_fields: ClassVar[tuple[str, ...]] = ("direction",)
    aim_keys: ClassVar[tuple[str, ...]] = ("target",)

    position: Vector = given(converter=to_vector)
    """World position of the disk's centre, scene units, shape (3,)."""
    direction: Vector = given(converter=to_vector, default=(0.0, 0.0, 0.0))
    """Normal of the emitting side, any length; normalised. Required unless there is a ``target``."""
    radius: Annotated[float, Range(0.0, unit="scene units", above=True)] = 0.5
    """Radius of the disk."""
    color: Vector = given(converter=COLOR, default=(1.0, 1.0, 1.0))
    """Linear Rec.709 colour, multiplied by ``intensity``."""
    intensity: Annotated[float, Range(0.0, unit="cd/m2")] = 1.0
    """Radiance (luminance) of the emitting side, candela per square metre, multiplied by ``color``."""
    enabled: bool = field(default=True, kw_only=True)
    """Whether the light shines; False turns it off."""
    casts_shadow: bool = field(default=True, kw_only=True)
    """Whether objects block the light; False: it shines through everything."""
    visible: bool = field(default=True, kw_only=True)
    """Whether the path pipeline shows the disk to the camera and in reflections. Area lights never shadow other
    lights.
    """
    name: str = field(default="", kw_only=True)
    """Name of the light; in EXR files, also the name of the layer with this light's contribution."""
    target: InitVar[npt.ArrayLike | None] = field(default=None, kw_only=True)
    """Point that the light faces, world position, shape (3,); given instead of ``direction``."""

    def __post_init__(self, target: npt.ArrayLike | None) -> None:
        take_scene_fields(self)
        object.__setattr__(self, "direction", towards("a disk", self.direction, self.position, target))

    @property
    def area_vector(self) -> Doubles:
        """Normal of the emitting side times the disk's area, world space, shape (3,)."""
        return math.pi * self.radius**2 * np.array(self.direction)

    def boundary(self) -> Doubles:
        """Returns 48 points around the rim in order, world space, shape (48, 3)."""
        normal, angles = np.array(self.direction), np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False)[:, None]
        u = np.cross(np.eye(3)[int(np.abs(normal).argmin())], normal)
        u /= np.linalg.norm(u)
        return self.position + self.radius * (np.cos(angles) * u + np.sin(angles) * np.cross(normal, u))

    def covers(self, offsets: Doubles) -> Flags:
        """Returns whether each of N points of the disk's plane lies inside the disk, shape (N,).

        Args:
            offsets: Points in the disk's plane minus its centre, world space, shape (N, 3).
        """
        return np.asarray((offsets**2).sum(axis=1) <= self.radius**2)

    def candela(self, offsets: Doubles) -> Doubles:
        """Returns the candela that radiance 1 sends towards N points: area times cosine, shape (N,).

        Args:
            offsets: Points minus the disk's centre, scene units, shape (N, 3).
        """
        return _flat_candela(self, offsets)

    def distances(self, origins: Doubles, directions: Doubles) -> Doubles:
        """Returns the distances at which N rays hit the emitting side, scene units, shape (N,); inf for misses.

        Args:
            origins: Ray origins, world space, shape (N, 3).
            directions: Unit ray directions, shape (N, 3).
        """
        return _flat_distances(self, origins, directions)


@frozen
class LightEnvironment:
    """An environment: light from all directions at infinity, as a latitude-longitude image or one colour.

    The image's upper edge is the environment's +y, its middle column -z, and +x is to the right of the middle:
    ``u = 1/2 + atan2(x, -z) / (2 pi)``, ``v = acos(y) / pi``.

    Raises:
        SceneError: The image is not a finite, non-negative (H, W, 3) array, or another value is out of range.
    """

    kind: ClassVar[str] = "environment"
    unit: ClassVar[str] = "x image"
    aim_fields: ClassVar[tuple[str, ...]] = ()
    aim_keys: ClassVar[tuple[str, ...]] = ()

    image: FloatArray | None = given(converter=_radiance, default=None)
    """Linear Rec.709 radiance, shape (H, W, 3); None: 1 everywhere."""
    color: Vector = given(converter=COLOR, default=(1.0, 1.0, 1.0))
    """Linear Rec.709 colour, multiplied by ``intensity``."""
    intensity: Annotated[float, Range(0.0, unit="x image")] = 1.0
    """Factor that multiplies the radiance, as ``color`` does. Without an image the radiance before both factors is 1.
    """
    rotation_wxyz: tuple[float, float, float, float] = given(converter=_unit_quaternion, default=(1.0, 0.0, 0.0, 0.0))
    """World-from-environment rotation, a quaternion, scalar first. Scenes with y down need (0, 1, 0, 0), 180 degrees
    about x."""
    visible: bool = True
    """Show the environment as the background of lit frames, unless ``RenderConfig.background`` is None. Mirrors reflect
    the environment in either case."""
    enabled: bool = field(default=True, kw_only=True)
    """Whether the environment lights the scene and may be its background; False turns it off."""
    casts_shadow: bool = field(default=True, kw_only=True)
    """Whether objects block the light; False: it shines through everything."""
    shadow_distance: Annotated[float, Range(0.0, unit="scene units", above=True, infinite=True)] = field(
        default=math.inf, kw_only=True
    )
    """Largest distance from a surface at which objects still block the light; inf: all do. A finite value lets the
    light pass the Gaussians of a captured sky."""
    name: str = field(default="", kw_only=True)
    """Name of the light; in EXR files, also the name of the layer with this light's contribution."""

    __post_init__ = take_scene_fields


FlatLight = LightRect | LightDisk
"""Lights that shine from one side of a plane."""
AreaLight = LightSphere | LightRect | LightDisk
"""Lights with an emitting surface. Their intensity is a radiance, and frames of the path pipeline show the surface."""
RoundLight = LightPoint | LightSpot | LightSphere | LightDisk
"""Lights with a position and a radius."""
AimedLight = LightSpot | LightDirectional | LightDisk
"""Lights with a direction."""
PlacedLight = LightPoint | LightSpot | LightSphere | LightRect | LightDisk
"""Lights with a position."""
Light = PlacedLight | LightDirectional | LightEnvironment
"""Any light class."""
LIGHT_KINDS: dict[str, type[PlacedLight | LightDirectional]] = {
    one.kind: one for one in (LightPoint, LightSpot, LightDirectional, LightSphere, LightRect, LightDisk)
}
"""Light classes by their ``type`` in scene files. Environments are missing, because scene files have a separate table
for environments."""


def facing_irradiance(light: Light, points: npt.NDArray[np.floating]) -> Doubles:
    """Returns the irradiance that a light, as an unshadowed point, gives at N points to surfaces that face the light.

    The formulas are those of device/light/light.py for hard shadows.

    Args:
        light: Any light but an environment.
        points: World positions, shape (N, 3).

    Returns:
        Linear Rec.709 irradiance, shape (N, 3).
    """
    assert not isinstance(light, LightEnvironment)
    power = light.intensity * np.array(light.color)
    if isinstance(light, LightDirectional):
        return np.broadcast_to(power, (len(points), 3)).copy()
    offsets = np.asarray(points, dtype=np.float64) - np.array(light.position)
    return (light.candela(offsets) / _squared(offsets))[:, None] * power


def move_light(light: Light, world_from_light: npt.NDArray[np.float64]) -> Light:
    """Transforms a light together with the object to which it belongs.

    The size of the light is scaled; its intensity and range stay, as in glTF.

    Args:
        light: Any light; environments are returned unchanged.
        world_from_light: Similarity transform, shape (4, 4).
    """
    linear = world_from_light[:3, :3]
    changes: dict[str, Any] = {
        name: linear @ getattr(light, name) for name in ("direction", "edge_u", "edge_v") if hasattr(light, name)
    }
    if isinstance(light, RoundLight):
        changes["radius"] = light.radius * float(np.cbrt(np.linalg.det(linear)))
    if isinstance(light, PlacedLight):
        changes["position"] = linear @ light.position + world_from_light[:3, 3]
    return replace(light, **changes)


def _squared(offsets: Doubles) -> Doubles:
    """Returns the squared lengths of N offsets from a light, at least `LIGHT_DISTANCE_MIN` squared, shape (N,)."""
    return np.maximum(np.einsum("ij,ij->i", offsets, offsets), LIGHT_DISTANCE_MIN**2)


def _window(reach: float, distance2: Doubles) -> Doubles:
    """Returns glTF's factor ``clamp(1 - (distance / reach)^4, 0, 1)`` that fades light out towards its range, (N,)."""
    return np.clip(1.0 - (distance2 / reach**2) ** 2, 0.0, 1.0)


def _flat_candela(light: FlatLight, offsets: Doubles) -> Doubles:
    return np.maximum(offsets @ light.area_vector, 0.0) / np.sqrt(_squared(offsets))


def _flat_distances(light: FlatLight, origins: Doubles, directions: Doubles) -> Doubles:
    offsets, normal = origins - np.array(light.position), light.area_vector
    towards = -directions @ normal
    distances = (offsets @ normal) / np.where(towards > 0.0, towards, 1.0)
    hits = (towards > 0.0) & (distances > 0.0) & light.covers(offsets + distances[:, None] * directions)
    return np.where(hits, distances, np.inf)
