"""Reads the actors of a scene file: animated objects that move by a clip, by a frame sequence, or by keyframes.

[[actors]]
path = "walker.glb"                     # a rig, a folder of frames, a capture or a mesh
position = [0.0, 0.0, 2.0]              # the placement is applied first ...
speed = 1.2
name = "walker"

[[actors.keyframes]]                    # ... then the keyframes
time = 0.0
position = [-1.0, 0.0, 0.0]

[[actors.keyframes]]
time = 2.0
position = [1.0, 0.0, 0.0]
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.gltf.animation import is_rigged
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.rigs.bound_gaussians import read_triangles, read_weights
from lumisplat.io.rigs.loading import BODY_FILES, GLTF_FILES, load_rig
from lumisplat.io.scene_toml.placement import (
    PLACEMENT,
    STANDING,
    found_ground,
    insert_entry,
    is_placed,
    placement,
    scene_around,
    scene_up,
    stand_upright,
)
from lumisplat.io.scene_toml.toml_table import (
    FLAG,
    NUMBER,
    NUMBER_OR_FLAG,
    NUMBERS,
    TABLE,
    TABLES,
    TEXT,
    WHOLE,
    TomlTable,
    Values,
)
from lumisplat.io.splats.sequence import read_sequence
from lumisplat.math.arrays import Doubles
from lumisplat.scene.animation.actors import Actor, Instance, Subject
from lumisplat.scene.animation.keyframes import Keyframes
from lumisplat.scene.animation.rig import Rig
from lumisplat.scene.animation.rigged_gaussians import RiggedGaussians, bind_gaussians
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.insertion import lowest
from lumisplat.scene.ops.mesh_sampling import gaussians_from_instances
from lumisplat.scene.placing import Vector
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

ACTOR_KEYS = {
    "path": TEXT.about(
        "A `.glb`, `.gltf` or `.vrm` with a skin or animation, a `.npz` of SMPL, SMPL-H, SMPL-X or FLAME, a "
        "folder of frames, a capture or a mesh. Required."
    ),
    **PLACEMENT,
    **STANDING,
    "ground": NUMBER_OR_FLAG.about(
        "Height along up of its lowest point over its clip, at each keyframe; true: that of the ground below it."
    ),
    "name": TEXT.about("Name of its instances. Default: that of the file, or of its meshes."),
    "form": TEXT.about('Form of a rig or mesh: `"gaussians"` (default) or `"mesh"`.'),
    "count": WHOLE.about("Number of Gaussians of a rig or mesh. Default: neighbours are 1/300 of its size apart."),
    "vertex_colors": FLAG.about("Multiplies the colours of a rig by COLOR_0. Default: true."),
    "motion": TEXT.about(
        "Motion of a rig from another file: `.npz` of AMASS (body models), `.bvh`, `.glb`, `.gltf` or `.vrma`."
    ),
    "joints": TABLE.about(
        'Names in SMPL of joints of `motion` or the rig, by their own: `{ "Shin.L" = "left_knee" }`. A name that '
        "both have applies to `motion` alone if the rig has another such joint. Default: those that other programs use "
        "are known."
    ),
    "gaussians": TEXT.about(
        "A capture that is bound to the rig, in its rest pose: a trained avatar. Default: new Gaussians on its meshes."
    ),
    "pose": NUMBER.about("Time of `clip` whose pose the `gaussians` have, seconds. Default: the rest pose."),
    "weights": TEXT.about(
        "Skinning weights of `gaussians`, `.npy` or `.npz`, Gaussians x joints. Default: nearest triangles, or bones."
    ),
    "betas": NUMBERS.about("Shape of a body model. Default: that of `motion`, or the mean."),
    "fps": NUMBER.about("Frames a second of a folder of frames. Default: 25."),
    "clip": TEXT.about("Animation of a rig, by its name. Default: the first."),
    "loop": FLAG.about("Repeats the clip or frames; false holds the last pose or frame. Default: true."),
    "speed": NUMBER.about("Speed of the clip or frames relative to the animation. Default: 1."),
    "casts_shadow": FLAG.about("Casts shadows on captures. Default: true."),
    "relight": FLAG.about("Lights the actor by the light at its position; false keeps its own colours. Default: true."),
    "hidden": FLAG.about("Reads and checks the actor without rendering it. Default: false."),
    "keyframes": TABLES.about("Motion of the placed actor: the tables `[[actors.keyframes]]`."),
}
KEYFRAME_KEYS = {
    "time": NUMBER.about("Time in the animation, seconds; times increase. Required."),
    "position": PLACEMENT["position"].about("Translation at that time. Default: that of the keyframe before, or 0."),
    "rotation_wxyz": PLACEMENT["rotation_wxyz"].about(
        "Rotation at that time, a quaternion, scalar first. Default: that of the keyframe before, or none."
    ),
    "scale": PLACEMENT["scale"].about("Scale at that time. Default: that of the keyframe before, or 1."),
}
_POSES = 8
"""Number of poses of a clip or sequence of which the lowest stands on the ground."""
_FORMS = ("gaussians", "mesh")
_BOUND = ("gaussians", "weights", "pose")
"""Keys that bind a capture to a rig."""
_KEY_OWNERS = {
    "count": "a rig or a mesh as Gaussians",
    "form": "a rig or a mesh",
    "vertex_colors": "a glTF rig",
    "motion": "a rig",
    "joints": "a rig",
    "gaussians": "a rig",
    "weights": "a rig",
    "pose": "a rig",
    "betas": "a body model",
    "fps": "a folder of frames",
}
"""Keys of ``[[actors]]`` that apply to some kinds of files only, each with a phrase that names these kinds in
messages."""

Load = Callable[..., Gaussians | Mesh | Scene]
"""Loads a file by its path; ``lod`` and ``budget`` are passed too if the entry gives them."""


def read_actors(document: TomlTable, load: Load, scene: Scene) -> list[Actor]:
    """Reads the visible actors of a scene file, in order.

    A file that several actors use is loaded once for each form (Gaussians, mesh, rig or sequence).

    Args:
        document: Top-level table of the scene file.
        load: Reads one capture or mesh.
        scene: The static scene. An actor without a placement is inserted among the scene's captures, beside earlier
            actors.

    Raises:
        FormatError: A key is unknown, a value is invalid, or a file cannot be read.
    """
    subjects, up = Subjects(load), scene_up(document)
    actors: list[Actor] = []
    for table in document.tables("actors"):
        actor = read_actor(table, subjects, up, scene_around(table.values, scene))
        if not table.values.get("hidden", False):
            actors.append(actor)
            scene = with_instances(scene, actor.at(0.0))
    return actors


def with_instances(scene: Scene, instances: Sequence[SplatInstance | MeshInstance]) -> Scene:
    """Returns the scene with ``instances`` added to its captures and meshes."""
    splats = tuple(instance for instance in instances if isinstance(instance, SplatInstance))
    meshes = tuple(instance for instance in instances if isinstance(instance, MeshInstance))
    return replace(scene, splats=(*scene.splats, *splats), meshes=(*scene.meshes, *meshes))


def read_actor(table: TomlTable, subjects: Subjects, up: Vector, scene: Scene | None = None) -> Actor:
    """Reads one entry of ``[[actors]]``.

    Args:
        table: The entry.
        subjects: Cache that loads the files of actors.
        up: Unit vector that points up in the scene.
        scene: Non-empty scene into which an actor without a placement is inserted, and on whose ground one with
            ``ground = true`` stands. None leaves the actor where its file has it.

    Raises:
        FormatError: A key is unknown, a value is invalid, or a file cannot be read.
    """
    given = table.take(ACTOR_KEYS, required=("path",))
    world_from_file = placement(table, up)
    motion = _motion(table)
    subject = subjects.get(table, given)
    if scene is not None and not is_placed(given) and subjects.has_y_up(table, given):
        if motion is None:
            world_from_file = insert_entry(table, scene, Actor(subject).at(0.0), None)
        elif not any("rotation_wxyz" in frame.values for frame in table.tables("keyframes")):
            world_from_file = stand_upright(table, up)
    settings = {key: given[key] for key in ("name", "clip", "loop", "speed", "casts_shadow", "relight") if key in given}
    if not isinstance(subject, Mesh | Rig | Scene):  # their meshes have names
        settings.setdefault("name", table.file("path").stem)
    try:
        actor = Actor(subject, motion, world_from_file, **settings)
        return actor if table.values.get("ground", False) is False else _on_ground(table, actor, up, scene)
    except FormatError:
        raise
    except SceneError as error:
        raise table.failed(error) from None


def _on_ground(table: TomlTable, actor: Actor, up: Vector, scene: Scene | None) -> Actor:
    """Moves an actor along up so that its feet are on the ground, at each of its keyframes if it has some.

    The new positions replace ``ground`` in the table, so that later readings need no scene.

    Args:
        table: The entry, with the key ``ground``.
        actor: The actor as the entry places it.
        up: Unit vector that points up in the scene.
        scene: Scene that the actor joins.

    Raises:
        FormatError: ``ground`` is true and the scene has no ground below a keyframe, or it is not finite.
    """
    if not np.isfinite(table.values["ground"]):
        raise table.wrong("ground", "a height, a finite number")
    still, motion = replace(actor, motion=None), actor.motion
    poses = [still.at(share * still.own_duration) for share in np.linspace(0.0, 1.0, _POSES, endpoint=False)]
    moves = [np.eye(4)] if motion is None else [motion.at(time) for time in np.asarray(motion.times)]
    placed = [[[_moved(one, move) for one in pose] for pose in poses] for move in moves]
    feet = [min(lowest(one, up) for pose in at_key for one in pose) for at_key in placed]
    ground = table.values.pop("ground")
    heights = found_ground(table, scene, [at_key[0] for at_key in placed]) if ground is True else [ground] * len(feet)
    lifts = np.subtract(heights, feet)[:, None] * np.array(up)
    if motion is None:
        matrix = np.array(actor.world_from_object)
        matrix[:3, 3] += lifts[0]
        table.values["position"] = matrix[:3, 3].tolist()
        return replace(actor, world_from_object=matrix)
    positions = np.asarray(motion.positions) + lifts
    for frame, position in zip(table.tables("keyframes"), positions.tolist(), strict=True):
        frame.values["position"] = position
    return replace(actor, motion=replace(motion, positions=positions))


def _moved(instance: Instance, move: Doubles) -> Instance:
    return replace(instance, world_from_object=move @ instance.transform)


def _motion(table: TomlTable) -> Keyframes | None:
    """Reads the keyframes of an entry; None if it has none. A keyframe inherits missing keys from the previous one."""
    frames: list[Values] = []
    last: Values = {"position": [0.0, 0.0, 0.0], "rotation_wxyz": [1.0, 0.0, 0.0, 0.0], "scale": 1.0}
    for entry in table.tables("keyframes"):
        given = entry.take(KEYFRAME_KEYS, required=("time",))
        placement(entry)  # raises errors that name the line
        if not np.isfinite(given["time"]):
            raise entry.wrong("time", "a finite number of seconds")
        if frames and given["time"] <= frames[-1]["time"]:
            raise entry.error(f"time is {given['time']:g}, after {frames[-1]['time']:g}: times must increase", "time")
        last = last | given
        frames.append(last)
    if not frames:
        return None
    columns = {key: [frame[key] for frame in frames] for key in ("time", *PLACEMENT)}
    return Keyframes(columns["time"], columns["position"], columns["rotation_wxyz"], columns["scale"])


@dataclass(slots=True)
class Subjects:
    """Loads the files of actors as Gaussians, mesh, rig or sequence, and caches them by file and form."""

    load: Load
    _subjects: dict[tuple[object, ...], Subject] = field(default_factory=dict[tuple[object, ...], Subject])
    _captures: set[Path] = field(default_factory=set[Path])
    """Actor files that hold captures. These have the up direction of the capture; all other actor files are y up."""

    def has_y_up(self, table: TomlTable, given: Values) -> bool:
        """Returns whether the actor file of an entry is y up: False for captures and folders of captures, else True.

        ``given`` are the entry's checked values.
        """
        self.get(table, given)
        return table.file("path") not in self._captures

    def get(self, table: TomlTable, given: Values) -> Subject:
        """Loads the file that an entry of ``[[actors]]`` names, in the form that the entry asks for.

        A file is loaded once for each form. ``given`` are the entry's checked values.
        """
        file = table.file("path")
        if given.get("form", "gaussians") not in _FORMS:
            raise table.wrong("form", " or ".join(_FORMS))
        key = file, *(repr(given.get(name)) for name in _KEY_OWNERS), given.get("clip") if "pose" in given else None
        if key not in self._subjects:
            try:
                self._subjects[key] = self._make(table, file, given)
            except FormatError:
                raise
            except SceneError as error:
                raise table.failed(error) from None
        return self._subjects[key]

    def _rig(self, table: TomlTable, file: Path, given: Values, mesh_keys: set[str]) -> Subject:
        """Loads a rig as a rig, as new Gaussians on its meshes, or with a capture that is bound to it."""
        is_body, as_mesh = file.suffix.lower() in BODY_FILES, given.get("form") == "mesh"
        known = {*mesh_keys, "motion", "joints", *_BOUND, "betas" if is_body else "vertex_colors"}
        _refuse_foreign_keys(table, given, known, "a rig as a mesh" if as_mesh else "a rig")
        for key in _BOUND:
            if key in given and "gaussians" not in given:
                raise table.error(f"{key} is that of a capture, but there is no gaussians", key)
        if not all(isinstance(joint, str) for joint in given.get("joints", {}).values()):
            raise table.wrong("joints", 'names of SMPL, such as { "Shin.L" = "left_knee" }')
        motion = table.file("motion") if "motion" in given else None
        colors = given.get("vertex_colors", True)
        try:
            joints, betas = given.get("joints"), given.get("betas")
            rig = load_rig(file, motion=motion, betas=betas, vertex_colors=colors, joints=joints)
        except FormatError as error:
            if motion is None or error.path != str(motion):
                raise
            problem = re.sub(r'joints=\{("NAME"): ("\w+")\}', r"joints = { \1 = \2 }", error.problem)
            raise table.error(f"motion {given['motion']!r} {problem}", "motion") from None
        if "gaussians" in given:
            return self._bound(table, given, rig)
        return rig if as_mesh else bind_gaussians(rig, given.get("count"))

    def _bound(self, table: TomlTable, given: Values, rig: Rig) -> RiggedGaussians:
        """Binds the capture that an entry names to its rig."""
        for key in ("count", "form"):
            if key in given:
                raise table.error(f"{key} and gaussians are both given: choose one of them", key)
        capture = self.load(table.file("gaussians"))
        if not isinstance(capture, Gaussians):
            raise table.error(f"gaussians is {given['gaussians']!r}, which is no capture", "gaussians")
        weights = read_weights(table.file("weights")) if "weights" in given else None
        triangles = None if "weights" in given else read_triangles(table.file("gaussians"))
        if not np.isfinite(given.get("pose", 0.0)):
            raise table.wrong("pose", "a time of the clip, a finite number of seconds")
        pose = rig.pose_at(given["pose"], given.get("clip")) if "pose" in given else None
        return bind_gaussians(rig, gaussians=capture, weights=weights, triangles=triangles, pose=pose)

    def _make(self, table: TomlTable, file: Path, given: Values) -> Subject:
        if file.suffix.lower() == ".toml":
            raise table.error(f"path is {given['path']!r}, a scene file itself: list its entries here instead", "path")
        as_mesh = given.get("form") == "mesh"
        mesh_keys = {"form"} if as_mesh else {"form", "count"}
        if file.is_dir() and not (file / "meta.json").is_file():
            _refuse_foreign_keys(table, given, {"fps"}, "a folder of frames")
            self._captures.add(file)
            return read_sequence(file, given.get("fps", 25.0), self.load)
        suffix = file.suffix.lower()
        if suffix in BODY_FILES or (suffix in GLTF_FILES and is_rigged(GltfFile(file))):
            return self._rig(table, file, given, mesh_keys)
        if suffix == ".bvh":
            if "gaussians" in given:
                _refuse_foreign_keys(table, given, {*_BOUND}, "a skeleton")
                return self._bound(table, given, load_rig(file))
            raise table.error(
                f'path is {given["path"]!r}, a motion without a body: write path = "walker.glb" and motion = '
                f'"{given["path"]}", or gaussians = "capture.ply" in the pose of its skeleton',
                "path",
            )
        loaded = self.load(file)
        if isinstance(loaded, Gaussians):
            _refuse_foreign_keys(table, given, set(), "a capture")
            self._captures.add(file)
            return loaded
        if isinstance(loaded, Scene) and not loaded.meshes:
            raise table.error(f"path is {given['path']!r}, which contains no mesh", "path")
        _refuse_foreign_keys(table, given, mesh_keys, "a mesh")
        if as_mesh:
            return loaded
        placed = loaded.meshes if isinstance(loaded, Scene) else (MeshInstance(loaded),)
        return gaussians_from_instances(placed, given.get("count"))


def _refuse_foreign_keys(table: TomlTable, given: Values, known: set[str], kind: str) -> None:
    """Raises `FormatError` if an entry has a key that its kind of file does not accept.

    Args:
        table: The entry.
        given: Checked values of the entry.
        known: Keys that this kind of file accepts.
        kind: Name of the kind of file, for the message.
    """
    for key, owner in _KEY_OWNERS.items():
        if key in given and key not in known:
            raise table.error(f"{key} applies to {owner}, but path is {given['path']!r}, {kind}", key)
