"""Surface terms of the loss keep the quality of scenes with cameras inside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lumisplat as ls
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TargetPixels, TrainingView
from support.scenes import known_surfaces

SIZE = 32, 24
HALF = np.array([2.0, 1.2, 1.6])
"""Half of the sides of a box whose walls have a texture."""
CONFIG = ls.TrainConfig(iterations=400, cap=1000, initial=800, sh_degree=0)
RELIGHTABLE = {"flatness": 0.3, "normals": 0.05, "depth_spread": 0.3}


def camera(number: float) -> ls.Camera:
    """Returns a camera near a wall that looks across the box."""
    angle = 2.399963 * number
    eye = 0.8 * HALF * (np.cos(angle), np.sin(5.0 * number), np.sin(angle))
    at = -0.6 * HALF * (np.cos(angle + 0.5), np.sin(3.0 * number), np.sin(angle + 0.5))
    return ls.Camera.look_at(eye, at, (0.0, -1.0, 0.0), width=SIZE[0], height=SIZE[1], fov_y=1.0)


def image(by: ls.Camera) -> TargetPixels:
    """Returns the image of the box's walls from a camera, as the mean of four rays per pixel."""
    rays = by.scaled(2 * by.width, 2 * by.height).ray_directions() @ by.camera_from_world[:3, :3]
    away = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    distance = ((np.sign(away) * HALF - by.eye) / away).min(axis=-1)
    colors = known_surfaces.texture((by.eye + distance[..., None] * rays) / 2.0)
    return TargetPixels(colors.reshape(by.height, 2, by.width, 2, 3).mean(axis=(1, 3)).astype(np.float32))


def held_out_psnr(config: ls.TrainConfig) -> float:
    """Returns the PSNR of eight held-out views, dB."""
    views = [TrainingView(str(k), camera(k), lambda k=k: image(camera(k))) for k in range(32)]
    trainer = Trainer(views, config, device="cpu")
    for _ in range(config.iterations):
        trainer.step()
    scene, renderer = ls.Scene([trainer.gaussians()]), ls.DifferentiableRenderer(device="cpu")
    others = [camera(k + 0.5) for k in range(0, 32, 4)]
    shown = [np.clip(renderer.render(scene, by).color, 0.0, 1.0) for by in others]
    return float(np.mean([ls.metrics.psnr(one, image(by).color) for one, by in zip(shown, others, strict=True)]))


def test_surface_loss_terms_lower_the_psnr_of_a_room_by_less_than_1_db() -> None:
    """The depth term must not create a thin layer of Gaussians in front of each camera."""
    plain, flat = held_out_psnr(CONFIG), held_out_psnr(replace(CONFIG, **RELIGHTABLE))
    assert flat > plain - 1.0, (plain, flat)
