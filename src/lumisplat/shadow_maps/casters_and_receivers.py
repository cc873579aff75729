"""Converts casters and receivers to Gaussians in the world, and chooses where receivers sample the map."""

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
"""Gaussians, or what can be turned into them."""

_EXPECTED = "Gaussians, a Mesh, an instance of one, a Scene, or a list of these"

SURFACES_HELD = 64
"""Meshes whose Gaussians are kept: those that were used last."""


class MeshesAsGaussians:
    """Turns meshes into Gaussians, each once: a mesh that returns after some frames casts the same shadow as before.

    Meshes that share their ``indices``, as poses of a rig do, are one surface that deforms: its Gaussians follow it.
    """

    def __init__(self) -> None:
        self._surfaces: dict[int, _Surface] = {}

    def placed(self, name: str, content: Content | Iterable[Content], origin: Doubles = ZERO) -> PlacedGaussians:
        """The Gaussians of all that is given, in the world; meshes come after the Gaussians of a scene.

        Args:
            name: The argument's name, for messages.
            content: One thing or several.
            origin: World position about which they are, shape (3,).

        Raises:
            SceneError: Something else is among them.
        """
        return placed_gaussians(self.instances(name, content), origin)

    def instances(self, name: str, content: Content | Iterable[Content]) -> list[SplatInstance]:
        """Returns all that is given as instances of Gaussians; arguments and errors as of `placed`."""
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
        # The least recently used one is dropped: meshes that are new in every frame must not pile up.
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
    """A mesh and Gaussians that cover it."""

    mesh: Mesh
    gaussians: Gaussians
    binding: Binding

    @classmethod
    def of(cls, mesh: Mesh) -> _Surface:
        samples = sample_surface(mesh)
        return cls(mesh, samples.gaussians, bind_surface(mesh, samples))

    def moved_to(self, positions: npt.NDArray[np.floating]) -> Gaussians:
        """The Gaussians of the surface with its vertices at ``positions``."""
        changed, vanished = deform_gaussians(self.binding, self.gaussians.scales, positions, None)
        opacities = np.where(vanished, np.float32(0.0), self.gaussians.opacities)
        return replace(self.gaussians, opacities=opacities, **changed)


def _is_similar(linear: npt.NDArray[np.float64]) -> bool:
    """Whether a matrix, shape (3, 3), turns and scales uniformly."""
    gram = linear.T @ linear / np.cbrt(np.linalg.det(linear)) ** 2
    return bool(np.linalg.det(linear) > 0.0 and np.abs(gram - np.eye(3)).max() <= SIMILARITY_TOLERANCE)


def as_iterable(name: str, content: object) -> Iterable[object]:
    """The content as something to iterate over.

    Raises:
        SceneError: It is a single thing; the message says what may be given.
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
"""What a map is sampled for: Gaussians, or what can be turned into them, or points."""

_PATTERN = {
    ReceiverSampling.CENTER: CENTER,
    ReceiverSampling.STENCIL: STENCIL,
    ReceiverSampling.MONTE_CARLO: RANDOM,
}
_STENCIL_POINTS = 7


def placed_receivers(receivers: Receiving, origin: Doubles) -> PlacedGaussians:
    """Receivers in the world about an origin, shape (3,), those that are points as Gaussians without extent.

    Raises:
        SceneError: Something is of another kind, or a value is not finite.
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
    """Points, shape (N, 3), as Gaussians without extent, about an origin.

    Raises:
        SceneError: The shape does not fit, or values are not finite.
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
    """The samples of each receiver as the settings say; of receivers without extent, their means."""
    sampling = FootprintSampling()
    sampling.pattern, sampling.count = _PATTERN[config.sampling], config.samples
    sampling.seed = wp.uint32(config.seed)
    if config.sampling is ReceiverSampling.STENCIL:
        sampling.count = _STENCIL_POINTS
    if config.sampling is ReceiverSampling.CENTER or not receivers.scales.any():
        sampling.pattern, sampling.count = CENTER, 1
    return sampling
