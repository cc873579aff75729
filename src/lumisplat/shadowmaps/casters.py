"""What may be given as casters or receivers, as Gaussians in the world."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SIMILARITY_TOLERANCE
from lumisplat.errors import SceneError
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.placed import PlacedGaussians, placed_gaussians
from lumisplat.scene.sampling import gaussians_from_mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

Content = Gaussians | SplatInstance | Mesh | MeshInstance | Scene
"""What has Gaussians, or can be turned into them."""

_EXPECTED = "Gaussians, a Mesh, an instance of one, a Scene, or a list of these"

_Key = tuple[int, bytes]
"""A mesh, which is held as long as its key, and what is done to its vertices."""


class MeshesAsGaussians:
    """Meshes turned into Gaussians, once each, as long as they keep coming back."""

    def __init__(self) -> None:
        self._turned: dict[_Key, tuple[Mesh, Gaussians]] = {}

    def placed(self, name: str, content: Content | Iterable[Content]) -> PlacedGaussians:
        """The Gaussians of all that is given, in the world; meshes come after the Gaussians of a scene.

        Args:
            name: What messages call it.
            content: One thing or several.

        Raises:
            SceneError: Something else is among them, or a mesh cannot be turned into Gaussians.
        """
        before, self._turned = self._turned, {}
        items: list[SplatInstance] = []
        for one in [content] if isinstance(content, Content) else _several(name, content):
            if isinstance(one, Scene):
                items += [*one.splats, *(self._turned_instance(i, before) for i in one.meshes)]
            elif isinstance(one, Mesh | MeshInstance):
                items.append(self._turned_instance(MeshInstance(one) if isinstance(one, Mesh) else one, before))
            else:
                items.append(SplatInstance(one) if isinstance(one, Gaussians) else one)
        return placed_gaussians(items)

    def _turned_instance(self, instance: MeshInstance, before: dict[_Key, tuple[Mesh, Gaussians]]) -> SplatInstance:
        linear, matrix = instance.transform[:3, :3], instance.transform
        # What no splat instance can do, mirroring and shearing, is done to the vertices.
        baked = b"" if _is_similar(linear) else linear.tobytes()
        key = id(instance.mesh), baked
        if key in before:
            self._turned[key] = before[key]
        if key not in self._turned:
            mesh = instance.mesh
            if baked:
                mesh = replace(mesh, positions=mesh.positions @ linear.T.astype(np.float32), normals=None)
            self._turned[key] = instance.mesh, gaussians_from_mesh(mesh)
        if baked:
            matrix = np.eye(4)
            matrix[:3, 3] = instance.transform[:3, 3]
        return SplatInstance(self._turned[key][1], matrix)


def _is_similar(linear: npt.NDArray[np.float64]) -> bool:
    """Whether a matrix, shape (3, 3), turns and scales uniformly."""
    gram = linear.T @ linear / np.cbrt(np.linalg.det(linear)) ** 2
    return bool(np.linalg.det(linear) > 0.0 and np.abs(gram - np.eye(3)).max() <= SIMILARITY_TOLERANCE)


def as_iterable(name: str, content: object) -> Iterable[object]:
    """What is given, if it is several things.

    Raises:
        SceneError: It is not; the message says what may be given.
    """
    if not isinstance(content, Iterable):
        raise SceneError(f"{name} is a {type(content).__name__}, expected {_EXPECTED}")
    return content


def _several(name: str, content: object) -> list[Content]:
    items = []
    for one in as_iterable(name, content):
        if not isinstance(one, Content):
            raise SceneError(f"{name} holds a {type(one).__name__}, expected {_EXPECTED}")
        items.append(one)
    return items
