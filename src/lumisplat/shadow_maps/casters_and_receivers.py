"""Converts shadow casters and receivers to Gaussians in world space, and chooses sample points in receivers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import DeepShadowConfig, ReceiverSampling
from lumisplat.constants import SIMILARITY_TOLERANCE
from lumisplat.device.shadow_map.lookup import CENTER, RANDOM, STENCIL, FootprintSampling, Receivers
from lumisplat.errors import SceneError, check_shapes
from lumisplat.math.arrays import Doubles, float_array
from lumisplat.runtime.buffers import Buffers
from lumisplat.scene.animation.rigged_gaussians import Binding, bind_surface, deform_gaussians
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.local_frame import ZERO, PlacedGaussians, placed_gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.mesh_sampling import sample_surface
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

Content = Gaussians | SplatInstance | Mesh | MeshInstance | Scene
"""Types of shadow casters and receivers: Gaussians, or objects that can be converted to Gaussians."""

_EXPECTED = "Gaussians, a Mesh, an instance of one, a Scene, or a list of these"

SURFACES_HELD = 64
"""Largest number of meshes whose conversion to Gaussians is cached; beyond it, the least recently used one is dropped.
"""


class MeshesAsGaussians:
    """Converts meshes to Gaussians and caches the result, so that a mesh that reappears casts the same shadow again.

    Meshes that share their ``indices``, such as poses of a rig, are one deforming surface: the Gaussians of the first
    pose move with the triangles.
    """

    def __init__(self) -> None:
        self._surfaces: dict[int, _Surface] = {}

    def placed(self, name: str, content: Content | Iterable[Content], origin: Doubles = ZERO) -> PlacedGaussians:
        """Returns the Gaussians of all casters or receivers in world space; in a scene, Gaussians of meshes come last.

        Args:
            name: Name of the argument in messages.
            content: One object or several.
            origin: World position to which the Gaussians are relative, shape (3,).

        Raises:
            SceneError: An item is not of the types in `Content`.
        """
        return placed_gaussians(self.instances(name, content), origin)

    def instances(self, name: str, content: Content | Iterable[Content]) -> list[SplatInstance]:
        """Returns all content as splat instances, converting meshes to Gaussians; arguments as for `placed`.

        Raises:
            SceneError: An item is not of the types in `Content`.
        """
        items: list[SplatInstance] = []
        for one in [content] if isinstance(content, Content) else _several(name, content):
            if isinstance(one, Scene):
                items += [*one.splats, *(self._as_splats(i) for i in one.meshes)]
            elif isinstance(one, Mesh | MeshInstance):
                items.append(self._as_splats(MeshInstance(one) if isinstance(one, Mesh) else one))
            else:
                items.append(SplatInstance(one) if isinstance(one, Gaussians) else one)
        return items

    def _as_splats(self, instance: MeshInstance) -> SplatInstance:
        mesh, matrix = instance.mesh, instance.transform
        # The least recently used surface is dropped, so that new meshes in every frame do not accumulate.
        surface = self._surfaces.pop(id(mesh.indices), None) or _Surface.of(mesh)
        self._surfaces[id(mesh.indices)] = surface
        if len(self._surfaces) > SURFACES_HELD:
            self._surfaces.pop(next(iter(self._surfaces)))
        if mesh is surface.mesh and _is_similar(matrix[:3, :3]):
            return SplatInstance(surface.gaussians, matrix)
        # Splat instances cannot deform, mirror or shear: the triangles do, and the Gaussians follow them.
        moved = np.eye(4)
        moved[:3, 3] = matrix[:3, 3]
        return SplatInstance(surface.moved_to(mesh.positions @ matrix[:3, :3].T), moved)


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """A mesh, the Gaussians that cover it, and the data that binds these Gaussians to the mesh's triangles."""

    mesh: Mesh
    gaussians: Gaussians
    binding: Binding

    @classmethod
    def of(cls, mesh: Mesh) -> _Surface:
        samples = sample_surface(mesh)
        return cls(mesh, samples.gaussians, bind_surface(mesh, samples))

    def moved_to(self, positions: npt.NDArray[np.floating]) -> Gaussians:
        """Returns the surface's Gaussians, moved along with the mesh to other vertex positions."""
        changed, vanished = deform_gaussians(self.binding, self.gaussians.scales, positions, None)
        opacities = np.where(vanished, np.float32(0.0), self.gaussians.opacities)
        return replace(self.gaussians, opacities=opacities, **changed)


def _is_similar(linear: npt.NDArray[np.float64]) -> bool:
    """Returns whether a matrix, shape (3, 3), is a rotation times a uniform scale."""
    gram = linear.T @ linear / np.cbrt(np.linalg.det(linear)) ** 2
    return bool(np.linalg.det(linear) > 0.0 and np.abs(gram - np.eye(3)).max() <= SIMILARITY_TOLERANCE)


def as_iterable(name: str, content: object) -> Iterable[object]:
    """Returns the content if it is iterable; ``name`` is the argument's name in the error message.

    Raises:
        SceneError: The content is a single object of another type; the message lists the types that are allowed.
    """
    if not isinstance(content, Iterable):
        raise SceneError(f"{name} is a {type(content).__name__}, expected {_EXPECTED}")
    return cast("Iterable[object]", content)


def _several(name: str, content: object) -> list[Content]:
    items: list[Content] = []
    for one in as_iterable(name, content):
        if not isinstance(one, Content):
            raise SceneError(f"{name} holds a {type(one).__name__}, expected {_EXPECTED}")
        items.append(one)
    return items


Receiving = Content | Iterable[Content] | npt.ArrayLike
"""Receivers of shadows: Gaussians, objects that can be converted to Gaussians, or points."""

_PATTERN = {
    ReceiverSampling.CENTER: CENTER,
    ReceiverSampling.STENCIL: STENCIL,
    ReceiverSampling.MONTE_CARLO: RANDOM,
}
_STENCIL_POINTS = 7


def placed_receivers(receivers: Receiving, origin: Doubles) -> PlacedGaussians:
    """Returns receivers in world space relative to an origin, shape (3,); points become Gaussians of scale 0.

    Raises:
        SceneError: A receiver is not of the types in `Receiving`, or a value is not finite.
    """
    if isinstance(receivers, Content):
        return MeshesAsGaussians().placed("receivers", receivers, origin)
    if isinstance(receivers, np.ndarray):
        return placed_points(cast("npt.ArrayLike", receivers), origin)
    items: list[Any] = list(as_iterable("receivers", receivers))
    if items and isinstance(items[0], Content):
        return MeshesAsGaussians().placed("receivers", items, origin)
    return placed_points(items, origin)


def placed_points(values: npt.ArrayLike, origin: Doubles) -> PlacedGaussians:
    """Returns N points, shape (N, 3), as Gaussians of scale 0 relative to an origin, shape (3,).

    Raises:
        SceneError: The points' shape is not (N, 3), or values are not finite.
    """
    points = float_array("points", values)
    if points.size == 0:
        points = points.reshape(0, 3)
    check_shapes(points=(points, "N 3"))
    if origin.any():
        points = (np.asarray(values, np.float64).reshape(-1, 3) - origin).astype(np.float32)
    unturned = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(points), 1))
    return PlacedGaussians(points, unturned, np.zeros_like(points), np.zeros(len(points), np.float32))


def upload_receivers(buffers: Buffers, placed: PlacedGaussians) -> Receivers:
    """Copies receivers to the device."""
    receivers = Receivers()
    receivers.means = buffers.upload("receivers.means", wp.vec3, placed.means)
    receivers.rotations = buffers.upload("receivers.rotations", wp.quat, placed.rotations_xyzw)
    receivers.scales = buffers.upload("receivers.scales", wp.vec3, placed.scales)
    return receivers


def footprint_sampling(config: DeepShadowConfig, receivers: PlacedGaussians) -> FootprintSampling:
    """Returns the points of each receiver's footprint at which its shadow is looked up: the mean if all are points.

    All receivers are points if every scale is 0.
    """
    sampling = FootprintSampling()
    sampling.pattern, sampling.count = _PATTERN[config.sampling], config.samples
    sampling.seed = wp.uint32(config.seed)
    if config.sampling is ReceiverSampling.STENCIL:
        sampling.count = _STENCIL_POINTS
    if config.sampling is ReceiverSampling.CENTER or not receivers.scales.any():
        sampling.pattern, sampling.count = CENTER, 1
    return sampling
