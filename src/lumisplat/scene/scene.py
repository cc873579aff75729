"""Scenes: captures, meshes and lights placed in the world."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import field
from typing import Annotated, Any, ClassVar, Literal, TypeVar, cast
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import Range
from lumisplat.config.setting import Share, frozen, given
from lumisplat.constants import SH_DEGREE_MAX, SIMILARITY_TOLERANCE
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray, box_text
from lumisplat.math.transforms import quaternions_from_matrices, transform_points
from lumisplat.scene.camera import Camera
from lumisplat.scene.checks import Vector, check_kind, items_of, take_scene_fields
from lumisplat.scene.gaussians import Gaussians, moved_orientation
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.materials import Material, MaterialPbr, MaterialSimple
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.placing import UP_AXES, PlacedInstance, Placement, up_vector, up_vector_or_none, y_up_from

BULK_TAIL = 0.02
"""Fraction of a capture's total opacity outside its bulk (the box of `Scene.bulk_bounds`) at each end of each axis:
stray Gaussians must neither set the view nor raise an object above the ground."""

Bounds = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]
"""Corners (min, max) of a box, world space, shape (3,) each."""

_BINS = 2**14
"""Number of histogram bins of `bulk_extent`. Only the heights in the bin that contains a quantile are sorted."""

_Placed = TypeVar("_Placed", "SplatInstance", "MeshInstance")


@frozen
class SplatInstance(PlacedInstance):
    """A capture placed in the world by rotation, uniform scale and translation.

    Raises:
        SceneError: ``gaussians`` is not a `Gaussians`; ``world_from_object`` mirrors, shears or scales the axes
            differently (the message names the fault and its size); or a matrix is given together with a position or
            another placement argument.
    """

    gaussians: Gaussians
    world_from_object: npt.NDArray[np.float64] | None = None
    """Similarity transform, shape (4, 4); None: as the placement arguments (``position`` and so on) say, or without
    them a translation to the ``origin`` of the Gaussians."""
    material: Material | None = None
    """Material that reflects light in lit frames; None: the capture shows its captured colours, whatever the lights."""
    sh_degree: Annotated[int, Range(0, SH_DEGREE_MAX)] = field(default=SH_DEGREE_MAX, kw_only=True)
    """Highest SH degree that is evaluated; the settings of the rasteriser and of the ray tracer may lower it further. A
    lower degree removes view-dependent colour that was baked in."""
    depth_iso_transmittance: Share | None = field(default=None, kw_only=True)
    """Transmittance at the capture's surface, which has depth, normal and light: the first Gaussian behind which the
    transmittance is lower. Lower it for a capture with floaters or fuzz. None: that of `RasterConfig` or `TraceConfig`.
    """
    shadow_catcher: bool = field(default=False, kw_only=True)
    """Make the capture a shadow catcher: in lit frames it shows its captured colours, darkened where other objects
    block a light. Lights do not brighten the capture, and its own Gaussians do not shadow it. Its ambient light sets
    how dark shadows are: the ``ambient`` of a `MaterialSimple`, 0.5 with a `MaterialPbr`; without a material 0.5, or 0
    in scenes with an environment (itself ambient light) and, except in real time, in scenes without lights."""

    def __post_init__(self, *placing: Any) -> None:
        check_kind("gaussians", self.gaussians, Gaussians, "Gaussians")
        if self.material is not None:
            check_kind("material", self.material, (MaterialPbr, MaterialSimple), "a MaterialPbr or MaterialSimple")
        take_scene_fields(self)
        self._place(self.world_from_object, Placement(*placing), self.gaussians.origin)
        check_similarity(self.transform[:3, :3])

    def __repr__(self) -> str:
        material = f", material={type(self.material).__name__}" if self.material is not None else ""
        catcher = ", shadow_catcher" if self.shadow_catcher else ""
        return f"SplatInstance({self.gaussians!r}, {self._placement()}{material}{catcher})"

    @property
    def world_means(self) -> npt.NDArray[np.float64]:
        """World-space centres of the instance's N Gaussians, float64, shape (N, 3)."""
        return transform_points(self.transform, self.gaussians.means)

    def bounds(self) -> Bounds:
        """Returns the corners (min, max) of the world-space bounding box of the means, shape (3,) each."""
        points = self.world_means
        return points.min(axis=0), points.max(axis=0)

    @property
    def scale(self) -> float:
        """Uniform scale factor that ``world_from_object`` contains."""
        return float(np.cbrt(np.linalg.det(self.transform[:3, :3])))


@frozen
class MeshInstance(PlacedInstance):
    """A mesh placed in the world by any invertible affine transform.

    Raises:
        SceneError: ``mesh`` is not a `Mesh`, ``world_from_object`` is not an invertible affine transform, or a matrix
            is given together with a position or another placement argument.
    """

    mesh: Mesh
    world_from_object: npt.NDArray[np.float64] | None = None
    """Affine transform, shape (4, 4); None: as the placement arguments (``position`` and so on) say, or without them a
    translation to the ``origin`` of the mesh."""
    shadow_catcher: bool = field(default=False, kw_only=True)
    """Make the mesh a shadow catcher: a lit frame shows only the shadows of other objects on the mesh, and, if it is
    shiny, their reflections. The mesh stands for a surface of a capture, or of an image composited behind the frame. It
    hides nothing and casts no shadow. Captures with a reflecting material cast shadows on the mesh. Unlit captures cast
    shadows on it only if another capture is a shadow catcher."""

    def __post_init__(self, *placing: Any) -> None:
        check_kind("mesh", self.mesh, Mesh, "a Mesh")
        take_scene_fields(self)
        self._place(self.world_from_object, Placement(*placing), self.mesh.origin)

    def __repr__(self) -> str:
        catches = ", shadow_catcher" if self.shadow_catcher else ""
        return f"MeshInstance({self.mesh!r}, {self._placement()}{catches})"

    def bounds(self) -> Bounds:
        """Returns the corners (min, max) of the world-space bounding box of the vertices, shape (3,) each."""
        points = transform_points(self.transform, self.mesh.positions)
        return points.min(axis=0), points.max(axis=0)


def checked_lights(lights: Iterable[Light], name: str = "lights") -> tuple[Light, ...]:
    """Converts a list of lights from the user to a tuple.

    Raises:
        SceneError: ``lights`` is not a list, an entry is not a light, or two environments are enabled.
    """
    checked: list[Light] = []
    for light in items_of(name, lights):
        if not isinstance(light, Light):
            raise SceneError(f"{name} holds a {type(light).__name__}, expected a LightPoint or another light")
        checked.append(light)
    if sum(isinstance(light, LightEnvironment) and light.enabled for light in checked) > 1:
        raise SceneError(f"{name} holds two enabled environments, expected one")
    return tuple(checked)


def _splats(items: Iterable[SplatInstance | Gaussians], name: str = "splats") -> tuple[SplatInstance, ...]:
    """Converts captures to instances; a bare `Gaussians` becomes an instance at its stored ``origin``."""
    return _instances(name, items, Gaussians, SplatInstance)


def _meshes(items: Iterable[MeshInstance | Mesh], name: str = "meshes") -> tuple[MeshInstance, ...]:
    """Converts meshes to instances; a bare `Mesh` becomes an instance at its stored ``origin``."""
    return _instances(name, items, Mesh, MeshInstance)


def _instances(name: str, items: Iterable[object], asset: type[Any], instance: type[_Placed]) -> tuple[_Placed, ...]:
    """Converts entries to ``instance`` objects; an ``asset`` is wrapped in one at its stored ``origin``."""
    placed: list[_Placed] = []
    for item in items_of(name, items):
        one = instance(cast("Any", item)) if isinstance(item, asset) else item
        if not isinstance(one, instance):
            raise SceneError(f"{name} holds a {type(one).__name__}, expected {instance.__name__} or {asset.__name__}")
        placed.append(one)
    return tuple(placed)


@frozen(weakref_slot=True)
class Scene:
    """Captures, meshes and lights to render. Bare `Gaussians` and `Mesh` objects stand at their stored ``origin``.

    Raises:
        SceneError: An entry of a list has the wrong type, two environments are enabled, or ``up`` is no direction.
    """

    UP_NAMES: ClassVar[tuple[str, ...]] = tuple(UP_AXES)
    """Axis names that ``up`` accepts, such as ``"y-down"``."""

    splats: tuple[SplatInstance, ...] = given(converter=_splats, default=())
    meshes: tuple[MeshInstance, ...] = given(converter=_meshes, default=())
    lights: tuple[Light, ...] = given(converter=checked_lights, default=())
    """Lights; at most one enabled light is a `LightEnvironment`."""
    up: Vector | None = given(converter=up_vector_or_none, default=None, kw_only=True)
    """Unit vector that points up; None: unknown, see `up_direction`. Accepts the name of an axis (``"y-down"``,
    ``"z-up"``) or a direction of any length."""

    __post_init__ = take_scene_fields

    def __repr__(self) -> str:
        bounds = f", bounds={box_text(*self.bounds())}" if self.splats or self.meshes else ""
        return (
            f"Scene(splats={len(self.splats)}, gaussians={self.gaussian_count}, meshes={len(self.meshes)}, "
            f"faces={self.face_count}, lights={len(self.lights)}{bounds})"
        )

    @property
    def is_lit_by_default(self) -> bool:
        """True if the scene has lights or meshes: frames are then lit unless ``RenderConfig.lighting`` is given.

        Meshes without any light would be flat areas of colour, so the captures around them light them, or a headlight
        at the camera does. Captures without meshes or lights show their captured colours.
        """
        return bool(self.lights or self.meshes)

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians of all splat instances together."""
        return sum(instance.gaussians.count for instance in self.splats)

    @property
    def face_count(self) -> int:
        """Number of triangles of all mesh instances together."""
        return sum(instance.mesh.face_count for instance in self.meshes)

    @property
    def up_direction(self) -> Vector:
        """Unit vector that points up: ``up``, else the up direction of the first capture with one, else a guess.

        The guess is y down for a scene with a capture, and y up for a scene of meshes. `up_source` names the source
        used.
        """
        if self.up is not None:
            return self.up
        stated = self._stated_up()
        return up_vector("y-down" if self.splats else "y-up") if stated is None else stated

    @property
    def up_source(self) -> Literal["scene", "capture", "guess"]:
        """Source of `up_direction`: ``up`` of the scene, ``up`` of a capture, or a guess."""
        if self.up is not None:
            return "scene"
        return "guess" if self._stated_up() is None else "capture"

    @property
    def first_view(self) -> Camera | None:
        """World-space camera of the first capture that stores a default view; None if no capture stores one."""
        for instance in self.splats:
            if instance.gaussians.first_view is not None:
                return moved_orientation(instance.gaussians, instance.transform)["first_view"]
        return None

    def _stated_up(self) -> Vector | None:
        """Returns the world-space up direction of the first capture that has an ``up``; None if no capture has one."""
        for instance in self.splats:
            if instance.gaussians.up is not None:
                return moved_orientation(instance.gaussians, instance.transform)["up"]
        return None

    @property
    def upright_wxyz(self) -> tuple[float, float, float, float]:
        """Quaternion, scalar first, of the rotation that stands an object with y up upright in the scene.

        The object's +z side, its front in glTF, then faces a viewer in front of the scene: by convention, scenes with y
        down are viewed along +z, scenes with y up along -z.
        """
        w, x, y, z = quaternions_from_matrices(y_up_from(self.up_direction).T[None])[0]
        return float(w), float(x), float(y), float(z)

    def bounds(self) -> Bounds:
        """Returns the corners (min, max) of the world-space bounding box of all means and vertices, shape (3,) each.

        Raises:
            SceneError: The scene is empty.
        """
        boxes = [instance.bounds() for instance in (*self.splats, *self.meshes)]
        if not boxes:
            raise SceneError("an empty scene has no bounds")
        lows, highs = zip(*boxes, strict=True)
        return np.min(lows, axis=0), np.max(highs, axis=0)

    def bulk_bounds(self) -> Bounds:
        """Returns the world-space corners (min, max), (3,) each, of a box around meshes and the bulk of captures.

        The bulk of a capture ignores stray Gaussians: 2 % of its opacity is left out at each end of each axis.

        Raises:
            SceneError: The scene is empty.
        """
        boxes = [_bulk(instance) for instance in self.splats]
        worlds = [transform_points(i.transform, i.mesh.positions) for i in self.meshes]
        boxes += [(world.min(axis=0), world.max(axis=0)) for world in worlds]
        if not boxes:
            raise SceneError("the scene is empty, expected a capture or a mesh")
        lows, highs = zip(*boxes, strict=True)
        return np.min(lows, axis=0), np.max(highs, axis=0)


_BULKS: WeakKeyDictionary[Gaussians, tuple[bytes, Bounds]] = WeakKeyDictionary()
"""Cache of captures' bulk boxes: the transform of the instance as bytes, and the box (min, max) in world space."""


def _bulk(instance: SplatInstance) -> Bounds:
    """Returns the world-space box of an instance's means, less the outer 2 % of opacity at each end of each axis."""
    place = instance.transform.tobytes()
    held = _BULKS.get(instance.gaussians)
    if held is None or held[0] != place:
        ends = [bulk_extent(axis, instance.gaussians.opacities) for axis in instance.world_means.T]
        low, high = np.array(ends).T
        held = _BULKS[instance.gaussians] = place, (low, high)
    low, high = held[1]
    return low.copy(), high.copy()


def bulk_extent(heights: npt.NDArray[np.float64], weights: FloatArray, tail: float = BULK_TAIL) -> tuple[float, float]:
    """Returns two heights: the fraction ``tail`` of all weight lies below the first, and as much above the second.

    Args:
        heights: Height of each Gaussian, in any direction, shape (N,).
        weights: Weight of each Gaussian, such as its opacity, shape (N,).
        tail: Fraction of the summed weights, 0..0.5.
    """
    low = float(heights.min())
    extent = float(heights.max()) - low
    # Binning avoids sorting millions of heights: only two bins are sorted.
    bins = ((heights - low) / (extent or 1.0) * (_BINS - 1)).astype(np.int32)
    share = np.cumsum(np.bincount(bins, weights, _BINS), dtype=np.float64)
    first, last = (_height_at(heights, weights, bins, share, end * share[-1]) for end in (tail, 1.0 - tail))
    return first, last


def _height_at(
    heights: npt.NDArray[np.float64],
    weights: FloatArray,
    bins: npt.NDArray[np.int32],
    share: npt.NDArray[np.float64],
    wanted: float,
) -> float:
    """Returns the smallest height whose cumulative weight, over all points up to that height, reaches ``wanted``.

    Args:
        heights: Heights of N points, shape (N,).
        weights: Weight of each point, shape (N,).
        bins: Index of the histogram bin of each height, shape (N,).
        share: Sum of the weights in each bin and all bins before it, shape (`_BINS`,).
        wanted: Cumulative weight at which to find the height.
    """
    number = int(np.searchsorted(share, wanted))
    rows = np.flatnonzero(bins == number)
    rows = rows[np.argsort(heights[rows])]
    within = np.cumsum(weights[rows], dtype=np.float64) + (share[number - 1] if number else 0.0)
    return float(heights[rows[min(int(np.searchsorted(within, wanted)), rows.size - 1)]])


def check_similarity(
    linear: npt.NDArray[np.float64], name: str = "world_from_object", taker: str = "a splat instance"
) -> None:
    """Checks that a matrix, shape (3, 3), is a rotation times a uniform scale, as a splat instance needs.

    ``name`` and ``taker`` name the matrix and its user in the message.

    Raises:
        SceneError: The matrix mirrors, shears, or scales the axes differently; the message says by how much.
    """
    gram = linear.T @ linear
    gram /= np.trace(gram) / 3.0
    factors = np.linalg.norm(linear, axis=0)
    x, y, z = linear.T / factors[:, None]
    determinant = np.linalg.det(linear)
    reasons: list[str] = []
    if determinant < 0.0:
        reasons.append(f"mirrors (determinant {determinant:.4g})")
    if np.abs(np.diag(gram) - 1.0).max() > SIMILARITY_TOLERANCE:
        reasons.append("scales the axes by {:.6g}, {:.6g} and {:.6g}".format(*factors))
    if np.abs(gram - np.diag(np.diag(gram))).max() > SIMILARITY_TOLERANCE:
        angles = np.degrees(np.arccos(np.clip([x @ y, y @ z, z @ x], -1.0, 1.0)))
        reasons.append("shears (its axes meet at {:.5g}, {:.5g} and {:.5g} degrees)".format(*angles))
    if reasons:
        listed = " and ".join(reasons)
        raise SceneError(f"{name} {listed}: {taker} takes rotation, uniform scale and translation only")
