"""Writes tests/reference/mitsuba_path_*.npz: rooms of meshes by Mitsuba's path tracer.

The scenes are those of tests/support/scenes/path_rooms.py and Mitsuba's Cornell box, all by its integrator ``path``
with as many bounces as ours. The files have means of pixel tiles and their standard errors, estimated from frames of
different seeds.

Needs the extra ``bench`` and a libLLVM that Mitsuba accepts (Debian's ``libllvm19``); minutes on two cores::

    pip install -e '.[bench]' && python tools/make_mitsuba_path_reference.py [NAME...]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "tests"), str(REPOSITORY / "tools")]

from bench.mitsuba_peer import load_mitsuba  # noqa: E402
from make_mitsuba_light_reference import light_of, mesh_of, sensor_of  # noqa: E402

from support.compare.tile_means import tile_means  # noqa: E402
from support.scenes.path_rooms import BOUNCES, TILE, PathRoom, mild_environment, path_rooms  # noqa: E402

FRAMES = 16
SAMPLES = 256
"""Samples per frame: 4,096 in total."""


def main(names: list[str]) -> None:
    """Renders and stores the named rooms, or all."""
    mi = load_mitsuba()
    for name, room in path_rooms().items():
        if names and name not in names:
            continue
        scene = mi.load_dict(describe(mi, name, room))
        frames = [mi.render(scene, seed=mi.UInt32(seed)).numpy()[..., :3] for seed in range(FRAMES)]
        blocks = np.stack([tile_means(frame.astype(np.float64), TILE) for frame in frames])
        stored = {"blocks": blocks.mean(axis=0), "errors": blocks.std(axis=0, ddof=1) / np.sqrt(FRAMES)}
        path = REPOSITORY / "tests" / "reference" / f"mitsuba_path_{name}.npz"
        np.savez_compressed(path, **stored, made_with=f"mitsuba {mi.__version__}")
        print(f"{path}: errors up to {(stored['errors'] / stored['blocks']).max():.2%}", flush=True)


def describe(mi: Any, name: str, room: PathRoom, samples: int = SAMPLES) -> dict:
    """Returns Mitsuba's scene dictionary."""
    seen = {
        "integrator": {"type": "path", "max_depth": BOUNCES + 2},
        "sensor": sensor_of(mi, room.camera, samples),
    }
    if name == "cornell":
        return mi.cornell_box() | seen
    parts: dict = {"type": "scene"} | seen
    parts |= {f"mesh{i}": mesh_of(mi, instance.mesh) for i, instance in enumerate(room.scene.meshes)}
    return parts | {f"light{i}": light_of(mi, light, mild_environment) for i, light in enumerate(room.scene.lights)}


if __name__ == "__main__":
    main(sys.argv[1:])
