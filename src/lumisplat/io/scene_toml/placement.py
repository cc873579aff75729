"""Places the entries of a scene file (scale, then rotation, then translation), and finds the scene's up direction.

The up direction is the ``up`` at the top of the scene file, else the one that a capture states, else a guess. Where the
format allows it, a capture's up direction is read without its Gaussians.
"""

from __future__ import annotations

import json
import logging
import threading
import zipfile
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, LumisplatError, SceneError
from lumisplat.io.files.source import BLOCKS, STREAMED_SOG, format_of, parsing, read_bytes
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.gltf.nodes import lumisplat_extras
from lumisplat.io.gltf.scene import read_gltf
from lumisplat.io.ply import read_ply_header
from lumisplat.io.scene_toml.toml_table import FLAG, NUMBER, QUATERNION, TEXT, VECTOR, Kind, TomlTable, is_list
from lumisplat.io.splats.orientation import orientation_of, orientation_of_comments
from lumisplat.io.splats.sog import LUMISPLAT_KEY, read_meta
from lumisplat.io.splats.spz import read_spz_orientation
from lumisplat.math.transforms import rotation_matrix
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.insertion import ground_below, insertion
from lumisplat.scene.placing import Placement, Vector, placed, up_vector
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

_log = logging.getLogger("lumisplat")

PLACEMENT = {
    "position": VECTOR.about("Translation, scene units; a point is scaled, then rotated, then translated. Default: 0."),
    "rotation_wxyz": QUATERNION.about("Rotation as a quaternion, scalar first. Default: none."),
    "scale": NUMBER.about("Uniform scale, above 0. Default: 1."),
}
"""Keys that place an entry in the world: ``position``, ``rotation_wxyz`` and ``scale``."""
STANDING = {
    "rotation_degrees": VECTOR.about("Rotation about x, then y, then z, degrees, instead of `rotation_wxyz`."),
    "look_at": VECTOR.about("Point to which the front is turned, with the object upright."),
    "front": TEXT.about('Axis of the object that is its front: `"+z"` (default), `"-z"`, `"+x"` or `"-x"`.'),
    "upright": FLAG.about("Rotates an object with y up so that it stands upright in the scene; false leaves it."),
}
"""Keys of captures, meshes and actors that rotate them without a quaternion, such as ``upright``."""


_ROUNDING = 1e-15
"""The ``up`` of a scene file counts as normalised by a program if its length differs from 1 by at most this."""
_ROTATION_KEYS = ("rotation_wxyz", "rotation_degrees", "look_at", "upright")


_UPRIGHT_MIN = 0.7
"""Smallest y of the scene's up direction at which a y-up object needs no rotation to look upright."""

_USD = (".usd", ".usda", ".usdc", ".usdz")


def _is_saved(document: TomlTable) -> bool:
    """Returns whether a program wrote the scene file: ``up`` is then three floats of length 1 to the last digit."""
    up: Any = document.values.get("up")
    is_written = VECTOR.accepts(up) and all(isinstance(value, float) for value in up)
    return is_written and abs(float(np.linalg.norm(up)) - 1.0) <= _ROUNDING


def is_placed(values: Mapping[str, Any]) -> bool:
    """Returns whether an entry states a position, rotation or ground height, and so is not inserted automatically."""
    return any(key in values for key in ("position", *_ROTATION_KEYS)) or not isinstance(
        values.get("ground", False), bool
    )


def keep_saved_positions(document: TomlTable) -> None:
    """Keeps meshes and actors without a placement where their files have them, if a program saved the scene file.

    Earlier versions wrote no position for objects at the origin. Saved files are recognised by their unit ``up``;
    current versions write every position.
    """
    if not _is_saved(document):
        return
    for heading in ("meshes", "actors"):
        for table in document.tables(heading):
            if "path" in table.values and not is_placed(table.values):
                table.values["upright"] = False
                _warn(
                    table,
                    "has no position in a saved scene file, so it is placed as in its file; "
                    "upright = true rotates it upright",
                )


def stand_placed_upright(document: TomlTable, up: Vector) -> None:
    """Rotates meshes and actors upright that have a position but no rotation, if the scene is not y up; logs each.

    In saved files and entries with ``upright = false`` the orientation is intended; captures have their own axes.
    """
    if not document.tables("splats") or up[1] > _UPRIGHT_MIN or _is_saved(document):
        return
    for heading in ("meshes", "actors"):
        for table in document.tables(heading):
            keys = table.values.keys()
            if (
                "path" in keys
                and is_placed(table.values)
                and keys.isdisjoint((*_ROTATION_KEYS, "front"))
                and not any("rotation_wxyz" in frame.values for frame in _keyframes(table))
                and not _holds_capture(table)
            ):
                table.values["upright"] = True
                if "hidden" not in keys:
                    _warn(table, "has no rotation, and is rotated upright (upright = false: as in its file)")


def _keyframes(table: TomlTable) -> list[TomlTable]:
    """Returns the keyframes of an entry; none if they are no tables, which is reported when they are read."""
    try:
        return table.tables("keyframes")
    except FormatError:
        return []


def _holds_capture(table: TomlTable) -> bool:
    """Returns whether the file of an entry is a capture, by its name or, for PLY, by its lack of faces."""
    path = table.path.parent / str(table.values["path"])
    if path.suffix.lower() == ".ply":
        try:
            return not any(element.name == "face" for element in read_ply_header(path).elements)
        except (LumisplatError, OSError):  # reported when the file is read
            return True
    return path.suffix.lower() in _CAPTURES


def insert_entry(
    table: TomlTable, scene: Scene, instances: Sequence[MeshInstance | SplatInstance], instances_up: Vector | None
) -> npt.NDArray[np.float64]:
    """Inserts an entry without a placement into the captures of a scene, and logs the position.

    Args:
        table: The entry; ``scale``, ``front`` and ``ground = false`` are respected, and ``ground = true`` is removed.
        scene: Scene with at least one capture.
        instances: Captures and meshes of the entry, in the coordinates of its file.
        instances_up: Up direction of the file; None for y up.

    Returns:
        The entry's ``world_from_file``, shape (4, 4).

    Raises:
        FormatError: The scale is not positive.
    """
    try:
        found = insertion(scene, instances, instances_up, *(table.values.get(key) for key in ("scale", "front")))
    except SceneError as error:
        raise table.failed(error) from None
    matrix = found.world_from_asset
    if table.values.get("ground", True) is False:
        matrix[:3, 3] = 0.0
        _warn(
            table, "has no position: it stands upright at the coordinates of its file (upright = false: as in its file)"
        )
    else:
        table.values.pop("ground", None)
        _warn(
            table,
            f"has no position: it stands upright {found.where}{found.scaling}: {found} "
            "(upright = false: as in its file)",
        )
    return matrix


def stand_upright(table: TomlTable, up: Vector) -> npt.NDArray[np.float64]:
    """Rotates an actor upright and logs it, for actors with no rotation in their placement or their keyframes.

    Returns:
        The actor's ``world_from_file``, shape (4, 4).

    Raises:
        FormatError: The scale is not positive.
    """
    matrix = placement(TomlTable.of(table.path, {**table.values, "upright": True}), up)
    _warn(table, "has no rotation, and is rotated upright (upright = false: as in its file)")
    return matrix


def scene_around(values: Mapping[str, Any], scene: Scene) -> Scene | None:
    """Returns the scene into which an entry of a scene file is inserted, or on whose ground it stands; None: neither.

    Entries are inserted beside captures alone; with ``ground = true`` they stand on meshes, too.
    """
    return scene if scene.splats or (scene.meshes and values.get("ground") is True) else None


def found_ground(
    table: TomlTable, scene: Scene | None, placements: Sequence[Sequence[MeshInstance | SplatInstance]]
) -> list[float]:
    """Returns the height along up of the ground below each of several placements of an entry with ``ground = true``.

    Raises:
        FormatError: The scene is empty or None, or has no ground below a placement.
    """
    if scene is None or not (scene.splats or scene.meshes):
        heights = [None]
    else:
        heights = ground_below(scene, placements)
    if None in heights:
        x, y, z = placements[heights.index(None)][0].transform[:3, 3]
        where = f"[{x:.4g}, {y:.4g}, {z:.4g}]"
        raise table.error(
            f"ground is true, but there is no ground below {where}: give its height along up, a number", "ground"
        )
    return [height for height in heights if height is not None]


def _warn(table: TomlTable, line: str) -> None:
    asset = table.values.get("path")
    named = table.is_of_file or asset is None
    _log.warning("%s", table.error(line) if named else f"{Path(str(asset)).name}: {line}")


def placement(table: TomlTable, up: Vector = (0.0, 1.0, 0.0)) -> npt.NDArray[np.float64]:
    """Returns ``world_from_file`` of an entry, shape (4, 4).

    Args:
        table: Entry whose values have the right types.
        up: Unit vector that points up in the scene, for ``upright`` and ``look_at``.

    Raises:
        FormatError: A value is not finite, the scale is not positive, the rotation has zero length, or the entry has
            two keys that rotate it.
    """
    rotation_keys = [key for key in STANDING if key in table.values]
    if rotation_keys:
        if "rotation_wxyz" in table.values:
            raise table.error(
                f"rotation_wxyz and {rotation_keys[0]} are both given: choose one of them", rotation_keys[0]
            )
        given = {key: table.values.get(key) for key in ("position", "rotation_degrees", "scale", "look_at", "front")}
        is_upright = table.values.get("upright", "front" in table.values) or "look_at" in table.values
        try:
            return placed(None, Placement(**given, up=up if is_upright else None))
        except SceneError as error:
            raise table.failed(error) from None
    scale = table.values.get("scale", 1.0)
    position = table.values.get("position", (0.0, 0.0, 0.0))
    if not 0.0 < scale < np.inf:
        raise table.wrong("scale", "one positive number")
    if not np.isfinite(position).all():
        raise table.wrong("position", "three finite numbers")
    matrix = np.eye(4)
    try:
        matrix[:3, :3] = scale * rotation_matrix(table.values.get("rotation_wxyz", (1.0, 0.0, 0.0, 0.0)))
    except SceneError as error:
        raise table.error(f"rotation_wxyz is {error}", "rotation_wxyz") from None
    matrix[:3, 3] = position
    return matrix


def stated_up(path: Path) -> Vector | None:
    """Returns the up direction that a capture file states, a unit vector in the coordinates of the capture.

    Args:
        path: File or folder of any format.

    Returns:
        None if the file states no up direction, is not a capture, or cannot be read; the loader reports the error
        later.
    """
    try:
        with parsing(path, "a capture"):
            kind = format_of(path)
            if kind in (".glb", ".gltf", *_USD):
                status = path.stat()
                return _up_by_format(path, kind, status.st_mtime_ns, status.st_size)
            return _up_by_values(path, kind)
    except (LumisplatError, OSError, zipfile.BadZipFile):
        return None


def _up_by_values(path: Path, kind: str) -> Vector | None:
    """Returns the up direction that a PLY, SPZ, SOG or block capture states, read without its Gaussians.

    Args:
        path: The file.
        kind: Its format, from `format_of`.

    Returns:
        None if the file states no up direction, or has another format.
    """
    if kind == ".ply":
        return orientation_of_comments(path, read_ply_header(path).comments).up
    if kind in (BLOCKS, STREAMED_SOG):
        stored = json.loads(read_bytes(path / kind if path.is_dir() else path))
        return orientation_of(path, stored if kind == BLOCKS else stored.get(LUMISPLAT_KEY)).up
    if kind == ".sog":
        return orientation_of(path, read_meta(path).get(LUMISPLAT_KEY)).up
    return read_spz_orientation(path).up if kind == ".spz" else None


@lru_cache(maxsize=64)
def _up_by_format(path: Path, kind: str, *_version: int) -> Vector | None:
    """Returns the up direction of a glTF or OpenUSD capture, which depends on the transform of its node.

    The whole file is read. Log lines are suppressed, because the loader logs them later.

    Args:
        path: The file.
        kind: Its format, from `format_of`.
        *_version: Size and time of the file, by which the result is cached.
    """
    with _silenced():
        if kind in _USD:
            from lumisplat.io.usd.scene import read_usd

            return _up_of(read_usd(path, drop_invalid=True))
        return _up_of(read_gltf(path, drop_invalid=True)) if _has_up(GltfFile(path)) else None


@contextmanager
def _silenced() -> Generator[None]:
    """Suppresses the log lines that this thread writes inside the block."""
    thread = threading.get_ident()

    def is_other_thread(record: logging.LogRecord) -> bool:
        return record.thread != thread

    _log.addFilter(is_other_thread)
    try:
        yield
    finally:
        _log.removeFilter(is_other_thread)


def _up_of(loaded: Gaussians | Scene) -> Vector | None:
    return loaded.up if isinstance(loaded, Gaussians) else None


def _has_up(file: GltfFile) -> bool:
    """Returns whether Lumisplat stored the up direction of a capture in the extras of a glTF file.

    Without it the up direction is unknown, although glTF files are y up.
    """
    primitives = (one for mesh in file.model.meshes or [] for one in mesh.primitives)
    return any("up" in (lumisplat_extras(one) or {}) for one in primitives)


def _may_be_direction(value: object) -> bool:
    return is_list(value) or isinstance(value, str)


DIRECTION = Kind("the name of an axis, such as y-down, or three numbers", _may_be_direction)
"""Expected value of a key that gives a direction: an axis name such as ``y-down``, or three numbers."""
UP = DIRECTION.about(
    'Up direction of the scene, such as `"y-down"` or `"z-up"`. Default: that of the first capture that states one, '
    "else y down with captures, y up without."
)
"""Expected value of the key ``up`` at the top of a scene file: an axis name or three numbers."""

_CAPTURES = (".ply", ".spz", ".splat", ".ksplat", ".sog", ".json", "")
"""File extensions that may be captures; ``.json`` is the meta.json of a SOG, and folders have no extension."""


def scene_up(document: TomlTable) -> Vector:
    """Returns the unit vector that points up in the scene.

    The up direction is the ``up`` of the file, or else that of the first capture that states one. If no capture states
    an up direction, it is y down for a scene with a capture, and y up for a scene with only meshes.

    Args:
        document: Top-level table of the scene file.

    Raises:
        FormatError: ``up`` is not a direction.
    """
    if "up" in document.values:
        return _direction(document, "up")
    for table in document.tables("splats"):
        if (up := _stated(table)) is not None:
            return up
    actors = (Path(str(table.values.get("path"))).suffix.lower() for table in document.tables("actors"))
    has_capture = bool(document.tables("splats")) or any(suffix in _CAPTURES for suffix in actors)
    return up_vector("y-down" if has_capture else "y-up")


def _stated(table: TomlTable) -> Vector | None:
    """Returns the up direction that an entry's capture states, rotated with the entry; None if none is stated.

    None is also returned for an entry with ``upright`` or ``look_at``, because its rotation depends on the scene's up.
    """
    is_upright = table.values.get("upright", False) or "look_at" in table.values
    path = table.values.get("path")
    if is_upright or not isinstance(path, str) or (up := stated_up(table.path.parent / path)) is None:
        return None
    keys = {key: kind for key, kind in (PLACEMENT | STANDING).items() if key.startswith("rotation")}
    rotation = {key: value for key, value in table.values.items() if key in keys and keys[key].accepts(value)}
    try:
        return up_vector(placement(TomlTable.of(table.path, rotation))[:3, :3] @ up)
    except FormatError:  # reported when the entry is read
        return None


def _direction(table: TomlTable, key: str) -> Vector:
    """Reads the value of a key as a unit vector."""
    try:
        return up_vector(table.values[key])
    except SceneError as error:
        raise table.error(str(error), key) from None
