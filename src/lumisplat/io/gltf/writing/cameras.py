"""Cameras as those of glTF files, which have a field of view and an aspect ratio, but no lens and no size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lumisplat.io.gltf.extras import CAMERAS, with_extras
from lumisplat.io.gltf.lights import node_item
from lumisplat.io.gltf.nodes import Matrix
from lumisplat.io.gltf.writing.document import GltfDocument
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.scene import Scene

_FAR = 1000.0
"""Far plane of parallel rays in an empty scene, in near planes; glTF must have one."""
_CENTRED = 1e-6
"""Distance of a principal point from the middle of the image, pixels, that is none."""


def can_hold_camera(camera: Camera) -> bool:
    """Whether glTF has such a camera: a pinhole, or parallel rays."""
    return camera.model is not CameraModel.FISHEYE and not camera.is_distorted


def add_camera(document: GltfDocument, camera: Camera, scene: Scene, file_from_world: Matrix) -> int | None:
    """Appends a camera and its node; returns the node's index, None if glTF has no such camera."""
    if not can_hold_camera(camera):
        return None
    half_width, half_height = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    if camera.model is CameraModel.ORTHOGRAPHIC:
        lens = {"xmag": half_width, "ymag": half_height, "znear": camera.near, "zfar": _far(camera, scene)}
        item: dict[str, Any] = {"type": "orthographic", "orthographic": lens}
    else:
        lens = {"yfov": camera.fov_y, "aspectRatio": half_width / half_height, "znear": camera.near}
        item = {"type": "perspective", "perspective": lens}
    own = {name: getattr(camera, name) for name in CAMERAS if getattr(camera, name)}
    number = document.add("cameras", with_extras(item | ({"name": camera.name} if camera.name else {}), own))
    looking = camera.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])  # glTF looks along -z, with y up
    return document.add("nodes", node_item(file_from_world @ looking, camera.name) | {"camera": number})


def camera_losses(cameras: Sequence[Camera]) -> list[str]:
    """What of cameras glTF cannot hold, a phrase each."""
    lenses = sum(not can_hold_camera(camera) for camera in cameras)
    shifted = sum(
        abs(camera.cx - 0.5 * camera.width) > _CENTRED or abs(camera.cy - 0.5 * camera.height) > _CENTRED
        for camera in cameras
    )
    rolling = sum(camera.camera_from_world_end is not None for camera in cameras)
    return [
        phrase
        for count, phrase in (
            (lenses, f"fisheyes and lenses that distort ({lenses} cameras are left out)"),
            (shifted, f"principal points ({shifted} cameras have it in the middle instead)"),
            (rolling, f"rolling shutters ({rolling} cameras have their first pose)"),
        )
        if count
    ]


def _far(camera: Camera, scene: Scene) -> float:
    """A plane behind all that there is."""
    if not (scene.splats or scene.meshes):
        return _FAR * camera.near
    corners = np.array(np.meshgrid(*np.array(scene.bounds()).T)).reshape(3, -1).T
    return camera.near + 2.0 * float(np.linalg.norm(corners - camera.eye, axis=1).max())
