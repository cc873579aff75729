"""Makes images of a textured ball over a textured disc by formula, so that trained surfaces have a ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import lumisplat as ls
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TargetPixels, TrainingView

SIZE = 96
VIEWS = 24
HELD_OUT = 6
BALL, DISC, FLOOR = 0.6, 1.3, 0.6
"""Radii of ball and disc, and distance of the disc below the centre of the ball; y points down."""
SUPERSAMPLED = 3
WAVES = np.array([[9, 4, -5], [-3, 11, 6], [5, -7, 10], [3, 2, 1], [1, -3, 2], [-2, 1, 3]], float)
FINE_WAVE = np.array([23.0, 19.0, -21.0])
CONFIG = ls.TrainConfig(iterations=1500, cap=3000, initial=1500, sh_degree=1)


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """Exact colour and geometry at the pixels of a camera."""

    color: np.ndarray
    is_hit: np.ndarray
    normal: np.ndarray
    """World-space normals that face the camera, shape (H, W, 3)."""
    depth: np.ndarray
    """View depth, shape (H, W)."""


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of a capture against the ground truth."""

    psnr: float
    normals: float
    """Mean angle between the blended shortest axes of the Gaussians and the true normal, degrees."""
    depth: float
    """Mean absolute error of depth in scene units."""


def camera(angle: float, height: float) -> ls.Camera:
    """Returns a camera that looks at the ball."""
    eye = (2.6 * np.cos(angle), -height, 2.6 * np.sin(angle))
    return ls.Camera.look_at(eye, (0.0, 0.1, 0.0), (0.0, -1.0, 0.0), width=SIZE, height=SIZE, fov_y=0.75)


def ground_truth(view: ls.Camera) -> GroundTruth:
    """Intersects the ray through each pixel centre with ball and disc; the nearer hit counts."""
    rays = view.ray_directions() @ view.camera_from_world[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along, square = rays @ view.eye, view.eye @ view.eye - BALL**2
    under = along**2 - square
    t = np.where(under > 0.0, -along - np.sqrt(np.maximum(under, 0.0)), np.inf)
    t = np.where(t > 0.0, t, np.inf)
    down = np.where(np.abs(rays[..., 1]) < 1e-9, 1e-9, rays[..., 1])
    t_floor = (FLOOR - view.eye[1]) / down
    floor = view.eye + t_floor[..., None] * rays
    is_floor = (t_floor > 0.0) & (np.hypot(floor[..., 0], floor[..., 2]) < DISC) & (t_floor < t)
    t = np.where(is_floor, t_floor, t)
    is_hit = np.isfinite(t)
    t = np.where(is_hit, t, 0.0)
    points = view.eye + t[..., None] * rays
    normal = np.where(is_floor[..., None], np.array([0.0, -1.0, 0.0]), points / BALL)
    depth = t * (rays @ view.camera_from_world[2, :3])
    return GroundTruth(np.where(is_hit[..., None], texture(points), 0.0), is_hit, normal, depth)


def texture(points: np.ndarray) -> np.ndarray:
    """Returns the colours of the texture at points, 0..1."""
    waves = 0.5 + 0.5 * np.sin(points @ WAVES.T)
    fine_waves = 0.5 + 0.5 * np.sin(points @ FINE_WAVE)
    return np.clip(0.5 * fine_waves[..., None] * waves[..., :3] + 0.25 * waves[..., 3:] + 0.1, 0.0, 1.0)


def target_pixels(view: ls.Camera) -> TargetPixels:
    """Returns colour and alpha, averaged over the area of each pixel."""
    fine = ground_truth(view.scaled(SUPERSAMPLED * view.width, SUPERSAMPLED * view.height))
    layers = np.dstack([fine.color, fine.is_hit])
    tiles = layers.reshape(view.height, SUPERSAMPLED, view.width, SUPERSAMPLED, 4).mean(axis=(1, 3)).astype(np.float32)
    return TargetPixels(np.ascontiguousarray(tiles[..., :3]), None, np.ascontiguousarray(tiles[..., 3]))


def views() -> list[TrainingView]:
    """Returns the training views, at golden angles around the ball and at varying heights."""
    views_found: list[TrainingView] = []
    for number in range(VIEWS):
        view = camera(2.399963 * number, 0.4 + (0.618034 * number) % 1.0)
        pixels = target_pixels(view)
        views_found.append(TrainingView(f"{number:02d}", view, lambda pixels=pixels: pixels))
    return views_found


def held_out() -> list[ls.Camera]:
    """Returns the cameras of the held-out views."""
    return [camera(1.1 * k + 0.4, 0.45 + 0.17 * k) for k in range(HELD_OUT)]


def fitted(config: ls.TrainConfig, device: str = "cpu") -> ls.Gaussians:
    """Trains Gaussians on the training views."""
    one = Trainer(views(), config, device=device)
    for _ in range(config.iterations):
        one.step()
    return one.gaussians()


def score(gaussians: ls.Gaussians, device: str = "cpu") -> Score:
    """Evaluates on the held-out views; normals and depth count where truth and capture are opaque."""
    renderer, scene = ls.DifferentiableRenderer(device=device), ls.Scene([gaussians])
    psnr: list[float] = []
    angles: list[np.ndarray] = []
    depths: list[np.ndarray] = []
    for view in held_out():
        wanted, truth, frame = target_pixels(view), ground_truth(view), renderer.render(scene, view)
        psnr.append(ls.metrics.psnr(np.clip(frame.color, 0.0, 1.0), wanted.color))
        features = renderer.render_features(ls.gradients.SurfaceFeatures.of(scene, view).values)
        is_inside = truth.is_hit & (np.asarray(wanted.alpha) > 0.999) & (frame.alpha > 0.5)
        normals = features[..., 1:] / np.maximum(np.linalg.norm(features[..., 1:], axis=-1, keepdims=True), 1e-9)
        cosines = np.clip(np.sum(normals * truth.normal, axis=-1), -1.0, 1.0)
        angles.append(np.degrees(np.arccos(cosines))[is_inside])
        depths.append(np.abs(features[..., 0] / np.maximum(frame.alpha, 0.5) - truth.depth)[is_inside])
    return Score(float(np.mean(psnr)), *(float(np.concatenate(one).mean()) for one in (angles, depths)))
