"""Builds a ball of Gaussians with known albedo under a known environment, and writes training images of the ball."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.color import encode_srgb
from lumisplat.math.sh import even_directions
from support.scenes.training_scenes import cameras

Environment = Callable[[np.ndarray], np.ndarray]


def ball(count: int = 700) -> ls.Gaussians:
    """Returns an opaque grey ball of radius 0.6; the shortest axes of its Gaussians point outwards."""
    normals = even_directions(count)
    half = normals + np.array([0.0, 0.0, 1.0])  # a half turn about this vector maps z to the normal
    width = 0.6 * np.sqrt(4.0 * np.pi / count)
    return ls.Gaussians(
        means=0.6 * normals,
        rotations_wxyz=np.column_stack([np.zeros(count), half]),
        scales=np.tile((0.7 * width, 0.7 * width, 0.04 * width), (count, 1)),
        opacities=np.full(count, 0.98),
        sh=np.zeros((count, 1, 3)),
    )


def matte(gaussians: ls.Gaussians, albedo: np.ndarray, environment: Environment) -> ls.Gaussians:
    """Returns the ball with the colours of matte Gaussians that are lit by the unoccluded environment."""
    directions = even_directions(2000)
    normals = gaussians.means / np.linalg.norm(gaussians.means, axis=1, keepdims=True)
    irradiance = np.maximum(normals @ directions.T, 0.0) @ environment(directions) * (4.0 / len(directions))
    sh = ((encode_srgb(albedo * irradiance) - 0.5) / SH_C0)[:, None]
    return ls.Gaussians(gaussians.means, gaussians.rotations_wxyz, gaussians.scales, gaussians.opacities, sh)


def write_training_images(path: Path, gaussians: ls.Gaussians, count: int = 10, size: int = 48) -> Path:
    """Writes images of a capture, transparent outside of the object, with their poses. Returns the folder."""
    (path / "images").mkdir(parents=True)
    renderer = ls.create_renderer(ls.RenderConfig(lighting=False), "cpu")
    frames: list[dict[str, Any]] = []
    for number, camera in enumerate(cameras(count, size)):
        frame = renderer.render(ls.Scene([gaussians]), camera)
        color = np.clip(frame.color / np.maximum(frame.alpha, 1e-3)[..., None], 0.0, 1.0)
        pixels = np.round(255.0 * np.dstack([color, frame.alpha])).astype(np.uint8)
        Image.fromarray(pixels, "RGBA").save(path / "images" / f"{number:02d}.png")
        pose = np.linalg.inv(camera.camera_from_world) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{number:02d}.png", "transform_matrix": pose.tolist()})
    camera = cameras(1, size)[0]
    shared = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": size, "h": size}
    (path / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    return path
