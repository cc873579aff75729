"""Files of a scene, of any kind, the settings that come with them, and captures in blocks view by view."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.input.file_marks import toml_values

USD = (".usd", ".usda", ".usdc", ".usdz")
"""Extensions of OpenUSD."""
WITH_CAMERAS = (".toml", ".glb", ".gltf", *USD)
"""Extensions of scenes, which may have cameras."""
_SCENES = (".glb", ".gltf", *USD)
"""Extensions of scenes of other programs."""

BLOCKS = "blocks.json"
"""The index of a capture in blocks."""


def load_scene(
    paths: Sequence[Path],
    load: Callable[[Path], ls.Gaussians | ls.Mesh | ls.Scene],
    up: str | tuple[float, float, float] | None = None,
    *,
    keep_coordinates: bool = False,
    around: ls.Scene | None = None,
) -> ls.Scene:
    """Loads files of any kind into one scene. Meshes beside captures are put into these, as of `lumisplat.insert`.

    Args:
        paths: The files.
        load: Reads one of them.
        up: Up of the scene; None: as the files say.
        keep_coordinates: Whether meshes stay as they are in their files.
        around: What is there already, and not part of the result; None: nothing.

    Raises:
        ConfigError: No file was given.
        FormatError: A file cannot be read.
    """
    if not paths:
        raise ls.ConfigError("no scene given: name a capture, a mesh or a scene.toml")
    around = around or ls.Scene()
    scenes = {path: as_scene(load(path)) for path in paths}
    put = [path for path in scenes if path.suffix.lower() != ".toml" and not scenes[path].splats]
    if keep_coordinates or not any(scene.splats for scene in (around, *scenes.values())):
        put = []
    stated = [scene for path, scene in scenes.items() if path not in put]
    scene = ls.Scene(
        up=up or _stated_up(scenes, around),
        splats=(*around.splats, *(splat for scene in stated for splat in scene.splats)),
        meshes=tuple(mesh for scene in stated for mesh in scene.meshes),
        lights=tuple(light for scene in stated for light in scene.lights),
    )
    for path in put:
        scene = ls.insert(scene, scenes[path], name=path.name)
    if not around.splats:
        return scene
    return replace(scene, splats=scene.splats[len(around.splats) :], up=scene.up_direction)


def _stated_up(scenes: Mapping[Path, ls.Scene], around: ls.Scene) -> tuple[float, float, float] | None:
    """Up as a scene.toml says it, else as the first capture does; None: both say nothing.

    That of a file of meshes is its own, unless there is no capture.
    """
    for path, scene in scenes.items():
        if path.suffix.lower() == ".toml" and "up" in toml_values(path):
            return scene.up
    listed = (around, *scenes.values())
    said = [scene for scene in listed if scene.splats] or listed
    return next((scene.up_direction for scene in said if scene.up_source != "guess"), None)


def as_scene(asset: ls.Gaussians | ls.Mesh | ls.Scene) -> ls.Scene:
    """A scene as it is; one of a single asset has it at the origin."""
    if isinstance(asset, ls.Scene):
        return asset
    if isinstance(asset, ls.Mesh):
        return ls.Scene(meshes=(ls.MeshInstance(asset),))
    return ls.Scene(splats=(ls.SplatInstance(asset),))


def scene_file(paths: Sequence[Path]) -> Path | None:
    """The ``scene.toml`` among the files of a scene, which brings cameras and settings; None: there is none.

    Raises:
        ConfigError: There are two.
    """
    found = [path for path in paths if path.suffix.lower() == ".toml"]
    if len(found) > 1:
        raise ls.ConfigError(f"{found[0]} and {found[1]} are both scene files: list in one what both list")
    return found[0] if found else None


def scene_settings(file: Path | None) -> ls.RenderConfig:
    """The settings of a ``scene.toml``; None: the library's defaults.

    Raises:
        FormatError: The file cannot be read, or a setting is wrong.
    """
    return ls.RenderConfig() if file is None else ls.load_config(file)


def size_on_disk(path: Path) -> int:
    """Bytes of a file, or of all in the folder of an unpacked or streamed SOG or of blocks, or of its list's folder."""
    path = path.parent if path.name in ("meta.json", "lod-meta.json", BLOCKS) else path
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files)


def block_folder(path: Path) -> Path | None:
    """The folder of a capture in blocks, given by itself or by its index; None: it is something else."""
    if path.name == BLOCKS:
        return path.parent
    return path if os.path.isfile(path / BLOCKS) else None


_log = logging.getLogger("lumisplat")


@dataclass
class BlockViews:
    """A capture in blocks, of which each view loads what it sees; what the last one saw is kept."""

    index: ls.io.BlockIndex
    pixels: float
    """As of `lumisplat.io.visible_blocks`."""
    preview: ls.Scene
    """Some of its Gaussians, to see where it is."""
    _parts: list[ls.io.BlockPart] = field(default_factory=list["ls.io.BlockPart"], init=False)
    _scene: ls.Scene | None = field(default=None, init=False)

    def scene(self, camera: ls.Camera, release: Callable[[], None]) -> ls.Scene:
        """What a camera sees; of lenses other than pinholes, everything.

        Args:
            camera: The view.
            release: Lets go of what the last view saw, before something else is loaded.

        Raises:
            FormatError: A block cannot be read, or all of them do not fit into memory.
        """
        parts = self._seen(camera)
        if self._scene is None or parts != self._parts:
            self._scene = None
            release()
            shown = [replace(self.preview.splats[0], gaussians=ls.io.load_blocks(self.index, parts))] if parts else []
            self._parts, self._scene = parts, replace(self.preview, splats=shown)
        return self._scene

    def _seen(self, camera: ls.Camera) -> list[ls.io.BlockPart]:
        try:
            return ls.io.visible_blocks(self.index, camera, pixels=self.pixels)
        except ls.SceneError:  # a lens that sees around corners
            return ls.io.all_blocks(self.index)


def block_views(
    paths: Sequence[Path],
    config: ls.RenderConfig,
    pixels: float | None,
    *,
    lit: bool,
    whole: str = "",
    upright: Callable[[ls.Scene], ls.Scene],
) -> BlockViews | None:
    """What shows a capture in blocks view by view; None: there is none, or all of it is needed, which a line says.

    Args:
        paths: The files of the scene.
        config: The settings of frames.
        pixels: Of ``--lod pixels=``.
        lit: Whether lights are added to the scene.
        whole: An option that needs the whole capture, if it is given.
        upright: Gives a scene its up.

    Raises:
        ConfigError: ``pixels`` is given without a capture in blocks, or is negative.
        FormatError: Its index cannot be read.
    """
    folders = [folder for path in paths if (folder := block_folder(path)) is not None]
    if pixels is not None and not pixels >= 0.0:
        raise ls.ConfigError(f"--lod pixels={pixels:g}, expected 0 or more")
    if not folders:
        if pixels is not None:
            raise ls.ConfigError("--lod pixels= is of captures in blocks, which lumisplat blocks makes")
        return None
    needs = [
        "other files of the scene" * (len(paths) > 1),
        f"--pipeline {config.pipeline.value}" * config.pipeline.spawns_rays,
        "--set raster.projection=unscented" * (config.raster.projection is ls.config.Projection.UNSCENTED),
        "light" * (lit or config.lighting is True),
        whole,
    ]
    needed = next((one for one in needs if one), "")
    if needed:
        if pixels is not None:
            raise ls.ConfigError(f"--lod pixels= and {needed} do not go together: all of the capture is loaded")
        _log.warning(
            "%s: all of it is loaded, for %s: only unlit, rasterised pictures of it alone load what they see",
            folders[0],
            needed,
        )
        return None
    index = ls.io.open_blocks(folders[0])
    preview = ls.Scene(splats=[ls.SplatInstance(ls.io.thin_blocks(index))])
    return BlockViews(index, pixels or 0.0, upright(preview))


def holds_all_columns(path: Path) -> bool:
    """Whether a capture of that name has room for any columns: a .ply that is not compressed."""
    name = path.name.lower()
    return name.endswith(".ply") and not name.endswith(".compressed.ply")


def holds_materials(path: Path) -> bool:
    """Whether a capture of that name has room for albedo, roughness and normals: scenes of other programs have."""
    return holds_all_columns(path) or path.suffix.lower() in _SCENES
