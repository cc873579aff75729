"""glTF cameras: axes, image sizes, and refused cameras."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.files.mesh_files import Gltf, quad_gltf

HALF = math.sqrt(0.5)
LENS = {"yfov": 0.8, "znear": 0.1, "aspectRatio": 1.5}


def camera_gltf(camera: dict[str, Any], **node: Any) -> Gltf:
    """Returns a document with a single camera."""
    gltf = Gltf()
    gltf.add("cameras", **camera)
    gltf.add("nodes", camera=0, **node)
    return gltf


def read(tmp_path: Path, gltf: Gltf, **size: int) -> list[ls.Camera]:
    """Returns the cameras of a document."""
    (tmp_path / "a.glb").write_bytes(gltf.glb())
    return ls.load_cameras(tmp_path / "a.glb", **size)


def perspective(**changes: Any) -> dict[str, Any]:
    """Returns a perspective camera; None removes a key."""
    lens = {key: value for key, value in (LENS | changes).items() if value is not None}
    return {"type": "perspective", "perspective": lens, "name": "lens"}


def test_gltf_cameras_look_along_minus_z_with_y_up(tmp_path: Path) -> None:
    """Nodes move cameras, but scales and mirrorings of nodes are ignored."""
    (camera,) = read(tmp_path, camera_gltf(perspective()))
    np.testing.assert_allclose(camera.camera_from_world, np.diag([1.0, -1.0, -1.0, 1.0]), atol=1e-15)
    gltf = camera_gltf(perspective(), rotation=[0, HALF, 0, HALF], translation=[0, 0, 1], scale=[2, 3, 4], name="door")
    gltf.add("nodes", children=[0], translation=[5, 0, 0], scale=[-2, 2, 2])
    (camera,) = read(tmp_path, gltf)
    # A quarter turn about y takes -z to -x, which the parent mirrors to x.
    np.testing.assert_allclose(camera.eye, (5.0, 0.0, 2.0), atol=1e-12)
    np.testing.assert_allclose(camera.camera_from_world[2, :3], (1.0, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(camera.camera_from_world[1, :3], (0.0, -1.0, 0.0), atol=1e-12)
    assert camera.name == "door"


@pytest.mark.parametrize(
    ("aspect", "given", "size"),
    [
        (1.5, {}, (1080, 720)),
        (2.0, {}, (1280, 640)),
        (0.5, {}, (360, 720)),
        (None, {}, (1280, 720)),
        (1.5, {"width": 300}, (300, 200)),
        (1.5, {"height": 300}, (450, 300)),
        (1.5, {"width": 100, "height": 300}, (100, 300)),
    ],
)
def test_aspect_ratio_of_a_gltf_camera_is_fitted_into_the_image_size(
    tmp_path: Path, aspect: float | None, given: dict[str, int], size: tuple[int, int]
) -> None:
    """The image size is 1280 x 720 or the requested size; fov_y is unchanged."""
    (camera,) = read(tmp_path, camera_gltf(perspective(aspectRatio=aspect)), **given)
    assert (camera.width, camera.height) == size
    assert camera.fov_y == pytest.approx(0.8)
    assert (camera.fx, camera.cx, camera.cy) == (camera.fy, 0.5 * size[0], 0.5 * size[1])
    assert camera.near == 0.1


def test_gltf_orthographic_magnifications_are_half_the_image_size(tmp_path: Path) -> None:
    """The near plane may be at 0."""
    lens = {"xmag": 3.0, "ymag": 2.0, "znear": 0.0, "zfar": 10.0}
    gltf = camera_gltf({"type": "orthographic", "orthographic": lens}, scale=[5, 5, 5])
    (camera,) = read(tmp_path, gltf, height=200)
    assert camera.model is ls.CameraModel.ORTHOGRAPHIC
    assert (camera.width, camera.height) == (300, 200)
    assert (camera.fx, camera.fy) == (50.0, 50.0)
    assert 0.0 < camera.near <= 0.01


def test_gltf_cameras_have_the_order_of_nodes_and_unique_names(tmp_path: Path) -> None:
    """A file without cameras gives an empty list."""
    gltf = camera_gltf(perspective(), name="left")
    gltf.add("nodes", camera=0)
    gltf.add("nodes", camera=0, name="left")
    assert [camera.name for camera in read(tmp_path, gltf)] == ["left", "lens", "left_2"]
    assert read(tmp_path, quad_gltf()) == []


def test_gltf_with_only_cameras_loads_as_an_empty_scene(tmp_path: Path) -> None:
    """The scene has neither meshes nor lights, and loading it is no error."""
    read(tmp_path, camera_gltf(perspective()))
    scene = ls.load(tmp_path / "a.glb")
    assert isinstance(scene, ls.Scene)
    assert not scene.meshes and not scene.lights


@pytest.mark.parametrize(
    ("camera", "node", "message"),
    [
        (perspective(yfov=0.0), {}, r"cameras\[0\]: yfov is 0.0, expected a positive number"),
        (perspective(yfov=4.0), {}, r"cameras\[0\]: yfov is 4, expected less than pi"),
        (perspective(yfov=None), {}, r"cameras\[0\]: yfov is None"),
        (perspective(aspectRatio=-1.0), {}, r"cameras\[0\]: aspectRatio is -1.0"),
        (perspective(znear=-1.0), {}, r"cameras\[0\]: camera near is -1.0"),
        (
            {"type": "orthographic", "orthographic": {"xmag": 0.0, "ymag": 1.0}},
            {},
            r"cameras\[0\]: xmag is 0.0, expected a positive number",
        ),
        ({"type": "fisheye"}, {}, r"cameras\[0\]: type is 'fisheye', expected perspective or orthographic"),
        ({"type": "perspective"}, {}, r"cameras\[0\]: yfov is None"),
        (perspective(), {"camera": 3}, r"nodes\[0\] refers to cameras\[3\], but there are 1"),
        (perspective(), {"scale": [0, 0, 0]}, r"nodes\[0\] has a scale of zero: its camera has no direction"),
        (perspective(), {"translation": [0, 0, math.nan]}, r"nodes\[0\] has translation .* finite"),
    ],
)
def test_error_for_an_invalid_gltf_camera_names_the_camera(
    tmp_path: Path, camera: dict[str, Any], node: dict[str, Any], message: str
) -> None:
    """The error is one line."""
    gltf = camera_gltf(camera)
    gltf.json["nodes"][0] |= node
    with pytest.raises(ls.FormatError, match=message) as caught:
        read(tmp_path, gltf)
    assert str(caught.value).startswith(f"{tmp_path / 'a.glb'}: ")
    assert "\n" not in str(caught.value)
