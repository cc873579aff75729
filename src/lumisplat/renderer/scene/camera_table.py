"""The table from which a camera's rays are generated, sample by sample."""

from __future__ import annotations

import numpy as np

from lumisplat.config import RenderConfig
from lumisplat.constants import SUBPIXEL_STEPS
from lumisplat.device.camera import camera as rays
from lumisplat.device.structs.rays import LensData
from lumisplat.renderer.scene.device_scene import table_dtype
from lumisplat.scene.camera import Camera, CameraModel

_MODELS = {
    CameraModel.PINHOLE: rays.PINHOLE,
    CameraModel.FISHEYE: rays.FISHEYE,
    CameraModel.ORTHOGRAPHIC: rays.ORTHOGRAPHIC,
}


def lens_table(camera: Camera, config: RenderConfig, sample: int) -> np.ndarray:
    """The 1-element table that kernels read a camera's rays from.

    Args:
        camera: What they leave.
        config: Its seed, and whether samples spread over their pixel.
        sample: Number of the sample, from 0.
    """
    table = np.zeros(1, dtype=table_dtype(LensData))
    turn = camera.shutter_turn
    angle = np.linalg.norm(turn)
    table["world_from_camera"] = camera.world_from_camera[:3, :3]
    table["eye"] = camera.eye
    table["shutter"] = camera.camera_from_world_end is not None
    table["turn_axis"] = turn / angle if angle > 0.0 else turn
    table["turn_angle"] = angle
    table["motion"] = camera.shutter_motion
    table["focal"], table["center"] = (camera.fx, camera.fy), (camera.cx, camera.cy)
    table["model"] = _MODELS[camera.model]
    table["width"], table["height"] = camera.width, camera.height
    table["near"] = camera.near
    table["aperture"], table["focus_distance"] = camera.aperture, camera.focus_distance
    table["offset"] = subpixel(sample) if config.trace.jitter else subpixel(0)
    table["sample"], table["seed"] = sample, config.seed
    return table


def subpixel(sample: int) -> tuple[float, float]:
    """Where in its pixel a sample lies, 0..1: the centre, then the R2 sequence from there (Roberts 2018)."""
    x, y = SUBPIXEL_STEPS
    return (0.5 + sample * x) % 1.0, (0.5 + sample * y) % 1.0
