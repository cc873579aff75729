"""Generates the views of a data set, loads the data set's settings, and renders all views in one call."""

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
"""Function that loads a capture, a mesh or a scene from a file."""


class DatasetViews:
    """Generates the views of a data set; a view depends only on the scene, the settings and its index.

    Free space and ground are found by rays of a separate renderer, which holds a second copy of the scene on the
    device.

    Args:
        scene: The scene.
        config: Settings; None for the defaults.
        cameras: Cameras near which views are placed, for ``PosePlaces.CAMERAS``.
        load: Loads an object; None for `lumisplat.load`.
        device: As in ``create_renderer``.

    Raises:
        ConfigError: ``config`` is not a DatasetConfig.
        DeviceError: The device does not exist.
        FormatError: The file of an object or of an environment cannot be read.
        SceneError: The scene is empty, an object has no size, or ``cameras`` is empty although views are placed near
            cameras.
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
        """The given scene, into which objects are inserted and lights added for each view."""
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
        """Names of the categories; the first has id 1."""
        return self._catalogue.categories

    @property
    def are_lit(self) -> bool:
        """True if a view may have lights: those of the scene, environments, suns or point lights."""
        return self._light_sampler.has_lights

    def view(self, index: int) -> DatasetView:
        """Returns a view by its index.

        Args:
            index: Index of the view, from 0; it may exceed ``config.views``.

        Raises:
            ConfigError: ``index`` is below 0.
            SceneError: No tried pose has enough free space around it and enough surfaces in view.
        """
        check_whole("index", index, 0, 2**62)
        pose, objects, light = (
            Draws(self.config.seed, index, purpose) for purpose in (Purpose.POSE, Purpose.OBJECTS, Purpose.LIGHTS)
        )
        placement = self._placer.place(objects)
        if placement.left_out:
            _log.info("view %d: no free position for %s", index, ", ".join(placement.left_out))
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
        """Writes the files of a view into the folder of the data set, each atomically.

        ``views/view_000000.json`` is written last; if it exists, the view is complete.

        Args:
            view: The view.
            frame: Frame of the view. It must be rendered with ``albedo`` in ``RenderConfig.aovs`` if the layers include
                ``albedo``.
            folder: Folder of the data set.

        Raises:
            ConfigError: The layers include ``albedo``, and the frame has none.
            FormatError: A file cannot be written.
        """
        write_view(Path(folder), view, frame, self.config, self._id_types)

    def _scene(self, placement: Placement, light: Draws) -> Scene:
        """Returns the scene of a view: the given scene with inserted objects and random lights."""
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
        """Loads the environments that the settings name, rotated so that the top of each image is up in the scene."""
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
    """Loads the objects to insert; a file that is named several times is loaded once.

    Raises:
        FormatError: A file cannot be read.
        SceneError: An object has no size; the message names the file.
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
    """Makes a capture without a material a shadow catcher; returns a capture with a material unchanged."""
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
    """Renders random views of a scene with random lights and inserted objects, as training data.

    Views that are already in the folder are not rendered again and not checked. The command ``lumisplat dataset``
    checks the settings of such views, and divides the work among processes. `DatasetViews` gives single views.

    Args:
        scene: The scene.
        folder: Output folder (docs/guide/dataset.md): ``images``, one folder per layer, ``views`` with a JSON file per
            view, and the files of `finish_dataset`.
        config: Settings of the data set; None for the defaults.
        render: Render settings; None for the defaults.
        cameras: Cameras near which views are placed, for ``PosePlaces.CAMERAS``.
        device: As in ``create_renderer``.
        progress: Called after each view with the fraction done, 0..1.

    Returns:
        The number of views in each split.

    Raises:
        ConfigError: A setting is invalid, or ``albedo`` is requested of unlit views.
        DeviceError: The device does not exist or is out of memory.
        FormatError: A file cannot be read or written.
        SceneError: As in `DatasetViews` and `DatasetViews.view`.
    """
    frame_config = _frame_config(checked_config(render), config or DatasetConfig())
    views = DatasetViews(scene, config, cameras=cameras, device=device)
    renderer = create_renderer(frame_config, device)
    root = Path(folder)
    for index in range(views.config.views):
        if not (root / view_file(index)).is_file():
            view = views.view(index)
            views.save(view, renderer.render(view.scene, view.camera), root)
        if progress:
            progress((index + 1) / views.config.views)
    return finish_dataset(root, views.config)


def _frame_config(render: RenderConfig, config: DatasetConfig) -> RenderConfig:
    """Returns the render settings with the AOVs that the layers need.

    Raises:
        ConfigError: The pipeline is real time, whose frames depend on earlier ones.
    """
    if render.pipeline.is_sequence:
        raise ConfigError(
            "Pipeline.REALTIME renders frames that depend on earlier frames, and views of a data set are independent: "
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
        path: TOML file with the settings of `DatasetConfig` and the tables ``[poses]``, ``[lights]`` and ``[objects]``.
            Missing settings have their defaults. Paths are relative to the file's folder.

    Raises:
        FormatError: The file cannot be read, has an unknown or invalid setting, or names a missing file.
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
    """Returns the paths in a list of file names, relative to the folder of the settings file.

    Args:
        table: Table of the settings file, for messages.
        key: Key of the list.
        names: The file names.

    Raises:
        FormatError: A file does not exist.
    """
    paths = [table.path.parent / name for name in names]
    for name, path in zip(names, paths, strict=True):
        if not path.exists():
            raise table.error(f"{key} has {name!r}, no such file", key)
    return tuple(map(os.fspath, paths))
