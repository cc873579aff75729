"""Writes small sets of posed images in the layouts of nerfstudio, Blender and COLMAP."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import lumisplat as ls
from lumisplat.io.images.texture import write_png
from lumisplat.math.transforms import quaternions_from_matrices

OPENGL_FROM_OPENCV = np.diag((1.0, -1.0, -1.0, 1.0))


def ring_cameras(count: int = 5, width: int = 40, height: int = 30, **lens: Any) -> list[ls.Camera]:
    """Returns cameras on a ring of radius 3 around (1, 2, 3) that look at its centre, named ``view_0`` and so on."""
    target = np.array((1.0, 2.0, 3.0))
    cameras: list[ls.Camera] = []
    for k in range(count):
        angle = 2.0 * np.pi * k / count
        eye = target + 3.0 * np.array((np.cos(angle), 0.0, np.sin(angle)))
        looking = ls.Camera.look_at(eye, target, (0, -1, 0), width=width, height=height, name=f"view_{k}")
        values: dict[str, Any] = {"fx": 45.0, "fy": 46.0, "cx": 0.5 * width + 0.7, "cy": 0.5 * height - 0.4}
        cameras.append(replace(looking, **values | lens))
    return cameras


def radiance(directions: np.ndarray) -> np.ndarray:
    """Returns the display-referred radiance of a smooth distant environment in each direction, shape (..., 3)."""
    waves = np.array([[3.0, 1.0, 2.0], [-2.0, 4.0, 1.0], [1.0, -3.0, 3.0]])
    return 0.5 + 0.4 * np.sin(directions @ waves.T + (0.1, 0.5, 1.2))


def render_image(camera: ls.Camera) -> np.ndarray:
    """Renders the environment with a camera, shape (H, W, 3)."""
    return radiance(camera.ray_directions() @ camera.camera_from_world[:3, :3])


def write_nerfstudio_images(
    folder: Path, cameras: Sequence[ls.Camera], images: Sequence[np.ndarray] | None = None, **shared: Any
) -> Path:
    """Writes nerfstudio's layout: ``transforms.json`` and ``images``."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    ls.save_cameras(folder / "transforms.json", cameras)
    content = json.loads((folder / "transforms.json").read_text()) | shared
    for k, (frame, camera) in enumerate(zip(content["frames"], cameras, strict=True)):
        frame["file_path"] = f"images/{camera.name}.png"
        write_png(folder / frame["file_path"], render_image(camera) if images is None else images[k])
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def change_frame(path: Path, index: int, **values: Any) -> None:
    """Changes values of one frame in a transforms file."""
    content = json.loads(path.read_text())
    content["frames"][index] |= values
    path.write_text(json.dumps(content))


def write_blender_images(folder: Path, parts: Mapping[str, Sequence[ls.Camera]], alpha: float | None = 0.5) -> Path:
    """Writes NeRF-synthetic's layout: ``transforms_train.json`` and others, RGBA without sizes, names without .png."""
    for part, cameras in parts.items():
        (folder / part).mkdir(parents=True)
        frames: list[dict[str, Any]] = []
        for camera in cameras:
            pixels = render_image(camera)
            if alpha is not None:
                pixels = np.dstack([pixels, np.full(pixels.shape[:2], alpha)])
            write_png(folder / part / f"{camera.name}.png", pixels)
            pose = np.linalg.inv(camera.camera_from_world) @ OPENGL_FROM_OPENCV
            frames.append({"file_path": f"./{part}/{camera.name}", "transform_matrix": pose.tolist()})
        angle = 2.0 * np.arctan(0.5 * cameras[0].width / cameras[0].fx)
        (folder / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return folder


def write_colmap_images(
    folder: Path, cameras: Sequence[ls.Camera], points: np.ndarray, *, text: bool = False, model: str = "sparse/0"
) -> Path:
    """Writes COLMAP's layout: a model with one pinhole, its ``images``, and points coloured red, green, blue, ..."""
    for name in ("images", model):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for camera in cameras:
        write_png(folder / "images" / f"{camera.name}.png", render_image(camera))
    (_write_text if text else _write_binary)(folder / model, cameras, points)
    return folder


def point_colors(count: int) -> np.ndarray:
    """Returns the colours of the points as bytes, shape (N, 3)."""
    return np.eye(3, dtype=np.uint8)[np.arange(count) % 3] * np.uint8(200)


def _write_binary(folder: Path, cameras: Sequence[ls.Camera], points: np.ndarray) -> None:
    lens = cameras[0]
    intrinsics = (lens.fx, lens.fy, lens.cx, lens.cy)
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, lens.width, lens.height, *intrinsics))
    images = struct.pack("<Q", len(cameras))
    for number, camera in enumerate(cameras, 1):
        images += struct.pack("<i7di", number, *_pose(camera), 1) + f"{camera.name}.png".encode() + b"\0"
        images += struct.pack("<Q", 0)
    (folder / "images.bin").write_bytes(images)
    stored = struct.pack("<Q", len(points))
    for number, (point, color) in enumerate(zip(points, point_colors(len(points)), strict=True)):
        track = number % 4  # tracks of different lengths
        stored += struct.pack("<Q3d3BdQ", number + 1, *point, *color, 0.5, track) + struct.pack("<ii", 1, 2) * track
    (folder / "points3D.bin").write_bytes(stored)


def _write_text(folder: Path, cameras: Sequence[ls.Camera], points: np.ndarray) -> None:
    lens = cameras[0]
    intrinsics = f"{lens.fx} {lens.fy} {lens.cx} {lens.cy}"
    (folder / "cameras.txt").write_text(f"# Cameras\n1 PINHOLE {lens.width} {lens.height} {intrinsics}\n")
    lines: list[str] = []
    for number, camera in enumerate(cameras, 1):
        lines += [f"{number} {' '.join(map(str, _pose(camera)))} 1 {camera.name}.png", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    colors = point_colors(len(points))
    lines = [
        f"{k + 1} {' '.join(map(str, point))} {' '.join(map(str, colors[k]))} 0.5{' 1 2' * (k % 4)}"
        for k, point in enumerate(points.tolist())
    ]
    (folder / "points3D.txt").write_text("# Points\n" + "\n".join(lines) + "\n")


def _pose(camera: ls.Camera) -> list[float]:
    """Returns quaternion wxyz and translation of camera_from_world."""
    pose = camera.camera_from_world
    return [*quaternions_from_matrices(pose[None, :3, :3])[0].tolist(), *pose[:3, 3].tolist()]
