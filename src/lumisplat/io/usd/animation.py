"""Reads OpenUSD animations: prims with time samples become actors, and animated cameras become camera paths."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.constants import ANIMATION_FRAMES_MAX
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import PathLike
from lumisplat.io.usd.cameras import cameras_of
from lumisplat.io.usd.library import check_loaded, pxr, reading_usd
from lumisplat.io.usd.process import Remote, read_in_child
from lumisplat.io.usd.scene import StageReader, light_time_codes, shape_time_codes, transform_time_codes
from lumisplat.io.usd.stage import PlacedPrim, UsdFile, open_usd, prim_name
from lumisplat.math.arrays import Doubles, matrix_4x4
from lumisplat.math.transforms import quaternions_from_matrices
from lumisplat.scene.animation.actors import Actor, Animation, Deforming, Instance
from lumisplat.scene.animation.camera_path import CameraPath
from lumisplat.scene.animation.keyframes import Keyframes
from lumisplat.scene.animation.lights import LightPath
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import MeshInstance, Scene, check_similarity


def read_usd_animation(path: PathLike, drop_invalid: bool = False) -> Animation:
    """Reads a stage with its time samples, from the stage's first to its last time code, at the stage's frame rate.

    Time samples of transforms and lights become keyframes. Deforming prims are read again at each rendered time. A
    deforming prim that a point instancer copies keeps its shape of the first time code, and a log line names the prim.

    Args:
        path: ``.usd``, ``.usda``, ``.usdc`` or ``.usdz``.
        drop_invalid: Drop Gaussians with invalid values instead of refusing the file.

    Raises:
        FormatError: The file cannot be read, or its time codes or rates are invalid.
        MissingExtraError: usd-core is not installed.
    """
    return read_in_child(path, _animation_of, drop_invalid)


def _animation_of(path: Path, drop_invalid: bool) -> Animation:
    """Reads an animation in the current process, which must stay alive to read deforming prims later.

    See `read_usd_animation`.
    """
    with reading_usd(path):
        file = open_usd(path)
        animation = _read(file, drop_invalid)
        check_loaded(path)
    file.remarks.report()
    return animation


def _read(file: UsdFile, drop_invalid: bool) -> Animation:
    reader = StageReader(file, drop_invalid, for_animation=True).run()
    stage = file.stage
    rate, fps = float(stage.GetTimeCodesPerSecond()), float(stage.GetFramesPerSecond())
    if not (0.0 < rate < np.inf and 0.0 < fps < np.inf):
        raise FormatError(
            file.path, f"has timeCodesPerSecond {rate:g} and framesPerSecond {fps:g}, expected both above 0"
        )
    codes = {key: transform_time_codes(stage.GetPrimAtPath(key)) for key in reader.moving}
    moving_cameras = [one for one in _cameras(file) if transform_time_codes(one).size]
    shapes = [
        codes_of(one.prim)
        for one, _ in reader.deforming.values()
        for codes_of in (shape_time_codes, transform_time_codes)
    ]
    light_codes = [light_time_codes(placed.prim) for placed, _ in reader.moving_lights]
    moving_codes = map(transform_time_codes, moving_cameras)
    first, last = _range(file, [*codes.values(), *shapes, *light_codes, *moving_codes])
    actors = [
        actor
        for key, instances in reader.moving.items()
        for actor in _actors(file, stage.GetPrimAtPath(key), instances, codes[key], (codes[key] - first) / rate)
    ]
    actors += [
        Actor(Deforming(Remote(partial(_instances_at, reader, placed, first, rate))), name=placed.name, loop=False)
        for placed, _ in reader.deforming.values()
    ]
    played = [*reader.moving.values(), *(instances for _, instances in reader.deforming.values())]
    actor_instances = {id(one) for instances in played for one in instances}
    scene = Scene(
        [one for one in reader.splats if id(one) not in actor_instances],
        [one for one in reader.meshes if id(one) not in actor_instances],
        reader.lights,
        up="y-up",
    )
    frames = (last - first) / rate * fps
    if not 0.0 <= frames < ANIMATION_FRAMES_MAX:
        time_range = f"time codes {first:g} to {last:g}"
        raise FormatError(file.path, f"has {time_range}, expected at most {ANIMATION_FRAMES_MAX:,} frames between them")
    cameras = cameras_of(file)
    path = _camera_path(file, moving_cameras, first, rate)
    lights = [
        LightPath([reader.light_at(placed, light, float(code)) for code in codes], (codes - first) / rate)
        for (placed, light), codes in zip(reader.moving_lights, light_codes, strict=True)
    ]
    return Animation(scene, actors, cameras, fps=fps, frame_count=round(frames) + 1, camera_path=path, lights=lights)


def _instances_at(
    reader: StageReader, placed: PlacedPrim, first: float, rate: float, time: float
) -> tuple[Instance, ...]:
    """Returns the instances of a deforming prim at a time.

    Args:
        reader: Reader of the stage.
        placed: The prim.
        first: Time code of time 0.
        rate: Time codes per second.
        time: Seconds.
    """
    with reading_usd(reader.file.path):
        instances = tuple(reader.instances_at(placed, first + time * rate))
        check_loaded(reader.file.path)
        return instances


def _cameras(file: UsdFile) -> Iterator[Any]:
    return (prim for prim in file.stage.Traverse() if str(prim.GetTypeName()) == "Camera")


def _range(file: UsdFile, codes: list[Doubles]) -> tuple[float, float]:
    """Returns the first and last time code that a stage states or, if it states none, of all samples in ``codes``."""
    if file.stage.HasAuthoredTimeCodeRange():
        return float(file.stage.GetStartTimeCode()), float(file.stage.GetEndTimeCode())
    sampled = np.concatenate([np.zeros(0), *codes])
    return (float(sampled.min()), float(sampled.max())) if sampled.size else (0.0, 0.0)


def _world_transforms(file: UsdFile, prim: Any, codes: Doubles) -> Doubles:
    """Returns ``world_from_prim`` at each of K time codes, shape (K, 4, 4)."""
    px = pxr()
    caches = (px.UsdGeom.XformCache(px.Usd.TimeCode(float(code))) for code in codes)
    return np.array([file.world_transform(cache.GetLocalToWorldTransform(prim)) for cache in caches])


def _actors(file: UsdFile, prim: Any, instances: list[Instance], codes: Doubles, seconds: Doubles) -> Iterator[Actor]:
    """Yields an actor with keyframes for each instance of a prim whose transform has time samples.

    Args:
        file: The open file.
        prim: The prim.
        instances: Its captures and meshes.
        codes: Time codes of the keyframes.
        seconds: The same times in seconds.
    """
    transforms = _world_transforms(file, prim, codes)
    rest = np.eye(4)
    try:
        for transform in transforms:
            check_similarity(transform[:3, :3])
    except SceneError:  # keep the first transform fixed, and animate the motion relative to it
        rest = transforms[0]
        transforms = np.asarray(transforms @ np.linalg.inv(rest), np.float64)
    motion = Keyframes(seconds, transforms[:, :3, 3], *_rotations_and_scales(file, prim, transforms))
    try:
        for time in seconds:
            matrix_4x4("its transform", motion.at(float(time)) @ rest)
    except SceneError as error:
        raise FormatError(file.path, f"{prim.GetPath()}: {error}") from None
    for instance in instances:
        if isinstance(instance, MeshInstance):
            yield Actor(instance.mesh, motion, rest, name=instance.name)
        else:  # a stretching transform is already applied to the Gaussians
            yield Actor(instance.gaussians, motion, name=instance.name)


def _rotations_and_scales(file: UsdFile, prim: Any, transforms: Doubles) -> tuple[Doubles, Doubles]:
    """Returns quaternions wxyz, shape (K, 4), and uniform scales, shape (K,), nearest to the K transforms of a prim.

    Quaternions and uniform scales cannot represent stretching and mirroring; a log line reports such transforms.
    """
    linear = transforms[:, :3, :3]
    left, factors, right = np.linalg.svd(linear)
    if (factors[:, 0] > factors[:, 2] * (1.0 + 1e-3)).any() or (np.linalg.det(linear) < 0.0).any():
        file.remarks.add("animated transforms that stretch or mirror", str(prim.GetPath()))
    rotations = left @ right
    rotations = rotations * np.sign(np.linalg.det(rotations))[:, None, None]
    return quaternions_from_matrices(rotations).astype(np.float64), np.maximum(np.cbrt(factors.prod(axis=1)), 1e-9)


def _camera_path(file: UsdFile, moving: list[Any], first: float, rate: float) -> CameraPath | None:
    """Returns the path of the first of the cameras ``moving``, with a keyframe at each time sample; None without one.

    Args:
        file: The open file.
        moving: Camera prims whose transform has time samples.
        first: Time code of time 0.
        rate: Time codes per second.
    """
    if not moving:
        return None
    px, codes, at_start = pxr(), transform_time_codes(moving[0]), file.time
    keys: list[Camera] = []
    for code in codes:
        file.time = px.Usd.TimeCode(float(code))
        keys += [one for one in cameras_of(file) if one.name == prim_name(moving[0])][:1]
    file.time = at_start
    if len(moving) > 1:
        file.remarks.add("all animated cameras but the first", str(moving[1].GetPath()))
    return CameraPath(keys, (codes - first) / rate)
