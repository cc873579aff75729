"""A scene: assets placed in the world."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_DEGREE_MAX, SIMILARITY_TOLERANCE
from lumisplat.errors import SceneError
from lumisplat.math.arrays import matrix_4x4
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.materials import Material
from lumisplat.scene.mesh import Mesh


@dataclass(frozen=True, slots=True, eq=False)
class SplatInstance:
    """A Gaussian set placed in the world by rotation, uniform scale and translation.

    Raises:
        SceneError: The asset is none, or ``world_from_object`` mirrors, shears or scales the axes differently; the
            message says which, and by how much.
    """

    gaussians: Gaussians
    world_from_object: npt.NDArray[np.float64] | None = None
    """Similarity transform, shape (4, 4); None: the identity."""
    material: Material | None = None
    """How it takes light; None: it shines as captured, whatever the lights."""
    name: str = field(default="", kw_only=True)
    sh_degree: int = field(default=SH_DEGREE_MAX, kw_only=True)
    """Highest SH degree that is evaluated, 0..3: less drops what light from other directions was baked in."""
    shadow_only: bool = field(default=False, kw_only=True)
    """It keeps its captured look, light does not brighten it, and its own Gaussians do not shadow it: it is only
    darkened where something else blocks a light. By how much depends on the light that it has besides, the
    ``ambient`` of a `MaterialSimple` (0.5 without a material)."""

    def __post_init__(self) -> None:
        if not isinstance(self.gaussians, Gaussians):
            raise SceneError(f"a splat instance holds Gaussians, got a {type(self.gaussians).__name__}")
        if self.material is not None and not isinstance(self.material, Material):
            raise SceneError(f"material is a {type(self.material).__name__}, expected a MaterialPbr or MaterialSimple")
        degree = self.sh_degree
        whole = isinstance(degree, int | np.integer) and not isinstance(degree, bool)
        if not whole or not 0 <= degree <= SH_DEGREE_MAX:
            raise SceneError(f"sh_degree is {degree}, expected a whole number from 0 to {SH_DEGREE_MAX}")
        if not isinstance(self.shadow_only, bool | np.bool_):
            raise SceneError(f"shadow_only is {self.shadow_only}, expected True or False")
        matrix = matrix_4x4("world_from_object", self.world_from_object)
        refuse_dissimilar(matrix[:3, :3])
        object.__setattr__(self, "world_from_object", matrix)

    @property
    def transform(self) -> npt.NDArray[np.float64]:
        """``world_from_object``, never None."""
        assert self.world_from_object is not None
        return self.world_from_object

    @property
    def world_means(self) -> npt.NDArray[np.float64]:
        """Means in world space, shape (N, 3)."""
        return self.gaussians.means @ self.transform[:3, :3].T + self.transform[:3, 3]

    @property
    def scale(self) -> float:
        """Uniform scale factor of the transform."""
        return float(np.cbrt(np.linalg.det(self.transform[:3, :3])))


@dataclass(frozen=True, slots=True, eq=False)
class MeshInstance:
    """A mesh placed in the world by any invertible affine transform.

    Raises:
        SceneError: The asset is none, or ``world_from_object`` is no such transform.
    """

    mesh: Mesh
    world_from_object: npt.NDArray[np.float64] | None = None
    """Affine transform, shape (4, 4); None: the identity."""
    name: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.mesh, Mesh):
            raise SceneError(f"a mesh instance holds a Mesh, got a {type(self.mesh).__name__}")
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
        SceneError: An entry is neither an asset nor an instance of one, or no light, or there are two environments.
    """

    splats: tuple[SplatInstance, ...] = field(default=())
    meshes: tuple[MeshInstance, ...] = field(default=())
    lights: tuple[Light, ...] = field(default=())
    """At most one of those that are enabled is a `LightEnvironment`."""

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
        """Corners (min, max) of a world-space box around all means and vertices, shape (3,) each.

        Raises:
            SceneError: The scene is empty.
        """
        clouds = [(i.gaussians.means, i.transform) for i in self.splats]
        clouds += [(i.mesh.positions, i.transform) for i in self.meshes]
        if not clouds:
            raise SceneError("an empty scene has no bounds")
        worlds = [points @ matrix[:3, :3].T + matrix[:3, 3] for points, matrix in clouds]
        return np.min([w.min(axis=0) for w in worlds], axis=0), np.max([w.max(axis=0) for w in worlds], axis=0)


def refuse_dissimilar(linear: npt.NDArray[np.float64]) -> None:
    """Refuses what a splat instance cannot be placed by.

    Raises:
        SceneError: The matrix, shape (3, 3), does not only turn and scale uniformly; with the figures.
    """
    gram = linear.T @ linear
    gram /= np.trace(gram) / 3.0
    factors = np.linalg.norm(linear, axis=0)
    x, y, z = linear.T / factors[:, None]
    determinant = np.linalg.det(linear)
    reasons = []
    if determinant < 0.0:
        reasons.append(f"mirrors (determinant {determinant:.4g})")
    if np.abs(np.diag(gram) - 1.0).max() > SIMILARITY_TOLERANCE:
        reasons.append("scales the axes by {:.6g}, {:.6g} and {:.6g}".format(*factors))
    if np.abs(gram - np.diag(np.diag(gram))).max() > SIMILARITY_TOLERANCE:
        angles = np.degrees(np.arccos(np.clip([x @ y, y @ z, z @ x], -1.0, 1.0)))
        reasons.append("shears (its axes meet at {:.5g}, {:.5g} and {:.5g} degrees)".format(*angles))
    if reasons:
        said = " and ".join(reasons)
        raise SceneError(
            f"world_from_object {said}: a splat instance takes rotation, uniform scale and translation only"
        )


def checked_lights(lights: Iterable[object]) -> tuple[Light, ...]:
    """The lights of a list.

    Raises:
        SceneError: It is none, holds something else, or two environments that are enabled.
    """
    if not isinstance(lights, Iterable):
        raise SceneError(f"lights is one {type(lights).__name__}, expected a list")
    checked = []
    for light in lights:
        if not isinstance(light, Light):
            raise SceneError(f"lights holds a {type(light).__name__}, expected a LightPoint or another light")
        checked.append(light)
    if sum(isinstance(light, LightEnvironment) and light.enabled for light in checked) > 1:
        raise SceneError("lights holds two enabled environments, expected one")
    return tuple(checked)


def _instances(name: str, items: Iterable[object], asset: type, instance: type) -> tuple:
    if not isinstance(items, Iterable):
        raise SceneError(f"{name} is one {type(items).__name__}, expected a list")
    placed = tuple(instance(item) if isinstance(item, asset) else item for item in items)
    for item in placed:
        if not isinstance(item, instance):
            raise SceneError(f"{name} holds a {type(item).__name__}, expected {instance.__name__} or {asset.__name__}")
    return placed
