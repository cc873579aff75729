"""Writes a small data set with known materials and light, rendered from a capture (docs/guide/material_sets.md)."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

import lumisplat as ls
from lumisplat.io.images.exr import read_exr, write_exr
from lumisplat.io.images.texture import write_png
from lumisplat.math.directions import panorama_directions
from lumisplat.relighting.evaluation import LayerRenderer, over_black, relit_scene
from support.files.training_image_files import write_blender_images

SIZE, VIEWS = 32, 2
CHANNELS = {"albedo": "RGB", "normal": "XYZ", "roughness": "Y"}
CONFIG = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=4, jitter=False)
"""Render settings of relit images."""


def painted_ball() -> ls.Gaussians:
    """Returns a ball with varying albedo, roughness and normals, and captured colours that differ from the albedo."""
    ball = ls.gaussians_from_mesh(ls.sphere(1.0), 800, 3)
    x, y, z = ball.means.T
    albedo = np.clip(np.stack([0.4 + 0.2 * x, 0.5 + 0.3 * y, 0.3 + 0.1 * z], axis=1), 0.0, 1.0)
    look = {"albedo": albedo, "roughness": 0.5 + 0.3 * y, "normals": ball.means, "sh": 0.8 * ball.sh}
    return replace(ball, **look, antialiased=False)  # as captures are trained


def cameras() -> list[ls.Camera]:
    """Returns cameras around the ball."""
    eyes = [(4.0 * np.cos(a), 0.5, 4.0 * np.sin(a)) for a in np.arange(2 + VIEWS) * 1.3]
    return [ls.Camera.look_at(eye, (0, 0, 0), (0, 1, 0), width=SIZE, height=SIZE, fov_y=0.6) for eye in eyes]


def panorama(tilt: float = 0.0) -> np.ndarray:
    """Returns a panorama that differs in all directions."""
    x, y, z = np.moveaxis(panorama_directions(16, 32), -1, 0)
    return np.stack([0.6 + 0.3 * x, 0.6 + 0.3 * y, 0.5 + 0.3 * (z + tilt * x)], axis=-1)


def write_relightable_set(folder: Path, gaussians: ls.Gaussians) -> Path:
    """Writes renderings of a capture as a data set with the capture's materials as ground truth. Returns the folder."""
    names = [f"r_{index:03}" for index in range(2 + VIEWS)]
    posed = [replace(camera, name=name) for camera, name in zip(cameras(), names, strict=True)]
    write_blender_images(folder, {"train": posed[:2], "test": posed[2:]})
    for part in ("train", "test"):
        path = folder / f"transforms_{part}.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"camera_angle_x": 0.6}))
    write_radiance(folder / "environment.exr", panorama())
    write_radiance(folder / "relit" / "dusk.exr", panorama(0.5))
    (folder / "set.json").write_text(json.dumps({"specular": 0.5}))
    layers = LayerRenderer.of(gaussians, "cpu")
    dusk = ls.LightEnvironment(ls.io.load_radiance(folder / "relit" / "dusk.exr"), visible=False)
    scene = relit_scene(gaussians, (dusk,), (1.0, 1.0, 1.0), 0.5)
    relighter = ls.create_renderer(replace(CONFIG, background=None), "cpu")
    unlit = ls.create_renderer(ls.RenderConfig(background=None), "cpu")
    (folder / "relit" / "dusk").mkdir()
    for camera in posed[2:]:
        frame = unlit.render(ls.Scene(splats=[gaussians]), camera)
        write_png(folder / "test" / f"{camera.name}.png", frame.pixels_srgb())
        write_png(folder / "relit" / "dusk" / f"{camera.name}.png", over_black(relighter, scene, camera))
        for name, values in layers.draw(camera).items():
            write_layer(folder, name, camera.name, values)
    return folder


def write_layer(folder: Path, name: str, view: str, values: np.ndarray) -> None:
    """Writes a layer of a view's ground truth, (H, W, C)."""
    path = folder / "truth" / name / f"{view}.exr"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, {channel: values[..., i] for i, channel in enumerate(CHANNELS[name])} | {"A": values[..., 0]})


def read_layer(folder: Path, name: str, view: str) -> np.ndarray:
    """Reads a layer of a view's ground truth, (H, W, C)."""
    stored = read_exr(folder / "truth" / name / f"{view}.exr")
    return np.stack([stored[channel] for channel in CHANNELS[name]], axis=-1)


def write_radiance(path: Path, image: np.ndarray) -> None:
    """Writes a panorama of radiance as an EXR file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, {name: image[..., i] for i, name in enumerate("RGB")})
