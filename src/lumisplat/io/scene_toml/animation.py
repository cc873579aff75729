"""The animation of a scene file: scene, actors, number of frames, and how actors are lit.

[animation]
fps = 25.0
duration = 4.0                          # or frames = 100

[animation.lighting]
direct = 0.7
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lumisplat.constants import ANIMATION_FRAMES_MAX
from lumisplat.io.files.source import PathLike, parsing
from lumisplat.io.scene_toml.actors import Load, read_actors
from lumisplat.io.scene_toml.cameras import LoadCameras, read_camera_path, read_scene_cameras
from lumisplat.io.scene_toml.scene_file import read_document, static_scene
from lumisplat.io.scene_toml.timing import read_timing
from lumisplat.io.scene_toml.toml_table import TomlTable
from lumisplat.scene.animation.actors import Actor, Animation
from lumisplat.scene.animation.camera_path import CameraPath
from lumisplat.scene.scene import Scene


def read_animation(path: PathLike, load: Load, load_cameras: LoadCameras) -> Animation:
    """As `lumisplat.io.load_animation`.

    Args:
        path: The scene file.
        load: Reads one capture or mesh.
        load_cameras: Reads a camera file.
    """
    with parsing(path, "a scene file"):
        document = read_document(path)
        if not document.tables("actors") and read_camera_path(document) is None:
            raise document.error("lists no [[actors]]: there is nothing to animate, nor a camera with keyframes")
        scene = static_scene(document, load)
        animation = animation_of(document, scene, read_actors(document, load, scene))
        return replace(animation, cameras=tuple(read_scene_cameras(document, load_cameras)))


def animation_of(document: TomlTable, scene: Scene, actors: Sequence[Actor]) -> Animation:
    """How a scene moves, without the cameras that stand still.

    Args:
        document: Top table of the scene file.
        scene: What stands still.
        actors: What moves.

    Raises:
        FormatError: ``[animation]`` or a camera is wrong.
    """
    moving = read_camera_path(document)
    fps, lighting = read_timing(document)
    count = _frame_count(document.table("animation"), fps, actors, moving)
    return Animation(scene, tuple(actors), (), fps, count, lighting, moving)


def _frame_count(table: TomlTable, fps: float, actors: Sequence[Actor], moving: CameraPath | None) -> int:
    """Number of frames, from ``frames``, from ``duration``, or from what takes longest: an actor, or the camera."""
    given = table.values
    if "frames" in given:
        count = given["frames"]
    else:
        longest = max((*map(_own_duration, actors), moving.duration if moving is not None else 0.0))
        count = given.get("duration", longest) * fps
    if count > ANIMATION_FRAMES_MAX:
        raise table.error(
            f"has {count:,.8g} frames at fps = {fps:g}, expected at most {ANIMATION_FRAMES_MAX:,}: "
            "lower duration or frames, or fps",
            "frames" if "frames" in given else "duration",
        )
    return max(1, round(count))


def _own_duration(actor: Actor) -> float:
    """Time of the last keyframe, else the duration of the clip or the frames, seconds."""
    return actor.motion.duration if actor.motion is not None else actor.own_duration
