"""Actors of a frame: Gaussians and meshes placed in the world, and what is said about each of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import cast

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, SplatInstance

PlacedActor = SplatInstance | MeshInstance
"""What moves through the scene, as it is at one time."""


def placed_actors(actors: Iterable[PlacedActor | Gaussians | Mesh]) -> list[PlacedActor]:
    """Actors as instances.

    Raises:
        SceneError: It is no list, or holds something else.
    """
    given: object = actors
    return [_placed(actor) for actor in _items("actors", given)]


def actor_flags(name: str, flags: Sequence[bool] | None, count: int) -> Sequence[bool]:
    """One flag for each actor; all True if none are given.

    Raises:
        SceneError: They are no list of booleans, or of another number.
    """
    if flags is None:
        return [True] * count
    _check_booleans(name, flags)
    if len(flags) != count:
        raise SceneError(f"{name} has {len(flags)} entries, expected {count}, one an actor")
    return flags


def centroid(actors: Sequence[PlacedActor]) -> npt.NDArray[np.float64]:
    """World-space mean of the Gaussians of all actors, weighted by opacity; meshes by their vertices, shape (3,)."""
    sums, total = np.zeros(3), 0.0
    for actor in actors:
        if isinstance(actor, SplatInstance):
            points, weights = actor.gaussians.means, actor.gaussians.opacities.astype(np.float64)
        else:
            points, weights = actor.mesh.positions, np.ones(actor.mesh.vertex_count)
        # Actors that are transparent throughout have a place nevertheless.
        weights = weights if weights.any() else np.ones_like(weights)
        world = points @ actor.transform[:3, :3].T + actor.transform[:3, 3]
        sums += weights @ world
        total += weights.sum()
    return sums / total


def _items(name: str, values: object) -> Iterable[object]:
    if not isinstance(values, Iterable):
        raise SceneError(f"{name} is one {type(values).__name__}, expected a list")
    return cast("Iterable[object]", values)


def _placed(actor: object) -> PlacedActor:
    if isinstance(actor, Gaussians):
        return SplatInstance(actor)
    if isinstance(actor, Mesh):
        return MeshInstance(actor)
    if isinstance(actor, SplatInstance | MeshInstance):
        return actor
    raise SceneError(f"actors holds a {type(actor).__name__}, expected Gaussians, a Mesh or an instance of one")


def _check_booleans(name: str, flags: object) -> None:
    if not isinstance(flags, Sequence) or not all(
        isinstance(flag, bool | np.bool_) for flag in cast("Sequence[object]", flags)
    ):
        raise SceneError(f"{name} is {flags!r:.60}, expected a list of True and False, one an actor")
