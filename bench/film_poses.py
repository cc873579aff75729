"""How near poses that are found from a film come to those it was filmed from: ``python -m bench.film_poses``.

    python -m bench.film_poses walk biker.compressed.ply walk.mp4          a capture in a patterned room, or --black
    python -m bench.film_poses photographs fox fox.mp4                     a folder with a transforms.json, 2 a second
    lumisplat frames walk.mp4 -o walk && lumisplat train walk -o walk.ply --poses colmap-film
    python -m bench.film_poses compare walk walk.mp4 walk.json             errors after a similarity, as a JSON object

The room, the walk twice around it and the shaking of the hand are made by formula; the extra ``video`` writes the film.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image

import lumisplat as ls

FPS, SECONDS, SIZE = 4, 45, (1280, 720)
"""Of the walk."""
ROOM, CEILING = 7.0, -6.0
"""Half the width of the room and the place of its ceiling, along y, which points down; the floor is at 0."""
TARGET = (-0.06, -1.4, 0.03)
"""What the camera points at."""


def main() -> None:
    """One of three commands."""
    options = argparse.ArgumentParser("film_poses", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    commands = options.add_subparsers(required=True)
    for name, run, arguments in (
        ("walk", walk, ("capture", "film")),
        ("photographs", photographs, ("folder", "film")),
        ("compare", compare, ("folder", "film", "truth")),
    ):
        command = commands.add_parser(name)
        command.set_defaults(run=run)
        for argument in arguments:
            command.add_argument(argument, type=Path)
    commands.choices["walk"].add_argument("--black", action="store_true", help="without the room")
    given: dict[str, Any] = vars(options.parse_args())
    chosen: Callable[..., None] = given.pop("run")
    chosen(**given)


def walk(capture: Path, film: Path, black: bool) -> None:
    """Films a capture, and writes where from beside the film."""
    gaussians = ls.load(capture)
    if not isinstance(gaussians, ls.Gaussians):
        raise SystemExit(f"{capture} is no capture")
    scene = ls.Scene([gaussians], [] if black else list(_room()))
    cameras = _cameras(FPS * SECONDS)
    ls.save_cameras(film.with_suffix(".json"), cameras)
    renderer = ls.create_renderer(ls.RenderConfig(lighting=False))
    _write(film, (np.rint(255.0 * renderer.render(scene, camera).color).astype(np.uint8) for camera in cameras), FPS)


def photographs(folder: Path, film: Path) -> None:
    """A film that shows each photograph of a transforms.json for half a second, and its cameras beside it."""
    cameras = sorted(ls.load_cameras(folder / "transforms.json"), key=lambda camera: camera.name)
    ls.save_cameras(film.with_suffix(".json"), cameras)
    pictures = (np.asarray(Image.open(folder / "images" / f"{camera.name}.jpg").convert("RGB")) for camera in cameras)
    _write(film, (picture for picture in pictures for _ in range(5)), 10)


def compare(folder: Path, film: Path, truth: Path) -> None:
    """Prints errors of positions, in per cent of the radius of the walk, and of directions, in degrees."""
    known = ls.load_cameras(truth)
    frames = _frame_of(folder / "images", film)
    found = ls.load_cameras(folder / "sparse" / "0")
    pairs = [(camera, known[int(frames[camera.name] * len(known))]) for camera in found]
    ours, theirs = (np.stack([pair[k].eye for pair in pairs]) for k in (0, 1))
    turn, scale = _similarity(ours, theirs)
    moved = scale * (ours - ours.mean(axis=0)) @ turn.T + theirs.mean(axis=0)
    radius = np.linalg.norm(theirs - theirs.mean(axis=0), axis=1).max()
    off = 100.0 * np.linalg.norm(moved - theirs, axis=1) / radius
    between = [a.camera_from_world[:3, :3] @ turn.T @ b.camera_from_world[:3, :3].T for a, b in pairs]
    angles = np.degrees([math.acos(min(0.5 * (np.trace(matrix) - 1.0), 1.0)) for matrix in between])
    row = {
        "placed": len(found),
        "photographs": len(frames),
        "position_percent": [round(float(np.median(off)), 3), round(float(off.max()), 3)],
        "direction_degrees": [round(float(np.median(angles)), 3), round(float(angles.max()), 3)],
        "focal": [round(found[0].fx, 1), round(known[0].fx, 1)],
    }
    print(json.dumps(row))


def _room() -> Iterator[ls.Mesh]:
    """A floor and four walls, each with a pattern of its own that has detail of all sizes."""
    r, c = ROOM, CEILING
    corners = (
        ((-r, 0, -r), (r, 0, -r), (r, 0, r), (-r, 0, r)),
        ((-r, c, -r), (r, c, -r), (r, 0, -r), (-r, 0, -r)),
        ((-r, c, r), (r, c, r), (r, 0, r), (-r, 0, r)),
        ((-r, c, -r), (-r, c, r), (-r, 0, r), (-r, 0, -r)),
        ((r, c, -r), (r, c, r), (r, 0, r), (r, 0, -r)),
    )
    for seed, positions in enumerate(corners, start=1):
        yield ls.Mesh(
            positions,
            [[0, 1, 2], [0, 2, 3]],
            uvs=[[0, 0], [1, 0], [1, 1], [0, 1]],
            material=ls.MaterialPbr(base_color=(1, 1, 1), roughness=1.0, base_color_texture=_pattern(seed)),
        )


def _pattern(seed: int, size: int = 1024) -> np.ndarray:
    """Noise of four sizes, rather grey, uint8, shape (size, size, 3)."""
    rng = np.random.default_rng(seed)
    total = np.zeros((size, size, 3))
    for cells, weight in ((8, 0.35), (32, 0.35), (128, 0.2), (512, 0.1)):
        colors = 0.25 * rng.uniform(size=(cells, cells, 3)) + 0.75 * rng.uniform(size=(cells, cells, 1))
        small = Image.fromarray((255.0 * colors).astype(np.uint8))
        how = Image.Resampling.NEAREST if cells == 8 else Image.Resampling.BICUBIC
        total += weight * np.asarray(small.resize((size, size), how), np.float64)
    return (1.5 * (total - 127.5) + 127.5).clip(0, 255).astype(np.uint8)


def _cameras(count: int) -> list[ls.Camera]:
    """Twice round, first level with what is filmed, then from above, with a shaking hand."""
    rng = np.random.default_rng(1)
    window = np.hanning(FPS + 2)[1:-1]
    noise = rng.normal(size=(count + FPS, 6))
    shake = np.stack([np.convolve(column, window / np.linalg.norm(window), "same")[:count] for column in noise.T], 1)
    time = np.arange(count) / count
    up = np.clip((time - 0.45) / 0.1, 0.0, 1.0)
    turn, height = 4.0 * np.pi * time, -1.5 - 1.7 * up * up * (3.0 - 2.0 * up)
    radius = 4.2 + 0.25 * np.sin(3.0 * turn)
    eyes = np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], axis=1) + 0.03 * shake[:, :3]
    targets = np.array(TARGET) + 0.06 * shake[:, 3:]
    width, height_px = SIZE
    return [
        ls.Camera.look_at(
            eye, target, (0, -1, 0), width=width, height=height_px, fov_y=math.radians(45.0), name=f"{k:04}"
        )
        for k, (eye, target) in enumerate(zip(eyes, targets, strict=True))
    ]


def _write(film: Path, pictures: Iterator[np.ndarray], fps: int) -> None:
    """Writes a film of pictures, uint8, shape (H, W, 3)."""
    with av.open(str(film), "w") as container:
        stream: Any = container.add_stream("libx264", rate=Fraction(fps), options={"crf": "18"})
        for number, picture in enumerate(pictures):
            if number == 0:
                stream.height, stream.width, stream.pix_fmt = *picture.shape[:2], "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def _frame_of(images: Path, film: Path) -> dict[str, Fraction]:
    """Which frame of a film each photograph is, the one most like it, as a share of the film, 0..1."""
    with av.open(str(film)) as container:
        frames = np.stack(
            [frame.to_ndarray(format="rgb24")[::8, ::8] for frame in container.decode(video=0)], dtype=np.float32
        )
    found: dict[str, Fraction] = {}
    for path in sorted(images.iterdir()):
        picture = np.asarray(Image.open(path).convert("RGB"), np.float32)[::8, ::8]
        nearest = int(np.abs(frames - picture).mean(axis=(1, 2, 3)).argmin())
        found[path.stem] = Fraction(nearest, len(frames))
    return found


def _similarity(points: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float]:
    """The rotation and the scale that bring centred points nearest to others (Umeyama 1991)."""
    a, b = points - points.mean(axis=0), target - target.mean(axis=0)
    u, sizes, v = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    return u @ np.diag(signs) @ v, float((sizes * signs).sum() / (a * a).sum())


if __name__ == "__main__":
    main()
