"""Makes the views of a data set, each from its number alone; reads its settings, and renders all of it by one call."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from lumisplat.config import DatasetConfig, RenderConfig
from lumisplat.config.checks import check_kind, check_whole
from lumisplat.dataset.draws import Draws, Purpose, split_of
from lumisplat.dataset.files import id_type, view_file, write_view
from lumisplat.dataset.finish import DatasetSummary, finish_dataset
from lumisplat.dataset.labels import Catalogue, DatasetView
from lumisplat.dataset.lights import LightSampler
from lumisplat.dataset.objects import Asset, ObjectPlacer, Placement
from lumisplat.dataset.poses import PoseSampler
from lumisplat.dataset.space import Space
from lumisplat.errors import ConfigError, SceneError
from lumisplat.frame.frame import Frame
from lumisplat.io import load, load_radiance
from lumisplat.io.files.source import PathLike
from lumisplat.io.scene_toml.config_file import read_settings
from lumisplat.io.scene_toml.toml_table import TomlTable
from lumisplat.renderer.checks import checked_config
from lumisplat.renderer.renderer import create_renderer
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
        self._placer = ObjectPlacer(self.config.objects, assets, space)
        self._pose_sampler = PoseSampler(self.config, space, cameras)
        self._has_objects = bool(assets)
        needs_light = bool(scene.meshes) or any(splat.material is not None for splat in scene.splats)
        needs_light |= any(asset.scene.meshes for asset in assets)
        self._light_sampler = LightSampler(
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
        return self._light_sampler.has_lights

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
        camera = self._pose_sampler.camera(index, pose, placement.placed)
        exposure = self._light_sampler.exposure(light)
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
        lights = self._light_sampler.lights(light)
        splats = scene.splats
        if lights and self._has_objects and self.config.objects.shadows:
            splats = tuple(map(_as_shadow_catcher, splats))
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


def _as_shadow_catcher(splats: SplatInstance) -> SplatInstance:
    """A capture that keeps its look, and receives shadows."""
    return splats if splats.material is not None else replace(splats, shadow_catcher=True)


def render_dataset(
    scene: Scene,
    folder: str | os.PathLike[str],
    config: DatasetConfig | None = None,
    *,
    render: RenderConfig | None = None,
    cameras: Sequence[Camera] = (),
    device: str = "auto",
    progress: Callable[[float], None] | None = None,
) -> DatasetSummary:
    """Renders views of a scene from random places, in random light, with objects put into it, as training data.

    Views that are there stay, whatever they are of: ``lumisplat dataset`` checks that, and shares the work among
    processes; `DatasetViews` has the views one by one.

    Args:
        scene: The scene.
        folder: Where files go (docs/guide/dataset.md): ``images``, a folder for each layer, ``views`` with what is
            known of each, and what `finish_dataset` writes.
        config: Settings of the data set; None: the defaults.
        render: Settings of frames; None: the defaults.
        cameras: Given ones, of ``PosePlaces.CAMERAS``.
        device: As for ``create_renderer``.
        progress: Called after each view with the fraction done, 0..1.

    Raises:
        ConfigError: A setting is wrong, or ``albedo`` is wanted of views without light.
        DeviceError: There is no such device, or it is out of memory.
        FormatError: A file cannot be read or written.
        SceneError: As of `DatasetViews` and `DatasetViews.view`.
    """
    frame_config = _frame_config(checked_config(render), config or DatasetConfig())
    views = DatasetViews(scene, config, cameras=cameras, device=device)
    renderer = create_renderer(frame_config, device)
    place = Path(folder)
    for index in range(views.config.views):
        if not (place / view_file(index)).is_file():
            view = views.view(index)
            views.save(view, renderer.render(view.scene, view.camera), place)
        if progress:
            progress((index + 1) / views.config.views)
    return finish_dataset(place, views.config)


def _frame_config(render: RenderConfig, config: DatasetConfig) -> RenderConfig:
    """Settings of frames that have what the layers need.

    Raises:
        ConfigError: The pipeline is in real time: its frames follow from each other, and views do not.
    """
    if render.pipeline.is_sequence:
        raise ConfigError(
            "Pipeline.REALTIME is of frames that follow from each other, and views do not: "
            "use Pipeline.PATH or Pipeline.HYBRID"
        )
    return replace(render, aovs=(*render.aovs, "albedo")) if "albedo" in config.layers else render


def load_dataset_config(path: PathLike) -> DatasetConfig:
    """Loads the settings of a data set from TOML: keys are the names of settings, groups are tables.

    views = 1000
    layers = ["depth", "instance"]

    [poses]
    where = "inside"

    [objects]
    files = ["chair.glb"]                   # relative to the settings file

    Args:
        path: A TOML file, whose keys are the settings of `DatasetConfig`, with tables ``[poses]``, ``[lights]`` and
            ``[objects]``; what it does not name has its default. Paths in it begin at its folder.

    Raises:
        FormatError: The file cannot be read, has an unknown or invalid setting, or names a file that is not there.
    """
    document = TomlTable.read(path, "settings of a data set")
    config = read_settings(document, DatasetConfig)
    lights, objects = config.lights, config.objects
    return replace(
        config,
        lights=replace(lights, environments=_files(document.table("lights"), "environments", lights.environments)),
        objects=replace(objects, files=_files(document.table("objects"), "files", objects.files)),
    )


def _files(table: TomlTable, key: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Paths from the folder of the settings file.

    Raises:
        FormatError: One of them is not there.
    """
    paths = [table.path.parent / name for name in names]
    for name, path in zip(names, paths, strict=True):
        if not path.exists():
            raise table.error(f"{key} has {name!r}, no such file", key)
    return tuple(map(os.fspath, paths))
