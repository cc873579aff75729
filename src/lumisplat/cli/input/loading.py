"""Loads the files of a scene, the settings that come with them, and captures in blocks view by view.

`file_fingerprints` tells whether a file of a scene, or one that it refers to, has changed: by size and time.
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

_log = logging.getLogger("lumisplat")

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
    # Scene files come first, as mistakes in them are found before other files are loaded, which may take minutes.
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
    """Up as a scene.toml says it, else as the first capture does; None: both say nothing.

    That of a file of meshes is its own, unless there is no capture.
    """
    for path, scene in scenes.items():
        if path.suffix.lower() == ".toml" and "up" in toml_values(path):
            return scene.up
    listed = (around, *scenes.values())
    deciding = [scene for scene in listed if scene.splats] or listed
    return next((scene.up_direction for scene in deciding if scene.up_source != "guess"), None)


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


def camera_file(paths: Sequence[Path]) -> Path | None:
    """Returns the file that brings the cameras of a scene: its scene.toml, or the only file, if that is a scene.

    A scene beside other files is put among them, where its cameras would look past it.

    Raises:
        ConfigError: There are two scene files.
    """
    is_scene = len(paths) == 1 and paths[0].suffix.lower() in _SCENES
    return paths[0] if is_scene else scene_file(paths)


def warn_of_unused_cameras(paths: Sequence[Path]) -> None:
    """Logs a line about glTF and OpenUSD files whose cameras are not used, as they are not the only file."""
    if len(paths) < 2:
        return
    having: list[str] = []
    for path in paths:
        if path.suffix.lower() in _SCENES:
            with suppress(ls.LumisplatError):  # loading the scene reports what is wrong with the file
                having += [str(path)] * bool(ls.load_cameras(path))
    if having:
        _log.warning(
            "the cameras of %s are not used beside other files: --cameras %s uses them", " and ".join(having), having[0]
        )


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


_OBJ_REFERENCE = re.compile(r"^(?:mtllib|map_\w+|norm|bump)\s+(?:.*\s)?(\S+)\s*$", re.MULTILINE)
_USDA_REFERENCE = re.compile(r"@([^@\n]+)@")
_OBJ_HEAD = 2**20
"""Bytes of an OBJ that are searched for its material library."""


def file_fingerprints(paths: list[Path], excluded: Path) -> dict[str, str]:
    """Size and time of files and of all files that they refer to, by their paths from the first one's folder.

    A text in a file refers to a file if it is its path from the folder of the file that holds the text; the path of a
    folder refers to the files in it.

    Args:
        paths: The files to begin with; the first is the scene file.
        excluded: A folder that is left out, that of the frames.
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
        with suppress(ValueError):  # a file that does not parse refers to nothing here; its reader reports it
            waiting += [path.parent / name for text in _texts(path) for name in _paths(text)]
    home = Path(os.path.abspath(paths[0])).parent
    return {os.path.relpath(path, home): mark for path, mark in sorted(found.items())}


def toml_values(path: Path) -> dict[str, Any]:
    """Parses a TOML file.

    Raises:
        ValueError: It is not TOML; of a file that cannot be read, a FormatError, which is one, too.
    """
    from lumisplat.io.files.source import read_text  # at last, as help comes without NumPy

    return tomllib.loads(read_text(path))


def _paths(text: str) -> set[str]:
    """The paths that a text may be, with slashes or Windows' backslashes; none for this folder and those around it."""
    is_path = 0 < len(text) < 1024 and "\0" not in text and bool(set(Path(text).parts) - {".", "..", "/"})
    return {text, text.replace("\\", "/")} if is_path else set()


def _texts(path: Path) -> Iterator[str]:
    """The texts of a file that may refer to others."""
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
    elif suffix in (".obj", ".mtl"):
        with path.open("rb") as stream:
            yield from _OBJ_REFERENCE.findall(stream.read(_OBJ_HEAD).decode(errors="replace"))


def gltf_document(path: Path) -> Any:
    """Reads the JSON of a .gltf or a .glb, without its buffers; None if a .glb does not begin with it."""
    if path.suffix.lower() == ".gltf":
        return json.loads(path.read_bytes())
    with path.open("rb") as stream:
        head = stream.read(20)
        return json.loads(stream.read(int.from_bytes(head[12:16], "little"))) if head[16:20] == b"JSON" else None


def _usd_references(path: Path) -> list[str]:
    """The files that a binary layer of OpenUSD refers to: layers, and the values of all attributes and times."""
    try:
        library: Any = importlib.import_module("pxr.UsdUtils")
    except ImportError:  # then nothing reads it
        return []
    return [text for texts in library.ExtractExternalReferences(str(path)) for text in texts]


def _strings(value: object) -> Iterator[str]:
    """All texts in the values of a document."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in cast(dict[str, object], value).values():
            yield from _strings(inner)
    elif isinstance(value, list):
        for inner in cast(list[object], value):
            yield from _strings(inner)
