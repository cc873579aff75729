"""Scenes that can be edited and saved as scene files.

Each edit changes a table of the scene file, as a user would do by hand, and reads the entry again with the reader of
scene files. A saved file therefore loads as exactly the edited scene.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from lumisplat import io
from lumisplat.config import AvatarLightingConfig, RenderConfig
from lumisplat.config.checks import suggestion
from lumisplat.errors import ConfigError, FormatError, MissingExtraError, SceneError
from lumisplat.io.document.entries import (
    KINDS,
    SINGLE,
    EntryKind,
    EntryReader,
    SceneEntry,
    explicit_table,
    visible_scene,
)
from lumisplat.io.document.saving import entries_of, light_kind, relative_path, relocated, saved_assets
from lumisplat.io.document.tables import NAMED_PLACEMENT_KEYS, light_table, placement_table
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike, parsing
from lumisplat.io.gltf.scene import holds_one_capture
from lumisplat.io.load_save import USD, holds_mesh
from lumisplat.io.scene_toml.cameras import read_scene_cameras
from lumisplat.io.scene_toml.config_file import changed_settings, read_config
from lumisplat.io.scene_toml.materials import read_material_paths
from lumisplat.io.scene_toml.placement import is_placed, scene_around, scene_up, stand_placed_upright
from lumisplat.io.scene_toml.scene_file import animation_of, check_one_sky, read_document
from lumisplat.io.scene_toml.toml_table import TomlTable, plain_value, toml_text
from lumisplat.math.arrays import Doubles, matrix_4x4
from lumisplat.math.transforms import quaternions_from_matrices, rotation_between, rotation_matrix
from lumisplat.scene.animation.actors import Animation
from lumisplat.scene.animation.lights import light_at, with_materials
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.insertion import lowest
from lumisplat.scene.placing import Vector, up_vector
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance, check_similarity


@dataclass(frozen=True, slots=True, eq=False)
class SceneDocument:
    """An editable scene, created by `SceneDocument.open` or `SceneDocument.of`.

    A document is immutable: each edit returns a new one, which shares all unchanged objects with the old one. To undo
    an edit, go back to the old document.
    """

    entries: tuple[SceneEntry, ...]
    top: Mapping[str, Any]
    """Tables of the scene file other than its entries: ``up``, ``render``, ``animation``, ``materials`` and
    ``cameras``.
    """
    problems: tuple[str, ...] = ()
    """A message for each file or object that could not be read and is left out."""
    _reader: EntryReader = field(kw_only=True, repr=False)
    _scenes: dict[float, tuple[Scene, list[SceneEntry]]] = field(
        default_factory=dict[float, tuple[Scene, list[SceneEntry]]], kw_only=True, repr=False
    )
    """Cache of `SceneDocument.scene`: the scene at the last requested time, and the entry of each of its instances."""

    @classmethod
    def open(
        cls,
        paths: PathLike | Iterable[PathLike],
        load: Callable[[Path], Gaussians | Mesh | Scene] | None = None,
        *,
        up: str | npt.ArrayLike | None = None,
        keep_coordinates: bool = False,
    ) -> SceneDocument:
        """Opens files as one scene; unreadable files are left out and listed in ``problems``.

        Args:
            paths: Captures, meshes, and at most one ``scene.toml``. Its tables are kept as written, without comments.
            load: Function that reads a capture or mesh; None uses `lumisplat.load`.
            up: Up direction if the scene file does not give one. None uses the up direction that a capture states, else
                y down for a scene with captures and y up for one with only meshes.
            keep_coordinates: Whether meshes opened beside captures keep the coordinates of their files. Otherwise they
                are inserted into the captures as by `lumisplat.insert`. Does not apply to meshes of a scene file.

        Raises:
            ConfigError: There are two scene files, or no file at all.
            FormatError: The scene file cannot be read, or no file can be read.
        """
        files = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(path) for path in paths]
        listing = _listed_files(files, keep_coordinates=keep_coordinates)
        if up is not None:
            listing.top.setdefault("up", list(up_vector(up)))
        reader = _reader_of(listing, load or io.load)
        entries, problems = _read_entries(reader, listing)
        return cls(tuple(entries), listing.top, tuple(problems), _reader=reader)

    @classmethod
    def of(cls, scene: Scene | Animation | Gaussians | Mesh) -> SceneDocument:
        """Creates a document from a scene made by a program; saving it also saves the scene's assets beside the file.

        Cameras that a scene file cannot store are left out, and listed in ``problems``.

        Raises:
            SceneError: ``scene`` has another type.
        """
        memory = entries_of(scene)
        reader = EntryReader(Path("scene.toml"), io.load, memory.up, {}, memory.assets, memory.environments)
        entries = [reader.read(number, kind, table) for number, (kind, table) in enumerate(memory.tables)]
        for actor in memory.actors:
            name = {"name": actor.name or "actor"}
            world = actor.world_from_object
            entries.append(SceneEntry(len(entries), "actors", name, actor=actor, world_from_file=world))
        for function in memory.lights:
            light = light_at(function, 0.0)
            table = light_table(light)
            entries.append(SceneEntry(len(entries), light_kind(light), table, lights=(light,), moving=(function,)))
        return cls(tuple(entries), memory.top, tuple(memory.problems), _reader=reader)

    @staticmethod
    def kind_of(path: PathLike) -> EntryKind:
        """Returns the kind of entry for a file: ``"splats"`` if it has only a capture, else ``"meshes"``."""
        return _heading_of(Path(path))

    # --- Content ---

    def entry(self, number: int) -> SceneEntry:
        """Returns the entry with the id ``number``.

        Raises:
            SceneError: There is no such entry.
        """
        for entry in self.entries:
            if entry.id == number:
                return entry
        raise SceneError(f"there is no entry {number} in the scene: it has been removed")

    def scene(self, time: float = 0.0) -> Scene:
        """Returns the visible scene at a time in seconds, with actors posed. Equal times return the same object.

        Raises:
            FormatError: A frame of an actor cannot be read.
        """
        return self._at(time)[0]

    def owner(self, instance: int, time: float = 0.0) -> SceneEntry:
        """Returns the entry that an instance of the scene belongs to.

        Args:
            instance: Index of the instance as in `lumisplat.Frame.instance_index`.
            time: Seconds.

        Raises:
            SceneError: There is no such instance.
        """
        owners = self._at(time)[1]
        if not 0 <= instance < len(owners):
            raise SceneError(f"there is no instance {instance}: the scene has {len(owners)}")
        return owners[instance]

    @property
    def file(self) -> Path:
        """Path of the scene file, which need not exist yet. Relative paths in tables start from its folder."""
        return self._reader.file

    @property
    def config(self) -> RenderConfig:
        """Settings of the ``[render]`` table.

        Raises:
            FormatError: A setting is invalid.
        """
        return read_config(TomlTable.of(self.file, dict(self.top)))

    @property
    def animation(self) -> Animation | None:
        """Moving content and cameras with their timing, without hidden entries; None if nothing changes with time.

        Raises:
            FormatError: ``[animation]`` or a camera is invalid.
        """
        actors = [entry.actor for entry in self.entries if entry.actor is not None and not entry.hidden]
        lights = [light for kind in KINDS for entry in self.entries if entry.kind == kind for light in entry.moving]
        fixed = [entry for entry in self.entries if entry.actor is None and not entry.moving]
        still, _ = visible_scene(fixed, up_vector(self.top["up"]), 0.0)
        animation = animation_of(TomlTable.of(self.file, dict(self.top)), still, actors, lights)
        is_moving = animation.has_moving_content or animation.camera_path is not None
        return replace(animation, cameras=self.cameras) if is_moving else None

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the scene file.

        Raises:
            FormatError: A camera is invalid, or its file cannot be read.
        """
        return read_scene_cameras(TomlTable.of(self.file, dict(self.top)), io.load_cameras)

    def part_names(self, number: int) -> list[str]:
        """Returns the names of the meshes in the file of the mesh entry ``number``."""
        return self._reader.part_names(self.entry(number))

    def material(self, number: int) -> Mapping[str, Any]:
        """Returns the table of an entry's ``material``, inline or from ``[materials]``; empty if it states none."""
        given = self.entry(number).table.get("material", {})
        return self.top.get("materials", {}).get(given, {}) if isinstance(given, str) else given

    # --- Edits ---

    def changed(self, number: int, **keys: Any) -> SceneDocument:
        """Returns a document in which keys of an entry's table have new values; None removes a key.

        Arrays and tuples become lists.

        Raises:
            FormatError: The entry would be invalid; the message names the key.
            SceneError: There is no entry with this id, or the entry is an actor or moving light that a program made.
        """
        entry = self.entry(number)
        if entry.is_of_program and (keys.keys() != {"hidden"} or entry.moving):
            hint = "it cannot be edited" if entry.moving else "it can be hidden, but not edited"
            raise SceneError(f"{entry.name} is {'a light' if entry.moving else 'an actor'} made by a program: {hint}")
        if entry.moving and "keyframes" not in keys:
            frames = entry.table.get("keyframes", [])
            keyed = next((key for key in keys if any(key in frame for frame in frames)), None)
            if keyed is not None:
                raise SceneError(f"{keyed} of {entry.name} changes with time: edit its keyframes in the scene file")
        table = {key: value for key, value in (dict(entry.table) | keys).items() if value is not None}
        if "path" not in entry.table and entry.kind == "actors":
            return self._with(replace(entry, table=table))
        return self._with(_read_entry(self._reader, entry.id, entry.kind, table))

    def placed(self, number: int, world_from_file: npt.ArrayLike) -> SceneDocument:
        """Returns a document in which a capture, mesh or actor has another transform.

        Args:
            number: Id of the entry.
            world_from_file: A similarity (rotation, uniform scale, translation), shape (4, 4).

        Raises:
            SceneError: The matrix is not a similarity.
        """
        matrix = matrix_4x4("world_from_file", world_from_file)
        check_similarity(matrix[:3, :3], "world_from_file", "an entry")
        return self.changed(number, **dict.fromkeys(NAMED_PLACEMENT_KEYS), **placement_table(matrix))

    def added(self, kind: EntryKind, table: Mapping[str, Any]) -> tuple[SceneDocument, int]:
        """Returns a document with one more entry, and the id of that entry.

        A mesh or actor without a placement is inserted into the scene upright on the ground, as by `lumisplat.insert`.

        Args:
            kind: Kind of the entry.
            table: Keys and values of the entry; paths are relative to the folder of `SceneDocument.file`.

        Raises:
            ConfigError: The kind is unknown, or the scene already has an environment.
            FormatError: The entry is invalid.
        """
        if kind not in KINDS:
            raise ConfigError(f"there are no entries of kind '{kind}', {suggestion(kind, KINDS)}")
        skies = [
            entry.kind for entry in self.entries if entry.kind in SINGLE and (entry.kind == kind or not entry.hidden)
        ]
        if kind in SINGLE and skies:
            raise ConfigError(f"there is {_SKIES[skies[0]]} already: change that one, or remove it first")
        number = 1 + max((entry.id for entry in self.entries), default=-1)
        number = max(number, self._reader.next_id)
        self._reader.next_id = number + 1
        insertion_scene = self.scene() if kind in ("meshes", "actors") else None
        insertion_scene = (
            insertion_scene
            if insertion_scene is not None and (insertion_scene.splats or insertion_scene.meshes)
            else None
        )
        entry = _read_entry(self._reader, number, kind, dict(table), insertion_scene)
        return replace(self, entries=(*self.entries, entry), _scenes={}), number

    def duplicated(self, number: int) -> tuple[SceneDocument, int]:
        """Returns a document with a copy of an entry at the same place, and the copy's id.

        Raises:
            ConfigError: The entry is an environment.
        """
        entry = self.entry(number)
        copied = explicit_table(entry)
        if copied.get("name"):
            names = {other.name for other in self.entries}
            copied["name"] = next(name for n in range(2, len(names) + 3) if (name := f"{entry.name} {n}") not in names)
        return self.added(entry.kind, copied)

    def removed(self, number: int) -> SceneDocument:
        """Returns a document without the entry ``number``; this document is unchanged."""
        self.entry(number)
        return replace(self, entries=tuple(entry for entry in self.entries if entry.id != number), _scenes={})

    def with_up(self, up: str | npt.ArrayLike) -> SceneDocument:
        """Returns a document with another up direction.

        Meshes and actors that stand upright among captures are rotated about their lowest point to stand upright again.
        An environment image whose top points up is rotated, too. All other entries keep their transform.

        Args:
            up: An axis (``"z-up"``) or a direction of any length, world space.

        Raises:
            SceneError: ``up`` is neither an axis nor a direction.
        """
        before, now = up_vector(self.top["up"]), up_vector(up)
        reader, among = self._reader.with_up(now), any(entry.splats for entry in self.entries)
        entries = tuple(_rotated_with_up(reader, entry, before, is_among_captures=among) for entry in self.entries)
        return replace(self, entries=entries, top=dict(self.top) | {"up": list(now)}, _reader=reader, _scenes={})

    def split(self, number: int) -> SceneDocument:
        """Returns a document in which a mesh entry is split into one entry for each mesh and each light of its file.

        Raises:
            SceneError: The file has only one mesh.
        """
        entry = self.entry(number)
        names = self.part_names(number) if entry.kind == "meshes" and "part" not in entry.table else []
        if len(names) < 2:
            raise SceneError(f"{entry.name} is one mesh: there is nothing to split")
        document = self.removed(number)
        matrix = entry.world_from_file
        assert matrix is not None
        rest = {key: value for key, value in entry.table.items() if key not in (*NAMED_PLACEMENT_KEYS, "lights")}
        for part, name in enumerate(names):
            document, _ = document.added(
                "meshes", rest | placement_table(matrix) | {"part": part, "name": name or f"part {part}"}
            )
        for light in entry.lights:
            document, _ = document.added("lights", light_table(light))
        return document

    def with_config(self, config: RenderConfig) -> SceneDocument:
        """Returns a document whose ``[render]`` table has these settings; this document is unchanged."""
        return replace(self, top=dict(self.top) | {"render": changed_settings(config)})

    def with_animation(self, **keys: Any) -> SceneDocument:
        """Returns a document in which keys of ``[animation]`` have new values; None removes a key.

        Args:
            **keys: ``fps``, ``duration``, ``frames``, or ``lighting``, an AvatarLightingConfig.

        Raises:
            FormatError: A value is invalid.
        """
        if isinstance(keys.get("lighting"), AvatarLightingConfig):
            keys["lighting"] = changed_settings(keys["lighting"])
        merged = dict(self.top.get("animation", {})) | plain_value(keys)
        table = {key: value for key, value in merged.items() if value is not None and value != {}}
        rest = {key: value for key, value in self.top.items() if key != "animation"}
        document = replace(self, top=rest | ({"animation": table} if table else {}))
        _ = document.animation
        return document

    def with_cameras(self, cameras: Sequence[Mapping[str, Any]]) -> SceneDocument:
        """Returns a document whose ``[[cameras]]`` are these tables.

        Raises:
            FormatError: A camera is invalid.
        """
        document = replace(self, top=dict(self.top) | {"cameras": plain_value(list(cameras))})
        _ = document.cameras
        return document

    # --- Files ---

    def toml(self, folder: PathLike | None = None) -> str:
        """Returns the text of the scene file.

        Args:
            folder: Folder that paths are relative to; None uses the folder of `SceneDocument.file`.
        """
        target = self.file.parent if folder is None else Path(folder)
        tables: dict[str, Any] = relocated(dict(self.top), self.file.parent, target)
        for kind in KINDS:
            listed = [
                relocated(self._written(entry), self.file.parent, target)
                for entry in self.entries
                if entry.kind == kind
            ]
            if listed:
                tables[kind] = listed[0] if kind in SINGLE else listed
        return toml_text(tables)

    def save(self, path: PathLike, *, overwrite: bool = False) -> None:
        """Saves the scene file, and in-memory assets beside it. The file appears complete or not at all.

        The assets are written first, to the folder ``NAME.assets``. Comments of the opened file are lost.

        Args:
            path: The ``.toml`` file.
            overwrite: Whether the scene file and asset files may replace existing ones.

        Raises:
            FormatError: The file exists already, is not a ``.toml``, or cannot be written, or an object has no file
                format.
        """
        target = Path(path)
        if target.suffix.lower() != ".toml":
            raise FormatError(path, "is not a .toml: scenes are saved as .toml files")
        if target.exists() and not overwrite:
            raise FormatError(path, "exists already: choose another name, or allow overwriting")
        entries = saved_assets(self.entries, self._reader, target, overwrite)
        try:
            text = replace(self, entries=entries, _scenes={}).toml(target.parent).encode()
        except UnicodeEncodeError:
            raise FormatError(path, "cannot be written: the name of a file that it refers to is not text") from None
        with atomic_write(target) as temporary:
            Path(temporary).write_bytes(text)

    def _written(self, entry: SceneEntry) -> dict[str, Any]:
        """Returns an entry's table for saving, with a placement for an object that was inserted among captures."""
        beside = any(other.kind == "splats" for other in self.entries)
        return explicit_table(entry) if beside else dict(entry.table)

    def _with(self, changed: SceneEntry) -> SceneDocument:
        entries = tuple(changed if entry.id == changed.id else entry for entry in self.entries)
        skies = [_SKIES[entry.kind] for entry in entries if entry.kind in SINGLE and not entry.hidden]
        if len(skies) > 1:
            raise SceneError(f"there would be {' and '.join(skies)}: hide one of them first")
        return replace(self, entries=entries, _scenes={})

    def _at(self, time: float) -> tuple[Scene, list[SceneEntry]]:
        cached = self._scenes.get(time)
        if cached is None:
            scene, owners = visible_scene(self.entries, up_vector(self.top["up"]), time)
            materials = read_material_paths(TomlTable.of(self.file, dict(self.top)))
            cached = with_materials(scene, materials, time), owners
            self._scenes.clear()
            self._scenes[time] = cached
        return cached


_MESHES = (".obj", ".stl")
_INSERTED_KINDS = ("meshes", "actors")
"""Kinds of entries that `lumisplat.insert` puts beside the captures of a scene if their table states no position."""

_UP_KEYS = ("look_at", "upright", "ground")
"""Placement keys whose meaning depends on the up direction."""
_SKIES = {"environment": "an environment", "sun": "a sun with its sky"}
_UPRIGHT = 1e-4
"""Largest distance between an object's unit y axis and the unit up direction at which the object counts as upright."""


@dataclass(slots=True)
class _Listing:
    """Tables of a scene file and of further opened files, from which the entries of a document are read."""

    file: Path
    """Path of the scene file, which need not exist yet. Relative paths in tables start from its folder."""
    top: dict[str, Any] = field(default_factory=dict[str, Any])
    """Tables of the scene file other than entries: ``up``, ``render``, ``animation``, ``materials`` and ``cameras``."""
    tables: list[tuple[EntryKind, dict[str, Any]]] = field(default_factory=list[tuple[EntryKind, dict[str, Any]]])


def _listed_files(files: Sequence[Path], *, keep_coordinates: bool = False) -> _Listing:
    """Returns the tables of the scene file among ``files``, and a new table for each other file.

    Args:
        files: Paths of captures, meshes and at most one scene file.
        keep_coordinates: See `SceneDocument.open`.

    Raises:
        ConfigError: There are two scene files, or no file at all.
    """
    scene_files = [file for file in files if file.suffix.lower() == ".toml"]
    if len(scene_files) > 1:
        raise ConfigError(f"{scene_files[0]} and {scene_files[1]} are both scene files: merge them into one")
    if not files:
        raise ConfigError("no scene given: name a capture, a mesh or a scene.toml")
    listing = _Listing(scene_files[0] if scene_files else Path("scene.toml"))
    if scene_files:
        with parsing(listing.file, "a scene file"):
            document = read_document(listing.file)
            stand_placed_upright(document, scene_up(document))
            listing.top = {key: value for key, value in document.values.items() if key not in KINDS}
            for kind in KINDS:
                tables = document.tables(kind) if kind not in SINGLE else [document.table(kind)]
                for table in tables if kind in document.values else ():
                    listing.tables.append((kind, table.values))
            check_one_sky(document)
    for file in files:
        if file not in scene_files:
            path = str(file) if file.is_absolute() else relative_path(file, listing.file.absolute().parent)
            kind = _heading_of(file)
            keys = {"upright": False} if keep_coordinates and kind == "meshes" else {}
            listing.tables.append((kind, {"path": path, **keys}))
    return listing


def _reader_of(listing: _Listing, load: Callable[[Path], Gaussians | Mesh | Scene]) -> EntryReader:
    """Creates the reader for the tables of a listing, and writes the scene's up direction to ``listing.top["up"]``."""
    top = listing.top
    named = {kind: [table for other, table in listing.tables if other == kind] for kind in ("splats", "actors")}
    top["up"] = list(scene_up(TomlTable.of(listing.file, {**named, **top})))
    return EntryReader(listing.file, load, up_vector(top["up"]), top.get("materials", {}))


def _read_entries(reader: EntryReader, listing: _Listing) -> tuple[list[SceneEntry], list[str]]:
    """Reads all tables of a listing. Returns the entries, and a message for each table that cannot be read."""
    entries: dict[int, SceneEntry] = {}
    problems: list[str] = []
    numbered = list(enumerate(listing.tables))
    # Entries without a placement are inserted among the others, so they are read last.
    for number, (kind, table) in sorted(
        numbered, key=lambda one: one[1][0] in _INSERTED_KINDS and not is_placed(one[1][1])
    ):
        insertion_scene = None
        if kind in _INSERTED_KINDS:
            insertion_scene = scene_around(table, visible_scene(list(entries.values()), reader.up, 0.0)[0])
        try:
            entries[number] = _read_entry(reader, number, kind, table, insertion_scene)
        except FormatError as error:
            problems.append(" ".join(str(error).split()))
            if len(listing.tables) == 1:
                raise
    if problems and not entries:
        raise SceneError("; ".join(problems))
    return [entries[number] for number in sorted(entries)], problems


def _read_entry(
    reader: EntryReader, number: int, kind: EntryKind, table: Mapping[str, Any], insertion_scene: Scene | None = None
) -> SceneEntry:
    """Reads the entry with the id ``number`` by `EntryReader.read`, and reports malformed content as `FormatError`."""
    with parsing(reader.file, "a scene file"):
        return reader.read(number, kind, table, insertion_scene)


def _heading_of(file: Path) -> Literal["splats", "meshes"]:
    """Returns ``meshes`` if the extension and content of a file are those of a mesh or scene, else ``splats``.

    Unreadable files are reported later, when the entry is read.
    """
    suffix = file.suffix.lower()
    is_mesh = suffix in _MESHES or (suffix == ".ply" and holds_mesh(file))
    if suffix in (".glb", ".gltf", ".vrm"):
        is_mesh = not holds_one_capture(file)
    if suffix in USD:
        from lumisplat.io.usd.scene import holds_one_capture as holds_one_field

        with suppress(FormatError, MissingExtraError):
            is_mesh = not holds_one_field(file)
    return "meshes" if is_mesh else "splats"


def _rotated_with_up(reader: EntryReader, entry: SceneEntry, before: Vector, *, is_among_captures: bool) -> SceneEntry:
    """Returns an entry for a scene whose up direction changes.

    An upright mesh or actor among captures is rotated about its lowest point by the smallest rotation from the old to
    the new up direction, so that it stays on the ground and faces the same way. Captures keep their transform, because
    the up direction is relative to their coordinates. Meshes without captures also keep their transform. The transform
    is then written as numbers, because keys such as ``upright`` would now mean another rotation.

    Args:
        reader: Reader with the new up direction.
        entry: The entry.
        before: The old up direction, a unit vector.
        is_among_captures: Whether the scene has a capture.
    """
    rotation_of_up = rotation_between(np.array(before), np.array(reader.up))
    if entry.kind == "environment" and "path" in entry.table:
        light: Any = entry.lights[0]
        return _rotated_environment(reader, entry, rotation_matrix(light.rotation_wxyz), rotation_of_up, before)
    if entry.kind == "sun":
        return _read_entry(reader, entry.id, entry.kind, entry.table)
    matrix = entry.world_from_file
    if matrix is None or (entry.actor is not None and "path" not in entry.table):
        return entry
    start = np.eye(4) if entry.actor is None or entry.actor.motion is None else entry.actor.motion.at(0.0)
    stands = is_among_captures and entry.kind != "splats" and _is_upright((start @ matrix)[:3, :3], before)
    if stands:
        about_foot, foot = np.eye(4), _foot(entry, before)
        about_foot[:3, :3], about_foot[:3, 3] = rotation_of_up, foot - rotation_of_up @ foot
        matrix = np.linalg.inv(start) @ about_foot @ start @ matrix
    elif not any(key in entry.table for key in _UP_KEYS):
        return entry
    rest = {key: value for key, value in entry.table.items() if key not in NAMED_PLACEMENT_KEYS}
    return _read_entry(reader, entry.id, entry.kind, rest | placement_table(matrix))


def _rotated_environment(
    reader: EntryReader, entry: SceneEntry, rotation: Doubles, rotation_of_up: Doubles, before: Vector
) -> SceneEntry:
    """Returns an environment rotated to a new up direction, if the top of its image points to the old up direction.

    An environment with any other orientation is returned unchanged.

    Args:
        reader: Reader with the new up direction.
        entry: The environment.
        rotation: Rotation of the environment before the change, shape (3, 3).
        rotation_of_up: Rotation from the old to the new up direction, shape (3, 3).
        before: The old up direction, a unit vector.
    """
    if not _is_upright(rotation, before):
        return entry
    wxyz = quaternions_from_matrices((rotation_of_up @ rotation)[None])[0]
    turned = {"rotation_wxyz": [float(f"{x:.12g}") for x in wxyz]}
    return _read_entry(reader, entry.id, entry.kind, dict(entry.table) | turned)


def _is_upright(linear: Doubles, up: Vector) -> bool:
    """Returns whether a rotation with uniform scale, shape (3, 3), maps the y axis to ``up``."""
    y = linear[:, 1] / np.linalg.norm(linear[:, 1])
    return bool(np.linalg.norm(y - np.array(up)) < _UPRIGHT)


def _foot(entry: SceneEntry, up: Vector) -> Doubles:
    """Returns the point vertically below the centre of an entry's box, at the entry's lowest height, in world space."""
    instances = entry.at(0.0)
    splats = [instance for instance in instances if isinstance(instance, SplatInstance)]
    meshes = [instance for instance in instances if isinstance(instance, MeshInstance)]
    low, high = Scene(splats, meshes).bulk_bounds()
    middle, upward = 0.5 * (low + high), np.array(up)
    return middle + (min(lowest(instance, up) for instance in instances) - middle @ upward) * upward
