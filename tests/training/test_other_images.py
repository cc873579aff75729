"""A training does not resume with images other than its own."""

from __future__ import annotations

import json
import os
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from support.files.training_image_files import ring_cameras, write_nerfstudio_images

BEFORE = (-0.1, 0.0, 0.0, 0.0, 0.0, 0.0)
CONFIG = ls.TrainConfig(iterations=1, cap=60, initial=60, sh_degree=0)


def changed_cameras(camera: ls.Camera) -> dict[str, Any]:
    """Returns cameras with another value for one field each."""
    turned = np.diag((1.0, -1.0, -1.0, 1.0)) @ camera.camera_from_world
    return {
        "width": camera.width + 1,
        "height": camera.height + 1,
        **{name: getattr(camera, name) * 1.01 for name in ("fx", "fy", "cx", "cy", "near", "focus_distance")},
        "camera_from_world": turned,
        "camera_from_world_end": camera.camera_from_world,
        "name": "another",
        "model": ls.CameraModel.FISHEYE,
        "aperture": 0.01,
        "distortion": (0.0, 0.0, 0.0, 0.0, 0.0, 1e-9),
        "exposure": 0.5,
        "window": (0, 0, 16, 16),
    }


@pytest.mark.parametrize("lens", [{}, {"projection": ls.config.Projection.UNSCENTED}], ids=["undistorted", "distorted"])
def test_resuming_a_training_with_another_lens_is_refused(lens: dict[str, Any], tmp_path: Path) -> None:
    """Another distortion is refused, even if the images are undistorted to the same pinhole camera."""
    folder = write_nerfstudio_images(tmp_path / "set", ring_cameras(3, distortion=BEFORE))
    config = replace(CONFIG, **lens)
    ls.train(folder, config, output=tmp_path / "a.ply", device="cpu")
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["k1"] = 0.3
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(
        ls.FormatError,
        match=r"npz: was trained with other images, another hold-out or another background: use",
    ):
        ls.train(folder, config, output=tmp_path / "a.ply", device="cpu")


def test_fingerprint_of_training_images_depends_on_every_camera_field(tmp_path: Path) -> None:
    """The test changes one field at a time."""
    folder = write_nerfstudio_images(tmp_path, ring_cameras(3))
    images = ls.io.load_training_images(folder)
    one = images.training[0]
    changes = changed_cameras(one.camera)
    assert set(changes) == {field.name for field in fields(ls.Camera)}
    for name, value in changes.items():
        other = replace(one, camera=replace(one.camera, **{name: value}))
        assert replace(images, training=(other, *images.training[1:])).fingerprint != images.fingerprint
    assert ls.io.load_training_images(folder).fingerprint == images.fingerprint


def test_resuming_with_other_images_of_equal_names_and_sizes_is_refused(tmp_path: Path) -> None:
    """File times do not matter; with the original images the training resumes."""
    folder, output = write_nerfstudio_images(tmp_path / "set", ring_cameras(3)), tmp_path / "a.ply"
    image = folder / "images" / "view_1.png"
    Image.fromarray(np.full((30, 40, 3), 90, np.uint8)).save(image, compress_level=0)
    ls.train(folder, CONFIG, output=output, device="cpu")
    before, status = image.read_bytes(), image.stat()
    Image.fromarray(np.full((30, 40, 3), 91, np.uint8)).save(image, compress_level=0)
    os.utime(image, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert image.stat().st_size == len(before)
    with pytest.raises(ls.FormatError, match=r"npz: was trained with other images"):
        ls.train(folder, CONFIG, output=output, device="cpu")
    image.write_bytes(before)
    os.utime(image, ns=(0, 0))
    ls.train(folder, CONFIG, output=output, device="cpu")


def test_fingerprint_of_training_images_depends_on_masks_and_point_colours(tmp_path: Path) -> None:
    """Changed mask files of equal size change the fingerprint as well."""
    folder = write_nerfstudio_images(tmp_path, ring_cameras(3))
    found = [ls.io.load_training_images(folder).fingerprint]
    (folder / "masks").mkdir()
    for column in (3, 9):
        mask = np.full((30, 40), 255, np.uint8)
        mask[:, column] = 0
        Image.fromarray(mask).save(folder / "masks" / "view_1.png", compress_level=0)
        found.append(ls.io.load_training_images(folder).fingerprint)
    colored = replace(ls.io.load_training_images(folder), points=np.zeros((2, 3), np.float32))
    for shade in (0.0, 1.0):
        found.append(replace(colored, point_colors=np.full((2, 3), shade, np.float32)).fingerprint)
    assert len(set(found)) == 5


def test_fingerprint_error_names_a_missing_training_image(tmp_path: Path) -> None:
    """The error names the file."""
    images = ls.io.load_training_images(write_nerfstudio_images(tmp_path, ring_cameras(3)))
    images.training[1].path.unlink()
    with pytest.raises(ls.FormatError, match=r"view_2\.png: cannot be read: No such file"):
        _ = images.fingerprint
