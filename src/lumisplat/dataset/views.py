"""The views of a data set, each made of its number alone."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from lumisplat.config.checks import check_kind, check_whole
from lumisplat.config.dataset import DatasetConfig
from lumisplat.dataset.draws import Draws, Purpose, split_of
from lumisplat.dataset.files import id_type, write_view
from lumisplat.dataset.lights import Lighter
from lumisplat.dataset.objects import Asset, Placement, Placer
from lumisplat.dataset.poses import Poser
from lumisplat.dataset.space import Space
from lumisplat.dataset.things import Catalogue
from lumisplat.dataset.view import DatasetView
from lumisplat.errors import SceneError
from lumisplat.frame.frame import Frame
from lumisplat.io import load, load_radiance
from lumisplat.scene.camera import Camera
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightEnvironment
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene, SplatInstance

_log = logging.getLogger("lumisplat")

Loader = Callable[[Path], Gaussians | Mesh | Scene]
"""Loads a capture, a mesh or a scene."""


class DatasetViews:
    """Draws the views of a data set. A view follows from the scene, the settings and its number, and nothing else.

    Free space and ground are found by rays, on a renderer of its own: the scene is held once more on the device.

    Args:
        scene: The scene.
        config: Settings; None: the defaults.
        cameras: Given ones, of ``PosePlaces.CAMERAS``.
        load: Reads an object; None: `lumisplat.load`.
        device: As for ``create_renderer``.

    Raises:
        ConfigError: ``config`` is no DatasetConfig.
        DeviceError: There is no such device.
        FormatError: The file of an object or of an environment cannot be read.
        SceneError: The scene is empty, an object has no size, or ``cameras`` are needed.
    """

    def __init__(
        self,
        scene: Scene,
        config: DatasetConfig | None = None,
        *,
        cameras: Sequence[Camera] = (),
        load: Loader | None = None,
        device: str = "auto",
    ) -> None:
        check_argument("DatasetViews", scene, Scene, "a Scene", ": ls.Scene([gaussians]) makes one")
        self.config = DatasetConfig() if config is None else config
        check_kind("config", self.config, DatasetConfig)
        self.base = scene
        """The scene, without what views put into it."""
        assets = _loaded_assets(self.config.objects.files, load)
        environments = self._environments(scene)
        self._space = space = Space(scene, device)
        self._catalogue = Catalogue(scene, assets)
        things = len(scene.splats) + len(scene.meshes) + self.config.objects.count[1] * bool(assets)
        self._id_types = {"instance": id_type(things), "category": id_type(len(self._catalogue.categories))}
        self._placer = Placer(self.config.objects, assets, space)
        self._poser = Poser(self.config, space, cameras)
        self._has_objects = bool(assets)
        needs_light = bool(scene.meshes) or any(splat.material is not None for splat in scene.splats)
        needs_light |= any(asset.scene.meshes for asset in assets)
        self._lighter = Lighter(
            self.config.lights, space, environments, where=self.config.poses.where, needs_light=needs_light
        )

    def __len__(self) -> int:
        return self.config.views

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of the categories: the first has the id 1."""
        return self._catalogue.categories

    @property
    def are_lit(self) -> bool:
        """Whether views have lights, or may have."""
        return self._lighter.lights_views

    def view(self, index: int) -> DatasetView:
        """One of the views.

        Args:
            index: Its number, from 0; there are as many as one likes.

        Raises:
            ConfigError: It is below 0.
            SceneError: No pose of many has free space and sees enough.
        """
        check_whole("index", index, 0, 2**62)
        pose, objects, light = (
            Draws(self.config.seed, index, purpose) for purpose in (Purpose.POSE, Purpose.OBJECTS, Purpose.LIGHTS)
        )
        placement = self._placer.place(objects)
        if placement.left_out:
            _log.info("view %d: no room for %s", index, ", ".join(placement.left_out))
        camera = self._poser.camera(index, pose, placement.placed)
        exposure = self._lighter.exposure(light)
        return DatasetView(
            index=index,
            split=split_of(self.config.seed, index, self.config.split),
            scene=self._scene(placement, light),
            camera=replace(camera, exposure=exposure),
            things=tuple(self._catalogue.things(placement.placed)),
            left_out=placement.left_out,
        )

    def save(self, view: DatasetView, frame: Frame, folder: str | os.PathLike[str]) -> None:
        """Writes the files of a view into the folder of the data set, each whole or not at all.

        The last one is ``views/view_000000.json``: where it is, the others are.

        Args:
            view: The view.
            frame: Its frame, rendered with ``albedo`` in ``RenderConfig.aovs`` if the layers have it.
            folder: The data set's.

        Raises:
            ConfigError: The frame has no albedo, which is wanted.
            FormatError: A file cannot be written.
        """
        write_view(Path(folder), view, frame, self.config, self._id_types)

    def _scene(self, placement: Placement, light: Draws) -> Scene:
        """The scene with objects and lights."""
        scene, placed = self.base, placement.placed
        lights = self._lighter.lights(light)
        splats = scene.splats
        if lights and self._has_objects and self.config.objects.shadows:
            splats = tuple(map(_receiving, splats))
        return replace(
            scene,
            splats=(*splats, *(splat for one in placed for splat in one.splats)),
            meshes=(*scene.meshes, *(mesh for one in placed for mesh in one.meshes)),
            lights=lights,
            up=scene.up_direction,
        )

    def _environments(self, scene: Scene) -> list[LightEnvironment]:
        """The environments of files, upright in the scene."""
        lights = self.config.lights
        return [
            LightEnvironment(
                image=load_radiance(file),
                rotation_wxyz=scene.upright_wxyz,
                visible=lights.visible,
                name=Path(file).stem,
            )
            for file in lights.environments
        ]


def _loaded_assets(files: Sequence[str], loader: Loader | None) -> list[Asset]:
    """The objects of files, each loaded once.

    Raises:
        FormatError: A file cannot be read.
        SceneError: An object has no size; names the file.
    """
    loaded: dict[str, Asset] = {}
    for file in files:
        if file not in loaded:
            stem = os.path.basename(file).split(".")[0] or os.path.basename(file)
            try:
                loaded[file] = Asset.of(stem, (loader or load)(Path(file)))
            except SceneError as error:
                if str(error).startswith(os.fspath(file)):
                    raise
                raise SceneError(f"{file}: {error}") from None
    return [loaded[file] for file in files]


def _receiving(splats: SplatInstance) -> SplatInstance:
    """A capture that keeps its look, and receives shadows."""
    return splats if splats.material is not None else replace(splats, shadow_catcher=True)
