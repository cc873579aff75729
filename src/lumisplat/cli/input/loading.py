"""Files of a scene, of any kind, and the settings that come with them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.input.file_marks import toml_values

USD = (".usd", ".usda", ".usdc", ".usdz")
"""Extensions of OpenUSD."""
WITH_CAMERAS = (".toml", ".glb", ".gltf", *USD)
"""Extensions of scenes, which may have cameras."""

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
