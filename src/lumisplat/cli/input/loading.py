"""Loads the files of a scene and their settings; from a folder of `lumisplat blocks`, only the blocks a view sees.

`file_fingerprints` detects changed files, and changes in files that they refer to, by size and modification time.
"""

from __future__ import annotations

import importlib
import json
import logging
import os
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import lumisplat as ls
from lumisplat.cli.input.programs import program_texts

_log = logging.getLogger("lumisplat")

USD = (".usd", ".usda", ".usdc", ".usdz")
"""Extensions of OpenUSD files."""
WITH_CAMERAS = (".toml", ".glb", ".gltf", *USD)
"""Extensions of the scene files that can contain cameras: scene.toml, glTF and OpenUSD."""
_SCENES = (".glb", ".gltf", ".vrm", *USD)
"""Extensions of the scene formats that other programs write: glTF and OpenUSD."""

BLOCKS = "blocks.json"
"""Name of the index file in a folder that `lumisplat blocks` writes."""


def load_scene(
    paths: Sequence[Path],
    load: Callable[[Path], ls.Gaussians | ls.Mesh | ls.Scene],
    up: str | tuple[float, float, float] | None = None,
    *,
    keep_coordinates: bool = False,
    around: ls.Scene | None = None,
) -> ls.Scene:
    """Loads files of any kind into one scene; sets meshes on the ground of captures beside them (`lumisplat.insert`).

    Args:
        paths: The files.
        load: Loads one file.
        up: Up direction of the scene; None takes the up direction of the files.
        keep_coordinates: True leaves meshes at the coordinates of their files.
        around: Scene that is loaded already: meshes are set on the ground of its captures, but the result does not
            contain it. None for none.

    Raises:
        ConfigError: No file was given.
        FormatError: A file cannot be read.
    """
    if not paths:
        raise ls.ConfigError("no scene given: name a capture, a mesh or a scene.toml")
    around = around or ls.Scene()
    # Scene files are loaded first, so that their mistakes appear before minutes of loading other files.
    loaded = {path: as_scene(load(path)) for path in sorted(paths, key=lambda path: path.suffix.lower() != ".toml")}
    scenes = {path: loaded[path] for path in paths}
    inserted = [path for path in scenes if path.suffix.lower() != ".toml" and not scenes[path].splats]
    if keep_coordinates or not any(scene.splats for scene in (around, *scenes.values())):
        inserted = []
    stated = [scene for path, scene in scenes.items() if path not in inserted]
    scene = ls.Scene(
        up=up or _stated_up(scenes, around),
        splats=(*around.splats, *(splat for scene in stated for splat in scene.splats)),
        meshes=tuple(mesh for scene in stated for mesh in scene.meshes),
        lights=tuple(light for scene in stated for light in scene.lights),
    )
    for path in inserted:
        scene = ls.insert(scene, scenes[path], name=path.name)
    if not around.splats:
        return scene
    return replace(scene, splats=scene.splats[len(around.splats) :], up=scene.up_direction)


def _stated_up(scenes: Mapping[Path, ls.Scene], around: ls.Scene) -> tuple[float, float, float] | None:
    """Returns the up direction that files state: of a scene.toml, else of the first file with a capture.

    Other files count only if none has a capture. Returns None if no file states an up direction.

    Args:
        scenes: Scene of each file.
        around: Scene that is loaded already; it counts as the first file.
    """
    for path, scene in scenes.items():
        if path.suffix.lower() == ".toml" and "up" in toml_values(path):
            return scene.up
    listed = (around, *scenes.values())
    deciding = [scene for scene in listed if scene.splats] or listed
    return next((scene.up_direction for scene in deciding if scene.up_source != "guess"), None)


def as_scene(asset: ls.Gaussians | ls.Mesh | ls.Scene) -> ls.Scene:
    """Returns a scene that contains an asset at the origin; an asset that already is a scene is returned unchanged."""
    if isinstance(asset, ls.Scene):
        return asset
    if isinstance(asset, ls.Mesh):
        return ls.Scene(meshes=(ls.MeshInstance(asset),))
    return ls.Scene(splats=(ls.SplatInstance(asset),))


def scene_file(paths: Sequence[Path]) -> Path | None:
    """Returns the only .toml file among the files of a scene; None without one.

    Raises:
        ConfigError: Several files are .toml files.
    """
    found = [path for path in paths if path.suffix.lower() == ".toml"]
    if len(found) > 1:
        raise ls.ConfigError(f"{found[0]} and {found[1]} are both scene files: give one that lists the entries of both")
    return found[0] if found else None


def camera_file(paths: Sequence[Path]) -> Path | None:
    """Returns the file from which a scene's cameras are read: a .toml, or a single glTF or OpenUSD file; else None.

    A glTF or OpenUSD file beside other files is moved onto their ground, so that its cameras would not show it.

    Raises:
        ConfigError: There are two .toml files.
    """
    is_scene = len(paths) == 1 and paths[0].suffix.lower() in _SCENES
    return paths[0] if is_scene else scene_file(paths)


def warn_of_unused_cameras(paths: Sequence[Path]) -> None:
    """Logs a warning if glTF or OpenUSD files have cameras that are ignored, because several files are given."""
    if len(paths) < 2:
        return
    having: list[str] = []
    for path in paths:
        if path.suffix.lower() in _SCENES:
            with suppress(ls.LumisplatError):  # loading the scene reports the error
                having += [str(path)] * bool(ls.load_cameras(path))
    if having:
        _log.warning(
            "the cameras of %s are not used beside other files: --cameras %s uses them", " and ".join(having), having[0]
        )


def scene_settings(file: Path | None) -> ls.RenderConfig:
    """Returns the render settings that a scene.toml stores; the library's defaults if ``file`` is None.

    Raises:
        FormatError: The file cannot be read, or a setting is wrong.
    """
    return ls.RenderConfig() if file is None else ls.load_config(file)


def size_on_disk(path: Path) -> int:
    """Returns the size of a capture on disk, bytes; for a capture in a folder, the size of all its files.

    Args:
        path: File, folder, or index file of a folder (unpacked or streamed SOG, or `lumisplat blocks`).
    """
    path = path.parent if path.name in ("meta.json", "lod-meta.json", BLOCKS) else path
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files)


def block_folder(path: Path) -> Path | None:
    """Returns the folder that `lumisplat blocks` wrote, given it or its index file; None for any other path."""
    if path.name == BLOCKS:
        return path.parent
    return path if os.path.isfile(path / BLOCKS) else None


@dataclass
class BlockViews:
    """A folder of `lumisplat blocks`, of which only the blocks that the last camera saw are in memory."""

    index: ls.io.BlockIndex
    pixels: float
    """A far block uses a coarser level of detail while its Gaussians cover at most this many pixels on average."""
    preview: ls.Scene
    """Scene with a few of the capture's Gaussians; enough to choose a camera that frames the capture."""
    _parts: list[ls.io.BlockPart] = field(default_factory=list["ls.io.BlockPart"], init=False)
    _scene: ls.Scene | None = field(default=None, init=False)

    def scene(self, camera: ls.Camera, release: Callable[[], None]) -> ls.Scene:
        """Returns a scene with the blocks that a camera sees; with all blocks unless it is an undistorted pinhole.

        Args:
            camera: The camera.
            release: Called before other blocks are loaded; frees the renderer's copy of the previous ones.

        Raises:
            FormatError: A block cannot be read, or all blocks do not fit into memory.
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
        except ls.SceneError:  # visible_blocks supports pinhole cameras only
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
    """Returns a loader of visible blocks if the scene is a folder of `lumisplat blocks` and the frames allow it.

    Only unlit, rasterised frames of a single file do; otherwise the whole capture is needed.

    Args:
        paths: Files of the scene.
        config: Settings of the frames.
        pixels: Value of ``--lod pixels=``; None without it.
        lit: True if an option adds lights to the scene.
        whole: Given option that needs the whole capture; empty without one.
        upright: Sets the up direction of a scene.

    Returns:
        The loader; None without a folder of blocks, or if the whole capture is needed, which is logged.

    Raises:
        ConfigError: ``pixels`` is negative, or is given although blocks cannot be loaded view by view.
        FormatError: The index cannot be read.
    """
    folders = [folder for path in paths if (folder := block_folder(path)) is not None]
    if pixels is not None and not pixels >= 0.0:
        raise ls.ConfigError(f"--lod pixels={pixels:g}, expected 0 or more")
    if not folders:
        if pixels is not None:
            raise ls.ConfigError("--lod pixels= needs a capture in blocks, which lumisplat blocks makes")
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
            raise ls.ConfigError(f"--lod pixels= and {needed} exclude each other: the latter needs the whole capture")
        _log.warning(
            "%s: the whole capture is loaded for %s: only unlit, rasterised images of it alone load visible blocks",
            folders[0],
            needed,
        )
        return None
    index = ls.io.open_blocks(folders[0])
    preview = ls.Scene(splats=[ls.SplatInstance(ls.io.thin_blocks(index))])
    return BlockViews(index, pixels or 0.0, upright(preview))


def holds_all_columns(path: Path) -> bool:
    """True if a capture file can store any column of values per Gaussian: an uncompressed .ply."""
    name = path.name.lower()
    return name.endswith(".ply") and not name.endswith(".compressed.ply")


def holds_materials(path: Path) -> bool:
    """True if a capture file can store albedo, roughness and normals: .ply, glTF or OpenUSD."""
    return holds_all_columns(path) or path.suffix.lower() in _SCENES


_OBJ_REFERENCE = re.compile(r"^(?:mtllib|map_\w+|norm|bump)\s+(?:.*\s)?(\S+)\s*$", re.MULTILINE)
_USDA_REFERENCE = re.compile(r"@([^@\n]+)@")
_OBJ_HEAD = 2**20
"""Number of bytes at the start of an OBJ file that are searched for references to material libraries."""


def file_fingerprints(paths: list[Path], excluded: Path) -> dict[str, str]:
    """Returns size and modification time, as text by path, of files and of all files that they refer to.

    Keys are paths relative to the folder of the first file. A string in a file counts as a reference to another file if
    it is that file's path, relative to the folder of the file with the string. The path of a folder refers to all files
    in it.

    Args:
        paths: Files to start with; the first is the scene file.
        excluded: Folder of the frames, which is ignored.
    """
    found: dict[Path, str] = {}
    waiting = list(paths)
    while waiting:
        path = Path(os.path.abspath(waiting.pop()))
        if path in found or path == Path(os.path.abspath(excluded)) or not path.exists():
            continue
        if path.is_dir():
            waiting += [file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")]
            continue
        if not path.is_file():
            continue
        status = path.stat()
        found[path] = f"{status.st_size} bytes, {status.st_mtime_ns} ns"
        with suppress(ValueError):  # the file's reader reports the error
            waiting += [path.parent / name for text in _texts(path) for name in _paths(text)]
    home = Path(os.path.abspath(paths[0])).parent
    return {os.path.relpath(path, home): mark for path, mark in sorted(found.items())}


def toml_values(path: Path) -> dict[str, Any]:
    """Returns the content of a TOML file as a dictionary.

    Raises:
        ValueError: The file is not TOML; a FormatError, which is a ValueError, if it cannot be read.
    """
    from lumisplat.io.files.source import read_text  # imported late: the help must not need NumPy

    return tomllib.loads(read_text(path))


def has_motion(values: object) -> bool:
    """Returns whether the content of a scene file has actors, or keyframes of a camera, light or material."""
    if isinstance(values, list):
        return any(map(has_motion, values))  # pyright: ignore[reportUnknownArgumentType]
    if not isinstance(values, dict):
        return False
    return bool({"actors", "keyframes"} & values.keys()) or any(map(has_motion, values.values()))  # pyright: ignore


def _paths(text: str) -> set[str]:
    r"""Returns the paths that a string in a file may mean, with ``\`` or ``/``; none for ``.``, ``..`` and ``/``."""
    is_path = 0 < len(text) < 1024 and "\0" not in text and bool(set(Path(text).parts) - {".", "..", "/"})
    return {text, text.replace("\\", "/")} if is_path else set()


def _texts(path: Path) -> Iterator[str]:
    """Yields all strings of a scene or asset file that may be paths of other files, such as textures."""
    suffix = path.suffix.lower()
    if suffix == ".toml":
        yield from _strings(toml_values(path))
    elif path.name in ("meta.json", "lod-meta.json"):
        yield from _strings(json.loads(path.read_bytes()))
    elif suffix in (".gltf", ".glb"):
        for text in _strings(gltf_document(path)):
            yield from {text, unquote(text)}
    elif suffix in (".usda", ".usd", ".usdc"):
        with path.open("rb") as stream:
            is_binary = stream.read(8) == b"PXR-USDC"
        yield from _usd_references(path) if is_binary else _USDA_REFERENCE.findall(path.read_text(errors="replace"))
    elif suffix == ".py":
        with suppress(SyntaxError):  # reported when the program runs
            yield from program_texts(path)
    elif suffix in (".obj", ".mtl"):
        with path.open("rb") as stream:
            yield from _OBJ_REFERENCE.findall(stream.read(_OBJ_HEAD).decode(errors="replace"))


def gltf_document(path: Path) -> Any:
    """Returns the JSON part of a .gltf or .glb file; None if a .glb does not begin with JSON."""
    if path.suffix.lower() == ".gltf":
        return json.loads(path.read_bytes())
    with path.open("rb") as stream:
        head = stream.read(20)
        return json.loads(stream.read(int.from_bytes(head[12:16], "little"))) if head[16:20] == b"JSON" else None


def _usd_references(path: Path) -> list[str]:
    """Returns the file paths in a binary OpenUSD layer: other layers, and assets such as textures, at all times."""
    try:
        library: Any = importlib.import_module("pxr.UsdUtils")
    except ImportError:  # without OpenUSD, the layer cannot be loaded either
        return []
    return [text for texts in library.ExtractExternalReferences(str(path)) for text in texts]


def _strings(value: object) -> Iterator[str]:
    """Yields all strings in nested dictionaries and lists; keys are left out."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in cast(dict[str, object], value).values():
            yield from _strings(inner)
    elif isinstance(value, list):
        for inner in cast(list[object], value):
            yield from _strings(inner)
