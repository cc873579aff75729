"""Checks of the camera, and its table on the device, which is rewritten for each sample."""

from __future__ import annotations

import numpy as np

from lumisplat.config import Pipeline, Projection
from lumisplat.constants import JACOBIAN_CLAMP, SUBPIXEL_STEPS, TILE_PX
from lumisplat.device.camera.camera import FISHEYE, ORTHOGRAPHIC, PINHOLE
from lumisplat.device.structs.camera import CameraData
from lumisplat.errors import SceneError
from lumisplat.math.distortion import distortion_reach, undistort
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.scene.camera import Camera, CameraModel

IMAGE_PIXELS_MAX = 200_000_000
"""Largest number of pixels of a frame, because its buffers take ten words per pixel and have signed 32-bit indices."""

FULL_IMAGE_PIXELS_MAX = 2**31 - 1
"""Largest number of pixels of a full image that is rendered in windows, because pixels are counted in signed 32 bits.
"""

FIELD_MARGIN = 0.1
"""Points up to this angle, radians, outside a pinhole's widest ray are still projected by the tangent of their angle.
Farther out, where tangents diverge, the distance from the image centre grows linearly with the angle."""

FIELD_MAX = 1.56
"""Angle from the optical axis, radians, beyond which points are never projected by the tangent of their angle."""

CENTER = (0.5, 0.5)
"""Position of a pixel's centre within the pixel."""

_MODELS = {
    CameraModel.PINHOLE: PINHOLE,
    CameraModel.FISHEYE: FISHEYE,
    CameraModel.ORTHOGRAPHIC: ORTHOGRAPHIC,
}


def check_camera(camera: object) -> None:
    """Raises SceneError unless the argument is a Camera with few enough pixels for 32-bit indices."""
    if not isinstance(camera, Camera):
        raise SceneError(f"expected a Camera, got {type(camera).__name__}: ls.Camera.look_at(eye, target) makes one")
    width, height = camera.image_size
    if width * height > IMAGE_PIXELS_MAX:
        raise SceneError(
            f"an image of {width} x {height} is too large: at most {IMAGE_PIXELS_MAX:,} pixels; render larger "
            "images in windows (Camera.window, lumisplat render --tiles)"
        )
    if camera.width * camera.height > FULL_IMAGE_PIXELS_MAX:
        raise SceneError(
            f"a full image of {camera.width} x {camera.height} is too large: at most {FULL_IMAGE_PIXELS_MAX:,} pixels"
        )


def refuse_window(camera: Camera, what: str) -> None:
    """Raises SceneError if the camera renders only a window; ``what`` names the feature that needs the full image."""
    if camera.window is not None:
        raise SceneError(f"{what} need the whole image: use a camera without a window")


def refuse_lens(camera: Camera, pipeline: Pipeline, projection: Projection = Projection.EWA) -> None:
    """Raises SceneError for a camera that the rasteriser cannot draw.

    The rasteriser needs a pinhole without aperture or rolling shutter. With ``Projection.UNSCENTED``, it can draw any
    perspective or fisheye lens without aperture, also with a rolling shutter.
    """
    problem, remedy = None, ""
    if not pipeline.is_sequence:
        remedy = "Projection.UNSCENTED or "
    if camera.model is CameraModel.ORTHOGRAPHIC or camera.aperture > 0.0:
        sharp = f"is {camera.model.value}" if camera.aperture == 0.0 else f"has an aperture of {camera.aperture:g}"
        problem, remedy = sharp, ""
    elif projection is Projection.UNSCENTED:
        return
    elif camera.model is not CameraModel.PINHOLE:
        problem = f"is {camera.model.value}"
    elif camera.camera_from_world_end is not None:
        problem = "has a rolling shutter"
    if problem:
        name = f" '{camera.name}'" if camera.name else ""
        others = "PATH" if pipeline.is_sequence else "TRACE"
        raise SceneError(
            f"camera{name} {problem}, which Pipeline.{pipeline.name} cannot draw: use {remedy}Pipeline.{others}"
        )


def camera_table(camera: Camera, offset: tuple[float, float] = CENTER) -> np.ndarray:
    """Returns the camera as a table with one CameraData row, for kernels.

    Args:
        camera: The camera.
        offset: Position of the sample within each pixel, 0..1.
    """
    row = table = np.zeros(1, dtype=table_dtype(CameraData))
    size, focal = np.array([camera.width, camera.height]), np.array([camera.fx, camera.fy])
    center = np.array([camera.cx, camera.cy])
    raster_center = center + 0.5 - np.array(offset)
    margin = (JACOBIAN_CLAMP - 1.0) * 0.5 * size / focal
    rotation = camera.shutter_rotation
    angle = np.linalg.norm(rotation)
    row["world_from_camera"] = camera.world_from_camera[:3, :3]
    row["eye"] = camera.eye
    row["model"] = _MODELS[camera.model]
    row["focal"], row["center"] = focal, center
    row["offset"], row["raster_center"] = offset, raster_center
    row["jacobian_min"] = -raster_center / focal - margin
    row["jacobian_max"] = (size - raster_center) / focal + margin
    row["width"], row["height"] = camera.image_size
    row["left"], row["top"] = camera.image_corner
    row["full_width"], row["full_height"] = camera.width, camera.height
    row["tiles_x"], row["tiles_y"] = tile_grid(*camera.image_size)
    row["near"] = camera.near
    row["aperture"], row["focus_distance"] = camera.aperture, camera.focus_distance
    row["distorted"] = camera.is_distorted
    row["radial"], row["tangential"] = camera.distortion[:4], camera.distortion[4:]
    row["distortion_reach"] = distortion_reach(camera.distortion)
    row["shutter"] = camera.camera_from_world_end is not None
    row["rotation_axis"] = rotation / angle if angle > 0.0 else rotation
    row["rotation_angle"] = angle
    row["motion"] = camera.shutter_motion
    return table


def image_field(camera: Camera) -> float:
    """Returns the tangent of the largest angle from the optical axis at which sigma points are projected by tangents.

    The camera is a pinhole. The angle is that of the widest pixel's ray plus ``FIELD_MARGIN``, at most ``FIELD_MAX``.
    """
    x, y = np.meshgrid(np.linspace(0.0, camera.width, 33), np.linspace(0.0, camera.height, 33))
    shown = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy], axis=-1)
    radii = np.linalg.norm(undistort(shown.astype(np.float64), camera.distortion), axis=-1)
    widest = np.nanmax(radii, initial=0.0) if not np.isnan(radii).any() else distortion_reach(camera.distortion)
    return float(np.tan(np.clip(np.arctan(widest) + FIELD_MARGIN, 0.0, FIELD_MAX)))


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Returns the number of rasteriser tiles across and down an image."""
    return -(-width // TILE_PX), -(-height // TILE_PX)


def subpixel(sample: int) -> tuple[float, float]:
    """Returns a sample's position within its pixel, 0..1: the centre first, then the R2 sequence (Roberts 2018)."""
    x, y = SUBPIXEL_STEPS
    return (0.5 + sample * x) % 1.0, (0.5 + sample * y) % 1.0
