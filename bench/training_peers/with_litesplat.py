"""litesplat 0.1.1 (Keras on PyTorch), trained as its own script does: MSE, Adam at 0.01, order renewed each ten steps.

One photograph a step, where its script shows all of them before each: so it learns more often.
"""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path

os.environ["KERAS_BACKEND"] = "torch"

import numpy as np
import torch  # noqa: TID253  # pyright: ignore[reportMissingImports]
from litesplat.core import CameraLayer, GaussianParameterLayer  # pyright: ignore[reportMissingImports]

from bench.training_peers.task import Floats, Task, Trained, nearest_distances, run_peer

SORT_EVERY = 10
PIXELS = 1024
"""Pixels that are drawn at once."""


def train(task: Task, trained: Trained) -> Floats:
    """Learns until the time is over, and shows the views."""
    torch.manual_seed(0)
    views = len(task.photographs)
    with tempfile.TemporaryDirectory() as folder:
        write_scene(task, Path(folder))
        gaussians = GaussianParameterLayer(folder)
        count = views + len(task.shown_poses)
        cameras = [CameraLayer(folder, gaussians, camera_index=number) for number in range(count)]
    # Its images are upside down.
    photographs, weights = torch.tensor(task.photographs).flip(1), torch.tensor(task.weights).flip(1)[..., None]
    optimizer = torch.optim.Adam(gaussians.parameters(), lr=1e-2)
    while trained.done < 1.0:
        number = int(torch.randint(views, ()))
        optimizer.zero_grad()
        image = cameras[number](inputs=task.size[::-1], batch_size=PIXELS, render=False)
        loss = (((image - photographs[number]) * weights[number]) ** 2).mean()
        loss.backward()
        optimizer.step()
        if trained.steps % SORT_EVERY == 0:
            for camera in cameras:
                camera.get_sorted_keys()
        trained.steps += 1
    with torch.no_grad():
        for camera in cameras:
            camera.get_sorted_keys()
        shown = [camera(inputs=task.size[::-1], batch_size=PIXELS, render=False) for camera in cameras[views:]]
        return np.stack([image.flip(0).cpu().numpy() for image in shown])


def write_scene(task: Task, folder: Path) -> None:
    """Writes the files that it reads. Its pixels are where ours have their corners, hence the halves."""
    width, height = task.size
    poses = np.concatenate([task.poses, task.shown_poses])
    intrinsics = np.concatenate([task.intrinsics, task.shown_intrinsics])
    cameras = [
        {
            "camera_id": number, "model": "PINHOLE", "image_name": "", "width": width, "height": height,
            "fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy + 0.5,
            "rotation": pose[:3, :3].tolist(), "translation": pose[:3, 3].tolist(),
        }
        for number, (pose, (fx, fy, cx, cy)) in enumerate(zip(poses, intrinsics.tolist(), strict=True))
    ]  # fmt: skip
    scales = nearest_distances(task.points).tolist()
    gaussians = [
        {"position": point, "color": color, "rotation": [1.0, 0.0, 0.0, 0.0], "scale": [scale] * 3, "opacity": 0.1}
        for point, color, scale in zip(task.points.tolist(), task.colors.tolist(), scales, strict=True)
    ]
    (folder / "camera.json").write_text(json.dumps(cameras))
    (folder / "gaussians.json").write_text(json.dumps(gaussians))


if __name__ == "__main__":
    run_peer(train)
