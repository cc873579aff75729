"""Scenes that can be edited and saved: the tables of a scene file, and what they were read to.

Every edit changes a table, as somebody would who writes the file, and the entry is read again by the reader of scene
files: what is saved is what was seen.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy.typing as npt

from lumisplat import io
from lumisplat.config import AvatarLightingConfig, RenderConfig
from lumisplat.config.checks import suggestion
from lumisplat.errors import ConfigError, FormatError, SceneError
from lumisplat.io.document.entries import (
    KINDS,
    EntryKind,
    EntryReader,
    SceneEntry,
    explicit_table,
    shown_scene,
)
from lumisplat.io.document.opening import heading_of, listed_files, read_entries, read_entry, reader_of, turned_with_up
from lumisplat.io.document.saving import entries_of, relocated, saved_assets
from lumisplat.io.document.tables import PLACED_IN_WORDS, light_table, placement_table
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.scene_toml.cameras import read_scene_cameras
from lumisplat.io.scene_toml.config_file import changed_settings, read_config
from lumisplat.io.scene_toml.scene_file import animation_of
from lumisplat.io.scene_toml.toml_table import TomlTable, plain_value, toml_text
from lumisplat.math.arrays import matrix_4x4
from lumisplat.scene.animation.actors import Animation
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene, check_similarity
from lumisplat.scene.up import up_vector


@dataclass(frozen=True, slots=True, eq=False)
class SceneDocument:
    """A scene as people edit it. `open` and `of` make one.

    It never changes: an edit returns another one, which shares with it all that is as it was, to the same objects. To
    undo is to keep the old one.
    """

    entries: tuple[SceneEntry, ...]
    top: Mapping[str, Any]
    """What is no entry: ``up``, ``render``, ``animation``, ``materials`` and ``cameras``, as in a scene file."""
    problems: tuple[str, ...] = ()
    """What could not be read, and is left out, a line each."""
    _reader: EntryReader = field(kw_only=True, repr=False)
    _scenes: dict[float, tuple[Scene, list[SceneEntry]]] = field(
        default_factory=dict[float, tuple[Scene, list[SceneEntry]]], kw_only=True, repr=False
    )
    """By time: the last scene, and the entry of each of its instances."""

    @classmethod
    def open(
        cls,
        paths: PathLike | Iterable[PathLike],
        load: Callable[[Path], Gaussians | Mesh | Scene] | None = None,
        *,
        up: str | npt.ArrayLike | None = None,
        keep_coordinates: bool = False,
    ) -> SceneDocument:
        """Opens files as one scene; those that cannot be read are left out and listed in ``problems``.

        Args:
            paths: Captures, meshes, and at most one ``scene.toml``, whose tables stay as they are; comments are lost.
            load: Reads one capture or mesh; None: `lumisplat.load`.
            up: Up, if the scene file does not say it; None: as `lumisplat.Scene.up_direction`.
            keep_coordinates: Whether meshes beside captures stay as they are in their files; else they are put into
                them as of `lumisplat.insert`. A scene file places its own.

        Raises:
            ConfigError: There are two scene files, or no file at all.
            FormatError: The scene file itself cannot be read, or none of the files.
        """
        files = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(path) for path in paths]
        listing = listed_files(files, keep_coordinates=keep_coordinates)
        if up is not None:
            listing.top.setdefault("up", list(up_vector(up)))
        reader = reader_of(listing, load or io.load)
        entries, problems = read_entries(reader, listing)
        return cls(tuple(entries), listing.top, tuple(problems), _reader=reader)

    @classmethod
    def of(cls, scene: Scene | Animation | Gaussians | Mesh) -> SceneDocument:
        """The document of what a program has made; assets are written beside the file when it is saved.

        Cameras that a scene file cannot hold are left out, and listed in ``problems``.

        Raises:
            SceneError: It is none of these.
        """
        memory = entries_of(scene)
        reader = EntryReader(Path("scene.toml"), io.load, memory.up, {}, memory.assets, memory.skies)
        entries = [reader.read(number, kind, table) for number, (kind, table) in enumerate(memory.tables)]
        for number, actor in enumerate(memory.actors, start=len(entries)):
            name = {"name": actor.name or "actor"}
            entries.append(SceneEntry(number, "actors", name, actor=actor, world_from_file=actor.world_from_object))
        return cls(tuple(entries), memory.top, tuple(memory.problems), _reader=reader)

    @staticmethod
    def kind_of(path: PathLike) -> EntryKind:
        """Under which heading a file is listed: ``"splats"`` if it is a capture and nothing else, else ``"meshes"``."""
        return heading_of(Path(path))

    # --- What it holds ---

    def entry(self, number: int) -> SceneEntry:
        """The entry of an id.

        Raises:
            SceneError: There is none.
        """
        for entry in self.entries:
            if entry.id == number:
                return entry
        raise SceneError(f"there is no entry {number}: it has been removed")

    def scene(self, time: float = 0.0) -> Scene:
        """What is shown at a time: all that is not hidden, and actors where they are then. The same object each time.

        Raises:
            FormatError: A frame of an actor cannot be read.
        """
        return self._at(time)[0]

    def owner(self, instance: int, time: float = 0.0) -> SceneEntry:
        """The entry of an instance of `scene`, as `lumisplat.Frame.instance_index` counts them.

        Raises:
            SceneError: There is no such instance.
        """
        owners = self._at(time)[1]
        if not 0 <= instance < len(owners):
            raise SceneError(f"there is no instance {instance}: the scene has {len(owners)}")
        return owners[instance]

    @property
    def file(self) -> Path:
        """The scene file, which need not exist; paths in tables start from its folder."""
        return self._reader.file

    @property
    def config(self) -> RenderConfig:
        """The settings of ``[render]``.

        Raises:
            FormatError: One is wrong.
        """
        return read_config(TomlTable.of(self.file, dict(self.top)))

    @property
    def animation(self) -> Animation | None:
        """How it moves, with its cameras; what is hidden is left out. None: nothing moves.

        Raises:
            FormatError: ``[animation]`` or a camera is wrong.
        """
        actors = [entry.actor for entry in self.entries if entry.actor is not None and not entry.hidden]
        still, _ = shown_scene([entry for entry in self.entries if entry.actor is None], up_vector(self.top["up"]), 0.0)
        animation = animation_of(TomlTable.of(self.file, dict(self.top)), still, actors)
        return replace(animation, cameras=self.cameras) if actors or animation.camera_path is not None else None

    @property
    def cameras(self) -> list[Camera]:
        """The cameras that it lists.

        Raises:
            FormatError: One is wrong, or its file cannot be read.
        """
        return read_scene_cameras(TomlTable.of(self.file, dict(self.top)), io.load_cameras)

    def part_names(self, number: int) -> list[str]:
        """The names of the meshes of a mesh entry's file."""
        return self._reader.part_names(self.entry(number))

    def material(self, number: int) -> Mapping[str, Any]:
        """The ``material`` of an entry as a table, a named one with its values; empty: it has none."""
        given = self.entry(number).table.get("material", {})
        return self.top.get("materials", {}).get(given, {}) if isinstance(given, str) else given

    # --- Edits ---

    def changed(self, number: int, **keys: Any) -> SceneDocument:
        """Sets keys of an entry's table; those that are None are removed. Arrays and tuples become lists.

        Raises:
            FormatError: The entry would be invalid; names the key.
        """
        entry = self.entry(number)
        if (
            entry.kind == "actors"
            and entry.actor is not None
            and "path" not in entry.table
            and keys.keys() != {"hidden"}
        ):
            raise SceneError(f"{entry.name} was made by a program: it can be hidden, but not edited")
        table = {key: value for key, value in (dict(entry.table) | keys).items() if value is not None}
        if "path" not in entry.table and entry.kind == "actors":
            return self._with(replace(entry, table=table))
        return self._with(read_entry(self._reader, entry.id, entry.kind, table))

    def placed(self, number: int, world_from_file: npt.ArrayLike) -> SceneDocument:
        """Places a capture, a mesh or an actor.

        Args:
            number: Id of the entry.
            world_from_file: A similarity, shape (4, 4).

        Raises:
            SceneError: It is no similarity.
        """
        matrix = matrix_4x4("world_from_file", world_from_file)
        check_similarity(matrix[:3, :3], "world_from_file", "an entry")
        return self.changed(number, **dict.fromkeys(PLACED_IN_WORDS), **placement_table(matrix))

    def added(self, kind: EntryKind, table: Mapping[str, Any]) -> tuple[SceneDocument, int]:
        """Adds an entry, and returns its id, too.

        A mesh or an actor that says no place is put into what is there: upright, on the ground, as of `insert`.

        Args:
            kind: Its heading.
            table: Its keys and values; paths start from the folder of `file`.

        Raises:
            ConfigError: There is no such kind, or an environment already.
            FormatError: The entry is invalid.
        """
        if kind not in KINDS:
            raise ConfigError(f"there are no entries of kind '{kind}', {suggestion(kind, KINDS)}")
        if kind == "environment" and any(entry.kind == kind for entry in self.entries):
            raise ConfigError("there is an environment already: change that one, or remove it first")
        number = 1 + max((entry.id for entry in self.entries), default=-1)
        number = max(number, self._reader.next_id)
        self._reader.next_id = number + 1
        around = self.scene() if kind in ("meshes", "actors") else None
        around = around if around is not None and (around.splats or around.meshes) else None
        entry = read_entry(self._reader, number, kind, dict(table), around)
        return replace(self, entries=(*self.entries, entry), _scenes={}), number

    def duplicated(self, number: int) -> tuple[SceneDocument, int]:
        """Adds another entry like one, in its place, and returns its id, too.

        Raises:
            ConfigError: It is an environment.
        """
        entry = self.entry(number)
        copied = explicit_table(entry)
        if copied.get("name"):
            names = {other.name for other in self.entries}
            copied["name"] = next(name for n in range(2, len(names) + 3) if (name := f"{entry.name} {n}") not in names)
        return self.added(entry.kind, copied)

    def removed(self, number: int) -> SceneDocument:
        """Removes an entry."""
        self.entry(number)
        return replace(self, entries=tuple(entry for entry in self.entries if entry.id != number), _scenes={})

    def with_up(self, up: str | npt.ArrayLike) -> SceneDocument:
        """Sets which way is up.

        Meshes and actors that stand upright among captures are turned about their feet, so that they stand upright
        again, and so is an environment whose image stands upright. All else stays where it is.

        Args:
            up: An axis (``"z-up"``) or a direction of any length, world space.

        Raises:
            SceneError: It is neither.
        """
        before, now = up_vector(self.top["up"]), up_vector(up)
        reader, among = self._reader.with_up(now), any(entry.splats for entry in self.entries)
        entries = tuple(turned_with_up(reader, entry, before, is_among_captures=among) for entry in self.entries)
        return replace(self, entries=entries, top=dict(self.top) | {"up": list(now)}, _reader=reader, _scenes={})

    def split(self, number: int) -> SceneDocument:
        """Makes each mesh of a mesh entry's file an entry of its own; the lights of the file become entries, too.

        Raises:
            SceneError: The file has one mesh only.
        """
        entry = self.entry(number)
        names = self.part_names(number) if entry.kind == "meshes" and "part" not in entry.table else []
        if len(names) < 2:
            raise SceneError(f"{entry.name} is one mesh: there is nothing to split")
        document = self.removed(number)
        matrix = entry.world_from_file
        assert matrix is not None
        rest = {key: value for key, value in entry.table.items() if key not in (*PLACED_IN_WORDS, "lights")}
        for part, name in enumerate(names):
            document, _ = document.added(
                "meshes", rest | placement_table(matrix) | {"part": part, "name": name or f"part {part}"}
            )
        for light in entry.lights:
            document, _ = document.added("lights", light_table(light))
        return document

    def with_config(self, config: RenderConfig) -> SceneDocument:
        """With other settings."""
        return replace(self, top=dict(self.top) | {"render": changed_settings(config)})

    def with_animation(self, **keys: Any) -> SceneDocument:
        """With other keys of ``[animation]``; those that are None are removed.

        Args:
            **keys: ``fps``, ``duration``, ``frames``, or ``lighting``, an AvatarLightingConfig.

        Raises:
            FormatError: A value is wrong.
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
        """With other ``[[cameras]]``, as tables.

        Raises:
            FormatError: One is wrong.
        """
        document = replace(self, top=dict(self.top) | {"cameras": plain_value(list(cameras))})
        _ = document.cameras
        return document

    # --- Files ---

    def toml(self, folder: PathLike | None = None) -> str:
        """The text of the scene file.

        Args:
            folder: From where its paths start; None: that of `file`.
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
                tables[kind] = listed[0] if kind == "environment" else listed
        return toml_text(tables)

    def save(self, path: PathLike, *, overwrite: bool = False) -> None:
        """Saves the scene file, which appears complete or not at all, and beside it what is in memory alone.

        That is written to the folder ``NAME.assets`` first. Comments of the file that was opened are lost.

        Args:
            path: The ``.toml`` file.
            overwrite: Whether it, and the files beside it, may replace those that are there.

        Raises:
            FormatError: It is there already, is no ``.toml``, or cannot be written, or something in memory has no file
                format.
        """
        target = Path(path)
        if target.suffix.lower() != ".toml":
            raise FormatError(path, "is no .toml: a scene is saved as one")
        if target.exists() and not overwrite:
            raise FormatError(path, "is there already: choose another name, or allow to overwrite it")
        entries = saved_assets(self.entries, self._reader, target, overwrite)
        try:
            text = replace(self, entries=entries, _scenes={}).toml(target.parent).encode()
        except UnicodeEncodeError:
            raise FormatError(path, "cannot be written: a file that it names has a name that is no text") from None
        with atomic_write(target) as temporary:
            Path(temporary).write_bytes(text)

    def _written(self, entry: SceneEntry) -> dict[str, Any]:
        """The table of an entry as it is saved: beside captures, meshes and actors say where they stand."""
        beside = any(other.kind == "splats" for other in self.entries)
        return explicit_table(entry) if beside else dict(entry.table)

    def _with(self, changed: SceneEntry) -> SceneDocument:
        entries = tuple(changed if entry.id == changed.id else entry for entry in self.entries)
        return replace(self, entries=entries, _scenes={})

    def _at(self, time: float) -> tuple[Scene, list[SceneEntry]]:
        held = self._scenes.get(time)
        if held is None:
            held = shown_scene(self.entries, up_vector(self.top["up"]), time)
            self._scenes.clear()
            self._scenes[time] = held
        return held
