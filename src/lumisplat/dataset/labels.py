"""Views of a data set and their labels: name, id, category, bounding box and pose of each object."""

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
"""Fraction of a capture's total opacity left outside of each face of its bounding box, to ignore stray Gaussians."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DatasetThing:
    """Labels of one object in a view: a capture or mesh of the given scene, or an object inserted into it."""

    id: int
    """Value of the object's pixels in the layer ``instance``, from 1.

    The captures and meshes of the given scene have the lowest ids, equal in all views. Inserted objects have the next
    ids.
    """
    name: str
    category: str
    """Name of the object's category. For an inserted object, it is the file name without extension. For a capture or
    mesh of the given scene, it is the instance's name or, without a name, ``capture`` or ``mesh``."""
    category_id: int
    """Value of the object's pixels in the layer ``category``, from 1. A category has the same value in all views."""
    kind: str
    """``capture`` or ``mesh``; for an inserted object with several captures or meshes ``scene``."""
    is_object: bool
    """True for an object that was inserted into the scene; False for a capture or mesh of the given scene."""
    instances: tuple[int, ...]
    """Indices of the object's captures and meshes in ``Frame.instance_index``."""
    world_from_object: Doubles
    """Transform to the world from object coordinates: the coordinates of the capture, the mesh or the inserted file."""
    low: Doubles
    """Lower corner of the bounding box in object coordinates, shape (3,), without a capture's stray Gaussians."""
    high: Doubles
    """Upper corner of the bounding box in object coordinates, shape (3,), without a capture's stray Gaussians."""


class Catalogue:
    """Assigns names, ids and categories to the objects of a scene and to inserted objects.

    Args:
        scene: Scene without inserted objects.
        assets: Objects that may be inserted.
    """

    def __init__(self, scene: Scene, assets: Sequence[Asset]) -> None:
        self._scene = scene
        self._names = [splat.name or f"capture {index}" for index, splat in enumerate(scene.splats)]
        self._names += [mesh.name or mesh.mesh.name or f"mesh {index}" for index, mesh in enumerate(scene.meshes)]
        self._categories = [splat.name or "capture" for splat in scene.splats]
        self._categories += [mesh.name or mesh.mesh.name or "mesh" for mesh in scene.meshes]
        self._boxes = [_capture_box(splat) for splat in scene.splats]
        self._boxes += [_box(mesh.mesh.positions) for mesh in scene.meshes]
        self._asset_boxes = {id(asset): _box(asset.points) for asset in assets}
        self.categories = tuple(dict.fromkeys((*self._categories, *(asset.name for asset in assets))))
        """Names of all categories in the order of their ids: the first has id 1."""

    def things(self, objects: Sequence[PlacedObject]) -> list[DatasetThing]:
        """Returns the labels of all objects in a view, in the order of their ids.

        Args:
            objects: Objects that this view adds to those of the scene.
        """
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
        """Returns the labels of the captures and meshes of the given scene.

        Args:
            between: Number of captures among the inserted objects. ``instance_index`` counts the scene's captures, then
                the inserted captures, then the scene's meshes.
        """
        instances = (*self._scene.splats, *self._scene.meshes)
        labelled = zip(instances, self._names, self._categories, self._boxes, strict=True)
        return [
            DatasetThing(
                id=index + 1,
                name=name,
                category=category,
                category_id=self.categories.index(category) + 1,
                kind="capture" if isinstance(instance, SplatInstance) else "mesh",
                is_object=False,
                instances=(index if isinstance(instance, SplatInstance) else index + between,),
                world_from_object=instance.transform,
                low=low,
                high=high,
            )
            for index, (instance, name, category, (low, high)) in enumerate(labelled)
        ]


def id_images(
    instance_index: npt.NDArray[np.int32], things: Sequence[DatasetThing]
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16]]:
    """Returns an image of object ids and an image of category ids, shape (H, W) each; 0 for the background.

    Args:
        instance_index: Instance index of a frame, shape (H, W); -1 for the background.
        things: Labels of the view.
    """
    last = max((index for thing in things for index in thing.instances), default=-1)
    # Index -1, the background, reads the last entry, which stays 0.
    ids, categories = np.zeros(last + 2, np.uint16), np.zeros(last + 2, np.uint16)
    for thing in things:
        ids[list(thing.instances)] = thing.id
        categories[list(thing.instances)] = thing.category_id
    return ids[instance_index], categories[instance_index]


def _capture_box(splat: SplatInstance) -> tuple[Doubles, Doubles]:
    """Returns the bounding box of a capture in its object space, without stray Gaussians."""
    gaussians = splat.gaussians
    ends = [bulk_extent(axis, gaussians.opacities, BOX_TAIL) for axis in gaussians.means.T.astype(np.float64)]
    low, high = np.array(ends).T
    return low, high


def _box(points: npt.NDArray[np.floating]) -> tuple[Doubles, Doubles]:
    return points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class DatasetView:
    """A view of a data set: the scene to render, the camera, and the labels."""

    index: int
    """Index of the view, from 0."""
    split: str
    """Split that the view belongs to: ``train``, ``val`` or ``test``."""
    scene: Scene
    """Scene to render: the given scene with the view's lights and inserted objects."""
    camera: Camera
    things: tuple[DatasetThing, ...]
    """Labels of all objects, visible or not, in the order of their ids."""
    left_out: tuple[str, ...] = ()
    """Names of objects that could not be inserted into this view, because no free position was found."""

    @property
    def name(self) -> str:
        """Name of the view's files without extension."""
        return self.camera.name
