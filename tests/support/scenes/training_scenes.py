"""Builds known Gaussians, and images of them for tests of training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import lumisplat as ls
from lumisplat.training.parameters import TrainedParameters
from lumisplat.training.views import TargetPixels, TrainingView

BACKGROUND = (0.1, 0.2, 0.3)


def known_gaussians(count: int = 30) -> ls.Gaussians:
    """Returns the Gaussians that training should recover."""
    rng = np.random.default_rng(0)
    return ls.Gaussians(
        means=rng.uniform(-0.6, 0.6, (count, 3)),
        rotations_wxyz=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.06, 0.2, (count, 3)),
        opacities=rng.uniform(0.5, 0.95, count),
        sh=np.concatenate([rng.normal(size=(count, 1, 3)), 0.1 * rng.normal(size=(count, 3, 3))], axis=1),
    )


def known_parameters() -> TrainedParameters:
    """Returns the known Gaussians as trained parameters before the first step."""
    gaussians = known_gaussians()
    logits = np.log(gaussians.opacities / (1.0 - gaussians.opacities))
    log_scales = np.log(gaussians.scales)
    values = {"means": gaussians.means, "rotations": gaussians.rotations_wxyz, "sh": gaussians.sh}
    return TrainedParameters.new({**values, "log_scales": log_scales, "logits": logits})


def cameras(count: int, size: int = 40) -> list[ls.Camera]:
    """Returns cameras around the Gaussians at varying heights."""
    found: list[ls.Camera] = []
    for number in range(count):
        angle, height = 2.4 * number, 0.9 * np.sin(1.7 * number)
        eye = (3.0 * np.cos(angle), height, 3.0 * np.sin(angle))
        found.append(ls.Camera.look_at(eye, (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=size, height=size, fov_y=0.6))
    return found


def views(count: int, size: int = 40, gains: np.ndarray | None = None) -> list[TrainingView]:
    """Returns noise-free training views; ``gains`` scales the channels of each image, shape (count, 3)."""
    renderer = ls.create_renderer(ls.RenderConfig(background=BACKGROUND), "cpu")
    scene, found = ls.Scene([known_gaussians()]), []
    for number, camera in enumerate(cameras(count, size)):
        frame = renderer.render(scene, camera)
        behind = (1.0 - frame.alpha[..., None]) * np.array(BACKGROUND)
        gain = 1.0 if gains is None else gains[number]
        color = (behind + gain * (frame.color - behind)).astype(np.float32)
        found.append(TrainingView(f"{number:02d}", camera, lambda color=color: TargetPixels(color)))
    return found


def write_training_folder(path: Path, count: int = 9) -> Path:
    """Writes training images in instant-ngp's layout. Returns the folder."""
    path.mkdir()
    (path / "images").mkdir()
    frames: list[dict[str, Any]] = []
    renderer = ls.create_renderer(ls.RenderConfig(background=BACKGROUND), "cpu")
    opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    for number, camera in enumerate(cameras(count)):
        pixels = np.clip(renderer.render(ls.Scene([known_gaussians()]), camera).color, 0.0, 1.0)
        Image.fromarray((255.0 * pixels + 0.5).astype(np.uint8)).save(path / "images" / f"{number:02d}.png")
        pose = np.linalg.inv(camera.camera_from_world) @ opengl
        frames.append({"file_path": f"images/{number:02d}.png", "transform_matrix": pose.tolist()})
    camera = cameras(1)[0]
    shared = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": 40, "h": 40}
    (path / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    return path
