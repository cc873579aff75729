"""Reads files to the entries of a document, and turns entries upright in a scene that gets another up."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lumisplat.errors import ConfigError, FormatError, MissingExtraError, SceneError
from lumisplat.io.document.entries import KINDS, EntryKind, EntryReader, SceneEntry, shown_scene
from lumisplat.io.document.saving import relative_path
from lumisplat.io.document.tables import PLACED_IN_WORDS, placement_table
from lumisplat.io.files.source import parsing
from lumisplat.io.formats import USD, holds_mesh
from lumisplat.io.gltf.scene import shows_one_capture
from lumisplat.io.scene_toml.placement import is_placed, say_unturned, scene_up
from lumisplat.io.scene_toml.scene_file import read_document
from lumisplat.io.scene_toml.toml_table import TomlTable
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import quaternions_from_matrices, rotation_between, rotation_matrix
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.insertion import lowest
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance
from lumisplat.scene.up import Vector, up_vector

_MESHES = (".obj", ".stl")
_PUT = ("meshes", "actors")
"""Headings of what is put into captures if it says no place."""

_OF_UP = ("look_at", "upright", "ground")
"""Keys whose meaning depends on up."""
_UPRIGHT = 1e-4
"""Largest distance of the y axis of what stands upright from up, both of length 1."""


@dataclass(slots=True)
class Listing:
    """Tables that are not read yet."""

    file: Path
    """The scene file, from whose folder paths start; it need not exist."""
    top: dict[str, Any] = field(default_factory=dict[str, Any])
    """What is no entry."""
    tables: list[tuple[EntryKind, dict[str, Any]]] = field(default_factory=list[tuple[EntryKind, dict[str, Any]]])


def listed_files(files: Sequence[Path], *, keep_coordinates: bool = False) -> Listing:
    """Files as entries: those of a scene file, and one for each other file, whose place may be that of its file.

    Raises:
        ConfigError: There are two scene files, or no file at all.
        FormatError: The scene file cannot be read.
    """
    scene_files = [file for file in files if file.suffix.lower() == ".toml"]
    if len(scene_files) > 1:
        raise ConfigError(f"{scene_files[0]} and {scene_files[1]} are both scene files: list in one what both list")
    if not files:
        raise ConfigError("no scene given: name a capture, a mesh or a scene.toml")
    listing = Listing(scene_files[0] if scene_files else Path("scene.toml"))
    if scene_files:
        with parsing(listing.file, "a scene file"):
            document = read_document(listing.file)
            say_unturned(document, scene_up(document))
            listing.top = {key: value for key, value in document.values.items() if key not in KINDS}
            for kind in KINDS[:-1]:
                for table in document.tables(kind):
                    listing.tables.append((kind, table.values))
            if "environment" in document.values:
                listing.tables.append(("environment", document.table("environment").values))
    for file in files:
        if file not in scene_files:
            path = str(file) if file.is_absolute() else relative_path(file, listing.file.absolute().parent)
            kind = heading_of(file)
            kept = {"upright": False} if keep_coordinates and kind == "meshes" else {}
            listing.tables.append((kind, {"path": path, **kept}))
    return listing


def reader_of(listing: Listing, load: Callable[[Path], Gaussians | Mesh | Scene]) -> EntryReader:
    """What reads the entries of a listing, whose ``up`` is then said.

    Raises:
        FormatError: ``up`` is no direction.
    """
    top = listing.top
    named = {kind: [table for other, table in listing.tables if other == kind] for kind in ("splats", "actors")}
    top["up"] = list(scene_up(TomlTable.of(listing.file, {**named, **top})))
    return EntryReader(listing.file, load, up_vector(top["up"]), top.get("materials", {}))


def read_entries(reader: EntryReader, listing: Listing) -> tuple[list[SceneEntry], list[str]]:
    """The entries of a listing, and a line for each that cannot be read.

    Raises:
        FormatError: None of them can.
    """
    entries: dict[int, SceneEntry] = {}
    problems: list[str] = []
    numbered = list(enumerate(listing.tables))
    # What says no place is put among what does.
    for number, (kind, table) in sorted(numbered, key=lambda one: one[1][0] in _PUT and not is_placed(one[1][1])):
        around = shown_scene(list(entries.values()), reader.up, 0.0)[0] if kind in _PUT else None
        around = around if around is not None and around.splats else None
        try:
            entries[number] = read_entry(reader, number, kind, table, around)
        except FormatError as error:
            problems.append(" ".join(str(error).split()))
            if len(listing.tables) == 1:
                raise
    if problems and not entries:
        raise SceneError("; ".join(problems))
    return [entries[number] for number in sorted(entries)], problems


def read_entry(
    reader: EntryReader, number: int, kind: EntryKind, table: Mapping[str, Any], around: Scene | None = None
) -> SceneEntry:
    """One entry; ``around`` as of `EntryReader.read`.

    Raises:
        FormatError: It is invalid, or a file cannot be read.
    """
    with parsing(reader.file, "a scene file"):
        return reader.read(number, kind, table, around)


def heading_of(file: Path) -> Literal["splats", "meshes"]:
    """Under which heading a file is listed, by its extension and its content. One that cannot be read says so later."""
    suffix = file.suffix.lower()
    is_mesh = suffix in _MESHES or (suffix == ".ply" and holds_mesh(file))
    if suffix in (".glb", ".gltf"):
        is_mesh = not shows_one_capture(file)
    if suffix in USD:
        from lumisplat.io.usd.scene import shows_one_capture as shows_one_field

        with suppress(FormatError, MissingExtraError):
            is_mesh = not shows_one_field(file)
    return "meshes" if is_mesh else "splats"


def turned_with_up(reader: EntryReader, entry: SceneEntry, before: Vector, *, is_among_captures: bool) -> SceneEntry:
    """Returns an entry as it stands in a scene with another up.

    A mesh or an actor among captures whose y axis was up is turned about its foot, by the smallest rotation between
    both ups: it stays on its ground, and its front stays in front. Captures stay, as up is measured by their ground,
    and so do meshes without captures. Tables then say places in numbers, as ``upright`` and its like would mean others.

    Args:
        reader: Has the new up.
        entry: The entry.
        before: The old up, a unit vector.
        is_among_captures: Whether the scene has a capture.
    """
    turn = rotation_between(np.array(before), np.array(reader.up))
    if entry.kind == "environment" and "path" in entry.table:
        light: Any = entry.lights[0]
        return _turned_image(reader, entry, rotation_matrix(light.rotation_wxyz), turn, before)
    matrix = entry.world_from_file
    if matrix is None or (entry.actor is not None and "path" not in entry.table):
        return entry
    start = np.eye(4) if entry.actor is None or entry.actor.motion is None else entry.actor.motion.at(0.0)
    stands = is_among_captures and entry.kind != "splats" and _is_upright((start @ matrix)[:3, :3], before)
    if stands:
        about_foot, foot = np.eye(4), _foot(entry, before)
        about_foot[:3, :3], about_foot[:3, 3] = turn, foot - turn @ foot
        matrix = np.linalg.inv(start) @ about_foot @ start @ matrix
    elif not any(key in entry.table for key in _OF_UP):
        return entry
    rest = {key: value for key, value in entry.table.items() if key not in PLACED_IN_WORDS}
    return read_entry(reader, entry.id, entry.kind, rest | placement_table(matrix))


def _turned_image(
    reader: EntryReader, entry: SceneEntry, rotation: Doubles, turn: Doubles, before: Vector
) -> SceneEntry:
    """Returns an environment turned with up, if the upper edge of its image was up."""
    if not _is_upright(rotation, before):
        return entry
    wxyz = quaternions_from_matrices((turn @ rotation)[None])[0]
    turned = {"rotation_wxyz": [float(f"{x:.12g}") for x in wxyz]}
    return read_entry(reader, entry.id, entry.kind, dict(entry.table) | turned)


def _is_upright(linear: Doubles, up: Vector) -> bool:
    """Returns whether a rotation with a scale turns y to up."""
    y = linear[:, 1] / np.linalg.norm(linear[:, 1])
    return bool(np.linalg.norm(y - np.array(up)) < _UPRIGHT)


def _foot(entry: SceneEntry, up: Vector) -> Doubles:
    """Returns the point of the ground below the middle of what an entry shows, world space, shape (3,)."""
    instances = entry.at(0.0)
    splats = [instance for instance in instances if isinstance(instance, SplatInstance)]
    meshes = [instance for instance in instances if isinstance(instance, MeshInstance)]
    low, high = Scene(splats, meshes).bulk_bounds()
    middle, upward = 0.5 * (low + high), np.array(up)
    return middle + (min(lowest(instance, up) for instance in instances) - middle @ upward) * upward
