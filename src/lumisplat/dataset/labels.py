"""A view of a data set and its labels: names, ids, boxes and poses of each object, as training data name them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.dataset.objects import Asset, PlacedObject
from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene, SplatInstance, bulk_extent

BOX_TAIL = 0.002
"""Share of a capture's opacity outside its box at each end of each axis: it holds what is seen, and no strays."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DatasetThing:
    """A capture, a mesh or an object in a view."""

    id: int
    """In the layer ``instance``, from 1: what the scene has keeps its id in all views, objects come after it."""
    name: str
    category: str
    """The name of what the scene has, the file of an object without its extension."""
    category_id: int
    """In the layer ``category``, from 1; the same in all views."""
    kind: str
    """``capture``, ``mesh`` or, of an object that has several of them, ``scene``."""
    is_object: bool
    """Whether it was put into the scene."""
    instances: tuple[int, ...]
    """Its places in the frame's ``instance_index``."""
    world_from_object: Doubles
    """Shape (4, 4)."""
    low: Doubles
    """Corner of its box in its own coordinates, shape (3,); of captures without stray Gaussians."""
    high: Doubles
    """The opposite corner."""


class Catalogue:
    """Names and ids of what views show.

    Args:
        scene: Without objects.
        assets: The objects that there may be.
    """

    def __init__(self, scene: Scene, assets: Sequence[Asset]) -> None:
        self._scene = scene
        self._names = [splat.name or f"capture {index}" for index, splat in enumerate(scene.splats)]
        self._names += [mesh.name or mesh.mesh.name or f"mesh {index}" for index, mesh in enumerate(scene.meshes)]
        self._boxes = [_capture_box(splat) for splat in scene.splats]
        self._boxes += [_box(mesh.mesh.positions) for mesh in scene.meshes]
        self._asset_boxes = {id(asset): _box(asset.points) for asset in assets}
        self.categories = tuple(dict.fromkeys((*self._names, *(asset.name for asset in assets))))
        """Of the layer ``category``: the first has the id 1."""

    def things(self, objects: Sequence[PlacedObject]) -> list[DatasetThing]:
        """What a view shows, in the order of ids."""
        things = self._scene_objects(sum(len(one.splats) for one in objects))
        next_splat = len(self._scene.splats)
        next_mesh = next_splat + sum(len(one.splats) for one in objects) + len(self._scene.meshes)
        counts: dict[str, int] = {}
        for one in objects:
            category = one.asset.name
            counts[category] = counts.get(category, 0) + 1
            splats, meshes = len(one.splats), len(one.meshes)
            low, high = self._asset_boxes[id(one.asset)]
            things.append(
                DatasetThing(
                    id=len(things) + 1,
                    name=category if counts[category] == 1 else f"{category} {counts[category]}",
                    category=category,
                    category_id=self.categories.index(category) + 1,
                    kind="scene" if splats + meshes > 1 else "capture" if splats else "mesh",
                    is_object=True,
                    instances=(*range(next_splat, next_splat + splats), *range(next_mesh, next_mesh + meshes)),
                    world_from_object=one.world_from_object,
                    low=low,
                    high=high,
                )
            )
            next_splat, next_mesh = next_splat + splats, next_mesh + meshes
        return things

    def _scene_objects(self, between: int) -> list[DatasetThing]:
        """What the scene has.

        Args:
            between: How many captures objects add: frames count these before the meshes.
        """
        instances = (*self._scene.splats, *self._scene.meshes)
        own = zip(instances, self._names, self._boxes, strict=True)
        return [
            DatasetThing(
                id=index + 1,
                name=name,
                category=name,
                category_id=self.categories.index(name) + 1,
                kind="capture" if isinstance(instance, SplatInstance) else "mesh",
                is_object=False,
                instances=(index if isinstance(instance, SplatInstance) else index + between,),
                world_from_object=instance.transform,
                low=low,
                high=high,
            )
            for index, (instance, name, (low, high)) in enumerate(own)
        ]


def id_images(
    instance_index: npt.NDArray[np.int32], things: Sequence[DatasetThing]
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16]]:
    """Ids of things, and of their categories, shape (H, W); 0 where there is nothing.

    Args:
        instance_index: Of a frame, shape (H, W), -1: nothing.
        things: What it shows.
    """
    last = max((place for thing in things for place in thing.instances), default=-1)
    ids, categories = np.zeros(last + 2, np.uint16), np.zeros(last + 2, np.uint16)  # the last: of -1
    for thing in things:
        ids[list(thing.instances)] = thing.id
        categories[list(thing.instances)] = thing.category_id
    return ids[instance_index], categories[instance_index]


def _capture_box(splat: SplatInstance) -> tuple[Doubles, Doubles]:
    """The box of a capture in its own coordinates, without stray Gaussians."""
    gaussians = splat.gaussians
    ends = [bulk_extent(axis, gaussians.opacities, BOX_TAIL) for axis in gaussians.means.T.astype(np.float64)]
    low, high = np.array(ends).T
    return low, high


def _box(points: npt.NDArray[np.floating]) -> tuple[Doubles, Doubles]:
    return points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class DatasetView:
    """A view: what is to be rendered, from where, and what of it is known."""

    index: int
    """Its number, from 0."""
    split: str
    """``train``, ``val`` or ``test``."""
    scene: Scene
    """With its lights and objects."""
    camera: Camera
    things: tuple[DatasetThing, ...]
    """What there is, in the order of ids, seen or not."""
    left_out: tuple[str, ...] = ()
    """Names of objects that found no room."""

    @property
    def name(self) -> str:
        """Stem of its files."""
        return self.camera.name
