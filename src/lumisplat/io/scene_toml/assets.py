"""Loads the captures and meshes of scene file entries, applies the changes of the entries, and places them.

[[meshes]]
path = "table.glb"
part = "leg"                        # only this mesh of a file with several, by its name or number
hidden = true                       # read and checked, but not rendered

[[splats]]
path = "garden.ply"
crop_low = [-2.0, -3.0, -2.0]       # box corners in file coordinates: Gaussians outside the box are removed
crop_high = [2.0, 0.5, 2.0]
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast
from weakref import WeakValueDictionary

import numpy as np

from lumisplat.config import NormalEstimate
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import STREAMED_SOG, format_of
from lumisplat.io.meshes.mesh_arrays import drop_textures_without_uvs
from lumisplat.io.scene_toml.actors import Load
from lumisplat.io.scene_toml.materials import MaterialTable, entry_material
from lumisplat.io.scene_toml.placement import (
    PLACEMENT,
    STANDING,
    found_ground,
    insert_entry,
    is_placed,
    placement,
)
from lumisplat.io.scene_toml.toml_table import (
    FLAG,
    NAME_OR_NUMBER,
    NUMBER,
    NUMBER_OR_FLAG,
    TEXT,
    TEXT_OR_TABLE,
    VECTOR,
    WHOLE,
    Kind,
    TomlTable,
    Values,
    is_list,
    suggestion,
)
from lumisplat.math.arrays import Doubles
from lumisplat.scene.checks import with_checked
from lumisplat.scene.editing.select import crop
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import Light, move_light
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.insertion import lowest
from lumisplat.scene.ops.normals import estimate_normals, smooth_normals
from lumisplat.scene.placing import Vector
from lumisplat.scene.primitives import box, plane, sphere
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

_SHAPES = ("box", "plane", "sphere")


def _is_size(value: object) -> bool:
    return not isinstance(value, bool | str | dict) and (not is_list(value) or len(value) in (2, 3))


_SIZE = Kind("a number, two (plane) or three (box)", _is_size)
"""Type of the key ``size``: edge lengths of a box (one or three) or a plane (one or two), or a sphere's diameter."""

_ENTRY = {
    **PLACEMENT,
    **STANDING,
    "ground": NUMBER_OR_FLAG.about(
        "Height along up of its lowest point; 2 % of the opacity of a capture may lie below. True: of meshes, that of "
        "the ground below it. False: an unplaced mesh stays at the height of its file."
    ),
    "name": TEXT.about("Name, instead of the one in the file."),
    "material": TEXT_OR_TABLE.about("Name of a `[materials.NAME]`, or a table with the keys of a material."),
    "hidden": FLAG.about("Reads and checks the entry without rendering it. Default: false."),
}
ENTRY_KEYS = {
    "splats": {
        "path": TEXT.about("File or folder of the capture, relative to the scene file. Required."),
        **_ENTRY,
        "kernel_degree": WHOLE.about(
            "Kernel that the capture was trained with, 0 to 5. Default: that of the file, else 2 (Gaussian)."
        ),
        "sh_degree": WHOLE.about("Highest SH degree of its colours, 0 to 3; lower ones remove captured highlights."),
        "depth_iso_transmittance": NUMBER.about(
            "Transmittance at its surface, which is lit, 0 to 1; lower it past floaters and fuzz. Default: that of the "
            "render settings, 0.7."
        ),
        "shadow_catcher": FLAG.about(
            "Keeps the capture as captured, but for the shadows of other objects. Default: false."
        ),
        "lod": WHOLE.about("Level of detail of a streamed SOG; 0 (default) is the finest."),
        "lod_budget": WHOLE.about("Loads the finest level of a streamed SOG with at most so many Gaussians."),
        "normals": TEXT.about(
            'Estimates normals for its material: `"smallest-axis"`, `"pca"`, or `"smooth"`, for highlights. Default: '
            "those of the file, else of each Gaussian's shape."
        ),
        "crop_low": VECTOR.about("Lower corner of a box, file coordinates: Gaussians outside of it are removed."),
        "crop_high": VECTOR.about("Upper corner of that box."),
    },
    "meshes": {
        "path": TEXT.about("File of the mesh or glTF scene, relative to the scene file. Required without `shape`."),
        "shape": TEXT.about('Primitive instead of a file: `"box"`, `"plane"` or `"sphere"`.'),
        "size": _SIZE.about("Edges of the box (one or three) or plane (one or two), or diameter. Default: 1."),
        **_ENTRY,
        "lights": FLAG.about("Loads the lights of a glTF file, too. Default: true."),
        "crease_angle_degrees": NUMBER.about(
            "Computes normals that are smooth where faces meet at less than this, 0 to 180 degrees. Default: the "
            "normals of the file, or 51.6 for an OBJ without."
        ),
        "part": NAME_OR_NUMBER.about("Loads one mesh of the file, by its name or its number from 0, without lights."),
        "shadow_catcher": FLAG.about(
            "Shows the mesh only where it is shadowed, or mirrors other objects. Default: false."
        ),
    },
}
"""Allowed keys of ``[[splats]]`` and ``[[meshes]]`` entries, by heading."""

INSTANCE_KEYS = ("sh_degree", "depth_iso_transmittance", "shadow_catcher")
"""Keys of a ``[[splats]]`` entry that are fields of `SplatInstance`."""

_CHANGES = ("kernel_degree", "crease_angle_degrees", "crop_low", "crop_high", "normals")
"""Keys of an entry that change the loaded capture or mesh itself, unlike its placement and material."""

_Key = tuple[str, ...]


def _shape_mesh(table: TomlTable, given: Values) -> Mesh:
    """Creates the box, plane or sphere of an entry with a ``shape``; ``size`` is 1 by default."""
    shape, size = given["shape"], given.get("size", 1.0)
    if shape not in _SHAPES:
        raise table.error(f"shape is {shape!r}, {suggestion(shape, _SHAPES)}", "shape")
    try:
        if shape == "box":
            return box(size)
        if shape == "sphere" and not is_list(size):
            return sphere(0.5 * size)
        if shape == "plane" and not (is_list(size) and len(size) != 2):
            edges = cast(list[Any], size if isinstance(size, list) else [size, size])
            return plane(*edges)
    except (SceneError, TypeError):
        pass
    expected = {"box": "one positive number or three", "plane": "one positive number or two", "sphere": "its diameter"}
    raise table.wrong("size", expected[shape])


@dataclass(frozen=True, slots=True)
class PlacedEntry:
    """Captures, meshes and lights that one entry of a scene file adds to the scene, in world space."""

    splats: tuple[SplatInstance, ...] = ()
    meshes: tuple[MeshInstance, ...] = ()
    lights: tuple[Light, ...] = ()
    world_from_file: Doubles = field(default_factory=lambda: np.eye(4))
    """Transform from the coordinates of the entry's file to the world, a similarity, shape (4, 4)."""
    assets: tuple[Scene, ...] = ()
    """The asset of the entry as loaded from its file, then with crop box and other changes, then with its material.

    These references keep the asset in the cache of `Assets`, which holds weak references only."""


@dataclass(slots=True)
class Assets:
    """Loads and caches the assets of entries. A file is loaded once, and entries with equal changes share one asset.

    The material is applied last, so that an edit of the material leaves the Gaussians of a capture unchanged.
    """

    load: Load
    materials: dict[str, MaterialTable]
    up: Vector
    """Unit vector that points up in the scene."""
    memory: Mapping[str, Scene] = field(default_factory=dict[str, Scene])
    """Captures and meshes without a file. The keys are placeholders that entries give as their ``path``."""
    _cache: WeakValueDictionary[_Key, Scene] = field(default_factory=WeakValueDictionary[_Key, Scene])
    """Loaded and changed assets, weakly referenced; a key has the file, the entry's changes and its material."""

    def splats(self, table: TomlTable) -> PlacedEntry:
        """Reads an entry of ``[[splats]]`` and places its captures in the world."""
        given, world_from_file = _read_entry(table, "splats", self.up)
        assets = self._assets(table, "splats", given)
        settings = {key: given[key] for key in INSTANCE_KEYS if key in given}
        try:
            splats = [
                replace(
                    i, world_from_object=world_from_file @ i.transform, name=given.get("name") or i.name, **settings
                )
                for i in assets[-1].splats
            ]
            lift = self._lift(given, splats)
            placed = (replace(splat, world_from_object=lift @ splat.transform) for splat in splats)
            return PlacedEntry(splats=tuple(placed), world_from_file=lift @ world_from_file, assets=assets)
        except SceneError as error:
            raise table.failed(error) from None

    def meshes(self, table: TomlTable, existing: Scene | None = None) -> PlacedEntry:
        """Reads an entry of ``[[meshes]]``, and places the meshes, lights and captures of its file in the world.

        Args:
            table: The entry.
            existing: Non-empty scene into which an entry without a placement is inserted, and on whose ground one with
                ``ground = true`` stands. None leaves the entry where its file has it.
        """
        given, world_from_file = _read_entry(table, "meshes", self.up)
        assets = self._assets(table, "meshes", given)
        scene = self._part(table, given, assets[-1])
        if existing is not None and (scene.meshes or scene.splats) and not is_placed(given):
            world_from_file = insert_entry(table, existing, (*scene.meshes, *scene.splats), scene.up)
        lights = scene.lights if given.get("lights", True) else ()
        try:
            meshes = [
                MeshInstance(
                    i.mesh,
                    world_from_file @ i.transform,
                    name=given.get("name") or i.name,
                    shadow_catcher=given.get("shadow_catcher", i.shadow_catcher),
                )
                for i in scene.meshes
            ]
            splats = [
                replace(i, world_from_object=world_from_file @ i.transform, name=given.get("name") or i.name)
                for i in scene.splats
            ]
            placed = [*meshes, *splats]
            if table.values.get("ground") is True and placed:
                # Written to the table, so that later readings need no scene.
                (given["ground"],) = (table.values["ground"],) = found_ground(table, existing, [placed])
            lift = self._lift(given, placed)
            return PlacedEntry(
                splats=tuple(replace(splat, world_from_object=lift @ splat.transform) for splat in splats),
                meshes=tuple(replace(mesh, world_from_object=lift @ mesh.transform) for mesh in meshes),
                lights=tuple(move_light(light, lift @ world_from_file) for light in lights),
                world_from_file=lift @ world_from_file,
                assets=assets,
            )
        except SceneError as error:
            raise table.failed(error) from None

    def part_names(self, table: TomlTable) -> list[str]:
        """Returns the names of all meshes in an entry's file, even if the entry selects one of them by ``part``."""
        return _mesh_names(self._assets(table, "meshes", table.values)[-1])

    def _part(self, table: TomlTable, given: Values, scene: Scene) -> Scene:
        """Returns only the mesh that the key ``part`` names, without lights; without the key, the whole file."""
        part = given.get("part")
        if part is None:
            return scene
        names = _mesh_names(scene)
        if isinstance(part, int) and not 0 <= part < len(names):
            raise table.error(
                f"part is {part}, expected 0 to {len(names) - 1}: the file has {len(names)} meshes", "part"
            )
        if isinstance(part, str) and part not in names:
            raise table.error(f"part is {part!r}, {suggestion(part, names)}", "part")
        if isinstance(part, str) and names.count(part) > 1:
            numbers = ", ".join(str(number) for number, name in enumerate(names) if name == part)
            raise table.error(f"part is {part!r}, the name of several meshes: give a number instead, {numbers}", "part")
        return Scene(meshes=(scene.meshes[names.index(part) if isinstance(part, str) else part],))

    def _lift(self, given: Values, placed: Sequence[SplatInstance | MeshInstance]) -> Doubles:
        """Returns a translation, shape (4, 4), along up that moves an entry's lowest point to the height ``ground``.

        It is the identity if the entry states no height.
        """
        move = np.eye(4)
        if not isinstance(given.get("ground", False), bool) and placed:
            height = min(lowest(instance, self.up) for instance in placed)
            move[:3, 3] = (given["ground"] - height) * np.array(self.up)
        return move

    def _assets(self, table: TomlTable, heading: str, given: Values) -> tuple[Scene, ...]:
        """Returns the asset of an entry in stages: loaded, then with the entry's changes, then with any material."""
        if "path" in given:
            key, loaded = self._loaded(table, heading, given)
        else:
            if "part" in given:
                raise table.error("part selects a mesh of a file, but there is no path", "part")
            key = ("shape", repr((given["shape"], given.get("size"))))
            loaded = self._cached(key, lambda: _as_scene(_shape_mesh(table, given)))
        changes = {name: given[name] for name in _CHANGES if name in given}
        if changes:
            key = (*key, repr(changes))
        changed = self._cached(key, lambda: _with_changes(loaded, table, changes)) if changes else loaded
        if "material" not in given:
            return loaded, changed
        key = (*key, "material", repr(given["material"]))
        return loaded, changed, self._cached(key, lambda: self._with_material(changed, table))

    def _loaded(self, table: TomlTable, heading: str, given: Values) -> tuple[_Key, Scene]:
        """Loads the file of an entry. Returns its cache key and contents.

        Raises:
            FormatError: The file does not fit ``heading``: ``splats`` takes captures, ``meshes`` all others.
        """
        if "size" in given or "shape" in given:
            key = "shape" if "shape" in given else "size"
            raise table.error(f"path and {key} are both given: an entry is a file or a shape", key)
        scene = self.memory.get(given["path"])
        key = ("memory", given["path"])
        if scene is None:
            file = table.file("path")
            if file.suffix.lower() == ".toml":
                raise table.error(
                    f"path is {given['path']!r}, a scene file itself: list its entries here instead", "path"
                )
            level_arguments = _level_arguments(table, file, given)
            key = ("file", str(file), repr(level_arguments))
            scene = self._cached(key, lambda: _as_scene(self.load(file, **level_arguments)))
        if _is_capture(scene) is not (heading == "splats"):
            whole = "a scene" if scene.splats else "a mesh"
            found, other = ("a capture", "splats") if _is_capture(scene) else (whole, "meshes")
            raise table.error(f"path is {given['path']!r}, which is {found}: list it under [[{other}]]", "path")
        return key, scene

    def _cached(self, key: _Key, make: Callable[[], Scene]) -> Scene:
        """Returns the cached asset of a key, or creates and caches it."""
        scene = self._cache.get(key)
        if scene is None:
            scene = self._cache[key] = make()
        return scene

    def _with_material(self, scene: Scene, table: TomlTable) -> Scene:
        """Returns the scene with the entry's material in place of the materials of all meshes and captures."""
        material = entry_material(table, self.materials)
        assert material is not None
        try:
            meshes = {id(i.mesh): i.mesh for i in scene.meshes}
            for key, mesh in meshes.items():
                changed = with_checked(mesh, material=material.apply_to(mesh.material))
                meshes[key] = drop_textures_without_uvs(table.path, changed)
            capture_material = material.apply_to(None) if _is_capture(scene) else None
        except SceneError as error:
            raise table.failed(error) from None
        return replace(
            scene,
            splats=tuple(replace(i, material=capture_material or i.material) for i in scene.splats),
            meshes=tuple(replace(i, mesh=meshes[id(i.mesh)]) for i in scene.meshes),
        )


def _level_arguments(table: TomlTable, file: Path, given: Values) -> dict[str, int | None]:
    """Returns the entry's ``lod`` and ``lod_budget`` as arguments of `lumisplat.load`; empty if it has neither."""
    stated = [(key, least) for key, least in (("lod", 0), ("lod_budget", 1)) if key in given]
    if len(stated) == 2:
        raise table.error("lod and lod_budget are both given: choose one of them", "lod_budget")
    for key, least in stated:
        if given[key] < least:
            raise table.wrong(key, f"{least} or more")
        if format_of(file) != STREAMED_SOG:
            raise table.error(f"{key} applies to a streamed SOG, but path is {given['path']!r}", key)
    return {"lod": given.get("lod"), "budget": given.get("lod_budget")} if stated else {}


def _with_changes(scene: Scene, table: TomlTable, changes: Values) -> Scene:
    """Applies the kernel degree, crop box, normals and crease angle of an entry to the assets of its file."""
    try:
        if "kernel_degree" in changes:
            degree = changes["kernel_degree"]
            splats = (replace(i, gaussians=replace(i.gaussians, kernel_degree=degree)) for i in scene.splats)
            scene = replace(scene, splats=tuple(splats))
        if "crop_low" in changes or "crop_high" in changes:
            box = _box(table, changes)
            splats = (replace(i, gaussians=crop(i.gaussians, box)) for i in scene.splats)
            scene = replace(scene, splats=tuple(splats))
        if "normals" in changes:
            if changes["normals"] not in (methods := [one.value for one in NormalEstimate]):
                raise table.wrong("normals", " or ".join(map(repr, methods)))
            found = [estimate_normals(i.gaussians, changes["normals"]) for i in scene.splats]
            splats = (
                replace(i, gaussians=replace(i.gaussians, normals=normals))
                for i, normals in zip(scene.splats, found, strict=True)
            )
            scene = replace(scene, splats=tuple(splats))
        if "crease_angle_degrees" in changes:
            angle = np.radians(changes["crease_angle_degrees"])
            meshes = (replace(i, mesh=smooth_normals(i.mesh, angle)) for i in scene.meshes)
            scene = replace(scene, meshes=tuple(meshes))
    except FormatError:
        raise
    except SceneError as error:
        raise table.failed(error) from None
    return scene


def _is_capture(scene: Scene) -> bool:
    """Returns whether a loaded file is a capture, not a mesh or a scene.

    A glTF scene with captures also contains Gaussians, but unlike a capture it states its up direction.
    """
    return bool(scene.splats) and scene.up is None


def _mesh_names(scene: Scene) -> list[str]:
    """Returns the names of all meshes in a scene."""
    return [instance.name or instance.mesh.name for instance in scene.meshes]


def _box(table: TomlTable, given: Values) -> tuple[list[float], list[float]]:
    """Reads the lower and the upper corner of the crop box; it is an error if only one of them is given."""
    for key in ("crop_low", "crop_high"):
        if key not in given:
            raise table.error(f"lacks {key}, three numbers: a box has two corners")
    low, high = given["crop_low"], given["crop_high"]
    if not (np.isfinite([low, high]).all() and (np.array(low) < np.array(high)).all()):
        raise table.wrong("crop_low", "three finite numbers, each below that of crop_high")
    return low, high


def _read_entry(table: TomlTable, heading: str, up: Vector) -> tuple[Values, Doubles]:
    """Checks the keys and values of an entry. Returns the values, and the ``world_from_file`` that they state."""
    given = table.take(ENTRY_KEYS[heading], required=() if "shape" in table.values else ("path",))
    if not np.isfinite(given.get("ground", 0.0)) or (heading == "splats" and given.get("ground") is True):
        raise table.wrong("ground", "a height, a finite number")
    if not 0.0 <= given.get("crease_angle_degrees", 0.0) <= 180.0:
        raise table.wrong("crease_angle_degrees", "0 to 180 degrees")
    return given, placement(table, up)


def _as_scene(asset: Gaussians | Mesh | Scene) -> Scene:
    """Wraps a single capture or mesh in a scene, at the origin; returns scenes unchanged."""
    if isinstance(asset, Scene):
        return asset
    if isinstance(asset, Mesh):
        return Scene(meshes=(MeshInstance(asset),))
    return Scene(splats=(SplatInstance(asset),))
