"""Entries of an editable scene, and the reader that builds them from tables of scene files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from lumisplat.io.document.tables import placement_table
from lumisplat.io.scene_toml.actors import Load, Subjects, read_actor
from lumisplat.io.scene_toml.assets import Assets
from lumisplat.io.scene_toml.lights import read_environment, read_light, read_sun
from lumisplat.io.scene_toml.materials import read_materials
from lumisplat.io.scene_toml.placement import is_placed, placement
from lumisplat.io.scene_toml.toml_table import TomlTable, plain_value
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.scene.animation.actors import Actor, Instance
from lumisplat.scene.animation.daylight import Daylight
from lumisplat.scene.animation.lights import LightPath, MovingLight, light_at
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.placing import Vector
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

EntryKind = Literal["splats", "meshes", "actors", "lights", "environment", "sun"]
"""Kind of an entry: the name of its table in a scene file."""

KINDS: tuple[EntryKind, ...] = ("splats", "meshes", "actors", "lights", "environment", "sun")
"""Kinds of entries, in the order in which their captures and meshes are added to the scene."""
SINGLE: tuple[EntryKind, ...] = ("environment", "sun")
"""Kinds of which a scene file has at most one entry, a table with single brackets."""
_LIGHTS: tuple[EntryKind, ...] = ("lights", "meshes", "splats", "actors", "environment", "sun")
"""Kinds of entries, in the order in which their lights are added to the scene."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneEntry:
    """One entry of a `SceneDocument`: a table of a scene file and the scene objects read from the table."""

    id: int
    """Unique id within the document, which edits do not change."""
    kind: EntryKind
    table: Mapping[str, Any]
    """Keys and values of the entry as in a scene file; change them by `SceneDocument.changed`."""
    splats: tuple[SplatInstance, ...] = ()
    meshes: tuple[MeshInstance, ...] = ()
    lights: tuple[Light, ...] = ()
    actor: Actor | None = None
    moving: tuple[MovingLight, ...] = ()
    """Lights of the entry if they change with time; ``lights`` then has them at time 0."""
    daylight: Daylight | None = None
    """Place and time of a sun, None for other kinds."""
    world_from_file: Doubles | None = None
    """Transform from the asset's file to the world, a similarity, shape (4, 4); None for lights."""
    _assets: tuple[Scene, ...] = field(default=(), repr=False)
    """The entry's asset as loaded, then with crop box and other changes, then with its material. Later edits reuse
    these scenes instead of loading the file again."""
    _poses: dict[float, tuple[Instance, ...]] = field(default_factory=dict[float, tuple[Instance, ...]], repr=False)
    """Cache of `SceneEntry.at`: an actor's instances at the last requested time. A repeated call thus returns the same
    objects."""

    @property
    def name(self) -> str:
        """Display name: the name in the table, or else the name of the entry's file, shape, type or kind."""
        given = self.table.get("name")
        if given:
            return str(given)
        path = self.table.get("path")
        if path:
            return Path(str(path)).name if str(path).startswith("<") else Path(str(path)).name.partition(".")[0]
        return str(self.table.get("shape") or self.table.get("type") or self.kind)

    @property
    def hidden(self) -> bool:
        """True if the entry is left out of the scene. A light or environment is hidden if it is disabled."""
        if self.kind in ("lights", "environment"):
            return not self.table.get("enabled", True)
        return bool(self.table.get("hidden", False))

    @property
    def is_of_program(self) -> bool:
        """True if the entry is an actor or a moving light that a program made and that no table describes."""
        if self.moving:
            return self.daylight is None and "keyframes" not in self.table
        return self.actor is not None and "path" not in self.table

    def at(self, time: float) -> tuple[Instance, ...]:
        """Returns the captures and meshes of the entry in world space at a time in seconds.

        Raises:
            FormatError: A frame of an actor cannot be read.
        """
        if self.actor is None:
            return (*self.splats, *self.meshes)
        pose = self._poses.get(time)
        if pose is None:
            pose = self.actor.at(time)
            self._poses.clear()
            self._poses[time] = pose
        return pose

    def lights_at(self, time: float) -> tuple[Light, ...]:
        """Returns the lights of the entry at a time in seconds."""
        return tuple(light_at(light, time) for light in self.moving) if self.moving else self.lights


@dataclass(slots=True)
class EntryReader:
    """Builds the entries of a document from their tables; a file that several entries name is read once."""

    file: Path
    """Path of the scene file, which need not exist yet. Relative paths in tables start from its folder."""
    load: Load
    up: Vector
    materials: Mapping[str, Any]
    """Tables of the named materials, by name."""
    memory: dict[str, Scene] = field(default_factory=dict[str, Scene])
    """Captures and meshes without a file. The keys are placeholders that entries give as their ``path``."""
    environments: dict[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    """Environment images. The keys are the ``path`` of entries: a file, or a placeholder for an image without a file.
    """
    next_id: int = 0
    """Id for the next entry, larger than the ids of all entries so far, including removed ones."""
    _assets: Assets | None = None
    _subjects: Subjects | None = None

    def read(
        self, number: int, kind: EntryKind, values: Mapping[str, Any], insertion_scene: Scene | None = None
    ) -> SceneEntry:
        """Reads a table, and returns an entry with a copy of the table.

        A mesh or actor without a placement is inserted into ``insertion_scene`` as by `lumisplat.insert`. The resulting
        placement is written to the entry's table, so that later edits do not move the entry.

        Args:
            number: Id of the entry.
            kind: Kind of the entry.
            values: The table.
            insertion_scene: Non-empty scene, for `insert` and for the ground of ``ground = true``. None leaves an entry
                without a placement at the position that its file states.

        Raises:
            FormatError: A key or value is invalid, or a file cannot be read.
        """
        plain: dict[str, Any] = plain_value(values)
        table = TomlTable.of(self.file, plain, kind)
        entry = SceneEntry(number, kind, MappingProxyType(plain))
        if kind == "lights":
            return _with_light(entry, read_light(table))
        if kind == "environment":
            return _with_light(entry, self._environment(table))
        if kind == "sun":
            daylight, lights = read_sun(table, self.up)
            moving = lights if daylight.speed else ()
            return replace(entry, lights=daylight.lights(self.up) if lights else (), moving=moving, daylight=daylight)
        if kind == "actors":
            if self._subjects is None:
                self._subjects = Subjects(self.load)
            actor = read_actor(table, self._subjects, self.up, insertion_scene)
            entry = replace(entry, actor=actor, world_from_file=actor.world_from_object)
            return self.read(number, kind, explicit_table(entry)) if _is_inserted(entry) else entry
        placed = self.assets.splats(table) if kind == "splats" else self.assets.meshes(table, insertion_scene)
        entry = replace(
            entry,
            splats=placed.splats,
            meshes=placed.meshes,
            lights=placed.lights,
            world_from_file=placed.world_from_file,
            _assets=placed.assets,
        )
        return self.read(number, kind, explicit_table(entry)) if _is_inserted(entry) else entry

    def with_up(self, up: Vector) -> EntryReader:
        """Returns a reader that has another up direction and shares the loaded assets of this reader."""
        return replace(self, up=up, _assets=None if self._assets is None else replace(self._assets, up=up))

    def part_names(self, entry: SceneEntry) -> list[str]:
        """Returns the names of the meshes in the file of a mesh entry."""
        return self.assets.part_names(TomlTable.of(self.file, dict(entry.table), entry.kind))

    @property
    def assets(self) -> Assets:
        """Loads and caches the captures and meshes that entries name."""
        if self._assets is None:
            named = read_materials(TomlTable.of(self.file, {"materials": dict(self.materials)}))
            self._assets = Assets(self.load, named, self.up, self.memory)
        return self._assets

    def _environment(self, table: TomlTable) -> LightEnvironment | LightPath:
        """Reads an ``[environment]`` table as a light. An image that several edits of the table name is read once."""
        path = table.values.get("path")
        read = read_environment(table, None if path is None else self.environments.get(path))
        if path is not None and path not in self.environments:
            light = read.lights[0] if isinstance(read, LightPath) else read
            assert isinstance(light, LightEnvironment) and light.image is not None
            self.environments[path] = light.image
        return read


def _with_light(entry: SceneEntry, light: Light | LightPath) -> SceneEntry:
    """Returns an entry with a light, which may change with time."""
    if isinstance(light, LightPath):
        return replace(entry, lights=(light.at(0.0),), moving=(light,))
    return replace(entry, lights=(light,))


def _is_inserted(entry: SceneEntry) -> bool:
    """Returns whether an entry states no placement, so that `lumisplat.insert` chose one beside the captures."""
    if entry.kind not in ("meshes", "actors") or is_placed(entry.table) or entry.world_from_file is None:
        return False
    return not np.array_equal(entry.world_from_file, placement(TomlTable.of(Path(), dict(entry.table))))


def explicit_table(entry: SceneEntry) -> dict[str, Any]:
    """Returns an entry's table; a mesh or actor that was inserted without a placement gets its placement as numbers.

    The table then gives the same placement whatever other entries the scene has.
    """
    if entry.kind not in ("meshes", "actors") or is_placed(entry.table) or entry.world_from_file is None:
        return dict(entry.table)
    rest = {key: value for key, value in entry.table.items() if key not in ("ground", "front")}
    return rest | placement_table(entry.world_from_file)


def visible_scene(entries: Sequence[SceneEntry], up: Vector, time: float) -> tuple[Scene, list[SceneEntry]]:
    """Returns the scene of all visible entries at a time, and the entry of each of its captures, then of each mesh.

    Args:
        entries: Entries of the document.
        up: Up direction of the scene.
        time: Seconds.

    Raises:
        FormatError: A frame of an actor cannot be read.
    """
    visible = [entry for kind in KINDS for entry in entries if entry.kind == kind and not entry.table.get("hidden")]
    splats: list[tuple[SplatInstance, SceneEntry]] = []
    meshes: list[tuple[MeshInstance, SceneEntry]] = []
    for entry in visible:
        for instance in entry.at(time):
            if isinstance(instance, SplatInstance):
                splats.append((instance, entry))
            else:
                meshes.append((instance, entry))
    scene = Scene(
        splats=[instance for instance, _ in splats],
        meshes=[instance for instance, _ in meshes],
        lights=[
            light for kind in _LIGHTS for entry in visible if entry.kind == kind for light in entry.lights_at(time)
        ],
        up=up,
    )
    return scene, [entry for _, entry in (*splats, *meshes)]
