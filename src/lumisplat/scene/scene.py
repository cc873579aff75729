"""A scene: assets placed in the world."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_DEGREE_MAX, SIMILARITY_TOLERANCE
from lumisplat.errors import SceneError
from lumisplat.math.arrays import matrix_4x4
from lumisplat.math.transforms import transform_points
from lumisplat.scene.checks import check_flag, check_kind, check_whole, items_of
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.materials import Material, MaterialPbr, MaterialSimple
from lumisplat.scene.mesh import Mesh

_Placed = TypeVar("_Placed", "SplatInstance", "MeshInstance")


@dataclass(frozen=True, slots=True, eq=False)
class SplatInstance:
    """A Gaussian set placed in the world by rotation, uniform scale and translation.

    Raises:
        SceneError: ``gaussians`` is something else, or ``world_from_object`` mirrors, shears or scales the axes
            differently; the message says which, and by how much.
    """

    gaussians: Gaussians
    world_from_object: npt.NDArray[np.float64] | None = None
    """Similarity transform, shape (4, 4); None: the identity."""
    material: Material | None = None
    """How it reflects light; None: it shines as captured, whatever the lights."""
    name: str = field(default="", kw_only=True)
    sh_degree: int = field(default=SH_DEGREE_MAX, kw_only=True)
    """Highest SH degree that is evaluated, 0..3. A lower degree removes view-dependent light that was baked in."""
    shadow_only: bool = field(default=False, kw_only=True)
    """Whether it shows its captured colours and only receives shadows: lights do not brighten it, its own Gaussians do
    not shadow it, and it is darkened where something else blocks a light. By how much depends on its ambient light,
    the ``ambient`` of a `MaterialSimple` (0.5 without a material)."""

    def __post_init__(self) -> None:
        check_kind("gaussians", self.gaussians, Gaussians, "Gaussians")
        if self.material is not None:
            check_kind("material", self.material, (MaterialPbr, MaterialSimple), "a MaterialPbr or MaterialSimple")
        check_whole("sh_degree", self.sh_degree, 0, SH_DEGREE_MAX)
        check_flag("shadow_only", self.shadow_only)
        matrix = matrix_4x4("world_from_object", self.world_from_object)
        check_similarity(matrix[:3, :3])
        object.__setattr__(self, "world_from_object", matrix)

    @property
    def transform(self) -> npt.NDArray[np.float64]:
        """``world_from_object``, never None."""
        assert self.world_from_object is not None
        return self.world_from_object

    @property
    def world_means(self) -> npt.NDArray[np.float64]:
        """Means in world space, shape (N, 3)."""
        return transform_points(self.transform, self.gaussians.means)

    @property
    def scale(self) -> float:
        """Uniform scale factor of the transform."""
        return float(np.cbrt(np.linalg.det(self.transform[:3, :3])))


@dataclass(frozen=True, slots=True, eq=False)
class MeshInstance:
    """A mesh placed in the world by any invertible affine transform.

    Raises:
        SceneError: ``mesh`` is something else, or ``world_from_object`` is not an invertible affine transform.
    """

    mesh: Mesh
    world_from_object: npt.NDArray[np.float64] | None = None
    """Affine transform, shape (4, 4); None: the identity."""
    name: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        check_kind("mesh", self.mesh, Mesh, "a Mesh")
        object.__setattr__(self, "world_from_object", matrix_4x4("world_from_object", self.world_from_object))

    @property
    def transform(self) -> npt.NDArray[np.float64]:
        """``world_from_object``, never None."""
        assert self.world_from_object is not None
        return self.world_from_object


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What a frame shows. Bare ``Gaussians`` and ``Mesh`` are accepted and placed at the origin.

    Raises:
        SceneError: An entry of a list has the wrong type, or two environments are enabled.
    """

    splats: tuple[SplatInstance, ...] = field(default=())
    meshes: tuple[MeshInstance, ...] = field(default=())
    lights: tuple[Light, ...] = field(default=())
    """At most one enabled light is a `LightEnvironment`."""

    if TYPE_CHECKING:  # what is accepted; the fields above are what it becomes

        def __init__(
            self,
            splats: Iterable[SplatInstance | Gaussians] = (),
            meshes: Iterable[MeshInstance | Mesh] = (),
            lights: Iterable[Light] = (),
        ) -> None: ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "lights", checked_lights(self.lights))
        object.__setattr__(self, "splats", _instances("splats", self.splats, Gaussians, SplatInstance))
        object.__setattr__(self, "meshes", _instances("meshes", self.meshes, Mesh, MeshInstance))

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians over all instances."""
        return sum(instance.gaussians.count for instance in self.splats)

    @property
    def face_count(self) -> int:
        """Number of triangles over all instances."""
        return sum(instance.mesh.face_count for instance in self.meshes)

    def bounds(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Corners (min, max) of the world-space bounding box of all means and vertices, shape (3,) each.

        Raises:
            SceneError: The scene is empty.
        """
        clouds = [(i.gaussians.means, i.transform) for i in self.splats]
        clouds += [(i.mesh.positions, i.transform) for i in self.meshes]
        if not clouds:
            raise SceneError("an empty scene has no bounds")
        # One after the other: together, the world points of many instances fill the memory.
        worlds = (transform_points(matrix, points) for points, matrix in clouds)
        lows, highs = zip(*((world.min(axis=0), world.max(axis=0)) for world in worlds), strict=True)
        return np.min(lows, axis=0), np.max(highs, axis=0)


def check_similarity(linear: npt.NDArray[np.float64]) -> None:
    """Checks that a matrix, shape (3, 3), is a rotation times a uniform scale, as a splat instance needs.

    Raises:
        SceneError: It mirrors, scales the axes differently or shears; the message says by how much.
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
        raise SceneError(
            f"world_from_object {listed}: a splat instance takes rotation, uniform scale and translation only"
        )


def checked_lights(lights: Iterable[object]) -> tuple[Light, ...]:
    """The lights of a list that the user gives, as a tuple.

    Raises:
        SceneError: It is not a list, an entry is not a light, or two environments are enabled.
    """
    checked: list[Light] = []
    for light in items_of("lights", lights):
        if not isinstance(light, Light):
            raise SceneError(f"lights holds a {type(light).__name__}, expected a LightPoint or another light")
        checked.append(light)
    if sum(isinstance(light, LightEnvironment) and light.enabled for light in checked) > 1:
        raise SceneError("lights holds two enabled environments, expected one")
    return tuple(checked)


def _instances(name: str, items: Iterable[object], asset: type[Any], instance: type[_Placed]) -> tuple[_Placed, ...]:
    """The entries of a list as instances; bare assets are placed at the origin."""
    placed: list[_Placed] = []
    for item in items_of(name, items):
        one = instance(cast("Any", item)) if isinstance(item, asset) else item
        if not isinstance(one, instance):
            raise SceneError(f"{name} holds a {type(one).__name__}, expected {instance.__name__} or {asset.__name__}")
        placed.append(one)
    return tuple(placed)
