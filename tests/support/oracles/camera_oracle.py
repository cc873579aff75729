"""Computes camera rays in float64 NumPy from the definitions of the models, as an oracle for the device's cameras."""

from __future__ import annotations

import numpy as np

from lumisplat.scene.camera import Camera, CameraModel
from support.oracles import random_oracle


def camera_rays(
    camera: Camera, sample: int = 0, seed: int = 0, jitter: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns origins (H, W, 3), unit directions (H, W, 3) and near distances (H, W); NaN where a pixel has no ray."""
    y, x = np.mgrid[: camera.height, : camera.width]
    step = sample * np.array([0.7548776662466927, 0.5698402909980532]) if jitter else np.zeros(2)
    offset_x, offset_y = (0.5 + step) % 1.0
    u, v = (x + offset_x - camera.cx) / camera.fx, (y + offset_y - camera.cy) / camera.fy
    start, axis = np.zeros((*x.shape, 3)), np.broadcast_to((0.0, 0.0, 1.0), (*x.shape, 3))
    theta, azimuth = np.hypot(u, v), np.arctan2(v, u)
    if camera.model is CameraModel.PINHOLE:
        center = unit(np.stack([u, v, np.ones_like(u)], axis=-1))
    elif camera.model is CameraModel.ORTHOGRAPHIC:
        start, center = np.stack([u, v, np.zeros_like(u)], axis=-1), axis
    else:
        radial = [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)]
        center = np.stack(radial, axis=-1)
        center[theta > np.pi] = np.nan

    radius, turn = camera.aperture * np.sqrt(lens_draw(camera, sample, seed, 0)), lens_draw(camera, sample, seed, 1)
    disk = np.stack([radius * np.cos(2.0 * np.pi * turn), radius * np.sin(2.0 * np.pi * turn)], axis=-1)
    if camera.model is CameraModel.FISHEYE:
        sideways = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(u)], axis=-1)
        shift = disk[..., :1] * sideways + disk[..., 1:] * np.cross(center, sideways)
        focus = camera.focus_distance * center
    else:
        shift = np.concatenate([disk, np.zeros_like(disk[..., :1])], axis=-1)
        focus = start + center * camera.focus_distance / center[..., 2:]
    origin = start + shift
    direction = unit(focus - origin) if camera.aperture else center
    near = camera.near / (1.0 if camera.model is CameraModel.FISHEYE else direction[..., 2])

    poses = np.stack([world_from_row(camera, row) for row in range(camera.height)])
    turned = np.einsum("yij,yxj->yxi", poses[:, :3, :3], direction)
    return (
        np.einsum("yij,yxj->yxi", poses[:, :3, :3], origin) + poses[:, None, :3, 3],
        turned,
        near + 0.0 * center[..., 2],
    )


def world_from_row(camera: Camera, row: float) -> np.ndarray:
    """Returns the pose at which a row is exposed; rotations interpolate as powers of the relative rotation."""
    first = np.linalg.inv(camera.camera_from_world)
    last = first if camera.camera_from_world_end is None else np.linalg.inv(camera.camera_from_world_end)
    time = (row + 0.5) / camera.height
    values, vectors = np.linalg.eig(last[:3, :3] @ first[:3, :3].T)
    part = (vectors * np.exp(time * np.log(values.astype(complex)))) @ np.linalg.inv(vectors)
    pose = np.eye(4)
    pose[:3, :3] = part.real @ first[:3, :3]
    pose[:3, 3] = (1.0 - time) * first[:3, 3] + time * last[:3, 3]
    return pose


def lens_draw(camera: Camera, sample: int, seed: int, which: int) -> np.ndarray:
    """Returns the random numbers that choose lens points, (H, W): ``which`` 0 for the radius, 1 for the angle."""
    pixels = np.arange(camera.height * camera.width).reshape(camera.height, camera.width)
    dimension = (random_oracle.LENS_RADIUS, random_oracle.LENS_ANGLE)[which]
    return random_oracle.draws(random_oracle.sample_keys(pixels, sample, seed), dimension)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Returns vectors scaled to length 1 along the last axis."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
