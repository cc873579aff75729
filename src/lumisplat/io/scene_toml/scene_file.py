"""Reads scene files, ``scene.toml``: captures and meshes in one scene, with lights, cameras, materials and settings.

up = "y-down"                           # up direction of the scene; captures are usually y down

[[splats]]
path = "garden.ply"                     # relative to the scene file
kernel_degree = 4                       # if it was not trained with degree 2 and the file does not say so
shadow_catcher = true                   # emits its captured colours, and receives shadows of other objects

[[meshes]]
path = "teapot.glb"
position = [0.0, -1.2, 3.0]
rotation_wxyz = [0.0, 1.0, 0.0, 0.0]    # y up to y down: 180 degrees about x
scale = 0.5
name = "teapot"
material = "chrome"                     # replaces the materials of the file
lights = false                          # ignores the lights of the file

[[meshes]]
shape = "box"                           # a primitive instead of a file; also plane and sphere
size = 0.4
ground = 0.0                            # height of its lowest point along up

[materials.chrome]
roughness = 0.0
metallic = 1.0

[animation]
fps = 25.0
duration = 4.0                          # or frames = 100

[animation.lighting]
direct = 0.7
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.config import AvatarLightingConfig
from lumisplat.constants import ANIMATION_FRAMES_MAX
from lumisplat.io.files.source import PathLike, parsing, with_current_keys
from lumisplat.io.scene_toml.actors import Load, read_actors, with_instances
from lumisplat.io.scene_toml.assets import Assets
from lumisplat.io.scene_toml.cameras import LoadCameras, read_camera_path, read_scene_cameras
from lumisplat.io.scene_toml.config_file import read_settings
from lumisplat.io.scene_toml.lights import read_environment, read_light, read_sun
from lumisplat.io.scene_toml.materials import read_material_paths, read_materials
from lumisplat.io.scene_toml.placement import keep_saved_positions, scene_around, scene_up, stand_placed_upright
from lumisplat.io.scene_toml.toml_table import NUMBER, TABLE, WHOLE, TomlTable, is_object
from lumisplat.scene.animation.actors import Actor, Animation
from lumisplat.scene.animation.camera_path import CameraPath
from lumisplat.scene.animation.lights import LightPath, MaterialPath, MovingLight
from lumisplat.scene.lights import Light
from lumisplat.scene.placing import up_vector
from lumisplat.scene.scene import Scene

ANIMATION_KEYS = {
    "fps": NUMBER.about("Frames a second. Default: 25."),
    "duration": NUMBER.about(
        "Length in seconds. Default: until the last keyframe, else once through the longest clip."
    ),
    "frames": WHOLE.about("Number of frames, instead of `duration`, at most 1,000,000."),
    "lighting": TABLE.about("Light of actors: the table `[animation.lighting]`."),
}
_FPS = 25.0

_HEADINGS = (
    "splats",
    "meshes",
    "actors",
    "lights",
    "environment",
    "sun",
    "cameras",
    "materials",
    "animation",
    "render",
    "up",
)
_VISIBLE_HEADINGS = ("splats", "meshes", "actors", "lights", "environment", "sun")
"""Headings of entries with visible content; a scene file without any of them renders nothing."""


def _read_timing(document: TomlTable) -> tuple[float, AvatarLightingConfig]:
    """Reads the frame rate and the lighting of actors from ``[animation]``; defaults if the file has no such table."""
    table = document.table("animation")
    given = table.take(ANIMATION_KEYS)
    lighting = read_settings(table.table("lighting"), AvatarLightingConfig)
    fps = given.get("fps", _FPS)
    if not 0.0 < fps < np.inf:
        raise table.wrong("fps", "a positive number of frames a second")
    if "duration" in given and "frames" in given:
        raise table.error("has both duration and frames: expected one of them", "frames")
    if not 0.0 < given.get("duration", 1.0) < np.inf:
        raise table.wrong("duration", "a positive number of seconds")
    if given.get("frames", 1) < 1:
        raise table.wrong("frames", "at least 1")
    return fps, lighting


def read_document(path: PathLike) -> TomlTable:
    """Reads the top-level table of a scene file and checks its headings.

    Raises:
        FormatError: The file is not TOML, or has an unknown heading.
    """
    document = TomlTable.read(path, "a scene file")
    document.check_keys(_HEADINGS)
    keep_saved_positions(document)
    captures = document.tables("splats")
    if captures:
        document.values["splats"] = [with_current_keys(table.values) for table in captures]
    return document


def read_scene_file(path: PathLike, load: Load, up: str | npt.ArrayLike | None = None) -> Scene:
    """Reads a scene file and the files that it names, with actors at time 0. A file named twice is loaded once.

    ``kernel_degree`` in an entry overrides the degree that its capture file states. ``material`` in an entry overrides
    the materials of all meshes in its mesh file. The lights of the scene file come first, then the lights of its mesh
    files, then the environment.

    Args:
        path: The ``.toml`` file.
        load: Reads one capture or mesh.
        up: Up direction if the file has no ``up``, an axis or a vector; None: see `scene_up`.

    Raises:
        FormatError: The file is not TOML, has an unknown or invalid entry, or names a file of the wrong kind.
        SceneError: ``up`` is not a direction.
    """
    direction = None if up is None else list(up_vector(up))
    with parsing(path, "a scene file"):
        document = read_document(path)
        if direction is not None:
            document.values.setdefault("up", direction)
        if all(document.values.get(key, []) == [] for key in _VISIBLE_HEADINGS):
            raise document.error(f"has no visible content: expected {', '.join(map(_heading, _VISIBLE_HEADINGS))}")
        _read_timing(document)  # unused for one frame, but reports errors of [animation] early
        scene, moving = _static_scene(document, load)
        animation = Animation(scene, lights=moving, materials=read_material_paths(document))
        instances = [instance for actor in read_actors(document, load, scene) for instance in actor.at(0.0)]
        return with_instances(animation.scene_at(0.0), instances)


def _static_scene(document: TomlTable, load: Load) -> tuple[Scene, list[MovingLight]]:
    """Builds the scene of a scene file without its actors, which may be empty; returns its moving lights apart."""
    up = scene_up(document)
    listed: list[Light | MovingLight] = [read_light(table) for table in document.tables("lights")]
    ending: list[Light | MovingLight] = []
    if "environment" in document.values:
        ending.append(read_environment(document.table("environment")))
    if "sun" in document.values:
        check_one_sky(document)
        ending += read_sun(document.table("sun"), up)[1]
    lights, environment = ([one for one in part if isinstance(one, Light)] for part in (listed, ending))
    moving = [one for one in (*listed, *ending) if not isinstance(one, Light)]
    stand_placed_upright(document, up)
    assets = Assets(load, read_materials(document), up)
    splats = [(assets.splats(table), table) for table in document.tables("splats")]
    captures = [entry for entry, table in splats if not table.values.get("hidden", False)]
    scene = Scene(splats=tuple(splat for entry in captures for splat in entry.splats), up=up)
    for table in document.tables("meshes"):
        entry = assets.meshes(table, scene_around(table.values, scene))
        if not table.values.get("hidden", False):
            scene = replace(
                scene,
                splats=(*scene.splats, *entry.splats),
                meshes=(*scene.meshes, *entry.meshes),
                lights=(*scene.lights, *entry.lights),
            )
    return replace(scene, lights=(*lights, *scene.lights, *environment)), moving


def check_one_sky(document: TomlTable) -> None:
    """Raises `FormatError` if a scene file has both a visible ``[sun]`` and an enabled ``[environment]``."""
    tables = document.values.get("sun"), document.values.get("environment")
    sun, sky = (table if is_object(table) else None for table in tables)
    if sun is not None and sky is not None and not sun.get("hidden", False) and sky.get("enabled", True):
        raise document.error("has [sun], which brings its sky, and [environment]: remove one of them", "environment")


def _heading(key: str) -> str:
    return f"[{key}]" if key in ("environment", "sun") else f"[[{key}]]"


def read_animation(path: PathLike, load: Load, load_cameras: LoadCameras) -> Animation:
    """Reads an animated scene; see `lumisplat.io.load_animation`.

    Args:
        path: The scene file.
        load: Reads one capture or mesh.
        load_cameras: Reads a camera file.
    """
    with parsing(path, "a scene file"):
        document = read_document(path)
        if not is_animated(document):
            raise document.error(
                "has neither [[actors]] nor keyframes of a camera, light or material: there is nothing to animate"
            )
        scene, lights = _static_scene(document, load)
        animation = animation_of(document, scene, read_actors(document, load, scene), lights)
        timing = document.table("animation").values
        if animation.frame_count == 1 and document.table("sun").values.get("speed") and timing.keys() <= {"fps"}:
            raise document.error(
                "has a [sun] with a speed, but no length: give duration or frames in [animation]", "sun"
            )
        return replace(animation, cameras=tuple(read_scene_cameras(document, load_cameras)))


def is_animated(document: TomlTable) -> bool:
    """Returns whether a scene file has actors, a clock that runs, or keyframes of a camera, light or material."""
    named = document.table("materials")
    tables = [*document.tables("cameras"), *document.tables("lights"), document.table("environment")]
    tables += [named.table(name) for name in named.values]
    is_keyed = any("keyframes" in table.values for table in tables)
    return is_keyed or bool(document.tables("actors")) or bool(document.table("sun").values.get("speed"))


def animation_of(
    document: TomlTable, scene: Scene, actors: Sequence[Actor], lights: Sequence[MovingLight]
) -> Animation:
    """Builds the animation of a scene file: what moves, timing and the first moving camera, without static cameras.

    Args:
        document: Top-level table of the scene file.
        scene: The static scene.
        actors: The moving objects.
        lights: The moving lights.

    Raises:
        FormatError: ``[animation]`` or a camera is invalid.
    """
    moving = read_camera_path(document)
    fps, lighting = _read_timing(document)
    materials = read_material_paths(document)
    paths = [one for one in (moving, *lights, *materials) if isinstance(one, CameraPath | LightPath | MaterialPath)]
    longest = max((*map(_duration, actors), *(one.duration for one in paths), 0.0))
    return Animation(
        scene,
        tuple(actors),
        fps=fps,
        frame_count=_frame_count(document.table("animation"), fps, longest),
        lighting=lighting,
        camera_path=moving,
        lights=lights,
        materials=materials,
    )


def _frame_count(table: TomlTable, fps: float, longest: float) -> int:
    """Returns the number of frames of an animation: ``frames``, or else ``duration`` times ``fps``.

    Without either key, the duration is ``longest``, that of the longest actor or path in seconds.
    """
    given = table.values
    if "frames" in given:
        count = given["frames"]
    else:
        count = given.get("duration", longest) * fps
    if count > ANIMATION_FRAMES_MAX:
        raise table.error(
            f"has {count:,.8g} frames at fps = {fps:g}, expected at most {ANIMATION_FRAMES_MAX:,}: "
            "lower duration or frames, or fps",
            "frames" if "frames" in given else "duration",
        )
    return max(1, round(count))


def _duration(actor: Actor) -> float:
    """Returns the time of the actor's last keyframe, or else the duration of its clip or sequence, seconds."""
    return actor.motion.duration if actor.motion is not None else actor.own_duration
