"""Writes small sets in the layouts of published relighting benchmarks, rendered from a capture with known materials."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import lumisplat as ls
from lumisplat.io.images.exr import write_exr
from lumisplat.io.images.radiance import write_radiance
from lumisplat.io.images.texture import write_png
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.directions import panorama_directions
from lumisplat.relighting.evaluation import LayerRenderer, relit_scene
from support.files.relightable_files import SIZE, cameras

RELIT = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=16, jitter=False)
ANGLE = 0.6
"""Field of view of the cameras, radians."""


def radiance(directions: np.ndarray, name: str) -> np.ndarray:
    """Returns a radiance that differs in all directions and between names, shape (..., 3)."""
    x, y, z = np.moveaxis(directions, -1, 0)
    tilt = 0.05 * (sum(map(ord, name)) % 7)
    return np.stack([0.6 + 0.3 * x, 0.6 + 0.3 * y, 0.5 + 0.3 * z + tilt * x], axis=-1)


def blender_panorama(name: str) -> np.ndarray:
    """Returns the radiance as an image as Blender maps it: z up, +x in the middle column, +y a quarter to its left."""
    rows, columns = 64, 128
    height = np.pi / 2.0 - (np.arange(rows)[:, None] + 0.5) * np.pi / rows
    turn = np.pi - (np.arange(columns)[None] + 0.5) * 2.0 * np.pi / columns
    directions = [np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height) + 0.0 * turn]
    return radiance(np.stack(directions, axis=-1), name)


class Truth:
    """Renders a capture's views as the benchmarks store them: by its own materials, in given light.

    Args:
        gaussians: The capture.
    """

    def __init__(self, gaussians: ls.Gaussians) -> None:
        self._gaussians = gaussians
        self._layers = LayerRenderer.of(gaussians, "cpu")
        self._unlit = ls.create_renderer(ls.RenderConfig(background=None), "cpu")
        self._relit = ls.create_renderer(replace(RELIT, background=None), "cpu")

    def novel(self, camera: ls.Camera) -> np.ndarray:
        """Returns the captured look, straight RGBA, (H, W, 4)."""
        return self._unlit.render(ls.Scene(splats=[self._gaussians]), camera).pixels_srgb()

    def layers(self, camera: ls.Camera) -> dict[str, np.ndarray]:
        """Returns linear albedo, normals and roughness."""
        return self._layers.draw(camera)

    def relit(self, camera: ls.Camera, name: str) -> ls.Frame:
        """Returns a frame in the light of a name, in world axes."""
        light = ls.LightEnvironment(radiance(panorama_directions(64, 128), name).astype(np.float32), visible=False)
        return self._relit.render(relit_scene(self._gaussians, (light,), (1.0, 1.0, 1.0), 1.0), camera)


def pose(camera: ls.Camera) -> np.ndarray:
    """Returns ``world_from_camera`` in OpenGL's axes, (4, 4)."""
    return camera.world_from_camera * (1.0, -1.0, -1.0, 1.0)


def with_alpha(color: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Returns RGBA of straight colours."""
    return np.concatenate([np.clip(color, 0.0, 1.0), alpha], axis=2)


def write_tensoir(folder: Path, gaussians: ls.Gaussians, lights: Path) -> Path:
    """Writes an object of TensoIR-Synthetic: two training views, two test views. Returns the folder."""
    truth = Truth(gaussians)
    lights.mkdir(parents=True, exist_ok=True)
    names = ("bridge", "city", "fireplace", "forest", "night")
    for name in names:
        write_radiance(lights / f"{name}.exr", blender_panorama(name).astype(np.float32))
        (lights / f"{name}.exr").rename(lights / f"{name}.hdr")  # files are told by their content
    for number, camera in enumerate(cameras()):
        split = f"{'train' if number < 2 else 'test'}_{number % 2:03}"
        place = folder / split
        place.mkdir(parents=True)
        matrix = ",".join(str(value) for value in pose(camera).ravel())
        place.joinpath("metadata.json").write_text(
            json.dumps({"imw": SIZE, "imh": SIZE, "cam_angle_x": ANGLE, "cam_transform_mat": matrix})
        )
        novel, layers = truth.novel(camera), truth.layers(camera)
        write_png(place / ("rgba_sunset_000.png" if number < 2 else "rgba_sunset.png"), novel)
        alpha = novel[..., 3:]
        write_png(place / "albedo.png", with_alpha(layers["albedo"], alpha))
        write_png(place / "normal.png", with_alpha(0.5 + 0.5 * layers["normal"], alpha))
        for name in names if number >= 2 else ():
            frame = truth.relit(camera, name)
            write_png(place / f"rgba_{name}.png", with_alpha(encode_srgb(frame.straight()), alpha))
    return folder


def write_transforms(path: Path, entries: list[tuple[str, ls.Camera]], **more: Callable[[int], object]) -> None:
    """Writes a transforms.json of images with their cameras; ``more`` gives further values of each frame."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = [
        {"file_path": name, "transform_matrix": pose(camera).tolist()} | {key: of(k) for key, of in more.items()}
        for k, (name, camera) in enumerate(entries)
    ]
    path.write_text(json.dumps({"camera_angle_x": ANGLE, "frames": frames}))


def write_synthetic4relight(folder: Path, gaussians: ls.Gaussians, lights: Path) -> Path:
    """Writes an object of Synthetic4Relight: two training views, two test views. Returns the folder."""
    truth, posed = Truth(gaussians), cameras()
    lights.mkdir(parents=True, exist_ok=True)
    for name in ("envmap6", "envmap12"):
        write_radiance(lights / f"{name}.exr", blender_panorama(name).astype(np.float32))
    for split, views in (("train", posed[:2]), ("test", posed[2:])):
        write_transforms(folder / f"transforms_{split}.json", [(f"./{split}/{k:03}", c) for k, c in enumerate(views)])
        for part in (split, "test_rli"):
            (folder / part).mkdir(exist_ok=True)
        for k, camera in enumerate(views):
            novel, layers = truth.novel(camera), truth.layers(camera)
            alpha = novel[..., 3:]
            write_png(folder / split / f"{k:03}.png", novel)
            if split == "train":
                continue
            write_png(folder / split / f"{k:03}_albedo.png", with_alpha(layers["albedo"], alpha))
            rough = np.repeat(layers["roughness"], 3, axis=2)
            write_png(folder / split / f"{k:03}_rough.png", with_alpha(rough, alpha))
            for name in ("envmap6", "envmap12"):
                frame = truth.relit(camera, name)
                image = with_alpha(encode_srgb(frame.straight()), alpha)
                write_png(folder / "test_rli" / f"{name}_{k:03}.png", image)
    return folder


def camera_panorama(camera: ls.Camera, name: str) -> np.ndarray:
    """Returns the radiance in the axes of a camera: -z, its view, in the middle, +x to the right, y up."""
    seen = panorama_directions(64, 128)
    return radiance(seen @ pose(camera)[:3, :3].T, name)


def write_orb(root: Path, gaussians: ls.Gaussians) -> Path:
    """Writes an object of Stanford-ORB in its place, and the same object in two other places.

    Returns the folder of the first.
    """
    truth, posed = Truth(gaussians), cameras()
    hdr, ground = root / "blender_HDR", root / "ground_truth"
    scenes = ("ball_scene001", "ball_scene002", "ball_scene003")
    for scene in scenes:
        for split, views in (("train", posed[:2]), ("test", posed[2:])):
            write_transforms(
                hdr / scene / f"transforms_{split}.json", [(f"{split}/{k:04}", c) for k, c in enumerate(views)]
            )
            for part in (split, f"{split}_mask"):
                (hdr / scene / part).mkdir(exist_ok=True)
            for k, camera in enumerate(views):
                novel, frame = truth.novel(camera), truth.relit(camera, scene)
                mask = (novel[..., 3:] > 0.5).astype(np.float32)
                write_png(hdr / scene / f"{split}_mask" / f"{k:04}.png", np.repeat(mask, 3, axis=2))
                linear = (
                    frame.premultiplied()
                    if scene != scenes[0]
                    else decode_srgb(novel[..., :3] * novel[..., 3:]).astype(np.float32)
                )
                write_exr(hdr / scene / split / f"{k:04}.exr", {name: linear[..., i] for i, name in enumerate("RGB")})
                if split == "train":
                    continue
                layers = truth.layers(camera)
                for part in ("env_map", "surface_normal", "pseudo_gt_albedo"):
                    (ground / scene / part).mkdir(parents=True, exist_ok=True)
                write_radiance(
                    ground / scene / "env_map" / f"{k:04}.exr", camera_panorama(camera, scene).astype(np.float32)
                )
                turned = layers["normal"] @ pose(camera)[:3, :3]
                np.save(ground / scene / "surface_normal" / f"{k:04}.npy", turned)
                write_png(
                    ground / scene / "pseudo_gt_albedo" / f"{k:04}.png", np.clip(encode_srgb(layers["albedo"]), 0, 1)
                )
    novel = [(f"test/{k:04}", camera) for _ in scenes[1:] for k, camera in enumerate(posed[2:])]
    write_transforms(
        hdr / scenes[0] / "transforms_novel.json",
        novel,
        scene_name=lambda k: scenes[1 + k // 2],
        camera_angle_x=lambda k: ANGLE,
    )
    return hdr / scenes[0]
