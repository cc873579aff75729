"""Finds the files of published relighting benchmarks in the folders that their authors distribute.

TensoIR-Synthetic (Jin et al. 2023), Synthetic4Relight (Zhang et al. 2022), Stanford-ORB (Kuang et al. 2023) and
NeRF-Synthetic (Mildenhall et al. 2020). docs/guide/published_sets.md lists the files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from lumisplat.errors import FormatError, MissingFileError
from lumisplat.frame.frame_data import unpremultiplied
from lumisplat.io.cameras.json_cameras import (
    decode_frame,
    frame_image,
    is_list,
    is_object,
    parse_json,
    transforms_camera,
    write_transforms,
)
from lumisplat.io.files.source import parsing, referenced_file
from lumisplat.io.images.radiance import read_radiance
from lumisplat.io.images.texture import image_size, read_texture, write_png
from lumisplat.io.training_images.listing import view_folder_images
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.resampling import area_mean
from lumisplat.math.transforms import quaternions_from_matrices
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import LightEnvironment

TENSOIR_LIGHTS = ("bridge", "city", "fireplace", "forest", "night")
"""Environments in which TensoIR's objects are relit."""
SYNTHETIC4RELIGHT_LIGHTS = ("envmap6", "envmap12")
"""Environments in which the objects of Synthetic4Relight are relit; training images show ``envmap3``."""
ORB_SIZE = 512
"""Width and height, pixels, at which Stanford-ORB compares images; its files have 2048."""

Z_UP = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""World-from-environment rotation of panoramas as Blender has them: z up, and +x in the middle column."""


@dataclass(frozen=True, slots=True)
class TestView:
    """A view in the light of the training images, with its ground truth."""

    camera: Camera
    """Camera of the image, named after it."""
    image: Path
    layers: Mapping[str, Path] = field(default_factory=dict[str, Path])
    """Files of ground truth: any of ``albedo``, ``normal`` and ``roughness``."""
    mask: Path | None = None
    """White where the object is; None: the alpha of the image tells."""


@dataclass(frozen=True, slots=True)
class RelitView:
    """A view under a light that no training image shows."""

    light: str
    """Name of the light or scene, by which figures are grouped."""
    camera: Camera
    image: Path
    environment: Path
    """Panorama of the light."""
    world_from_environment: Doubles
    """Rotation of the panorama, shape (3, 3), in the axes of `LightEnvironment`."""
    mask: Path | None = None

    def lights(self) -> LightEnvironment:
        """Reads the environment.

        Raises:
            FormatError: The file is missing or damaged.
        """
        rotation = quaternions_from_matrices(self.world_from_environment[None])[0]
        return LightEnvironment(
            read_radiance(existing(self.environment)),
            rotation_wxyz=cast("tuple[float, float, float, float]", tuple(rotation.tolist())),
            visible=False,
        )


@dataclass(frozen=True, slots=True)
class PublishedSet:
    """One object of a published benchmark."""

    views: tuple[TestView, ...]
    relit: tuple[RelitView, ...]


def existing(path: Path) -> Path:
    """Returns the path of a file that the set must have.

    Raises:
        MissingFileError: There is no such file.
    """
    if not path.is_file():
        raise MissingFileError(path, "no such file: the published set has it")
    return path


def open_tensoir(folder: Path, lights: Path | None) -> PublishedSet:
    """Finds the test views of an object of TensoIR-Synthetic.

    Args:
        folder: Folder of the object, with ``train_000``, ``test_000``, ...
        lights: Folder with ``bridge.hdr`` and the other environments; None: nothing is relit.

    Raises:
        FormatError: The folder has no test views, or one of their files is missing or damaged.
    """
    views: list[TestView] = []
    relit: list[RelitView] = []
    for one in view_folder_images(folder, "test"):
        place = one.image.parent
        layers = {name: existing(place / f"{name}.png") for name in ("albedo", "normal")}
        views.append(TestView(one.camera, one.image, layers))
        for name in TENSOIR_LIGHTS if lights is not None else ():
            assert lights is not None
            image = existing(place / f"rgba_{name}.png")
            relit.append(RelitView(name, one.camera, image, existing(lights / f"{name}.hdr"), Z_UP))
    return PublishedSet(tuple(views), tuple(relit))


def open_synthetic4relight(folder: Path, lights: Path | None) -> PublishedSet:
    """Finds the test views of an object of Synthetic4Relight.

    Args:
        folder: Folder of the object, with ``transforms_test.json``, ``test`` and ``test_rli``.
        lights: Folder with ``envmap6.exr`` and ``envmap12.exr``; None: nothing is relit.

    Raises:
        FormatError: A file is missing or damaged.
    """
    views: list[TestView] = []
    relit: list[RelitView] = []
    for camera, image, _ in transforms_views(folder / "transforms_test.json"):
        stem = image.stem
        layers = {
            name: existing(image.with_name(f"{stem}_{ending}.png"))
            for name, ending in (("albedo", "albedo"), ("roughness", "rough"))
        }
        views.append(TestView(camera, image, layers))
        for name in SYNTHETIC4RELIGHT_LIGHTS if lights is not None else ():
            assert lights is not None
            target = existing(folder / "test_rli" / f"{name}_{stem}.png")
            relit.append(RelitView(name, camera, target, existing(lights / f"{name}.exr"), Z_UP))
    return PublishedSet(tuple(views), tuple(relit))


def open_nerf_synthetic(folder: Path, lights: Path | None) -> PublishedSet:
    """Finds the test views of an object of NeRF-Synthetic, which has neither materials nor other light.

    Raises:
        FormatError: A file is missing or damaged, or ``lights`` are given.
    """
    if lights is not None:
        raise FormatError(folder, "is evaluated without other light: NeRF-Synthetic has no relit images")
    listed = transforms_views(folder / "transforms_test.json")
    return PublishedSet(tuple(TestView(camera, image) for camera, image, _ in listed), ())


def open_orb(folder: Path, lights: Path | None) -> PublishedSet:
    """Finds the test views of a scene of Stanford-ORB, and those of the same object in other places.

    Args:
        folder: Folder ``blender_HDR/OBJECT_scene00x``.
        lights: Folder ``ground_truth``; None: the one beside ``blender_HDR``.

    Raises:
        FormatError: A file is missing or damaged.
    """
    truth = folder.parent.parent / "ground_truth" if lights is None else lights
    views: list[TestView] = []
    for camera, image, _ in transforms_views(folder / "transforms_test.json"):
        layers = {
            name: path
            for name, path in (
                ("normal", truth / folder.name / "surface_normal" / f"{image.stem}.npy"),
                ("albedo", truth / folder.name / "pseudo_gt_albedo" / f"{image.stem}.png"),
            )
            if path.is_file()
        }
        views.append(TestView(camera, image, layers, _orb_mask(image)))
    relit: list[RelitView] = []
    for camera, image, values in transforms_views(folder / "transforms_novel.json", _orb_scene):
        scene = str(values["scene_name"])
        light = existing(truth / scene / "env_map" / f"{image.stem}.exr")
        # The panorama has the axes of the camera, x right, y up and -z forward.
        turn = camera.world_from_camera[:3, :3] * (1.0, -1.0, -1.0)
        relit.append(RelitView(scene, camera, image, light, turn, _orb_mask(image)))
    return PublishedSet(tuple(views), tuple(relit))


def write_orb_images(folder: Path, output: Path) -> Path:
    """Writes the training images of Stanford-ORB as sRGB with alpha, 512 pixels high, from HDR images and masks.

    Args:
        folder: Folder ``blender_HDR/OBJECT_scene00x``.
        output: Folder to write into; created if missing.

    Returns:
        The folder, with ``transforms_train.json`` and ``train``.

    Raises:
        FormatError: A file is missing or damaged.
    """
    (output / "train").mkdir(parents=True, exist_ok=True)
    cameras: list[Camera] = []
    for camera, image, _ in transforms_views(folder / "transforms_train.json"):
        color = read_radiance(image) if image.suffix == ".exr" else decode_srgb(unit_texels(image)[..., :3])
        alpha = unit_texels(_orb_mask(image))[..., :1]
        pixels = np.concatenate([color * alpha, alpha], axis=2).astype(np.float32)
        size = min(len(pixels), ORB_SIZE)
        pixels = area_mean(pixels, size, size)
        shown = np.clip(encode_srgb(unpremultiplied(pixels[..., :3], pixels[..., 3])), 0.0, 1.0)
        write_png(output / "train" / f"{image.stem}.png", np.concatenate([shown, pixels[..., 3:]], axis=2))
        cameras.append(replace(camera.scaled(size, size), name=f"train/{image.stem}"))
    write_transforms(output / "transforms_train.json", cameras)
    return output


def unit_texels(path: Path) -> FloatArray:
    """Reads an image of 8 bits as values in 0..1, as they are stored, shape (H, W, C)."""
    return read_texture(path).astype(np.float32) / np.float32(255.0)


def _orb_scene(file: Path, frame: Mapping[str, Any]) -> Path:
    scene = str(frame.get("scene_name", file.parent.name))
    if Path(scene).name != scene:
        raise FormatError(file, f"has the scene_name {scene!r}, expected the name of a folder beside its own")
    return file.parent.parent / scene


def _orb_mask(image: Path) -> Path:
    return existing(image.parent.with_name(image.parent.name + "_mask") / f"{image.stem}.png")


def _own_folder(file: Path, _: Mapping[str, Any]) -> Path:
    return file.parent


def transforms_views(
    file: Path, folder_of: Callable[[Path, Mapping[str, Any]], Path] = _own_folder
) -> list[tuple[Camera, Path, Mapping[str, Any]]]:
    """Returns camera, image and values of each frame of a ``transforms.json``; images may be EXR files with masks.

    Args:
        file: The file.
        folder_of: Returns the folder of a frame's image, from the file and the frame's values.

    Raises:
        FormatError: The file is malformed, or an image is missing.
        MissingFileError: There is no such file.
    """
    with parsing(existing(file), "a transforms.json of images"):
        content = parse_json(file)
    frames = content.get("frames") if is_object(content) else None
    if not is_object(content) or not is_list(frames) or not frames:
        raise FormatError(file, "lists no images: expected 'frames', each with file_path and transform_matrix")
    found: list[tuple[Camera, Path, Mapping[str, Any]]] = []
    for index, frame in enumerate(frames):
        values = frame if is_object(frame) else {}
        folder = folder_of(file, values)
        stem = referenced_file(folder / file.name, str(values.get("file_path", "")))
        image = stem.with_name(f"{stem.name}.exr")
        if not image.is_file():
            image = frame_image(folder, values) or existing(stem.with_name(f"{stem.name}.png"))
        width, height = image_size(_orb_mask(image) if image.suffix == ".exr" else image)
        sized = {**values, "w": width, "h": height}
        camera = decode_frame(file, index, sized, partial(transforms_camera, file, content, None))
        found.append((camera, image, values))
    return found
