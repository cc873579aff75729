"""Reads and writes glTF cameras, which look along -z of their node with y up.

A glTF camera has a field of view and an aspect ratio, but no image size and no lens model.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lumisplat.config.checks import is_number, is_whole
from lumisplat.constants import NEAR_PLANE
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.cameras.common import DEFAULT_SIZE_MAX, pose_of_node, size_of_aspect
from lumisplat.io.files.source import PathLike, parsing
from lumisplat.io.gltf.container import GltfDocument, GltfFile
from lumisplat.io.gltf.nodes import (
    CAMERA_EXTRAS,
    Matrix,
    lumisplat_extras,
    node_item,
    node_label,
    scene_nodes,
    with_extras,
    world_transforms,
)
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.scene import Scene

if TYPE_CHECKING:
    import pygltflib

_FAR = 1000.0
"""Far plane of an orthographic camera in a scene without objects, as a multiple of the near plane. glTF requires a far
plane."""
_CENTRE_TOLERANCE = 1e-6
"""Distance in pixels up to which a principal point counts as being in the image centre."""


def read_gltf_cameras(path: PathLike, width: int | None = None, height: int | None = None) -> list[Camera]:
    """Reads the cameras of the default scene in node order, each named after its node, else after the glTF camera.

    The scale of a node does not affect its camera, as section 3.10 of the glTF specification demands.

    Args:
        path: A ``.glb`` or ``.gltf`` file.
        width: Image width in pixels; None derives it from the height and the file's aspect ratio.
        height: Image height in pixels; None derives it from the width and the aspect ratio. If both are None, the image
            is the largest within 1280 x 720. The vertical field of view is always that of the file.

    Raises:
        FormatError: The file is malformed, or a camera is invalid; the message names the camera.
    """
    path = Path(path)
    with parsing(path, "a glTF file"):
        file = GltfFile(path)
        nodes = [index for index in scene_nodes(file) if file.model.nodes[index].camera is not None]
        return cameras_of(file, nodes, world_transforms(file), width, height) if nodes else []


def cameras_of(
    file: GltfFile,
    nodes: Iterable[int],
    world_from_node: list[Matrix],
    width: int | None = None,
    height: int | None = None,
) -> list[Camera]:
    """Returns the cameras of the given nodes, with their world transforms; image sizes as in `read_gltf_cameras`.

    Raises:
        FormatError: A camera is invalid; the message names the camera.
    """
    cameras: list[Camera] = []
    for index in nodes:
        node = file.model.nodes[index]
        definition = file.item("cameras", node.camera, f"nodes[{index}]")
        try:
            pose = pose_of_node(world_from_node[index])
        except SceneError as error:
            raise FormatError(file.path, f"{node_label(file, index)} {error}") from None
        try:
            name = node.name or definition.name or ""
            cameras.append(_camera(definition, pose, name, width, height))
        except SceneError as error:
            raise FormatError(file.path, f"cameras[{node.camera}]: {error}") from None
    return cameras


def _camera(definition: pygltflib.Camera, pose: Matrix, name: str, width: int | None, height: int | None) -> Camera:
    if definition.type == "perspective":
        lens = definition.perspective
        yfov = _positive(lens, "yfov")
        if yfov >= math.pi:
            raise SceneError(f"yfov is {yfov:g}, expected less than pi (radians)")
        has_aspect = lens is not None and lens.aspectRatio is not None
        aspect = _positive(lens, "aspectRatio") if has_aspect else DEFAULT_SIZE_MAX[0] / DEFAULT_SIZE_MAX[1]
        model, half_height = CameraModel.PINHOLE, math.tan(0.5 * yfov)
    elif definition.type == "orthographic":
        lens = definition.orthographic
        half_height = _positive(lens, "ymag")
        model, aspect = CameraModel.ORTHOGRAPHIC, _positive(lens, "xmag") / half_height
    else:
        raise SceneError(f"type is {definition.type!r}, expected perspective or orthographic")
    extras = _camera_extras(definition)
    if width is None and height is None and extras.keys() >= {"width", "height"}:
        width, height = extras["width"], extras["height"]
    width, height = size_of_aspect(aspect, width, height)
    focal = 0.5 * height / half_height
    return Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=0.5 * width,
        cy=0.5 * height,
        camera_from_world=pose,
        near=getattr(lens, "znear", None) or NEAR_PLANE,  # orthographic cameras may have a near plane of 0
        name=name,
        model=model,
        **{name: extras[name] for name in extras if name not in ("width", "height")},
    )


def _camera_extras(definition: pygltflib.Camera) -> dict[str, Any]:
    """Returns the camera settings in Lumisplat's extras: image size, exposure, aperture and focus distance."""
    extras = lumisplat_extras(definition) or {}
    settings = {name: extras[name] for name in CAMERA_EXTRAS if name in extras}
    for name in ("width", "height"):
        if name in settings and not is_whole(settings[name]):
            raise SceneError(f"{name} is {settings[name]}, expected a whole number")
    return settings


def _positive(lens: object, name: str) -> float:
    value: object = getattr(lens, name, None)
    if not is_number(value) or not 0.0 < value < math.inf:
        raise SceneError(f"{name} is {value}, expected a positive number")
    return float(value)


def _can_hold_camera(camera: Camera) -> bool:
    """Returns whether glTF can store a camera. It can store pinhole and orthographic cameras without distortion."""
    return camera.model is not CameraModel.FISHEYE and not camera.is_distorted


def add_camera(document: GltfDocument, camera: Camera, scene: Scene, file_from_world: Matrix) -> int | None:
    """Appends a camera and its node, and returns the node's index; None if glTF cannot store the camera.

    Args:
        document: The file being built.
        camera: The camera.
        scene: Scene that the far plane of an orthographic camera must enclose.
        file_from_world: Transform from the scene to the axes of the file, shape (4, 4).
    """
    if not _can_hold_camera(camera):
        return None
    half_width, half_height = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    if camera.model is CameraModel.ORTHOGRAPHIC:
        lens = {"xmag": half_width, "ymag": half_height, "znear": camera.near, "zfar": _far(camera, scene)}
        item: dict[str, Any] = {"type": "orthographic", "orthographic": lens}
    else:
        lens = {"yfov": camera.fov_y, "aspectRatio": half_width / half_height, "znear": camera.near}
        item = {"type": "perspective", "perspective": lens}
    extras = {name: getattr(camera, name) for name in CAMERA_EXTRAS if getattr(camera, name)}
    number = document.add("cameras", with_extras(item | ({"name": camera.name} if camera.name else {}), extras))
    looking = camera.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])  # glTF looks along -z, with y up
    return document.add("nodes", node_item(file_from_world @ looking, camera.name) | {"camera": number})


def camera_losses(cameras: Sequence[Camera]) -> list[str]:
    """Returns a phrase for each camera feature that glTF cannot store and at least one of ``cameras`` has."""
    lenses = sum(not _can_hold_camera(camera) for camera in cameras)
    shifted = sum(
        abs(camera.cx - 0.5 * camera.width) > _CENTRE_TOLERANCE
        or abs(camera.cy - 0.5 * camera.height) > _CENTRE_TOLERANCE
        for camera in cameras
    )
    rolling = sum(camera.camera_from_world_end is not None for camera in cameras)
    return [
        phrase
        for count, phrase in (
            (lenses, f"fisheye and distorted cameras ({lenses} left out)"),
            (shifted, f"principal points off the centre ({shifted} cameras are centred)"),
            (rolling, f"rolling shutters ({rolling} cameras keep their first pose)"),
        )
        if count
    ]


def _far(camera: Camera, scene: Scene) -> float:
    """Returns a distance for the far plane that is larger than the distance of any object in the scene."""
    if not (scene.splats or scene.meshes):
        return _FAR * camera.near
    corners = np.array(np.meshgrid(*np.array(scene.bounds()).T)).reshape(3, -1).T
    return camera.near + 2.0 * float(np.linalg.norm(corners - camera.eye, axis=1).max())
